"""Flying a controller over fresh episodes, and what is measured on the true state along the way.

Conventions, found by the expert's numbers in the thesis (4.3.1): the time to a tolerance is the end
of the first control step after which |r - r_T| is within it; the path is that of the whole episode,
15 s, not of the way until arrival.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.base.errors import ConfigError, ControllerError, unknown
from sb3_quad.base.seeds import row_seeds
from sb3_quad.controllers.controller import Controller
from sb3_quad.envs.batch_env import quadcopter_spaces
from sb3_quad.evaluation.fleets import FLEETS, Fleet
from sb3_quad.evaluation.scenarios.sample import Plan
from sb3_quad.simulation import MAX_EPISODE_STEPS
from sb3_quad.simulation.settings import FlightSettings, known_layout
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle

TOLERANCES = (0.1, 0.2, 0.5, 1.0)  # m
NEAR = 0.1  # m, of arrival, where it is among the tolerances; else the tightest is
ACTIONS = quadcopter_spaces()[1]
TILT, RATE, HOLD = (
    np.radians(45.0),
    2.0,
    0.2,
)  # stable: tilt (rad), roll and pitch rate (rad/s) below these, for so long (s)


@dataclass(frozen=True, eq=False)
class Flights:
    """The metrics of n episodes, one per row."""

    # : (n,), survived, and ended at the (last) target: success_distance and success_tilt of the
    # task
    success: BoolArray
    survival: BoolArray  #: (n,), neither collision nor out of range: the thesis's success
    collision: BoolArray  #: (n,), the ground was touched
    reward: FloatArray  #: (n,), sum of the rewards
    length: IntArray  #: (n,), control steps
    flown: FloatArray  #: (n,), s until lost or the end
    # : By tolerance (m): s until |r - r_T| is first within it, (n,), NaN if it never was; of a
    # course, to the last waypoint.
    time_to: Mapping[float, FloatArray]
    # : By tolerance: s after which it stays within it to the end, (n,), NaN if it ends outside or
    # was lost.
    settling_time: Mapping[float, FloatArray]
    # : (n,), largest |r - r_T| since it was first within NEAR, m; NaN if it never was
    overshoot: FloatArray
    path_length: FloatArray  #: (n,), m, over the whole episode
    final_error: FloatArray  #: (n,), |r - r_T| at the end, m
    final_offset: (
        FloatArray  #: (n, 3), r - r_T at the end, world frame, m; NaN where the flight was lost
    )
    recovery_time: FloatArray  #: (n,), s until it was stable again, NaN if it never was, see Motion
    # : (n,), largest distance from the straight way to the target, m; NaN where there is none
    cross_track_error: FloatArray
    # : (n, W), s until each waypoint was reached, NaN if it never was; W = 0 without waypoints
    waypoint_times: FloatArray
    # : (n, 13), position, quaternion (w, x, y, z; body to world), velocity (world), body rates
    # (body); SI
    start: FloatArray
    target: FloatArray  #: (n, 3), the first target, m

    @property
    def n(self) -> int:
        """Number of episodes."""
        return int(self.success.size)

    @staticmethod
    def concatenate(parts: Sequence["Flights"]) -> "Flights":
        """Several parts as one, in order."""
        columns: dict[str, Any] = {}
        for name in (entry.name for entry in dataclasses.fields(Flights)):
            values: list[Any] = [getattr(part, name) for part in parts]
            if isinstance(values[0], Mapping):
                columns[name] = {
                    key: np.concatenate([value[key] for value in values]) for key in values[0]
                }
            else:
                columns[name] = np.concatenate(values)
        return Flights(**columns)


def arrival_tolerance(tolerances: Iterable[float]) -> float:
    """The tolerance, m, by which overshoot and the time to stay are judged."""
    known = [*tolerances]
    return NEAR if NEAR in known else min(known)


class Hook:
    """What is done along a flight; a subclass writes what it needs."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        """The state that the flights start in."""

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        """The state before a control step, its observations (n, 18), the wrench (n, WRENCH_SIZE)
        during it, who flies (n,).
        """

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        """The state after control step ``step``, the actions (n, 4) that led to it, and the flights
        (n,) that go on.
        """


def fly(
    controller: Any,
    task: Any = "target_tracking",
    n_episodes: int = 240,
    seed: int = 0,
    vehicle: str | Vehicle = "itm",
    noise: float = 0.05,
    backend: str = "batch",
    max_steps: int = MAX_EPISODE_STEPS,
    tolerances: Sequence[float] = TOLERANCES,
    hooks: Sequence[Hook] = (),
    **environment: Any,
) -> Flights:
    """Fly ``n_episodes`` episodes; number k is the first one of the environment reset with
    ``row_seeds(seed, n_episodes)[k]`` (:func:`~sb3_quad.base.seeds.row_seeds`).

    :param controller: an expert, asked by ``actions(state)`` for the true state; an SB3 model,
        asked by ``predict(observation, deterministic=True)``; or a function from observations (n,
        18) to actions (n, 4).
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``vehicle``,
        ``noise`` and ``environment``: ``task_kwargs``, ``observation_std`` and
        ``observation_mean``. A model that says on which vehicle it was trained flies in that one's
        ``rotor_layout``, unless another is given here.
    :param backend: ``batch``, or ``pybullet`` for the reference.
    :param max_steps: control steps of an episode that nothing ends before.
    :param tolerances: of arrival, |r - r_T|, m.
    :param hooks: are called along the way.
    :raises ConfigError: an unknown backend or keyword, fewer than one episode, or a controller that
        is none of the three.
    :raises ControllerError: a controller that fails in flight.
    """
    if n_episodes < 1:
        raise ConfigError(f"n_episodes {n_episodes}: must be at least 1")
    environment |= {
        "task": task,
        "vehicle": vehicle,
        "noise": noise,
        "max_episode_steps": max_steps,
    }
    if environment.get("rotor_layout") is None:
        environment["rotor_layout"] = known_layout(controller)
    settings = FlightSettings().with_changes(**environment)
    return fly_settings(
        controller, settings, row_seeds(seed, n_episodes), backend, tolerances, hooks
    )


def fly_settings(
    controller: Any,
    settings: FlightSettings,
    seeds: Sequence[int],
    backend: str = "batch",
    tolerances: Sequence[float] = TOLERANCES,
    hooks: Sequence[Hook] = (),
    plan: Plan | None = None,
    deterministic: bool = True,
) -> Flights:
    """As :func:`fly`, by one record of how the episodes are flown: the first episode of each seed.

    :param plan: what happens to the episodes along the way.
    :param deterministic: whether a policy gives the mean of its actions, or a sample.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    with closing(FLEETS[backend](seeds, settings)) as fleet:
        spaces = ACTIONS, quadcopter_spaces(fleet.observation_size)[0]
        asked = Controller(controller, *spaces, fleet.true_state, deterministic=deterministic)
        return _fly_fleet(fleet, asked, plan or Plan(), settings.longest_episode, tolerances, hooks)


