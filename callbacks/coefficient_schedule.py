"""A callback that moves a coefficient of the algorithm with the progress of the training."""

import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.utils import FloatSchedule

from sb3_quad.base.errors import ConfigError, unknown

PROGRESS = "progress"


class CoefficientSchedule(BaseCallback):
    """Moves a coefficient from ``start`` to ``final`` while a quantity goes through ``between``.

    It was made for DAgger's ``beta`` (how often the expert flies) and PPOBC's ``bc_coef`` (weight
    of the cloning term). You can use it with any algorithm, for any of its numbers that is a float
    or a schedule: ``ent_coef``, ``clip_range``, ``learning_rate``, SAC's ``tau``.

    The coefficient is set after a rollout, applies to the next one, and is logged as
    ``schedule/<coefficient>``. A model's zip contains the current number, and nothing of this
    package. A training that continues from the zip continues from that number.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=CoefficientSchedule("ent_coef", start=0.01, final=0.0))
    >>> model.ent_coef
    0.0

    :param coefficient: its name. If the model has a method ``set_<name>(value)``, it is called.
    :param start: its value until the followed quantity is known and has passed ``between[0]``.
    :param final: its value once the quantity has passed ``between[1]``; in between, linear.
    :param follow: ``progress``, the share of the timesteps done; or the name of anything that is
        logged, such as ``rollout/success_rate``, ``rollout/ep_rew_mean``, ``eval/success_rate``
        (from :class:`~sb3_quad.callbacks.BestModel` or SB3's EvalCallback).
    :param between: values of the quantity at which the coefficient begins and ends to move. The
        second may be the smaller one, as for a loss.
    :param one_way: never move back when the quantity does.
    :raises ConfigError: for numbers that are not finite and for equal ends of ``between``; when
        training begins, for a coefficient that the algorithm does not have.
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
        first, last = between
        # A sum of finite numbers is finite.
        if not math.isfinite(start + final + first + last) or first == last:
            raise ConfigError(
                f"CoefficientSchedule: start {start}, final {final}, between {first} and {last}: "
                "must be finite, and the ends must differ"
            )
        self.coefficient = coefficient
        self.follow = follow
        self._start = float(start)
        self._final = float(final)
        self._between = (first, last)
        self._one_way = one_way

    def value_at(self, measured: float) -> float:
        """The coefficient at a value of the followed quantity, regardless of ``one_way``."""
        first, last = self._between
        share = min(max((measured - first) / (last - first), 0.0), 1.0)
        return self._start + share * (self._final - self._start)

    def _on_training_start(self) -> None:
        self._logged = _LastLogged()
        self.logger.output_formats.append(self._logged)
        current = self._current()
        self._value = self._start
        if self.num_timesteps > 0:
            self._value = current
        # Set each value once, so that one that is out of range is refused now and not at the end.
        for value in (self._final, self._start, self._value):
            self._set(value)
        if self.follow == PROGRESS:
            self._on_rollout_end()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._logged.write(self.logger.name_to_value)
        measured = self._logged.values.get(self.follow, math.nan)
        if self.follow == PROGRESS:
            measured = self.num_timesteps / self.model._total_timesteps
        if math.isfinite(measured):
            value = self.value_at(measured)
            # One way: what the quantity takes back is not followed.
            back = (value - self._value) * (self._final - self._start) < 0.0
            if not (self._one_way and back):
                self._value = value
        self._set(self._value)
        self.logger.record(f"schedule/{self.coefficient}", self._value)

    def _on_training_end(self) -> None:
        self.logger.output_formats.remove(self._logged)
        if self.follow != PROGRESS and self.follow not in self._logged.values:
            warnings.warn(
                f"CoefficientSchedule: {self.coefficient} stayed {self._value:g}: "
                + unknown("metric", self.follow, self._logged.values),
                stacklevel=2,
            )

    def _current(self) -> float:
        """The coefficient as the algorithm has it.

        :raises ConfigError: it has no such coefficient, or it is neither a float nor a schedule.
        """
        name = self.coefficient
        value: Any = getattr(self.model, f"current_{name}", vars(self.model).get(name))
        if isinstance(value, FloatSchedule) or name == "learning_rate":
            value = FloatSchedule(value)(self.model._current_progress_remaining)
        if isinstance(value, float):
            return value
        kind = type(self.model).__name__
        raise ConfigError(f"coefficient {name}: is {value!r} in {kind}, must be a float")

    def _set(self, value: float) -> None:
        """Set it with the algorithm's ``set_<name>``, or else as its constructor would."""
        name = self.coefficient
        setter = getattr(self.model, f"set_{name}", None)
        if setter is not None:
            setter(value)
        elif name != "learning_rate" and callable(getattr(self.model, name)):
            setattr(self.model, name, FloatSchedule(value))
        else:
            setattr(self.model, name, value)
            # This has an effect if it is the learning rate.
            self.model._setup_lr_schedule()


class _LastLogged(KVWriter):
    """The latest value of every number that goes through a logger."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}

    def write(
        self, key_values: Mapping[str, Any], key_excluded: object = None, step: int = 0
    ) -> None:
        for name, value in key_values.items():
            with suppress(TypeError, ValueError):
                self.values[name] = float(value)

    def close(self) -> None:
        """Nothing to close."""
