"""Flying a controller over fresh episodes, and what is measured on the true state meanwhile.

Conventions, found by the expert's figures in the thesis (4.3.1): the time to a tolerance is the end of the first control
step after which |r - r_T| is within it; the path is that of the whole episode, 15 s, not of the way until arrival.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, ControllerError, SB3QuadError, unknown
from sb3_quad.envs.registration import MAX_EPISODE_STEPS
from sb3_quad.evaluation.fleets import FLEETS, Fleet
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from sb3_quad.vehicles.vehicle import Vehicle

TOLERANCES = (0.1, 0.2, 0.5, 1.0)  # m

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Pilot = Callable[[npt.NDArray[np.float32]], Any]


@dataclass(frozen=True, eq=False)
class Flights:
    """The figures of n episodes, one per row.

    ================  ==========  ==================================================================================
    name              shape       meaning
    ================  ==========  ==================================================================================
    success           (n,) bool   neither collision nor out of range
    collision         (n,) bool   the ground was touched
    reward            (n,)        sum of the rewards
    length            (n,)        control steps
    flown             (n,)        s until lost or the end
    time_to           {m: (n,)}   s until |r - r_T| is first within the tolerance; NaN if it never was. Of a course
                                  of waypoints: of the last one, once it is the target
    path_length       (n,)        m, over the whole episode
    final_error       (n,)        |r - r_T| at the end, m
    final_offset      (n, 3)      r - r_T at the end, world frame, m; NaN where the flight was lost
    waypoint_times    (n, W)      s until each waypoint was reached, NaN if it never was; W = 0 without waypoints
    start             (n, 13)     position, quaternion, velocity (world frame), body rates; SI
    target            (n, 3)      the first target, m
    ================  ==========  ==================================================================================
    """

    success: BoolArray
    collision: BoolArray
    reward: FloatArray
    length: npt.NDArray[np.int64]
    flown: FloatArray
    time_to: Mapping[float, FloatArray]
    path_length: FloatArray
    final_error: FloatArray
    final_offset: FloatArray
    waypoint_times: FloatArray
    start: FloatArray
    target: FloatArray

    @property
    def n(self) -> int:
        """Number of episodes."""
        return int(self.success.size)

    @staticmethod
    def concatenate(parts: Sequence[Flights]) -> Flights:
        """Several parts as one, in order."""
        names = [entry.name for entry in dataclasses.fields(Flights) if entry.name != "time_to"]
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        times = {key: np.concatenate([part.time_to[key] for part in parts]) for key in parts[0].time_to}
        return Flights(time_to=times, **columns)


@dataclass(frozen=True, eq=False)
class Plan:
    """What happens to n episodes whoever flies them.

    :param start: what replaces the environments' own draw, as of :meth:`Fleet.reset`.
    :param wrenches: from the control steps before which the external wrench changes to the new one, (n, 12).
    :param waypoints: targets one after the other, (W, 3), m; ``start`` holds the first as its target.
    :param radius: the next waypoint becomes the target once |r - r_T| is within this, m.
    """

    start: Mapping[str, FloatArray] = field(default_factory=dict)
    wrenches: Mapping[int, FloatArray] = field(default_factory=dict)
    waypoints: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    radius: float = 0.5


def fly(
    controller: Any,
    task: Any = "target_tracking",
    n_episodes: int = 240,
    seed: int = 0,
    vehicle: str | Vehicle = "itm",
    noise: float = 0.05,
    backend: str = "batch",
    task_kwargs: Mapping[str, Any] | None = None,
    max_steps: int = MAX_EPISODE_STEPS,
    tolerances: tuple[float, ...] = TOLERANCES,
    observation_std: npt.ArrayLike | None = None,
) -> Flights:
    """Fly ``n_episodes`` episodes; number k is the first one of the environment seeded with ``seed + k``.

    :param controller: an expert, asked by ``actions(state)`` for the true state; an SB3 model, asked by
        ``predict(observation, deterministic=True)``; or a function from observations (n, 18) to actions (n, 4).
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``vehicle``, ``noise``, ``task_kwargs``
        and ``observation_std``.
    :param backend: ``batch``, or ``pybullet`` for the reference.
    :param max_steps: control steps of an episode that nothing ends before.
    :raises ConfigError: an unknown backend, fewer than one episode, or a controller that is none of the three.
    :raises ControllerError: a controller that fails in flight.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if n_episodes < 1 or max_steps < 1:
        raise ConfigError(f"n_episodes {n_episodes}, max_steps {max_steps}: must be at least 1")
    seeds = range(seed, seed + n_episodes)
    fleet = FLEETS[backend](seeds, task, task_kwargs, vehicle, noise, max_steps, observation_std)
    try:
        return fly_fleet(fleet, controller, Plan(), max_steps, tolerances)
    finally:
        fleet.close()


