"""How a run flies: the one record of it, written by training into every zip, read by all that flies its agent."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import parse_mapping_file
from sb3_quad.envs.registration import ENVIRONMENTS, MAX_EPISODE_STEPS
from sb3_quad.experts.models import saved_data
from sb3_quad.pretrained_policies import agent_path
from sb3_quad.settings.literals import ZooLoader, parse_mapping
from sb3_quad.simulation.designs import VehicleDistribution
from sb3_quad.simulation.memory import Memory
from sb3_quad.simulation.noise import NoiseLevel
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.simulation.tasks import Task
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

    @staticmethod
    def of(zip_file: str | Path) -> tuple["FlightSettings", Path | None]:
        """How the agent in a zip flies, and the file that says so: the zip, else the run's settings beside it; None: neither.

        Beside it, ``env_kwargs`` in the run's ``args.yml``, also in one of rl_zoo3, is what the agent was judged with; without
        it, that is in its ``config.yml``. Where nothing says how it flies, that is as ``FlightSettings()``.

        :raises ConfigError: a zip or settings that cannot be read or do not fit; several runs' settings lie there, or
            statistics of VecNormalize, which are no part of a zip.
        """
        record = saved_data(zip_file).get(KEY)
        if isinstance(record, dict):
            where, task, vehicle = f"{zip_file}: {KEY}", record.get("task"), record.get("vehicle")
            if isinstance(task, dict) and "name" in task:  # else a mixture
                record["task"] = validate(Task, task, where)
            return validate(FlightSettings, {**record, "vehicle": validate(Vehicle, vehicle, where)}, where), Path(zip_file)
        folder = Path(zip_file).parent
        statistics = sorted(folder.glob("*/vecnormalize.pkl"))
        if statistics:
            raise ConfigError(f"{zip_file}: was trained with VecNormalize ({statistics[0]}), which the zip does not hold")
        files = sorted(folder.glob("*/config.yml"))
        if not files:
            return FlightSettings(), None
        if len(files) > 1:
            raise ConfigError(f"{zip_file}: several config.yml files lie beside it ({', '.join(map(str, files))})")
        settings, where = parse_mapping_file(files[0], ZooLoader), f"{files[0]}: env_kwargs"
        file = files[0].with_name("args.yml")
        judged = parse_mapping_file(file, ZooLoader).get("env_kwargs") if file.is_file() else None
        parts = [judged] if judged is not None else [settings.get(key) for key in ("env_kwargs", "eval_env_kwargs")]
        name = files[0].parent.name
        given: dict[str, Any] = {"task": ENVIRONMENTS[name]} if name in ENVIRONMENTS else {}
        for part in parts:
            given |= parse_mapping(part, where)
        return validate(FlightSettings, given, where), files[0]


def env_kwargs(agent: str | Path) -> dict[str, Any]:
    """What the environments must be given so that they fly as an agent was trained to: its vehicle, noise and observation.

    >>> import gymnasium, sb3_quad
    >>> env = gymnasium.make("QuadTargetTracking-v0", **sb3_quad.env_kwargs("itm-robust"))

    :param agent: a zip, a run folder, or the name of a policy that comes with the package.
    :raises ConfigError: a zip or settings that cannot be read.
    """
    return FlightSettings.of(agent_path(str(agent)))[0].in_any_task()
