"""What the episodes of a scenario start with, sampled from their seeds; the same for every controller and backend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.seeds import SCENARIO_STREAM
from sb3_quad.scenarios.parts import Attitude, VectorDistribution, Wrench
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.simulation.tasks import Task
from sb3_quad.vehicles.vehicle import Vehicle


@dataclass(frozen=True, eq=False)
class Episodes:
    """n episodes of a scenario, before anybody flies them.

    :param seeds: of the environments, (n,).
    :param task: what the environment samples itself; random targets and attitudes are thus those of training.
    :param start: what replaces its sample: any of position, quaternion, velocity, body_rates, target; (n, 3) or (n, 4).
    :param wrenches: see :func:`sample_wrenches`.
    :param waypoints: (W, 3), m; W = 0 where there is a single target.
    :param radius: within which a waypoint is reached, m.
    :param steps: control steps of an episode.
    """

    seeds: Sequence[int]
    task: Task
    start: dict[str, FloatArray]
    wrenches: Mapping[int, FloatArray]
    waypoints: FloatArray
    radius: float
    vehicle: Vehicle
    noise: float
    steps: int


def sample_episodes(scenario: Scenario, seeds: Sequence[int] | None = None, factors: FloatArray | None = None) -> Episodes:
    """The episodes of a scenario.

    :param seeds: one for each; None: the scenario's own.
    :param factors: of the wrenches of each episode, (n,); None: 1.
    """
    chosen = range(scenario.seed, scenario.seed + scenario.episodes) if seeds is None else seeds
    vehicle, start, points = scenario.flown_vehicle(), scenario.start, scenario.target.points
    generators = Generators(chosen)
    steps = round(scenario.duration / vehicle.control_step)
    replaced: dict[str, FloatArray] = {}
    if start.attitude.distribution is None:
        replaced["quaternion"] = _quaternions(start.attitude, generators)
    for name, distribution in (("velocity", start.velocity), ("body_rates", start.body_rates)):
        if distribution.std is None:
            replaced[name] = _vectors(distribution, generators)
    if points:
        replaced["target"] = np.tile(np.array(points[0]), (len(chosen), 1))
    task = Task(
        name="scenario",
        start_position=start.position,
        target_distance=scenario.target.distance or 0.0,
        random_attitude=start.attitude.distribution == "uniform",
        velocity_std=start.velocity.std or 0.0,
        body_rates_std=start.body_rates.std or 0.0,
        max_distance=scenario.max_distance,
    )
    return Episodes(
        seeds=chosen,
        task=task,
        start=replaced,
        wrenches=sample_wrenches(scenario.wrenches, vehicle, steps, generators, factors),
        waypoints=np.array(scenario.target.waypoints or np.zeros((0, 3)), dtype=np.float64),
        radius=scenario.target.switching_radius,
        vehicle=vehicle,
        noise=scenario.noise,
        steps=steps,
    )


class Generators:
    """A random generator for each of n episodes, made when the first random number is wanted.

    :param seeds: of the episodes, (n,).
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        self.n, self._seeds = len(seeds), seeds

    @cached_property
    def _generators(self) -> list[np.random.Generator]:
        return [np.random.default_rng([SCENARIO_STREAM, seed]) for seed in self._seeds]

    def normals(self, size: int) -> FloatArray:
        """(n, size) numbers of N(0, 1)."""
        return np.stack([generator.standard_normal(size) for generator in self._generators])

    def directions(self, size: int) -> FloatArray:
        """(n, size) vectors of length 1, uniform."""
        normals = self.normals(size)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def sample_wrenches(
    wrenches: Sequence[Wrench], vehicle: Vehicle, steps: int, generators: Generators, factors: npt.ArrayLike | None = None
) -> dict[int, FloatArray]:
    """The sum of some wrenches over the time of n episodes.

    :param steps: control steps of an episode.
    :param factors: of the wrenches of each episode, (n,); None: 1.
    :return: from the control steps before which the sum changes to the new sum, (n, 12), as of the environments: force in
        the world and in the body frame, N; torque in the world and in the body frame, N m.
    """
    acting = []
    for wrench in wrenches:
        first = round(wrench.start / vehicle.control_step)
        length = steps if wrench.duration is None else max(1, round(wrench.duration / vehicle.control_step))
        values = np.zeros((generators.n, 12))
        for distribution, frame, column in ((wrench.force, wrench.force_frame, 0), (wrench.torque, wrench.torque_frame, 6)):
            column += 3 if frame == "body" else 0
            values[:, column : column + 3] = _vectors(distribution, generators)
        acting.append((first, first + length, values if factors is None else np.asarray(factors)[:, None] * values))
    times = sorted({time for first, last, _ in acting for time in (first, last) if time < steps})
    none = np.zeros((generators.n, 12))
    return {time: sum((values for first, last, values in acting if first <= time < last), none) for time in times}


def _vectors(distribution: VectorDistribution, generators: Generators) -> FloatArray:
    if distribution.value is not None:
        return np.tile(np.array(distribution.value), (generators.n, 1))
    if distribution.magnitude is None:
        return (distribution.std or 0.0) * generators.normals(3)
    return distribution.magnitude * generators.directions(3) if distribution.magnitude > 0 else np.zeros((generators.n, 3))


def _quaternions(attitude: Attitude, generators: Generators) -> FloatArray:
    if attitude.quaternion is not None:
        quaternion = np.array(attitude.quaternion)
        return np.tile(quaternion / np.linalg.norm(quaternion), (generators.n, 1))
    half = np.deg2rad(attitude.tilt or 0.0) / 2.0
    if half == 0.0:
        return np.tile([1.0, 0.0, 0.0, 0.0], (generators.n, 1))
    axis = generators.directions(2)
    return np.column_stack([np.full(generators.n, np.cos(half)), np.sin(half) * axis, np.zeros(generators.n)])
