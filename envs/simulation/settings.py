"""How quadcopters fly: every keyword of the environments, declared once.

Training writes them into every zip.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.plugins import FLIGHT_SETTINGS
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.envs import MAX_EPISODE_STEPS
from sb3_quad.envs.simulation.checks import per_row
from sb3_quad.envs.simulation.estimator import EstimatorError
from sb3_quad.envs.simulation.frames import ObservationSettings
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.envs.simulation.randomization import Randomization
from sb3_quad.envs.simulation.recordings import Recording
from sb3_quad.envs.simulation.references import Reference
from sb3_quad.envs.simulation.tasks import find_mixture, resolve_tasks
from sb3_quad.envs.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.envs.vehicles.vehicle import Vehicle, first_vehicle, load_vehicle

# The largest number of control steps that an episode can have
ENDLESS = 2**62 - 1
Steps = Annotated[int, Field(gt=0, le=ENDLESS)]
AsList = BeforeValidator(
    lambda value: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
)
Scaling = Annotated[list[float] | list[list[float]] | None, AsList]
# The attribute of a model, and so the key of the JSON in its zip
KEY = FLIGHT_SETTINGS
Level = Annotated[float, Field(ge=0, le=100)]
Action = Literal["thrusts", "rates"]


_OBSERVATION = set(ObservationSettings.model_fields)


class Noise(Frozen):
    """Observation noise: a feature x with scale σ (Eq. 3.16) gets the sum of two independent normal
    disturbances, with the standard deviation √((relative x)² + (additive σ)²).

    A number alone is ``relative``.
    """

    relative: Level = 0.0
    """as a fraction of the feature's value (thesis: 0.05)"""
    additive: Level = 0.0
    """as a fraction of σ, the same wherever the vehicle is"""
    estimator: EstimatorError | None = None
    """fields of EstimatorError: the features are those of an estimate, before other noise"""


# Without logs, whose files are elsewhere when a zip is read
UNRECORDED: Mapping[str, None] = {"wrench": None, "wind": None}
NoiseLevel = Level | list[Level] | Noise


