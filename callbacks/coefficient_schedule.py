"""A coefficient of the algorithm that follows how well the training goes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.utils import FloatSchedule

from sb3_quad.base.errors import ConfigError, unknown

PROGRESS = "progress"


class CoefficientSchedule(BaseCallback):
    """Moves a coefficient from ``start`` to ``final`` while what it follows goes through ``between``.

    Made for DAgger's ``beta`` (how often the expert flies) and PPOBC's ``bc_coef`` (weight of the cloning term); with any
    algorithm, for any of its numbers that are given as floats or schedules: ``ent_coef``, ``clip_range``, ``learning_rate``,
    SAC's ``tau``. Here β falls from 1 to 0 while the share of training episodes that succeed goes from 50 % to 95 %:

    >>> from sb3_quad import DAgger, PIDExpert
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = DAgger("MlpPolicy", env, PIDExpert(), n_steps=50, batch_size=100, n_epochs=1, seed=0, device="cpu")
    >>> schedule = CoefficientSchedule("beta", 1.0, 0.0, follow="rollout/success_rate", between=(0.5, 0.95))
    >>> _ = model.learn(1200, callback=schedule)
    >>> model.current_beta
    0.0

    In a configuration file::

        callback:
          - sb3_quad.callbacks.CoefficientSchedule:
              {coefficient: bc_coef, start: 1.0, final: 0.0, follow: eval/reward_against_expert, between: [-2.0, 0.0]}

    It is set after a rollout and holds for the next one; logged as ``schedule/<coefficient>``. A model's zip holds the number
    of the moment, nothing of this package; a training that goes on from it goes on from there.

    :param coefficient: its name; ``set_<name>(value)`` of the model is called where there is one.
    :param start: its value until the followed quantity is known and beyond ``between[0]``.
    :param final: its value from ``between[1]`` on; in between, linear.
    :param follow: ``progress``, the share of the transitions done; or the name of anything that is logged, such as
        ``rollout/success_rate``, ``rollout/ep_rew_mean``, ``eval/success_rate`` (of :class:`~sb3_quad.callbacks.BestModel`
        or SB3's EvalCallback) or ``eval/reward_against_expert`` (of ``BestModel`` with an ``expert``).
    :param between: where it begins to move and where it ends; the second may be the smaller one, as for a loss.
    :param one_way: never goes back when the followed quantity does.
    :raises ConfigError: numbers that are not finite, or equal ends of ``between``; when training begins, a coefficient that
        the algorithm does not have.
    """

    def __init__(
        self,
        coefficient: str,
        start: float,
        final: float,
        follow: str = PROGRESS,
        between: Sequence[float] = (0.0, 1.0),
        one_way: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        numbers = (start, final, *between)
        if len(numbers) != 4 or not all(isinstance(value, (int, float)) and math.isfinite(value) for value in numbers):
            raise ConfigError(f"CoefficientSchedule: start {start}, final {final}, between {between}: must be finite numbers")
        if between[0] == between[1]:
            raise ConfigError(f"CoefficientSchedule: between {tuple(between)}: its ends must differ")
        self.coefficient, self.follow = coefficient, follow
        self._start, self._final, self._between = float(start), float(final), tuple(between)
        self._one_way = one_way
        self._logged = _LastLogged()
        self._value = self._start

    def value_at(self, measured: float) -> float:
        """The coefficient where the followed quantity is ``measured``, whatever was before."""
        first, last = self._between
        share = min(max((measured - first) / (last - first), 0.0), 1.0)
        return self._start + share * (self._final - self._start)

    def _on_training_start(self) -> None:
        check_coefficient(self.model, self.coefficient)
        self._logged = _LastLogged()
        self.logger.output_formats.append(self._logged)
        self._value = self._start if self.num_timesteps == 0 else read_coefficient(self.model, self.coefficient)
        for value in (self._final, self._start, self._value):  # one that is out of range is refused now, not at the end
            set_coefficient(self.model, self.coefficient, value)
        if self.follow == PROGRESS:
            self._update()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._update()

    def _on_training_end(self) -> None:
        self.logger.output_formats.remove(self._logged)
        if self.follow != PROGRESS and self.follow not in self._logged.values:
            known = unknown("metric", self.follow, self._logged.values) if self._logged.values else "nothing was logged"
            warnings.warn(f"CoefficientSchedule: {self.coefficient} stayed {self._value:g}: {known}", stacklevel=2)

    def _update(self) -> None:
        measured = self._measured()
        if measured is not None:
            value = self.value_at(measured)
            if self._one_way:
                nearest = min if self._final < self._start else max
                value = nearest(value, self._value)
            self._value = value
        set_coefficient(self.model, self.coefficient, self._value)
        self.logger.record(f"schedule/{self.coefficient}", self._value)

    def _measured(self) -> float | None:
        """The latest value of what is followed; None as long as there is none, and where it is not finite."""
        if self.follow == PROGRESS:
            return self.num_timesteps / self.model._total_timesteps
        self._logged.read(self.logger.name_to_value)
        value = self._logged.values.get(self.follow)
        return value if value is not None and math.isfinite(value) else None


def set_coefficient(model: BaseAlgorithm, name: str, value: float) -> None:
    """Give the algorithm another value of a coefficient: by its ``set_<name>``, else as its constructor would."""
    setter = getattr(model, f"set_{name}", None)
    if setter is not None:
        setter(value)
    elif name == "learning_rate":
        model.learning_rate, model.lr_schedule = value, FloatSchedule(value)
    else:
        setattr(model, name, FloatSchedule(value) if callable(getattr(model, name)) else value)


def read_coefficient(model: BaseAlgorithm, name: str) -> float:
    """The present value of a coefficient."""
    value: Any = getattr(model, f"current_{name}", getattr(model, name))
    return float(value(model._current_progress_remaining) if callable(value) else value)


def check_coefficient(model: BaseAlgorithm, name: str) -> None:
    """:raises ConfigError: a name that is no coefficient of the algorithm, or one that is no float there."""
    public = {key: value for key, value in vars(model).items() if not key.startswith("_") and key != "lr_schedule"}
    valid = [key for key, value in public.items() if isinstance(value, (float, FloatSchedule))]
    if name in valid or (name == "learning_rate" and callable(public[name])):
        return
    if name not in public or callable(public[name]):
        raise ConfigError(unknown(f"coefficient of {type(model).__name__}", name, valid))
    if not (isinstance(public[name], int) and hasattr(model, f"set_{name}")):
        raise ConfigError(f"{name} of {type(model).__name__} is {public[name]!r}, which is no float; give it as one, as 0.0")


class _LastLogged(KVWriter):
    """The latest value of every number that goes through a logger."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}

    def read(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            if isinstance(value, (int, float)) or getattr(value, "shape", None) == ():
                self.values[name] = float(value)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.read(key_values)

    def close(self) -> None:
        """Nothing to close."""
