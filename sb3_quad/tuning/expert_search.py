"""The search for gains of the geometric expert: CMA-ES (Hansen), by Optuna, on the batched environment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.tuning.expert_objective import Cost, ExpertObjective
from sb3_quad.tuning.study import open_study, require_optuna
from sb3_quad.vehicles.gains import GAIN_NAMES, GeometricGains
from sb3_quad.vehicles.vehicle import Vehicle

if TYPE_CHECKING:
    from optuna import Study, Trial

# Slow descents are for agents that imitate the expert imprecisely; the expert itself could do without, and is not asked.
SEARCHED = tuple(name for name in GAIN_NAMES if name != "descent_deceleration")
RANGE = 2.0  # each gain between its first value divided by this and multiplied by it
SETTINGS, WRITTEN = "settings", "written"


class ExpertSearch:
    """A search that a journal file remembers, so that it goes on where it was left.

    :param vehicle: what the gains are for.
    :param first: the gains it starts from, in the middle of what it tries.
    :param journal: its file; one that exists is gone on with. None: nothing is remembered.
    :param seed: of the sampler, and of the episodes.
    :param starts: recoveries of the objective, of which the hardest are flown; ``targets`` its tracking episodes.
    :raises ConfigError: Optuna is missing; a journal that cannot be read, or that is of a search with other settings.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        first: GeometricGains,
        journal: Path | None = None,
        seed: int = 0,
        starts: int = 40_000,
        targets: int = 300,
    ) -> None:
        self.vehicle, self.first = vehicle, first
        self._sizes = {"starts": starts, "targets": targets, "seed": seed}
        require_optuna("tune-expert")
        from optuna.samplers import CmaEsSampler

        self.study, _ = open_study("geometric_gains", journal, CmaEsSampler(seed=seed, popsize=16), "minimize")
        plain = vehicle.model_dump(mode="json", exclude={"geometric_gains"})
        settings = json.dumps([plain, first.model_dump(mode="json", exclude={"measured"}), self._sizes], sort_keys=True)
        known = self.study.user_attrs.get(SETTINGS)
        if known is None:
            self.study.set_user_attr(SETTINGS, settings)
            self.study.enqueue_trial({name: getattr(first, name) for name in SEARCHED})
        elif known != settings:
            raise ConfigError(
                f"journal {journal}: is of a search for another vehicle, or with other gains, sizes or seed; give another one"
            )
        self._objective: ExpertObjective | None = None

    @property
    def trials_done(self) -> int:
        """How many gains have been flown, those of an earlier session included."""
        return len(_completed(self.study))

    @property
    def best(self) -> GeometricGains:
        """The best gains so far, the first ones if none have been flown."""
        return self._gains(self.study.best_params) if self.trials_done else self.first

    @property
    def best_cost(self) -> float:
        """What they cost; infinite if none have been flown."""
        return float(self.study.best_value) if self.trials_done else float("inf")

    def run(self, trials: int, after_each: Callable[[int, float], bool]) -> None:
        """Fly gains until ``trials`` are done in all.

        :param after_each: called with the number done and the least cost so far; what it returns says whether to go on.
        """
        remaining = trials - self.trials_done
        if remaining <= 0:
            return
        self._objective = self._objective or ExpertObjective(self.vehicle, self.first, **self._sizes)

        def report(study: Study, trial: Any) -> None:
            if not after_each(self.trials_done, self.best_cost):
                study.stop()

        self.study.optimize(self._fly, n_trials=remaining, callbacks=[report])

    def may_overwrite(self, output: Path) -> bool:
        """Whether a file that exists holds what this search itself wrote there earlier."""
        return self.study.user_attrs.get(WRITTEN) == _digest(output.read_bytes())

    def note_output(self, content: bytes) -> None:
        """Remember what is going to be written, for :meth:`may_overwrite`."""
        self.study.set_user_attr(WRITTEN, _digest(content))

    def _fly(self, trial: Trial) -> float:
        assert self._objective is not None
        values = {}
        for name in SEARCHED:
            middle = getattr(self.first, name)
            values[name] = trial.suggest_float(name, middle / RANGE, middle * RANGE, log=True)
        cost: Cost = self._objective.cost(self._gains(values))
        for part, value in cost._asdict().items():
            trial.set_user_attr(part, value)
        return cost.value

    def _gains(self, values: dict[str, float]) -> GeometricGains:
        rounded = {name: float(f"{value:.4g}") for name, value in values.items()}
        return GeometricGains.model_validate({**self.first.model_dump(exclude={"measured"}), **rounded})


def _completed(study: Study) -> list[Any]:
    from optuna.trial import TrialState

    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
