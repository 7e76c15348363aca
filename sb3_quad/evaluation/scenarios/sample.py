"""Sample the events of a scenario's episodes from their seeds, the same for every controller."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.seeds import SCENARIO_STREAM
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.batch_env import Vector
from sb3_quad.envs.simulation.state import WRENCH_SIZE, make_wrench, rotation_matrices
from sb3_quad.evaluation.scenarios.events import RandomDirection, Start
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
    begun = scenario.start
    start = {}
    if begun.sets_attitude:
        start["quaternion"] = _quaternions(begun, generators)
    if begun.velocity is not None:
        start["velocity"] = _vectors(begun.velocity, generators)
    if begun.body_rates is not None:
        start["body_rates"] = _vectors(begun.body_rates, generators)
    if begun.velocity_frame == "body":
        rotation = rotation_matrices(start["quaternion"])
        start["velocity"] = np.einsum("nij,nj->ni", rotation, start["velocity"])
    if scenario.targets:
        start["target"] = np.tile(scenario.targets[0], (len(seeds), 1))
    return Plan(
        start,
        sample_wrenches(scenario, generators),
        np.array(scenario.waypoints).reshape(-1, 3),
        scenario.waypoint_radius,
    )


def sample_wrenches(scenario: Scenario, generators: Generators) -> dict[int, FloatArray]:
    """Add up the wrenches of a scenario over the time of n episodes, for a :class:`Plan`."""
    control_step = scenario.nominal_vehicle().control_step
    acting = []
    times = set[int]()
    for wrench in scenario.wrenches:
        when = wrench.steps(control_step, scenario.steps)
        force = _vectors(wrench.force, generators)
        torque = _vectors(wrench.torque, generators)
        values = make_wrench(force, torque, wrench.force_frame, wrench.torque_frame).T
        acting.append((when, wrench.factor * values))
        times |= {when.start, when.stop}
    # The sum changes only where a wrench begins or ends.
    sums = {}
    for time in sorted(times & {*range(scenario.steps)}):
        sums[time] = np.zeros((len(generators), WRENCH_SIZE))
        for when, values in acting:
            if time in when:
                sums[time] += values
    return sums


def _vectors(given: Vector | RandomDirection, generators: Generators) -> FloatArray:
    if not isinstance(given, RandomDirection):
        return np.tile(given, (len(generators), 1))
    # Nothing is drawn for a magnitude of zero.
    if not given.magnitude:
        return np.zeros((len(generators), 3))
    return given.magnitude * _directions(generators, 3)


def _quaternions(start: Start, generators: Generators) -> FloatArray:
    n = len(generators)
    if start.quaternion is not None:
        quaternion = np.array(start.quaternion)
        return np.tile(quaternion / np.linalg.norm(quaternion), (n, 1))
    if not start.tilt:
        return np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    # A turn by the tilt about a random horizontal axis.
    half = np.deg2rad(start.tilt) / 2.0
    axis = _directions(generators, 2)
    return np.column_stack([np.full(n, np.cos(half)), np.sin(half) * axis, np.zeros(n)])


def _directions(generators: Generators, size: int) -> FloatArray:
    """(n, size) vectors of length 1, uniform."""
    normals = np.stack([generator.standard_normal(size) for generator in generators])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
