"""How quadcopters fly: every keyword of the environments, declared once; training writes them into
every zip.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.simulation import MAX_EPISODE_STEPS
from sb3_quad.simulation.frames import ObservationSettings
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.simulation.tasks import resolve_tasks
from sb3_quad.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle, load_vehicle

ENDLESS = 2**62 - 1  # the most control steps an episode can have
Steps = Annotated[int, Field(gt=0, le=ENDLESS)]
AsList = BeforeValidator(
    lambda value: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
)
Scaling = Annotated[list[float] | list[list[float]] | None, AsList]
KEY = "flight_settings"  # of a model, and so of the JSON in its zip
Level = Annotated[float, Field(ge=0, le=100)]


class Noise(Frozen):
    """Standard deviations of a feature x with scale σ (Eq. 3.16): √((relative x)² + (additive σ)²).

    That is the sum of two independent normal disturbances; one number for short is ``relative``.
    """

    relative: Level = Field(
        default=0.0, description="in shares of the feature itself, 0.05 in the thesis"
    )
    additive: Level = Field(
        default=0.0, description="in shares of σ, the same wherever the vehicle is"
    )


NoiseLevel = Level | list[Level] | Noise


class FlightSettings(ObservationSettings):
    """Keywords of the quadcopter environments, ``env_kwargs`` in YAML; ``dict`` gives them.

    Where a value may differ by row, row i of n environments has the i-th; fewer vehicles or steps
    than rows repeat.
    """

    task: Any = Field(
        default="target_tracking", description="name, Task, or mixture {name: weight}"
    )
    task_kwargs: dict[str, Any] | None = Field(
        default=None, description="fields of the task to override"
    )
    vehicle: Any = Field(
        default="itm",
        description="name, path or Vehicle; or a list of them, whose time steps agree",
    )
    rotor_layout: str | Path | Vehicle | None = Field(
        default=None, description="name, path or Vehicle whose order of the rotors the agent knows"
    )
    noise: Annotated[NoiseLevel, AsList] = Field(
        default=0.05,
        description="relative standard deviation of the observation noise, Noise, or a number for each row",
    )
    observation_mean: Scaling = Field(
        default=None, description="μ of Eq. 3.16, (18,) or (n, 18); None: zero"
    )
    observation_std: Scaling = Field(
        default=None, description="σ of Eq. 3.16, (18,) or (n, 18); None: Table A.2"
    )
    vehicles: VehicleDistribution | None = Field(
        default=None,
        description="fields of VehicleDistribution, or {distribution: name}: each episode has a vehicle of it",
    )
    randomize: Randomization | None = Field(
        default=None, description="fields of Randomization: what differs by episode"
    )
    max_episode_steps: Steps | Annotated[list[Steps], Field(min_length=1)] = Field(
        default=MAX_EPISODE_STEPS,
        description="control steps after which an episode is truncated; or a list of them",
    )

    @model_validator(mode="after")
    def _known_task(self) -> "FlightSettings":
        resolve_tasks(self.task, self.task_kwargs)
        return self

    @property
    def longest_episode(self) -> int:
        """Control steps of an episode, or of the longest where rows differ."""
        steps = self.max_episode_steps
        return max(steps) if isinstance(steps, list) else steps

    @property
    def observation(self) -> ObservationSettings:
        """What an observation is made of, alone."""
        return ObservationSettings(
            **{name: getattr(self, name) for name in ObservationSettings.model_fields}
        )

    def in_any_task(self) -> dict[str, Any]:
        """The settings that are not left at their defaults and do not belong to a task: vehicles,
        noise, observation.
        """
        others = ("task", "task_kwargs", "max_episode_steps", "randomize")
        return {
            name: value
            for name, value in self
            if name in self.model_fields_set and name not in others
        }

    @property
    def observed(self) -> dict[str, Any]:
        """What goes with an agent wherever it flies: scaling and frames of its observations, and
        its rotors' order.
        """
        scaling = {
            "observation_mean": self.observation_mean,
            "observation_std": self.observation_std,
        }
        return {
            **scaling,
            **self.model_dump(
                mode="json", include={*ObservationSettings.model_fields, "rotor_layout"}
            ),
        }

    @property
    def layout(self) -> Vehicle:
        """The vehicle whose axes and order of the rotors an agent with these settings knows."""
        return first_vehicle(self.vehicle if self.rotor_layout is None else self.rotor_layout)

    def with_changes(self, **changes: Any) -> "FlightSettings":
        """The same with some fields changed; a ``vehicle`` replaces ``vehicles``.

        :raises ConfigError: an unknown field, or a value that does not fit.
        """
        own = {**dict(self), "vehicles": None} if "vehicle" in changes else dict(self)
        return validate(FlightSettings, {**own, **changes}, "env_kwargs")

    def write_into(self, model: Any) -> None:
        """Make these settings a part of an SB3 model: ``model.flight_settings``, plain JSON with
        the vehicle's parameters.

        Its zips hold them from then on, and ``load`` of Stable-Baselines3 carries them along, also
        without this package. Of several vehicles it is the first.

        :raises ConfigError: a vehicle that cannot be loaded.
        """
        layout = None if self.rotor_layout is None else load_vehicle(self.rotor_layout)
        changes = {
            "vehicle": first_vehicle(self.vehicle),
            "vehicles": self.vehicles,
            "rotor_layout": layout,
        }
        setattr(model, KEY, self.with_changes(**changes).model_dump(mode="json"))


def known_layout(model: Any) -> Vehicle | None:
    """The layout that a model knows, by what :meth:`FlightSettings.write_into` wrote; None: it
    holds nothing of that kind.

    :raises ConfigError: what it holds does not fit.
    """
    own = getattr(model, KEY, None)
    if not isinstance(own, dict):
        return None
    return validate(
        Vehicle,
        own.get("rotor_layout") or own.get("vehicle"),
        f"{type(model).__name__}.{KEY}: vehicle",
    )


def levels(noise: Any) -> tuple[FloatArray, FloatArray]:
    """The relative and the additive level of a valid ``NoiseLevel``, () or (rows,) each."""
    relative, additive = (
        (noise.relative, noise.additive) if isinstance(noise, Noise) else (noise, 0.0)
    )
    return np.asarray(relative, np.float64), np.asarray(additive)


def in_words(noise: Any) -> str:
    """Such as ``5 %``, or ``5 % and 2 % of σ``; of several rows the mean."""
    relative, additive = (100 * level.mean() for level in levels(noise))
    return f"{relative:g} %" + (f" and {additive:g} % of σ" if additive else "")
