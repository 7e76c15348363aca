"""Flying a controller over fresh episodes, and what is measured on the true state meanwhile.

Conventions, found by the expert's figures in the thesis (4.3.1): the time to a tolerance is the end of the first control
step after which |r - r_T| is within it; the path is that of the whole episode, 15 s, not of the way until arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.dynamics.vehicle import Vehicle
from sb3_quad.envs.registration import MAX_EPISODE_STEPS
from sb3_quad.errors import ConfigError, unknown
from sb3_quad.evaluation.fleets import FLEETS, Fleet

TOLERANCES = (0.1, 0.2, 0.5, 1.0)  # m

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flights:
    """The figures of n episodes, one per row.

    ================  ==========  ==================================================================================
    name              shape       meaning
    ================  ==========  ==================================================================================
    success           (n,) bool   neither collision nor out of range
    reward            (n,)        sum of the rewards
    length            (n,)        control steps
    time_to           {m: (n,)}   s until |r - r_T| is first within the tolerance; NaN if it never was
    path_length       (n,)        m, over the whole episode
    final_error       (n,)        |r - r_T| at the end, m
    ================  ==========  ==================================================================================
    """

    success: npt.NDArray[np.bool_]
    reward: FloatArray
    length: npt.NDArray[np.int64]
    time_to: Mapping[float, FloatArray]
    path_length: FloatArray
    final_error: FloatArray

    @property
    def n(self) -> int:
        """Number of episodes."""
        return int(self.success.size)


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
) -> Flights:
    """Fly ``n_episodes`` episodes; number k is the first one of the environment seeded with ``seed + k``.

    :param controller: an expert, asked by ``actions(state)`` for the true state; an SB3 model, asked by
        ``predict(observation, deterministic=True)``; or a function from observations (n, 18) to actions (n, 4).
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``vehicle``, ``noise``, ``task_kwargs``.
    :param backend: ``batch``, or ``pybullet`` for the reference.
    :param max_steps: control steps of an episode that nothing ends before.
    :raises ConfigError: an unknown backend, fewer than one episode, or a controller that is none of the three.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if n_episodes < 1 or max_steps < 1:
        raise ConfigError(f"n_episodes {n_episodes}, max_steps {max_steps}: must be at least 1")
    fleet = FLEETS[backend](n_episodes, task, task_kwargs, vehicle, noise, seed, max_steps)
    try:
        return _fly(fleet, _pilot(controller, fleet), max_steps, tolerances)
    finally:
        fleet.close()


def _fly(
    fleet: Fleet, pilot: Callable[[npt.NDArray[np.float32]], Any], max_steps: int, tolerances: tuple[float, ...]
) -> Flights:
    n = fleet.n
    observation = fleet.reset()
    state = fleet.true_state()
    control_step = fleet.control_step
    position, error = state.position.copy(), state.distance
    flying = np.ones(n, dtype=np.bool_)
    success = np.ones(n, dtype=np.bool_)
    reward, path = np.zeros(n), np.zeros(n)
    length = np.zeros(n, dtype=np.int64)
    final_error = error.copy()
    time_to = {tolerance: np.where(error <= tolerance, 0.0, np.nan) for tolerance in tolerances}

    for step in range(1, max_steps + 1):
        actions = np.asarray(pilot(observation), dtype=np.float32)
        speed = np.linalg.norm(state.velocity, axis=1)
        observation, step_reward, terminated, error = fleet.step(actions, flying)
        state = fleet.true_state()
        reward[flying] += step_reward[flying]
        # A row that ended may show its next episode already: its last stretch is its speed times the step.
        stretch = np.where(terminated, speed * control_step, np.linalg.norm(state.position - position, axis=1))
        path[flying] += stretch[flying]
        position = state.position.copy()
        final_error[flying] = error[flying]
        length[flying] = step
        for tolerance, times in time_to.items():
            times[flying & np.isnan(times) & (error <= tolerance)] = step * control_step
        success &= ~(flying & terminated)
        flying &= ~terminated
        if not flying.any():
            break
    return Flights(success, reward, length, time_to, path, final_error)


def _pilot(controller: Any, fleet: Fleet) -> Callable[[npt.NDArray[np.float32]], Any]:
    if isinstance(controller, type):
        raise ConfigError(f"controller {controller.__name__}: is a class; give an instance, such as {controller.__name__}()")
    if hasattr(controller, "actions"):
        return lambda observation: controller.actions(fleet.true_state())
    if hasattr(controller, "predict"):
        return lambda observation: controller.predict(observation, deterministic=True)[0]
    if callable(controller):
        return lambda observation: controller(observation)
    raise ConfigError(f"controller {controller!r}: needs actions(state) or predict(observation), or must be callable")
