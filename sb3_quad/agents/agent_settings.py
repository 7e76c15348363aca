"""The flight settings of the agent in a zip, as training wrote them into or next to it."""

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.zips import refuse_settings, saved_data
from sb3_quad.algorithms.chain import WRAPPERS, refuse_wrapped
from sb3_quad.algorithms.labelling import name_beside
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.process import print_once
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD
from sb3_quad.envs.simulation.settings import KEY, UNRECORDED, FlightSettings
from sb3_quad.envs.simulation.tasks import Task
from sb3_quad.envs.simulation.vehicle_distribution import DISTRIBUTIONS, beyond
from sb3_quad.envs.vehicles.layout import Turn, find_turn
from sb3_quad.envs.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle


def agent_settings(zip_file: StrPath, model: Any = None) -> tuple[FlightSettings, Path | None]:
    """Return how the agent in a zip flies, and the file that says so.

    The file is the zip itself, or else a ``config.yml`` in a folder next to it, where runs of this
    package and of rl_zoo3 keep their settings. If neither says how the agent flies, the settings
    are ``FlightSettings()`` and the file is None.

    :param model: the model in the zip, if it has been loaded already.
    :raises ConfigError: a zip or settings that cannot be read or do not fit; settings of several
        runs next to the zip; or an agent of wrappers, which flights here do not have.
    """
    # Zips of this package contain the settings.
    data = saved_data(zip_file) if model is None else vars(model)
    refuse_wrapped(str(zip_file), data.get(WRAPPERS), [])
    if KEY in data:
        return settings_of_record(data[KEY], f"{zip_file}: {KEY}"), Path(zip_file)

    # Other zips, such as those of rl_zoo3, are in a run folder.
    configs = sorted(Path(zip_file).parent.glob("*/config.yml"))
    if not configs:
        return FlightSettings(), None
    if len(configs) > 1:
        raise ConfigError(
            f"{zip_file}: several config.yml files lie next to it ({', '.join(map(str, configs))})"
        )
    refuse_settings(zip_file)
    return _settings_of_run(configs[0]), configs[0]


def unlike_trained(label: str, own: FlightSettings, flown: Vehicle) -> str:
    """Return a warning if an agent was trained on another vehicle than ``flown``, or on many whose
    ranges do not include it; otherwise an empty text.

    :param own: the agent's settings.
    """
    if own.vehicles is not None:
        outside = own.vehicles.outside(flown)
        if own.randomize is not None and own.randomize.delay is not None:
            outside += beyond("delay in control steps", flown.delay, own.randomize.delay)
        if not outside:
            return ""
        return f"{label}: {flown.name} is outside of the ranges that it knows: {', '.join(outside)}"
    trained = first_vehicle(own.vehicle)
    if trained.flies_as(flown):
        return ""
    flies = name_beside(trained, flown)
    return f"{label}: was trained on the vehicle {trained.name} and flies {flies}"


def warn_of_observation(name: str, agent: Any, here: Any) -> None:
    """Warn if an agent was trained with other observations of the same size, or with its rotors in
    another order.

    :param name: what the warning calls the agent.
    :param agent: a model. One that does not say how it flies gives no warning.
    :param here: the flight settings with which it is to fly, as a record or as an object; None:
        unknown.
    :raises ConfigError: settings that do not fit, or rotors in other places.
    """
    record = getattr(agent, KEY, None)
    if not record or not here:
        return
    own = settings_of_record(record, f"{name}: {KEY}")
    if not isinstance(here, FlightSettings):
        here = settings_of_record(here, KEY)
    differences = []
    theirs, ours = _observed(own), _observed(here)
    for key, before in theirs.items():
        now = ours[key]
        # Training flies without the integral that evaluations use. An agent may start without it
        # and the preview, and get them later: new weights begin at zero, and the integral changes
        # nothing until there is a steady error.
        is_optional = (key == "position_integral" and not now) or (
            key in ("preview", "position_integral") and not before
        )
        if before == now or is_optional:
            continue
        if not key.startswith("observation_"):
            differences.append(f"{key} {before}, here {now}")
        # With a scaling for each row, any of several vehicles may be the agent's. For 18 numbers,
        # the name is enough.
        elif np.ndim(before) == np.ndim(now) == 1:
            differences.append(key)
    if find_turn(here.layout, own.layout) != Turn():
        differences.append(f"rotor_layout {own.layout.name}, here {here.layout.name}")
    if differences:
        print_once(
            f"warning: {name}: was trained with another observation ({'; '.join(differences)});"
            " sb3_quad.env_kwargs(agent) gives its own"
        )


