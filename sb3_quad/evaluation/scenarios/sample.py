"""Sample the events of a scenario's episodes from their seeds, the same for every controller and
backend.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.seeds import SCENARIO_STREAM
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import WRENCH_SIZE, make_wrench, rotation_matrices
from sb3_quad.evaluation.scenarios.parts import Attitude, VectorDistribution
from sb3_quad.evaluation.scenarios.scenario import Scenario

Generators = Sequence[np.random.Generator]  # one for each episode


class Plan(NamedTuple):
    """The events of n episodes, which do not depend on who flies them.

    :param start: replaces what the environments sample: any of position, quaternion, velocity,
        body_rates, target; (n, 3) or (n, 4).
    :param wrenches: external wrenches (n, WRENCH_SIZE) by the control step from which they act.
    :param waypoints: targets one after the other, (W, 3), m; ``start`` holds the first as its
        target.
    :param radius: the next waypoint becomes the target once |r - r_T| is within this, m.
    """

    start: Mapping[str, FloatArray] = {}
    wrenches: Mapping[int, FloatArray] = {}
    waypoints: FloatArray = np.zeros((0, 3))
    radius: float = 0.5


def sample_plan(scenario: Scenario, seeds: Sequence[int]) -> Plan:
    """Sample the events of some episodes of a scenario, beyond those that its task samples.

    :param seeds: seeds of the episodes, (n,).
    """
    generators = [np.random.default_rng([SCENARIO_STREAM, seed]) for seed in seeds]
    attitude = scenario.start.attitude
    target = scenario.target
    start = {}
    # The task samples uniform attitudes and normal velocities itself.
    if attitude.distribution is None:
        start["quaternion"] = _quaternions(attitude, generators)
    for name in ("velocity", "body_rates"):
        distribution = getattr(scenario.start, name)
        if distribution.std is None:
            start[name] = _vectors(distribution, generators)
    if scenario.start.velocity_frame == "body":
        rotation = rotation_matrices(start["quaternion"])
        start["velocity"] = np.einsum("nij,nj->ni", rotation, start["velocity"])
    if target.points:
        start["target"] = np.tile(target.points[0], (len(seeds), 1))
    wrenches = sample_wrenches(scenario, generators)
    return Plan(start, wrenches, np.array(target.waypoints or ()).reshape(-1, 3), target.radius)


def sample_wrenches(scenario: Scenario, generators: Generators) -> dict[int, FloatArray]:
    """Add up the wrenches of a scenario over the time of n episodes, for a :class:`Plan`."""
    vehicle = scenario.nominal_vehicle()
    acting = []
    times = set[int]()
    for wrench in scenario.wrenches:
        # A wrench acts for whole control steps.
        first = round(wrench.start / vehicle.control_step)
        last = first + scenario.steps
        if wrench.duration is not None:
            last = first + round(wrench.duration / vehicle.control_step)
        newton, newton_metre = wrench.units(vehicle)
        force = newton * _vectors(wrench.force, generators)
        torque = newton_metre * _vectors(wrench.torque, generators)
        values = make_wrench(force, torque, wrench.force_frame, wrench.torque_frame).T
        acting.append((range(first, last), wrench.factor * values))
        times |= {first, last}
    # The sum changes only where a wrench begins or ends.
    sums = {}
    for time in sorted(times & {*range(scenario.steps)}):
        sums[time] = np.zeros((len(generators), WRENCH_SIZE))
        for when, values in acting:
            if time in when:
                sums[time] += values
    return sums


def _vectors(distribution: VectorDistribution, generators: Generators) -> FloatArray:
    if distribution.value is not None:
        return np.tile(distribution.value, (len(generators), 1))
    if distribution.std is not None:
        return distribution.std * _normals(generators, 3)
    # Nothing is drawn for a magnitude of zero.
    if not distribution.magnitude:
        return np.zeros((len(generators), 3))
    return distribution.magnitude * _directions(generators, 3)


def _quaternions(attitude: Attitude, generators: Generators) -> FloatArray:
    n = len(generators)
    if attitude.quaternion is not None:
        quaternion = np.array(attitude.quaternion)
        return np.tile(quaternion / np.linalg.norm(quaternion), (n, 1))
    if not attitude.tilt:
        return np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    # A turn by the tilt about a random horizontal axis.
    half = np.deg2rad(attitude.tilt) / 2.0
    axis = _directions(generators, 2)
    return np.column_stack([np.full(n, np.cos(half)), np.sin(half) * axis, np.zeros(n)])


def _directions(generators: Generators, size: int) -> FloatArray:
    """(n, size) vectors of length 1, uniform."""
    normals = _normals(generators, size)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _normals(generators: Generators, size: int) -> FloatArray:
    """(n, size) numbers of N(0, 1)."""
    return np.stack([generator.standard_normal(size) for generator in generators])
