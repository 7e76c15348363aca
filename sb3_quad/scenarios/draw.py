"""What the episodes of a scenario start with, drawn from their seeds; the same for every controller and backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sb3_quad.scenarios.parts import Attitude, Draw, Wrench
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.simulation.tasks import Task
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]
_STREAM = 0x5B3  # so that these draws have nothing to do with those of the environment of the same seed


@dataclass(frozen=True, eq=False)
class DrawnWrench:
    """A wrench of n episodes: control steps ``first`` to ``last - 1``, values (n, 12) as of the environments (N, N m)."""

    first: int
    last: int
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Episodes:
    """n episodes of a scenario, before anybody flies them.

    :param seeds: of the environments, (n,).
    :param task: what the environment draws itself; random targets and attitudes are thus those of training.
    :param start: what replaces its draw: any of position, quaternion, velocity, body_rates, target; (n, 3) or (n, 4).
    :param waypoints: (W, 3), m; W = 0 where there is a single target.
    :param radius: within which a waypoint is reached, m.
    :param steps: control steps of an episode.
    """

    seeds: Sequence[int]
    task: Task
    start: dict[str, FloatArray]
    wrenches: tuple[DrawnWrench, ...]
    waypoints: FloatArray
    radius: float
    vehicle: Vehicle
    noise: float
    steps: int


def draw_episodes(scenario: Scenario, seeds: Sequence[int] | None = None, factors: FloatArray | None = None) -> Episodes:
    """The episodes of a scenario.

    :param seeds: one for each; None: the scenario's own.
    :param factors: of the wrenches of each episode, (n,); None: 1.
    """
    chosen = range(scenario.seed, scenario.seed + scenario.episodes) if seeds is None else seeds
    n, vehicle, start = len(chosen), scenario.flown_vehicle(), scenario.start
    generators = _Generators(chosen)
    replaced: dict[str, FloatArray] = {}
    if start.attitude.distribution is None:
        replaced["quaternion"] = _attitudes(start.attitude, generators)
    for name, draw in (("velocity", start.velocity), ("body_rates", start.body_rates)):
        if draw.std is None:
            replaced[name] = _vectors(draw, generators)
    points = scenario.target.points
    if points:
        replaced["target"] = np.tile(np.array(points[0]), (n, 1))
    scale = np.ones(n) if factors is None else np.asarray(factors, dtype=np.float64)
    return Episodes(
        seeds=chosen,
        task=_task(scenario),
        start=replaced,
        wrenches=tuple(_wrench(each, generators, scale, scenario, vehicle) for each in scenario.wrenches),
        waypoints=np.array(scenario.target.waypoints or np.zeros((0, 3)), dtype=np.float64),
        radius=scenario.target.switching_radius,
        vehicle=vehicle,
        noise=scenario.noise,
        steps=round(scenario.duration / vehicle.control_step),
    )


def _task(scenario: Scenario) -> Task:
    start = scenario.start
    return Task(
        name="scenario",
        start_position=start.position,
        target_distance=scenario.target.distance or 0.0,
        random_attitude=start.attitude.distribution == "uniform",
        velocity_std=start.velocity.std or 0.0,
        body_rates_std=start.body_rates.std or 0.0,
        max_distance=scenario.max_distance,
    )


class _Generators:
    """A generator for each episode, made when the first random number is wanted."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self.n, self._seeds = len(seeds), seeds
        self._made: list[np.random.Generator] | None = None

    def normals(self, size: int) -> FloatArray:
        """(n, size) numbers of N(0, 1)."""
        if self._made is None:
            self._made = [np.random.default_rng([_STREAM, seed]) for seed in self._seeds]
        return np.stack([generator.standard_normal(size) for generator in self._made])

    def directions(self, size: int) -> FloatArray:
        """(n, size) vectors of length 1, uniform."""
        normals = self.normals(size)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _vectors(draw: Draw, generators: _Generators) -> FloatArray:
    if draw.value is not None:
        return np.tile(np.array(draw.value), (generators.n, 1))
    if draw.magnitude is not None:
        return draw.magnitude * generators.directions(3) if draw.magnitude > 0 else np.zeros((generators.n, 3))
    return (draw.std or 0.0) * generators.normals(3)


def _attitudes(attitude: Attitude, generators: _Generators) -> FloatArray:
    if attitude.quaternion is not None:
        quaternion = np.array(attitude.quaternion)
        return np.tile(quaternion / np.linalg.norm(quaternion), (generators.n, 1))
    half = np.deg2rad(attitude.tilt or 0.0) / 2.0
    if half == 0.0:
        return np.tile([1.0, 0.0, 0.0, 0.0], (generators.n, 1))
    axis = generators.directions(2)
    return np.column_stack([np.full(generators.n, np.cos(half)), np.sin(half) * axis, np.zeros(generators.n)])


def _wrench(wrench: Wrench, generators: _Generators, scale: FloatArray, scenario: Scenario, vehicle: Vehicle) -> DrawnWrench:
    first = round(wrench.start / vehicle.control_step)
    length = scenario.duration if wrench.duration is None else wrench.duration
    values = np.zeros((generators.n, 12))
    for draw, frame, column in ((wrench.force, wrench.force_frame, 0), (wrench.torque, wrench.torque_frame, 6)):
        column += 3 if frame == "body" else 0
        values[:, column : column + 3] = scale[:, None] * _vectors(draw, generators)
    return DrawnWrench(first, first + max(1, round(length / vehicle.control_step)), values)


def wrench_changes(wrenches: Sequence[DrawnWrench], steps: int) -> dict[int, FloatArray]:
    """From the control steps before which the sum of the wrenches changes to the new sum, (n, 12)."""
    times = sorted({time for each in wrenches for time in (each.first, each.last) if time < steps})
    return {
        time: sum((each.values for each in wrenches if each.first <= time < each.last), np.zeros_like(wrenches[0].values))
        for time in times
    }
