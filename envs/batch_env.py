"""The part that all environments share: spaces, keywords, and reading and setting in flight."""

import inspect
import math
from collections.abc import Sequence
from typing import Annotated, Any, TypedDict

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike
from pydantic import AfterValidator
from typing_extensions import Unpack

from sb3_quad.base.errors import ConfigError, named, refuse_unknown
from sb3_quad.base.types import AnyArray, FloatArray, StrDict, StrMapping
from sb3_quad.base.validate import validate
from sb3_quad.envs.simulation.batch import QuadcopterBatch, Rows, StepResult
from sb3_quad.envs.simulation.checks import per_row
from sb3_quad.envs.simulation.frames import PositionIntegral
from sb3_quad.envs.simulation.motions import Motion
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.randomization import Randomization
from sb3_quad.envs.simulation.recordings import Recording
from sb3_quad.envs.simulation.references import Reference
from sb3_quad.envs.simulation.settings import Action, AsList, FlightSettings, Noise
from sb3_quad.envs.simulation.state import QUATERNION, TARGET, QuadcopterState, make_wrench
from sb3_quad.envs.simulation.tasks import TaskSpec
from sb3_quad.envs.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.envs.vehicles.vehicle import Vehicle, VehicleSource

# Keys of an info, and the fields of ``batch.outcome`` that they show.
INFOS = {
    "is_success": "success",
    "survival": "truncated",
    "distance": "distance",
    "collision": "collision",
    "out_of_range": "out_of_range",
}


def _has_length(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*quaternion) < 1e-6:
        raise ValueError("must not be zero")
    return quaternion


# Parts of a state, as options and files give them
Vector = Annotated[tuple[float, float, float], AsList]
Quaternion = Annotated[tuple[float, float, float, float], AsList, AfterValidator(_has_length)]


class FlightKeywords(TypedDict, total=False):
    """Keywords of the environments for editors and type checkers.

    :class:`~sb3_quad.envs.simulation.settings.FlightSettings` declares them, with their
    defaults and meanings. Each constructor adds ``task``, and a test keeps both lists equal.
    """

    task_kwargs: StrMapping | None
    vehicle: VehicleSource | Sequence[VehicleSource]
    rotor_layout: VehicleSource | None
    action: Action
    noise: ArrayLike | StrMapping | Noise
    observation_mean: ArrayLike | None
    observation_std: ArrayLike | None
    last_action: bool
    history: Sequence[int] | None
    position_integral: StrMapping | PositionIntegral | None
    vehicles: StrMapping | VehicleDistribution | None
    randomize: StrMapping | Randomization | None
    preview: Sequence[int] | None
    reference: str | StrMapping | Reference | Motion | None
    wrench: str | StrMapping | Recording | None
    wind: str | StrMapping | Recording | None
    max_episode_steps: int | Sequence[int]


def quadcopter_spaces(size: int = OBSERVATION_SIZE) -> "tuple[spaces.Box[Any], spaces.Box[Any]]":
    """Return new observation and action spaces of one quadcopter.

    They are not shared, since each space has its own random generator.
    """
    observations = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    return observations, spaces.Box(-1.0, 1.0, (4,), np.float32)


