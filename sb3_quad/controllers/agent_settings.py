"""How the agent in a zip flies, as training has written it there or beside it."""

from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.controllers.zips import saved_data
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.simulation.settings import KEY, FlightSettings
from sb3_quad.simulation.tasks import Task
from sb3_quad.simulation.vehicle_distribution import DISTRIBUTIONS
from sb3_quad.vehicles.vehicle import VEHICLES, Vehicle


def agent_settings(zip_file: str | Path) -> tuple[FlightSettings, Path | None]:
    """How the agent in a zip flies, and the file that says so: the zip, else the run's settings
    beside it; None: neither.

    Beside it, ``env_kwargs`` in the run's ``args.yml``, also in one of rl_zoo3, is what the agent
    was judged with; without it, that is in its ``config.yml``. Where nothing says how it flies,
    that is as ``FlightSettings()``.

    :raises ConfigError: a zip or settings that cannot be read or do not fit; several runs' settings
        lie there, or statistics of VecNormalize, which are no part of a zip.
    """
    record = saved_data(zip_file).get(KEY)
    if isinstance(record, dict):
        where, task, vehicle = f"{zip_file}: {KEY}", record.get("task"), record.get("vehicle")
        if isinstance(task, dict) and "name" in task:  # else a mixture
            record["task"] = validate(Task, task, where)
        _refuse_paths(record, where)
        return validate(
            FlightSettings, {**record, "vehicle": validate(Vehicle, vehicle, where)}, where
        ), Path(zip_file)
    folder = Path(zip_file).parent
    statistics = sorted(folder.glob("*/vecnormalize.pkl"))
    if statistics:
        raise ConfigError(
            f"{zip_file}: was trained with VecNormalize ({statistics[0]}), which the zip does not hold"
        )
    files = sorted(folder.glob("*/config.yml"))
    if not files:
        return FlightSettings(), None
    if len(files) > 1:
        raise ConfigError(
            f"{zip_file}: several config.yml files lie beside it ({', '.join(map(str, files))})"
        )
    settings, where = read_yaml(files[0]), f"{files[0]}: env_kwargs"
    file = files[0].with_name("args.yml")
    judged = read_yaml(file).get("env_kwargs") if file.is_file() else None
    parts = (
        [judged]
        if judged is not None
        else [settings.get(key) for key in ("env_kwargs", "eval_env_kwargs")]
    )
    name = files[0].parent.name
    given: dict[str, Any] = {"task": ENVIRONMENTS[name]} if name in ENVIRONMENTS else {}
    for part in parts:
        given |= parse_mapping(part, where)
    return validate(FlightSettings, given, where), files[0]


def _refuse_paths(record: dict[str, Any], where: str) -> None:
    """See that a zip, which may come from anybody, opens no file of this machine: a device may
    never end.

    :raises ConfigError: it gives a path where there may be a name.
    """
    vehicles = record.get("vehicles")
    distribution = vehicles.get("distribution") if isinstance(vehicles, dict) else vehicles
    sources = {
        "rotor_layout": (VEHICLES, record.get("rotor_layout")),
        "vehicles": (DISTRIBUTIONS, distribution),
    }
    for key, (folder, source) in sources.items():
        if isinstance(source, str) and folder.is_path(source):
            raise ConfigError(
                f"{where}: {key}: {source!r} is a path; a zip holds such files or names those of the package"
            )


def env_kwargs(agent: str | Path) -> dict[str, Any]:
    """What the environments must be given so that they fly as an agent was trained to: its vehicle,
    noise and observation.

    >>> import gymnasium, sb3_quad
    >>> env = gymnasium.make("QuadTargetTracking-v0", **sb3_quad.env_kwargs("itm-robust"))

    :param agent: a zip, a run folder, or the name of a policy that comes with the package.
    :raises ConfigError: a zip or settings that cannot be read.
    """
    return agent_settings(agent_path(str(agent)))[0].in_any_task()
