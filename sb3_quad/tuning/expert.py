"""The search for gains of the geometric expert: CMA-ES (Hansen), by Optuna, on the batched environment.

Gains are judged by recoveries first, then the way to a target, then the reward.
"""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from optuna import Study, Trial
from optuna.samplers import CmaEsSampler

from sb3_quad.base.arrays import BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.evaluation.flights import Flights, Hook, fly_settings
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.tuning.study import open_study
from sb3_quad.vehicles.gains import GAIN_NAMES, GeometricGains, GeometricMetrics
from sb3_quad.vehicles.vehicle import Vehicle

NEAR = 0.1  # m
CLOSE = 1.5  # m; the height above ground over which coming close to it loses its weight, by e
# Weights, in seconds of the way to a target:
LOST, TOO_LOW, TRACKING_REWARD, RECOVERY_REWARD = 1500.0, 1000.0, 0.25, 0.5  # per share lost, per share close, per reward
DESCENT, WAY, RECOVERY = 400, 800, 1000  # control steps flown of each kind
# Slow descents are for agents that imitate the expert imprecisely; the expert itself could do without, and is not asked.
SEARCHED = tuple(name for name in GAIN_NAMES if name != "descent_deceleration")
RANGE = 2.0  # each gain between its first value divided by this and multiplied by it
SETTINGS = "settings"
BLOCK = "geometric_gains"
COMMENT = "of GeometricExpert, found by search; what each means: sb3_quad/vehicles/gains.py"


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


def fresh_cost(metrics: GeometricMetrics) -> float:
    """What gains cost on fresh episodes, with the weights of :class:`Cost`, in seconds."""
    lost = LOST * (1.0 - metrics.recovery_survival)
    return lost + metrics.time_to_0_1_m - TRACKING_REWARD * metrics.tracking_reward