def _observed(settings: FlightSettings) -> StrDict:
    """Return the settings of the observation, with the defaults of those that are not given."""
    observed = settings.observed
    observed |= {
        "history": [*settings.ages],
        "observation_mean": settings.observation_mean or DEFAULT_MEAN.tolist(),
        "observation_std": settings.observation_std or DEFAULT_STD.tolist(),
    }
    # An agent of other actions is refused elsewhere.
    del observed["rotor_layout"], observed["action"]
    return observed


def settings_of_model(model: Any) -> FlightSettings | None:
    """Return the flight settings that a model has; None: it has none.

    :raises ConfigError: they do not fit.
    """
    record = getattr(model, KEY, None)
    if not isinstance(record, dict):
        return None
    return settings_of_record(record, f"{type(model).__name__}.{KEY}")


def settings_of_record(record: Any, where: str) -> FlightSettings:
    """Return the settings in a zip or a model.

    :param where: what messages call the record.
    :raises ConfigError: it does not fit.
    """
    if not isinstance(record, dict):
        raise ConfigError(f"{where}: must be what FlightSettings(...).write_into(model) writes")
    # A path in a stranger's zip could name a device file, which would be read forever. Both a
    # vehicle and a distribution may be given by a name, which could be a path.
    distribution = record.get("vehicles")
    if isinstance(distribution, dict):
        distribution = distribution.get("distribution")
    for folder, source in (
        (VEHICLES, record.get("rotor_layout")),
        (DISTRIBUTIONS, distribution),
    ):
        if isinstance(source, str) and folder.is_path(source):
            raise ConfigError(f"{where}: {source!r} is a path; a zip holds what it needs")
    # A task is saved by its fields; a mixture has weights by name instead.
    task = record.get("task")
    # Zips of before say which of two kinds of features they have; the other kind is gone.
    record = {key: value for key, value in record.items() if (key, value) != ("features", "body")}
    changes: StrDict = {"vehicle": validate(Vehicle, record.get("vehicle"), where)}
    if isinstance(task, dict) and "name" in task:
        changes["task"] = validate(Task, task, where)
    # The files of recordings and references in a zip are not opened, for the same reason.
    settings = validate(FlightSettings, {**record, **changes, **UNRECORDED}, where)
    if settings.reference is not None and settings.reference.curve == "file":
        settings = settings.model_copy(update={"reference": None})
    return settings


def _settings_of_run(config: Path) -> FlightSettings:
    """Return the settings that the agent of a run was evaluated with.

    They are ``env_kwargs`` in ``args.yml``, if it has some, otherwise those in ``config.yml``.
    """
    settings = read_yaml(config)
    parts = [settings.get("env_kwargs"), settings.get("eval_env_kwargs")]
    arguments = config.with_name("args.yml")
    if arguments.is_file():
        evaluated = read_yaml(arguments).get("env_kwargs")
        if evaluated is not None:
            parts = [evaluated]

    # The folder has the name of the environment, which tells the task.
    where = f"{config}: env_kwargs"
    given = {}
    if config.parent.name in ENVIRONMENTS:
        given["task"] = ENVIRONMENTS[config.parent.name]
    for part in parts:
        given |= parse_mapping(part, where)
    return validate(FlightSettings, given, where)


def env_kwargs(agent: StrPath | BaseAlgorithm, **changes: Any) -> StrDict:
    """Return the keywords of environments like those that an agent was trained in.

    These are its vehicle, noise and observation.

    >>> import gymnasium, sb3_quad
    >>> env = gymnasium.make("QuadTargetTracking-v0", **sb3_quad.env_kwargs("itm-robust"))

    :param agent: a zip, a run folder, the name of a policy that comes with the package, or a model.
    :param changes: keywords of your own, which replace the agent's: ``vehicle="mine.yaml"`` flies
        it on your vehicle, also where it was trained on ``vehicles``.
    :raises ConfigError: a zip or settings that cannot be read; an agent without settings.
    """
    if isinstance(agent, BaseAlgorithm):
        settings = settings_of_record(getattr(agent, KEY, None), f"{type(agent).__name__}.{KEY}")
    else:
        settings, source = agent_settings(agent_path(str(agent)))
        if source is None:
            raise ConfigError(
                f"{agent}: does not say how its agent flies; give the keywords that it was trained"
                " with"
            )
    keywords = settings.in_any_task()
    if "vehicle" in changes:
        keywords.pop("vehicles", None)
    return {**keywords, **changes}