class FlightSettings(ObservationSettings):
    """Keywords of the quadcopter environments, ``env_kwargs`` in YAML. ``dict`` returns them.

    Where a value may differ by row, give a list: row i of n environments has the i-th value. If you
    give fewer vehicles or steps than rows, they repeat.
    """

    task: Any = "target_tracking"
    """name of a task or mixture, Task, or mixture {name: weight}"""
    task_kwargs: dict[str, Any] | None = None
    """fields of the task to override"""
    vehicle: Any = "itm"
    """name, path or Vehicle; or a list of them with the same time steps"""
    rotor_layout: str | Path | Vehicle | None = None
    """name, path or Vehicle to whose axes and rotor order the vehicle is turned"""
    action: Action = "thrusts"
    """what actions command: the rotors' thrusts; or collective thrust and body rates, which the
    vehicle's RateLoop holds
    """
    noise: Annotated[NoiseLevel, AsList] = 0.05
    """relative standard deviation of the noise, one for all rows or one each; or fields of Noise"""
    observation_mean: Scaling = None
    """μ of Eq. 3.16, (18,) or (n, 18), in units; None: zero"""
    observation_std: Scaling = None
    """σ of Eq. 3.16, (18,) or (n, 18), in units; None: Table A.2"""
    vehicles: VehicleDistribution | None = None
    """fields of VehicleDistribution, or {distribution: name}: a vehicle for each episode, which has
    the layout, delay, time steps and gravity of ``vehicle``
    """
    randomize: Randomization | None = None
    """fields of Randomization: dynamics that differ by episode"""
    reference: Reference | None = None
    """name of a curve, fields of Reference, path of a CSV file, or function of time: what the
    target does in an episode; None: it rests"""
    wrench: Recording | None = None
    """a log's force and maybe torque: path of a CSV file with the columns t,fx,fy,fz[,tx,ty,tz], or
    fields of Recording; s, N in world axes, N m in body axes
    """
    wind: Recording | None = None
    """likewise, a log's velocity of the air: t,vx,vy,vz; m/s, world axes; for vehicles with drag"""
    max_episode_steps: Steps | Annotated[list[Steps], Field(min_length=1)] = MAX_EPISODE_STEPS
    """control steps after which an episode is truncated, for all rows or for each"""

    @model_validator(mode="after")
    def _check_task(self) -> "FlightSettings":
        """A named mixture sets the episode length, unless one is given."""
        resolve_tasks(self.task, self.task_kwargs)
        mixture = find_mixture(self.task)
        if mixture is not None and "max_episode_steps" not in self.model_fields_set:
            # Pydantic would count it as given, and with_changes would keep it for other tasks.
            object.__setattr__(self, "max_episode_steps", mixture.max_episode_steps)
        return self

    def load_vehicles(self) -> list[Vehicle]:
        """Return the vehicles in the layout that they are flown in; only one if all rows have the
        same.

        :raises ConfigError: a vehicle that cannot be loaded, or vehicles with different time steps.
        """
        given = self.vehicle if isinstance(self.vehicle, (list, tuple)) else [self.vehicle]
        vehicles = [load_vehicle(source, self.rotor_layout) for source in given]
        for row, vehicle in enumerate(vehicles):
            first = vehicles[0]
            if (vehicle.physics_step, vehicle.substeps) != (first.physics_step, first.substeps):
                raise ConfigError(
                    f"vehicle of row {row}: physics_step and control_step must be those of row 0"
                )
        return vehicles

    def scaling(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return μ and σ of Eq. 3.16 in n rows, (18, n) each.

        :raises ConfigError: other shapes, or numbers with which features would vanish or overflow.
        """
        mean: Any = DEFAULT_MEAN if self.observation_mean is None else self.observation_mean
        std: Any = DEFAULT_STD if self.observation_std is None else self.observation_std
        means = per_row("observation_mean", mean, n, OBSERVATION_SIZE)
        stds = per_row("observation_std", std, n, OBSERVATION_SIZE)
        if not ((stds >= 1e-6) & (stds <= 1e6)).all():
            raise ConfigError("observation_std: every value must be from 1e-6 to 1e6")
        if not (np.abs(means) <= 1e6).all():
            raise ConfigError("observation_mean: every value must be from -1e6 to 1e6")
        return means, stds

    @property
    def longest_episode(self) -> int:
        """Control steps of an episode; of the longest one if rows differ."""
        return int(np.max(self.max_episode_steps))

    @property
    def observation(self) -> ObservationSettings:
        """The settings of the observation alone."""
        return ObservationSettings(**self.model_dump(include=_OBSERVATION))

    def in_any_task(self) -> dict[str, Any]:
        """Return the settings that were given and do not belong to a task: vehicles, noise,
        observation.
        """
        kept = self.model_fields_set - {
            "task",
            "task_kwargs",
            "max_episode_steps",
            "randomize",
            "reference",
            "wrench",
            "wind",
        }
        return {name: value for name, value in self if name in kept}

    @property
    def observed(self) -> dict[str, Any]:
        """The settings that an agent needs wherever it flies: scaling and frames of its
        observations, what its actions command, and the order of its rotors.
        """
        needed = _OBSERVATION | {"action", "rotor_layout", "observation_mean", "observation_std"}
        return self.model_dump(mode="json", include=needed)

    @property
    def carried(self) -> dict[str, Any]:
        """The settings that go with an agent wherever it flies: :attr:`observed`, and the layout of
        the rotors that it knows, even if that is its own vehicle's.
        """
        return {**self.observed, "rotor_layout": self.layout}

    @property
    def layout(self) -> Vehicle:
        """The vehicle whose axes and rotor order an agent with these settings knows."""
        return first_vehicle(self.rotor_layout or self.vehicle)

    def with_changes(self, **changes: Any) -> "FlightSettings":
        """Return the same settings with some fields changed; a ``vehicle`` replaces ``vehicles``.

        :raises ConfigError: an unknown field, or a value that does not fit.
        """
        own = dict(self)
        if "vehicle" in changes:
            own["vehicles"] = None
        if "max_episode_steps" not in self.model_fields_set:
            # A mixture among the changes sets its own.
            del own["max_episode_steps"]
        return validate(FlightSettings, {**own, **changes}, "env_kwargs")

    def write_into(self, model: Any) -> None:
        """Write these settings into an SB3 model: ``model.flight_settings``, plain JSON with the
        parameters of the vehicle. If rows differ, they are the first vehicle and scaling, and the
        mean level of noise. A reference stays if it is a named curve; recordings do not.

        From then on its zips contain them, and ``load`` of Stable-Baselines3 keeps them, even
        without this package.

        :raises ConfigError: a vehicle that cannot be loaded.
        """
        changes: dict[str, Any] = {"vehicle": first_vehicle(self.vehicle), **UNRECORDED}
        if isinstance(self.noise, list):
            changes["noise"] = float(np.mean(self.noise))
        for name in ("observation_mean", "observation_std"):
            if np.ndim(getattr(self, name) or ()) == 2:
                changes[name] = getattr(self, name)[0]
        if self.rotor_layout is not None:
            changes["rotor_layout"] = load_vehicle(self.rotor_layout)
        if self.reference is not None and self.reference.curve in ("file", "function"):
            # A function cannot be written, and the file may not be where the zip is read. The agent
            # does not need either: it follows any reference.
            changes["reference"] = None
        setattr(model, KEY, self.model_copy(update=changes).model_dump(mode="json"))


def levels(noise: Any) -> tuple[FloatArray, FloatArray]:
    """Return the relative level, () or (rows,), and the additive level, (), of a valid
    ``NoiseLevel``.
    """
    if isinstance(noise, Noise):
        return np.asarray(noise.relative), np.asarray(noise.additive)
    return np.asarray(noise, np.float64), np.zeros(())


def estimator_of(noise: Any) -> EstimatorError | None:
    """Return the estimator's error in a valid ``NoiseLevel``."""
    return noise.estimator if isinstance(noise, Noise) else None


def in_words(noise: Any) -> str:
    """Return noise such as ``5 %``, or ``5 % and 2 % of σ``; the mean if rows differ."""
    relative, additive = levels(noise)
    text = f"{100 * relative.mean():g} %"
    if additive:
        text += f" and {100 * additive.mean():g} % of σ"
    if estimator_of(noise):
        text += ", of an estimate that is off"
    return text