class ExpertObjective:
    """The cost of gains on the same episodes each time, so that gains compare.

    Nearly all starts are recovered by any sensible gains and no longer tell them apart: of ``starts`` recoveries, those
    ``hardest`` on which the first gains come closest to the ground are flown, and the others taken as recovered.

    :param vehicle: what is flown; the gains of its file, or those derived from it, choose the hardest starts.
    :param starts: recoveries to choose from.
    :param targets: tracking episodes. Half as many recoveries, from any start, are flown for their reward.
    :param seed: of all episodes.
    """

    def __init__(self, vehicle: Vehicle, starts: int = 40_000, targets: int = 300, seed: int = 0) -> None:
        self.vehicle, self.starts = vehicle, starts
        begun = row_seeds(seed_for("search", seed), starts + max(targets // 2, 1))
        heights = self._fly(GeometricExpert(vehicle), "state_recovery", begun[:starts], DESCENT)[1].lowest
        self.hardest = [begun[row] for row in np.sort(np.argsort(heights)[: max(starts // 60, 1)])]
        self.tracking, self.recovery = begun[:targets], begun[starts:]

    def cost(self, gains: GeometricGains) -> Cost:
        """Fly all episodes with these gains."""
        expert = GeometricExpert(self.vehicle, gains)
        hard, descents = self._fly(expert, "state_recovery", self.hardest, DESCENT)
        tracking, ways = self._fly(expert, "target_tracking", self.tracking, WAY)
        recovery, _ = self._fly(expert, "state_recovery", self.recovery, RECOVERY)
        # Recoveries that are not chosen for being hard find gains that lose other starts than the hardest.
        lost = (~hard.survival).sum() / self.starts + (~recovery.survival).mean()
        low = float(np.exp(-np.maximum(descents.lowest, 0.0) / CLOSE).sum() / self.starts)
        settling = float(np.where(tracking.survival, ways.settled, 2 * WAY * self.vehicle.control_step).mean())
        rewards = float(tracking.reward.mean()), float(recovery.reward.mean())
        value = LOST * lost + TOO_LOW * low + settling - TRACKING_REWARD * rewards[0] - RECOVERY_REWARD * rewards[1]
        return Cost(float(value), float(lost), low, settling, *rewards)

    def _fly(self, expert: GeometricExpert, task: str, seeds: Sequence[int], steps: int) -> tuple[Flights, "_Way"]:
        """The first episode of each seed, on the true state."""
        settings, way = FlightSettings(task=task, vehicle=self.vehicle, noise=0.0, max_episode_steps=steps), _Way()
        return fly_settings(expert, settings, seeds, hooks=[way]), way


class _Way(Hook):
    """The lowest height of each flight, m, and when it came to stay within 0.1 m of its target, s; the whole time if never."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.lowest, self.settled, self._period = state.position[:, 2].copy(), np.zeros(state.n), vehicle.control_step

    def after_step(self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray) -> None:
        self.lowest = np.minimum(self.lowest, np.where(flying, state.position[:, 2], 0.0))
        self.settled[flying & (state.distance > NEAR)] = step * self._period


class ExpertSearch:
    """A search around the gains of a vehicle's file, or those derived from it.

    :param vehicle: what the gains are for.
    :param journal: a file that remembers the search; one that exists is continued. None: nothing is remembered.
    :param seed: of the sampler, and of the episodes.
    :param starts: recoveries of the objective, of which the hardest are flown; ``targets`` its tracking episodes.
    :raises ConfigError: Optuna is missing; a journal that cannot be read, or that is of a search with other settings.
    """

    def __init__(
        self, vehicle: Vehicle, journal: Path | None = None, seed: int = 0, starts: int = 40_000, targets: int = 300
    ) -> None:
        self.vehicle, self.first = vehicle, GeometricExpert(vehicle).gains
        self._sizes = {"starts": starts, "targets": targets, "seed": seed}
        plain = vehicle.model_dump(mode="json", exclude={"geometric_gains"})
        settings = json.dumps([plain, self.first.model_dump(mode="json", exclude={"measured"}), self._sizes], sort_keys=True)
        self._start = {name: getattr(self.first, name) for name in SEARCHED}
        self.study, known = open_study("geometric_gains", journal, "minimize", (SETTINGS, settings), self._start)
        if known != settings:
            other = "is of a search for another vehicle, or with other gains, sizes or seed"
            raise ConfigError(f"journal {journal}: {other}; give another one")
        self.study.sampler = CmaEsSampler(seed=seed, popsize=16)

    @property
    def trials_done(self) -> int:
        """How many gains have been flown, those of an earlier session included."""
        return sum(trial.state.name == "COMPLETE" for trial in self.study.get_trials(deepcopy=False))

    @property
    def best(self) -> GeometricGains:
        """The best gains so far, the first ones if none have been flown."""
        return self._gains(self.study.best_params) if self.trials_done else self.first

    def run(self, trials: int, after_each: Callable[[int, float], bool]) -> None:
        """Fly gains until ``trials`` are done in all.

        :param after_each: called with the number done and the least cost so far; what it returns says whether to go on.
        """
        remaining = trials - self.trials_done
        if remaining <= 0:
            return
        objective = ExpertObjective(self.vehicle, **self._sizes)

        def fly(trial: Trial) -> float:
            values = {name: trial.suggest_float(name, x / RANGE, x * RANGE, log=True) for name, x in self._start.items()}
            cost = objective.cost(self._gains(values))
            for part, value in cost._asdict().items():
                trial.set_user_attr(part, value)
            return cost.value

        def report(study: Study, trial: Any) -> None:
            if not after_each(self.trials_done, study.best_value):
                study.stop()

        self.study.optimize(fly, n_trials=remaining, callbacks=[report])

    def _gains(self, values: dict[str, float]) -> GeometricGains:
        rounded = {name: float(f"{value:.4g}") for name, value in values.items()}
        return GeometricGains.model_validate({**self.first.model_dump(exclude={"measured"}), **rounded})


def with_gains(text: str, gains: GeometricGains) -> str:
    """A vehicle's YAML with these gains instead of those it has, if any; all else, comments too, stays as it is written.

    :raises ConfigError: a file that holds its gains in a form that cannot be cut out of it.
    """
    block = rf"^{BLOCK}:.*\n(?:(?:[ \t].*)?\n)*"  # with all lines that are indented or empty
    head = re.sub(block, "", text + "\n", flags=re.MULTILINE).rstrip("\n") + "\n"
    if BLOCK in (yaml.safe_load(head) or {}):
        raise ConfigError(f"{BLOCK} is written in a form that cannot be replaced; remove it from the vehicle's file")
    values = gains.model_dump(mode="json", exclude_none=True)
    measured = values.pop("measured", None)
    lines = [f"{BLOCK}:".ljust(45) + f"# {COMMENT}", *(f"  {key}: {value:g}" for key, value in values.items())]
    if measured is not None:
        lines.append("  measured:".ljust(45) + "# on fresh episodes, target 10 m away")
        lines.extend(f"    {key}: {value}" for key, value in measured.items())
    return head + "\n".join(lines) + "\n"