def fly_fleet(
    fleet: Fleet,
    controller: Any,
    plan: Plan,
    max_steps: int,
    tolerances: Sequence[float],
    recorder: Recorder | None = None,
) -> Flights:
    """Fly the episodes of a fleet from their start to their ends.

    :param controller: see :func:`fly`.
    :param recorder: is shown every control step.
    :raises ConfigError: a controller that cannot be asked.
    :raises ControllerError: a controller that fails in flight.
    """
    pilot = _pilot(controller, fleet)
    n, control_step, count = fleet.n, fleet.control_step, len(plan.waypoints)
    observation = fleet.reset(plan.start)
    state = fleet.true_state()
    start, first_target = _start(state.array), state.target.copy()
    position, error = state.position.copy(), state.distance
    flying, success, collision = np.ones(n, dtype=np.bool_), np.ones(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    reward, path = np.zeros(n), np.zeros(n)
    length = np.zeros(n, dtype=np.int64)
    final_error, final_offset = error.copy(), np.full((n, 3), np.nan)
    limits = np.array(tolerances)[:, None]
    on_last = np.full(n, count <= 1)
    times = np.where((error <= limits) & on_last, 0.0, np.nan)
    waypoint, waypoint_times = np.zeros(n, dtype=np.int64), np.full((n, count), np.nan)
    wrench = np.zeros((n, 12))
    if recorder is not None:
        recorder.begin(state, control_step)

    for step in range(1, max_steps + 1):
        if step - 1 in plan.wrenches:
            wrench = plan.wrenches[step - 1]
            fleet.set_wrench(wrench)
        actions = _ask(pilot, observation, flying, (step - 1) * control_step)
        speed = np.linalg.norm(state.velocity, axis=1)
        if recorder is not None:
            recorder.push(state, wrench)
        observation, step_reward, terminated, error = fleet.step(actions, flying)
        state = fleet.true_state()
        reward[flying] += step_reward[flying]
        # A row that ended may show its next episode already: its last stretch is its speed times the step.
        stretch = np.where(terminated, speed * control_step, np.linalg.norm(state.position - position, axis=1))
        path[flying] += stretch[flying]
        position = state.position.copy()
        final_error[flying] = error[flying]
        length[flying] = step
        times[np.isnan(times) & (error <= limits) & (flying & on_last)] = step * control_step
        ended = flying & terminated
        collision |= ended & fleet.collided
        success &= ~ended
        flying &= ~terminated
        if recorder is not None:
            recorder.sample(step, state, actions, flying)
        if not flying.any():
            break
        if count:
            reached = np.flatnonzero(flying & (waypoint < count) & (error <= plan.radius))
            waypoint_times[reached, waypoint[reached]] = step * control_step
            waypoint[reached] += 1
            on_last |= waypoint >= count - 1
            onward = reached[waypoint[reached] < count]
            if onward.size:
                observation = fleet.retarget(onward, plan.waypoints[waypoint[onward]])
    final_offset[flying] = (state.position - state.target)[flying]
    return Flights(
        success=success,
        collision=collision,
        reward=reward,
        length=length,
        flown=np.asarray(length * control_step, dtype=np.float64),
        time_to=dict(zip(tolerances, times, strict=True)),
        path_length=path,
        final_error=final_error,
        final_offset=final_offset,
        waypoint_times=waypoint_times,
        start=start,
        target=first_target,
    )


def _start(array: FloatArray) -> FloatArray:
    return np.concatenate([array[rows] for rows in (POSITION, QUATERNION, VELOCITY, BODY_RATES)]).T.copy()


def _ask(pilot: Pilot, observation: npt.NDArray[np.float32], flying: BoolArray, time: float) -> npt.NDArray[np.float32]:
    """Actions (n, 4) of a controller; zero for rows that are over.

    :raises ControllerError: it raises something, or gives what are no actions.
    """
    try:
        actions = np.array(pilot(observation), dtype=np.float32)
    except SB3QuadError:
        raise
    except Exception as error:  # a controller of the user's may raise anything
        raise ControllerError(f"fails after {time:.2f} s with {type(error).__name__}: {error}") from error
    if actions.shape != (flying.size, 4):
        raise ControllerError(f"gives actions of shape {actions.shape} after {time:.2f} s, must be ({flying.size}, 4)")
    actions[~flying] = 0.0
    if not np.isfinite(actions).all():
        row = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
        raise ControllerError(f"gives {actions[row].tolist()} after {time:.2f} s; every number must be finite")
    return actions


def _pilot(controller: Any, fleet: Fleet) -> Pilot:
    if isinstance(controller, type):
        raise ConfigError(f"controller {controller.__name__}: is a class; give an instance, such as {controller.__name__}()")
    if hasattr(controller, "actions"):
        return lambda observation: controller.actions(fleet.true_state())
    if hasattr(controller, "predict"):
        return lambda observation: controller.predict(observation, deterministic=True)[0]
    if callable(controller):
        return lambda observation: controller(observation)
    raise ConfigError(f"controller {controller!r}: needs actions(state) or predict(observation), or must be callable")