def _fly_fleet(
    fleet: Fleet,
    controller: Controller,
    plan: Plan,
    max_steps: int,
    tolerances: Sequence[float],
    hooks: Sequence[Hook],
) -> Flights:
    observation = fleet.reset(plan.start)
    n, control_step, count = len(observation), fleet.vehicle.control_step, len(plan.waypoints)
    state = fleet.true_state()
    position, error = state.position.copy(), state.distance
    motion = Motion(state, control_step)
    limits = np.array(tolerances)[:, None]
    waypoint, on_last = np.zeros(n, dtype=np.int64), np.full(n, count <= 1)
    times = np.where((error <= limits) & on_last, 0.0, np.nan)
    stays = times.copy()
    first = (
        times[[*tolerances].index(arrival_tolerance(tolerances))]
        if len(limits)
        else np.full(n, np.nan)
    )  # a view
    flights = Flights(
        success=np.zeros(n, dtype=np.bool_),
        survival=np.ones(n, dtype=np.bool_),
        collision=np.zeros(n, dtype=np.bool_),
        reward=np.zeros(n),
        length=np.zeros(n, dtype=np.int64),
        flown=np.zeros(n),
        time_to=dict(zip(tolerances, times, strict=True)),
        settling_time=dict(zip(tolerances, stays, strict=True)),
        overshoot=np.where(np.isnan(first), np.nan, error),
        path_length=np.zeros(n),
        final_error=error.copy(),
        final_offset=np.full((n, 3), np.nan),
        recovery_time=motion.recovery_time,
        cross_track_error=motion.cross_track_error if count == 0 else np.full(n, np.nan),
        waypoint_times=np.full((n, count), np.nan),
        start=np.hstack([state.position, state.quaternion, state.velocity, state.body_rates]),
        target=state.target.copy(),
    )
    flying = flights.survival  # until it is lost
    for hook in hooks:
        hook.on_start(state, fleet.vehicle)

    for step in range(1, max_steps + 1):
        if step - 1 in plan.wrenches:
            fleet.set_wrench(plan.wrenches[step - 1])
        try:
            actions = controller.actions(observation, flying)
        except ControllerError as failed:
            raise ControllerError(f"{failed}, after {(step - 1) * control_step:.2f} s") from failed
        for hook in hooks:
            hook.before_step(state, observation, fleet.wrench, flying)
        observation, step_reward, lost, collided, error, arrived = fleet.step(actions, flying)
        state = fleet.true_state()
        flights.reward[flying] += step_reward[flying]
        flights.path_length[flying] += np.linalg.norm(state.position - position, axis=1)[flying]
        position = state.position.copy()
        flights.final_error[flying], flights.success[flying] = error[flying], arrived[flying]
        flights.length[flying], flights.flown[flying] = step, step * control_step
        within = (error <= limits) & on_last
        times[np.isnan(times) & within & flying] = step * control_step
        stays[~within & flying] = np.nan
        stays[np.isnan(stays) & within & flying] = step * control_step
        after = flying & ~np.isnan(first)
        flights.overshoot[after] = np.fmax(flights.overshoot, error)[after]
        flights.collision[flying & lost & collided] = True
        flying &= ~lost
        motion.see(step, state, flying)
        for hook in hooks:
            hook.after_step(step, state, actions, flying)
        if not flying.any():
            break
        if count:
            reached = np.flatnonzero(flying & (waypoint < count) & (error <= plan.radius))
            flights.waypoint_times[reached, waypoint[reached]] = step * control_step
            waypoint[reached] += 1
            on_last |= waypoint >= count - 1
            onward = reached[waypoint[reached] < count]
            if onward.size:
                observation = fleet.set_targets(onward, plan.waypoints[waypoint[onward]])
    flights.success[~(flying & on_last)] = False
    stays[:, ~flying] = np.nan
    flights.final_offset[flying] = (state.position - state.target)[flying]
    return flights


