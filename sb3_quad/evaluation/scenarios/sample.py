"""What happens in the episodes of a scenario, sampled from their seeds; the same for every
controller and backend.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.seeds import SCENARIO_STREAM
from sb3_quad.evaluation.scenarios.parts import Attitude, VectorDistribution, Wrench
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.simulation.state import WRENCH_SIZE, make_wrench, rotation_matrices
from sb3_quad.vehicles.vehicle import Vehicle

Generators = Sequence[np.random.Generator]  # one for each episode


@dataclass(frozen=True, eq=False)
class Plan:
    """What happens to n episodes whoever flies them.

    :param start: what replaces the environments' own sample: any of position, quaternion, velocity,
        body_rates, target; (n, 3) or (n, 4).
    :param wrenches: from the control steps before which the external wrench changes to the new one,
        (n, WRENCH_SIZE).
    :param waypoints: targets one after the other, (W, 3), m; ``start`` holds the first as its
        target.
    :param radius: the next waypoint becomes the target once |r - r_T| is within this, m.
    """

    start: Mapping[str, FloatArray] = field(default_factory=dict)
    wrenches: Mapping[int, FloatArray] = field(default_factory=dict)
    waypoints: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    radius: float = 0.5


def sample_plan(scenario: Scenario, seeds: Sequence[int]) -> Plan:
    """What happens in some episodes of a scenario, beyond what its task samples.

    :param seeds: of the episodes, (n,).
    """
    generators = [np.random.default_rng([SCENARIO_STREAM, seed]) for seed in seeds]
    attitude, target = scenario.start.attitude, scenario.target
    start: dict[str, FloatArray] = {}
    if attitude.distribution is None:
        start["quaternion"] = _quaternions(attitude, generators)
    for name in ("velocity", "body_rates"):
        distribution = getattr(scenario.start, name)
        if distribution.std is None:
            start[name] = _vectors(distribution, generators)
    if scenario.start.velocity_frame == "body":
        start["velocity"] = np.einsum(
            "nij,nj->ni", rotation_matrices(start["quaternion"]), start["velocity"]
        )
    if target.points:
        start["target"] = np.tile(np.array(target.points[0]), (len(seeds), 1))
    wrenches = sample_wrenches(
        scenario.wrenches, scenario.nominal_vehicle(), scenario.steps, generators
    )
    return Plan(
        start,
        wrenches,
        np.array(target.waypoints or np.zeros((0, 3))),
        target.radius or Plan.radius,
    )


def sample_wrenches(
    wrenches: Sequence[Wrench], vehicle: Vehicle, steps: int, generators: Generators
) -> dict[int, FloatArray]:
    """The sum of some wrenches over the time of n episodes, as a :class:`Plan` holds it.

    :param vehicle: gives the control step, and weights their size.
    :param steps: control steps of an episode.
    """
    acting = []
    for wrench in wrenches:
        first = round(wrench.start / vehicle.control_step)
        length = (
            steps
            if wrench.duration is None
            else max(1, round(wrench.duration / vehicle.control_step))
        )
        newton, newton_metre = wrench.units(vehicle)
        vectors = (
            newton * _vectors(wrench.force, generators),
            newton_metre * _vectors(wrench.torque, generators),
        )
        values = make_wrench(*vectors, wrench.force_frame, wrench.torque_frame).T
        acting.append((first, first + length, wrench.factor * values))
    times = sorted({time for first, last, _ in acting for time in (first, last) if time < steps})
    none = np.zeros((len(generators), WRENCH_SIZE))
    return {
        time: sum((values for first, last, values in acting if first <= time < last), none)
        for time in times
    }


def _vectors(distribution: VectorDistribution, generators: Generators) -> FloatArray:
    if distribution.value is not None:
        return np.tile(np.array(distribution.value), (len(generators), 1))
    if distribution.magnitude is None:
        return (distribution.std or 0.0) * _normals(generators, 3)
    return distribution.magnitude * (
        _directions(generators, 3) if distribution.magnitude else np.zeros((len(generators), 3))
    )


def _quaternions(attitude: Attitude, generators: Generators) -> FloatArray:
    n = len(generators)
    if attitude.quaternion is not None:
        quaternion = np.array(attitude.quaternion)
        return np.tile(quaternion / np.linalg.norm(quaternion), (n, 1))
    half = np.deg2rad(attitude.tilt or 0.0) / 2.0
    if half == 0.0:
        return np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    axis = _directions(generators, 2)
    return np.column_stack([np.full(n, np.cos(half)), np.sin(half) * axis, np.zeros(n)])


def _directions(generators: Generators, size: int) -> FloatArray:
    """(n, size) vectors of length 1, uniform."""
    normals = _normals(generators, size)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _normals(generators: Generators, size: int) -> FloatArray:
    """(n, size) numbers of N(0, 1)."""
    return np.stack([generator.standard_normal(size) for generator in generators])
