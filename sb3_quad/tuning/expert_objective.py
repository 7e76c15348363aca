"""How good gains of the geometric expert are, in one number: recoveries first, then the way to a target, then the reward."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.experts.geometric import GeometricExpert, derived_gains
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.vehicles.gains import GeometricGains
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]
NEAR = 0.1  # m
CLOSE = 1.5  # m; the height above ground over which coming close to it loses its weight, by e
# Weights, in seconds of the way to a target:
LOST, TOO_LOW, TRACKING_REWARD, RECOVERY_REWARD = 1500.0, 1000.0, 0.25, 0.5  # per share lost, per share close, per reward
DESCENT, WAY, RECOVERY = 400, 800, 1000  # control steps flown of each kind


class Cost(NamedTuple):
    """What gains cost, and of what that is made.

    :param value: to be minimised: ``1500 lost + 1000 too_low + settling + 0.25 |tracking reward| + 0.5 |recovery reward|``.
    :param lost: the hard recoveries lost, as a share of all starts, and the share lost of the others.
    :param too_low: mean of exp(-lowest height / 1.5 m) over the recoveries, which tells near losses apart.
    :param settling: mean time after which the vehicle stays within 0.1 m of a target 10 m away, s; lost flights count double.
    :param tracking_reward: mean, of 8 s.
    :param recovery_reward: mean, of 10 s.
    """

    value: float
    lost: float
    too_low: float
    settling: float
    tracking_reward: float
    recovery_reward: float


class ExpertObjective:
    """The cost of gains on the same episodes each time, so that gains compare.

    Nearly all starts are recovered by any sensible gains and tell them apart no longer: of ``starts`` recoveries, those
    ``hardest`` on which the first gains come closest to the ground are flown, and the others taken as recovered.

    :param vehicle: what is flown.
    :param first: gains to choose the hardest starts by; None: :func:`~sb3_quad.experts.geometric.derived_gains`.
    :param starts: recoveries to choose from.
    :param targets: tracking episodes. Half as many recoveries, from any start, are flown for their reward.
    :param seed: of all episodes.
    """

    def __init__(
        self, vehicle: Vehicle, first: GeometricGains | None = None, starts: int = 40_000, targets: int = 300, seed: int = 0
    ) -> None:
        self.vehicle, self.starts = vehicle, starts
        expert = GeometricExpert(vehicle, first or derived_gains(vehicle))
        heights = Episodes(vehicle, "state_recovery", starts, seed, DESCENT).fly(expert).lowest
        hardest = np.sort(np.argsort(heights)[: max(starts // 60, 1)])
        self.hard = Episodes(vehicle, "state_recovery", starts, seed, DESCENT, hardest)
        self.tracking = Episodes(vehicle, "target_tracking", targets, seed, WAY)
        self.recovery = Episodes(vehicle, "state_recovery", max(targets // 2, 1), seed + starts, RECOVERY)

    def cost(self, gains: GeometricGains) -> Cost:
        """Fly all episodes with these gains."""
        expert = GeometricExpert(self.vehicle, gains)
        hard, tracking, recovery = (each.fly(expert) for each in (self.hard, self.tracking, self.recovery))
        # Recoveries that are not chosen for being hard find gains that lose other starts than the hardest.
        lost = (~hard.alive).sum() / self.starts + (~recovery.alive).mean()
        low = float(np.exp(-np.maximum(hard.lowest, 0.0) / CLOSE).sum() / self.starts)
        way = WAY * self.vehicle.control_step
        settling = float(np.where(tracking.alive, tracking.settled, 2 * way).mean())
        rewards = float(tracking.reward.mean()), float(recovery.reward.mean())
        value = LOST * lost + TOO_LOW * low + settling - TRACKING_REWARD * rewards[0] - RECOVERY_REWARD * rewards[1]
        return Cost(float(value), float(lost), low, settling, *rewards)


class Outcome(NamedTuple):
    """What came of episodes, an entry each."""

    alive: npt.NDArray[np.bool_]
    lowest: FloatArray
    """m; of a lost one 0"""
    settled: FloatArray
    """s until it stayed within 0.1 m of its target; the whole time if it did not"""
    reward: FloatArray


class Episodes:
    """The same beginnings of episodes, to be flown again and again.

    :param rows: which of the ``n`` episodes to keep; None: all.
    """

    def __init__(self, vehicle: Vehicle, task: str, n: int, seed: int, steps: int, rows: Any = None) -> None:
        start = QuadcopterBatch(n, task=task, vehicle=vehicle, noise=0.0, seed=seed, max_episode_steps=steps + 1)
        start.reset()
        chosen = np.arange(n) if rows is None else rows
        self.steps, self.control_step = steps, vehicle.control_step
        self.batch = QuadcopterBatch(
            chosen.size, task=task, vehicle=vehicle, noise=0.0, seed=seed, max_episode_steps=steps + 1
        )
        self.batch.reset()
        names = ("state", "queue", "streams", "task_index")
        self._first = {name: np.ascontiguousarray(getattr(start, name)[..., chosen]) for name in names}

    def fly(self, expert: GeometricExpert) -> Outcome:
        """Fly them with an expert on the true state."""
        batch = self.batch
        for name, values in self._first.items():
            getattr(batch, name)[...] = values
        state = batch.true_state()
        alive, settled = np.ones(batch.n, dtype=np.bool_), np.zeros(batch.n)
        lowest, reward = batch.state[2].copy(), np.zeros(batch.n)
        for step in range(1, self.steps + 1):
            _, rewards, done = batch.step(expert.actions(state))
            reward += np.where(alive, rewards, 0.0)
            alive &= ~done
            lowest = np.minimum(lowest, batch.state[2])
            settled[state.distance > NEAR] = step * self.control_step
        lowest[~alive] = 0.0
        return Outcome(alive, lowest, settled, reward)