class BatchEnv:
    """An environment whose rows are those of ``batch``.

    ``QuadcopterEnv`` has one row, and its values have no row axis. The setters take ``indices``,
    the rows to set: a number, several, a slice, or None for all.
    """

    batch: QuadcopterBatch
    flight_settings: FlightSettings
    _has_begun = False

    def _make_batch(
        self,
        n: int,
        seed: int | None,
        n_threads: int | None,
        task: TaskSpec,
        autoreset: bool,
        **keywords: Unpack[FlightKeywords],
    ) -> None:
        """Make the batch of n rows that fly as the keywords say.

        :raises ConfigError: an unknown keyword, or a value that does not fit. It names the
            environment's class.
        """
        name = type(self).__name__
        # Check the names first, so that a typo in a constructor argument is recognised, too.
        valid = inspect.signature(type(self)).parameters.keys() | FlightSettings.model_fields.keys()
        with named(name):
            refuse_unknown("keyword", keywords, valid - {"keywords"})
        self.flight_settings = validate(FlightSettings, {"task": task, **keywords}, name)
        self.batch = QuadcopterBatch(n, self.flight_settings, seed, n_threads, autoreset)

    def _by_row(self, columns: FloatArray) -> FloatArray:
        """Return a copy of ``columns``, (..., n) or (..., 1) for all rows together, as (n, ...)."""
        # A single column serves all rows if they do not differ.
        return np.broadcast_to(columns.T, (self.batch.n, *columns.shape[:-1])).copy()

    def _require_reset(self, what: str, rows: Rows = None) -> None:
        # A row's quaternion is zero before its first reset. A restored batch needs no reset.
        if not self.batch.state[QUATERNION, self.batch.rows(rows)].any(axis=0).all():
            raise ResetNeeded(f"call reset() before {what}")

    def _fly(self, actions: AnyArray) -> StepResult:
        """Step the batch, which must have begun its episodes."""
        if not self._has_begun:
            self._require_reset("step()")
            self._has_begun = True
        return self.batch.step(actions)

    def true_state(self) -> QuadcopterState:
        """Return the true state of all rows, free of noise.

        It is a live view: the next step changes it, except for the velocity, acceleration and
        heading of a reference, which stay as they were at this call. If there are gusts or air,
        its wrench includes them and is a copy.
        """
        return self.batch.true_state()

    def estimated_state(self) -> QuadcopterState:
        """Return the state of all rows as their own estimators see it: a copy that is off by the
        errors of ``noise.estimator``. Without these it is :meth:`true_state`.
        """
        return self.batch.estimated_state()

    def set_target(self, position: ArrayLike, indices: Rows = None) -> None:
        """Move targets, after reset. They stay there until the next reset of their rows.

        :param position: r_T, (3,) for all these rows or (rows, 3), world frame, m.
        :raises ConfigError: a wrong shape, or a number that is not finite.
        :raises gymnasium.error.ResetNeeded: a row has not been reset yet.
        """
        self.set_reference(position, indices=indices)

    def set_reference(
        self,
        position: ArrayLike,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        acceleration: ArrayLike = (0.0, 0.0, 0.0),
        heading: ArrayLike | None = None,
        heading_rate: ArrayLike = 0.0,
        indices: Rows = None,
    ) -> None:
        """Set the reference of these rows: a position, its motion, and a heading.

        It lasts until you set another one or their episode ends, and does not move by itself: call
        this before each step. It replaces a curve of the environment's ``reference``.

        :param position: (3,) for all these rows or (rows, 3), world frame, m.
        :param velocity: likewise, m/s.
        :param acceleration: likewise, m/s².
        :param heading: angle of the body's x axis from the world's, one number or one for each of
            these rows, rad. None: no heading is commanded.
        :param heading_rate: likewise, rad/s.
        :raises ConfigError: a wrong shape, a number that is not finite, or a heading_rate without a
            heading.
        :raises gymnasium.error.ResetNeeded: a row has not been reset yet.
        """
        rows = self.batch.rows(indices)
        n = rows.size
        positions = per_row("position", position, n, 3)
        velocities = per_row("velocity", velocity, n, 3)
        accelerations = per_row("acceleration", acceleration, n, 3)
        rate = per_row("heading_rate", heading_rate, n)[0]
        turning = np.zeros((3, n))
        if heading is not None:
            angle = per_row("heading", heading, n)[0]
            turning = np.stack([np.cos(angle), np.sin(angle), rate])
        elif rate.any():
            raise ConfigError("heading_rate: needs a heading")
        # The first reset would set another target.
        self._require_reset("set_target() or set_reference()", rows)
        # Its future is unknown, so the acceleration ahead is the present one.
        parts = [positions, velocities, accelerations, turning, accelerations]
        self.batch.set_reference(np.concatenate(parts), rows)

    def set_wrench(
        self,
        force: ArrayLike = (0.0, 0.0, 0.0),
        torque: ArrayLike = (0.0, 0.0, 0.0),
        force_frame: str = "world",
        torque_frame: str = "body",
        indices: Rows = None,
    ) -> None:
        """Apply an external force and torque at the centre of mass.

        They act until you set others; if ``randomize`` samples a force or torque, until the next
        episode. A call without arguments removes them.

        :param force: (3,) for all these rows or (rows, 3), N.
        :param torque: likewise, N m.
        :param force_frame: axes of ``force``, ``"world"`` or ``"body"``.
        :param torque_frame: axes of ``torque``, likewise.
        :raises ConfigError: a wrong shape, a number that is not finite, or an unknown frame.
        """
        rows = self.batch.rows(indices)
        forces = per_row("force", force, rows.size, 3).T
        torques = per_row("torque", torque, rows.size, 3).T
        self.batch.wrench[:, rows] = make_wrench(forces, torques, force_frame, torque_frame)

    def set_wind(self, velocity: ArrayLike = (0.0, 0.0, 0.0), indices: Rows = None) -> None:
        """Set the velocity of the air until you set another; if ``randomize`` samples a wind, until
        the next episode.

        It acts through drag and the terms of :mod:`~sb3_quad.envs.simulation.aerodynamics`, and a
        warning says so if no vehicle here has any.

        :param velocity: (3,) for all these rows or (rows, 3), world frame, m/s.
        :raises ConfigError: a wrong shape, or a number that is not finite.
        """
        rows = self.batch.rows(indices)
        self.batch.wind[:, rows] = per_row("wind", velocity, rows.size, 3)
        if self.batch.wind.any():
            self.batch.warn_without_drag("set_wind")

    def set_noise(self, level: Any, indices: Rows = None) -> None:
        """Set the observation noise until you set another.

        :param level: the relative standard deviation, one number or one for each of these rows; or
            a :class:`~sb3_quad.envs.simulation.settings.Noise` or its fields. 0: no noise. The
            estimator's errors stay as they are.
        :raises ConfigError: a wrong shape, or a level below 0 or above 100.
        """
        self.batch.set_noise(level, indices)

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
        """The external wrench that was set or sampled, without gusts and recordings, (n, 12).

        Force in the world frame, force in the body frame, torque in the world frame, torque in the
        body frame; N and N m.
        """
        return self._by_row(self.batch.wrench)

    @property
    def wind(self) -> FloatArray:
        """The velocity of the air without gusts and recordings, (n, 3), world frame, m/s."""
        return self._by_row(self.batch.wind)

    @property
    def task(self) -> TaskSpec:
        """The task, as it was given; ``task_kwargs`` override fields of it."""
        task: TaskSpec = self.flight_settings.task
        return task

    @property
    def task_kwargs(self) -> StrDict:
        """Fields of the task that are overridden."""
        return dict(self.flight_settings.task_kwargs or {})

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
