"""How a run flies: the one record of it, written by training into every zip, read by all that flies its agent."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sb3_quad.base.validate import validate
from sb3_quad.simulation import MAX_EPISODE_STEPS
from sb3_quad.simulation.designs import VehicleDistribution
from sb3_quad.simulation.memory import Memory
from sb3_quad.simulation.noise import NoiseLevel
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle, load_vehicle

Steps = Annotated[int, Field(gt=0, lt=2**62)]
KEY = "flight_settings"  # of a model, and so of the JSON in its zip


class FlightSettings(Memory):
    """What an agent is flown with: keywords of the quadcopter environments, ``env_kwargs`` in YAML; ``dict`` gives them."""

    task: Any = Field(default="target_tracking", description="name, Task, or mixture {name: weight}")
    task_kwargs: dict[str, Any] | None = Field(default=None, description="fields of the task to override")
    vehicle: Any = Field(
        default="itm", description="name, path or Vehicle; or a list, of which row i flies number i, counted round"
    )
    rotor_layout: str | Vehicle | None = Field(
        default=None, description="name, path or Vehicle whose order of the rotors the agent knows"
    )
    noise: NoiseLevel = Field(default=0.05, description="relative standard deviation of the observation noise, or Noise")
    observation_mean: Any = Field(default=None, description="μ of Eq. 3.16, (18,); None: zero")
    observation_std: Any = Field(default=None, description="σ of Eq. 3.16, (18,); None: Table A.2")
    vehicles: VehicleDistribution | None = Field(
        default=None, description="fields of VehicleDistribution, or {distribution: name}: each episode has a vehicle of it"
    )
    randomize: Randomization | None = Field(default=None, description="fields of Randomization: what differs by episode")
    max_episode_steps: Steps | Annotated[list[Steps], Field(min_length=1)] = Field(
        default=MAX_EPISODE_STEPS,
        description="control steps of an episode; or a list, of which row i has number i, counted round",
    )

    @property
    def longest_episode(self) -> int:
        """Control steps of an episode, or of the longest where rows differ."""
        steps = self.max_episode_steps
        return max(steps) if isinstance(steps, list) else steps

    def given(self) -> dict[str, Any]:
        """The keywords that are not left at their defaults."""
        return {name: value for name, value in self if name in self.model_fields_set}

    def in_any_task(self) -> dict[str, Any]:
        """Of these, what an agent must be flown with in any task: vehicle or vehicles, noise, and what it sees."""
        others = ("task", "task_kwargs", "max_episode_steps", "randomize")
        return {name: value for name, value in self.given().items() if name not in others}

    @property
    def observed(self) -> dict[str, Any]:
        """What goes with an agent wherever it flies: how its observations are scaled, its rotors' order, what it remembers."""
        scaling = {"observation_mean": self.observation_mean, "observation_std": self.observation_std}
        return {**scaling, **self.model_dump(mode="json", include={*Memory.model_fields, "rotor_layout"})}

    def with_changes(self, **changes: Any) -> "FlightSettings":
        """The same with some fields changed; a ``vehicle`` replaces ``vehicles``.

        :raises ConfigError: an unknown field, or a value that does not fit.
        """
        own = {**dict(self), "vehicles": None} if "vehicle" in changes else dict(self)
        return validate(FlightSettings, {**own, **changes}, "env_kwargs")

    def write_into(self, model: Any) -> None:
        """Make these settings a part of an SB3 model: ``model.flight_settings``, plain JSON with the vehicle's parameters.

        Its zips hold them from then on, and ``load`` of Stable-Baselines3 carries them along, also without this package.

        Of several vehicles it is the first.

        :raises ConfigError: a vehicle that cannot be loaded.
        """
        scaling = {name: getattr(self, name) for name in ("observation_mean", "observation_std")}
        lists = {name: np.array(values).tolist() for name, values in scaling.items() if values is not None}
        whole = {**lists, "vehicle": first_vehicle(self.vehicle), "vehicles": self.vehicles}
        whole["rotor_layout"] = None if self.rotor_layout is None else load_vehicle(self.rotor_layout)
        setattr(model, KEY, self.with_changes(**whole).model_dump(mode="json"))
