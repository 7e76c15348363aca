"""What all environments have in common: their spaces, and what they can be asked and told in
flight.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from gymnasium import spaces

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.validate import validate
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.observation import OBSERVATION_SIZE
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import TARGET
from sb3_quad.simulation.tasks import TaskSpec
from sb3_quad.vehicles.vehicle import Vehicle

P = ParamSpec("P")
T = TypeVar("T")
INFOS = {"is_success": "success", "survival": "truncated"} | {
    key: key for key in ("distance", "collision", "out_of_range")
}
"""Keys of an info, and the fields of ``batch.outcome`` that they show."""


def _of_batch(
    method: Callable[Concatenate[QuadcopterBatch, P], T],
) -> Callable[Concatenate["BatchEnv", P], T]:
    """The method of an environment that is this one of its batch."""

    @functools.wraps(method)
    def call(self: "BatchEnv", /, *args: P.args, **kwargs: P.kwargs) -> T:
        return method(self.batch, *args, **kwargs)

    return call


def quadcopter_spaces(size: int = OBSERVATION_SIZE) -> "tuple[spaces.Box[Any], spaces.Box[Any]]":
    """Observation and action space of one quadcopter; made anew, since each space has random
    numbers of its own.
    """
    observations = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    return observations, spaces.Box(-1.0, 1.0, (4,), np.float32)


class BatchEnv:
    """An environment whose rows are those of ``batch``; ``QuadcopterEnv`` has one, and its values
    are without a row axis.

    ``indices`` says which rows are set: a number, several, a slice, or None for all. What is set
    holds until it is set anew, a target until its row's next reset. A value that does not fit
    raises :class:`~sb3_quad.base.errors.ConfigError`.
    """

    batch: QuadcopterBatch
    flight_settings: FlightSettings

    def _make_batch(
        self, n: int, seed: int | None, n_threads: int | None, autoreset: bool, **keywords: Any
    ) -> None:
        """Make the batch of n rows that fly as the keywords say; errors name the environment's
        class.
        """
        own = inspect.signature(type(self)).parameters.values()
        valid = {
            each.name for each in own if each.kind is each.POSITIONAL_OR_KEYWORD
        } | FlightSettings.model_fields.keys()
        for key in keywords.keys() - valid:
            raise ConfigError(f"{type(self).__name__}: {unknown('keyword', key, valid)}")
        self.flight_settings = validate(FlightSettings, keywords, type(self).__name__)
        self.batch = QuadcopterBatch(n, self.flight_settings, seed, n_threads, autoreset)

    def _by_row(self, columns: FloatArray) -> FloatArray:
        """A copy of ``columns``, (..., n) or (..., 1) for all rows together, as (n, ...)."""
        return np.broadcast_to(columns.T, (self.batch.n, *columns.shape[:-1])).copy()

    true_state = _of_batch(QuadcopterBatch.true_state)
    set_target = _of_batch(QuadcopterBatch.set_target)
    set_wrench = _of_batch(QuadcopterBatch.set_wrench)
    set_wind = _of_batch(QuadcopterBatch.set_wind)
    set_noise = _of_batch(QuadcopterBatch.set_noise)

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of row 0."""
        return self.batch.vehicle_list[0]

    @property
    def target(self) -> FloatArray:
        """Targets r_T, (n, 3), world frame, m."""
        return self._by_row(self.batch.state[TARGET])

    @property
    def wrench(self) -> FloatArray:
        """What was set or sampled, without gusts, (n, 12): force world, force body, torque world,
        torque body; N, N m.
        """
        return self._by_row(self.batch.wrench)

    @property
    def wind(self) -> FloatArray:
        """The velocity of the air without gusts, (n, 3), world frame, m/s."""
        return self._by_row(self.batch.wind)

    @property
    def task(self) -> TaskSpec:
        """The task, as it was given; ``task_kwargs`` replace fields of it."""
        return self.batch.task

    @property
    def task_kwargs(self) -> dict[str, Any]:
        """Fields of the task that are overridden."""
        return dict(self.batch.task_kwargs)

    @property
    def noise(self) -> Any:
        """Relative standard deviations of the observation noise, (n,)."""
        return self._by_row(self.batch.noise_level)

    @property
    def observation_mean(self) -> FloatArray:
        """μ of Eq. 3.16, (n, 18)."""
        return self._by_row(self.batch.mean)

    @property
    def observation_std(self) -> FloatArray:
        """σ of Eq. 3.16, (n, 18)."""
        return self._by_row(self.batch.std)