class Motion:
    """Watches n flights, step by step.

    ``recovery_time`` (n,): s until the tilt has come below 45° and the turning about the body's x and
    y axes below 2 rad/s, both for 0.2 s at least, of which the beginning counts; NaN if that never
    was. The thesis reads such a time from Fig. 4.9. ``cross_track_error`` (n,): the largest distance from
    the straight line through start and target, m, on the way and beyond: the oscillations of 4.3.1;
    NaN where both are one point.

    :param state: at the start.
    :param control_step: s.
    """

    def __init__(self, state: QuadcopterState, control_step: float) -> None:
        way = state.target - state.position
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self._start, self._control_step = state.position.copy(), control_step
        self._direction = np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)
        self._since = np.zeros(state.n)  # when the present stable time began
        self._stable = np.ones(state.n, dtype=np.bool_)
        self.recovery_time = np.full(state.n, np.nan)
        self.cross_track_error = np.where(length[:, 0] > 0.0, 0.0, np.nan)
        self.see(0, state, np.ones(state.n, dtype=np.bool_))

    def see(self, step: int, state: QuadcopterState, flying: BoolArray) -> None:
        """The state after control step ``step``; only flights (n,) that go on count."""
        time, before = step * self._control_step, self._stable
        x, y = state.quaternion.T[1:3]
        upright = 1.0 - 2.0 * (x * x + y * y) > np.cos(TILT)
        self._stable = upright & (np.hypot(*state.body_rates.T[:2]) < RATE)
        self._since[self._stable & ~before] = time
        held = flying & self._stable & (time - self._since > HOLD - 0.5 * self._control_step)
        new = held & np.isnan(self.recovery_time)
        self.recovery_time[new] = self._since[new]
        flown = state.position - self._start
        beside = np.linalg.norm(
            flown - (flown * self._direction).sum(axis=1, keepdims=True) * self._direction, axis=1
        )
        self.cross_track_error[flying] = np.maximum(self.cross_track_error, beside)[flying]
