"""One flight, step by step, as it is shown: flown in the reference environment, by any controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.dynamics.state import POSITION, STATE_SIZE, TARGET, QuadcopterState
from sb3_quad.dynamics.vehicle import Vehicle
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.errors import ConfigError

FloatArray = npt.NDArray[np.float64]
Pilot = Callable[[npt.NDArray[np.float32], QuadcopterState], npt.NDArray[np.float32]]


@dataclass(frozen=True)
class Push:
    """An external force and torque for some time.

    :param force: world frame, N; ``torque``: body frame, N m.
    :param start: when it begins, s.
    :param duration: how long it acts, s.
    """

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: float = 0.0
    duration: float = float("inf")

    def acts(self, seconds: float) -> bool:
        """Whether it acts in the control step that begins after ``seconds``."""
        return self.start - 1e-9 <= seconds < self.start + self.duration - 1e-9


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight of T control steps.

    ==========  ====================  =========================================================================
    name        shape                 meaning
    ==========  ====================  =========================================================================
    times       (T + 1,)              s since the start
    state       (STATE_SIZE, T + 1)   the true state, laid out as in :mod:`sb3_quad.dynamics.state`
    wrench      (12, T + 1)           force in the world and in the body frame (N), torques likewise (N m)
    actions     (T, 4)                as they were given, clipped to [-1, 1]
    rewards     (T,)                  of each control step
    outcome                           how it ended: ``flying`` (by its time), ``collision`` or ``out of range``
    ==========  ====================  =========================================================================
    """

    name: str
    vehicle: Vehicle
    times: FloatArray
    state: FloatArray
    wrench: FloatArray
    actions: npt.NDArray[np.float32]
    rewards: FloatArray
    outcome: str

    @property
    def error(self) -> FloatArray:
        """|r - r_T|, (T + 1,), m."""
        return np.asarray(np.linalg.norm(self.state[POSITION] - self.state[TARGET], axis=0))

    @property
    def path(self) -> FloatArray:
        """r, (T + 1, 3), world frame, m."""
        return self.state[POSITION].T

    @property
    def targets(self) -> FloatArray:
        """The targets flown to, one after the other, (k, 3), world frame, m."""
        targets = self.state[TARGET].T
        changed = np.flatnonzero((np.diff(targets, axis=0) != 0).any(axis=1)) + 1
        return np.asarray(targets[[0, *changed]])

    def at(self, seconds: float) -> int:
        """The index of the last state not later than ``seconds``."""
        return int(np.searchsorted(self.times, seconds + 1e-9, side="right")) - 1


def record(
    name: str,
    pilot: Pilot,
    env: QuadcopterEnv,
    seed: int | None,
    n_steps: int,
    target: Sequence[float] | None = None,
    start: Mapping[str, Any] | None = None,
    pushes: Sequence[Push] = (),
) -> Recording:
    """Fly one episode of ``env`` and write it all down.

    :param pilot: from an observation (18,) and the true state to an action (4,).
    :param seed: of the episode; None: the environment's next one.
    :param n_steps: control steps of an episode that nothing ends before.
    :param target: r_T, (3,), m; None: the episode's own.
    :param start: parts of the state at the start, as ``env.reset(options={"state": ...})`` takes them.
    """
    options: dict[str, Any] = {} if target is None else {"target": target}
    options |= {"state": dict(start)} if start else {}
    observation, _ = env.reset(seed=seed, options=options or None)
    state = np.empty((STATE_SIZE, n_steps + 1))
    wrench = np.zeros((12, n_steps + 1))
    actions, rewards = np.empty((n_steps, 4), dtype=np.float32), np.empty(n_steps)
    state[:, 0] = env.true_state().array[:, 0]
    steps, outcome = n_steps, "flying"
    for step in range(n_steps):
        force, torque = _sum_of(pushes, step * env.vehicle.control_step)
        env.set_wrench(force, torque)
        wrench[0:3, step], wrench[9:12, step] = force, torque
        action = np.asarray(pilot(observation, env.true_state()), dtype=np.float32).reshape(-1)
        observation, rewards[step], terminated, _, info = env.step(action)
        actions[step] = np.clip(action, -1.0, 1.0)
        state[:, step + 1] = env.true_state().array[:, 0]
        if terminated:
            steps, outcome = step + 1, "collision" if info["collision"] else "out of range"
            break
    env.set_wrench()
    wrench[:, steps] = wrench[:, steps - 1]
    times = np.arange(steps + 1) * env.vehicle.control_step
    return Recording(
        name, env.vehicle, times, state[:, : steps + 1], wrench[:, : steps + 1], actions[:steps], rewards[:steps], outcome
    )


def as_pilot(controller: Any, deterministic: bool = True) -> Pilot:
    """A controller as :func:`record` asks it.

    :param controller: an expert, asked by ``actions(state)`` for the true state; an SB3 model, asked by ``predict``; or a
        function from an observation (18,) to an action (4,).
    :raises ConfigError: a controller that is none of the three.
    """
    if hasattr(controller, "actions"):
        return lambda observation, state: np.asarray(controller.actions(state)[0])
    if hasattr(controller, "predict"):
        return lambda observation, state: np.asarray(controller.predict(observation, deterministic=deterministic)[0])
    if callable(controller):
        return lambda observation, state: np.asarray(controller(observation))
    raise ConfigError(f"controller {controller!r}: needs actions(state) or predict(observation), or must be callable")


def _sum_of(pushes: Sequence[Push], seconds: float) -> tuple[FloatArray, FloatArray]:
    acting = [push for push in pushes if push.acts(seconds)]
    force = np.sum([push.force for push in acting], axis=0) if acting else np.zeros(3)
    torque = np.sum([push.torque for push in acting], axis=0) if acting else np.zeros(3)
    return np.asarray(force, dtype=np.float64), np.asarray(torque, dtype=np.float64)
