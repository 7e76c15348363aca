"""The classes that settings name, and the keywords that their constructors take.

These are the algorithms that can be trained, and a user's callbacks and wrappers.
"""

import inspect
import pkgutil
import typing
from contextlib import suppress
from typing import Any

import gymnasium
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_quad.base.errors import ConfigError, raised_as, refuse_unknown
from sb3_quad.base.imports import import_name
from sb3_quad.base.literals import parse_mapping, parse_value
from sb3_quad.base.types import StrDict
from sb3_quad.base.validate import check

# Imported when first needed.
ALGORITHMS = {
    "dagger": "sb3_quad.algorithms.dagger:DAgger",
    "ppo_bc": "sb3_quad.algorithms.ppo_bc:PPOBC",
    "apg": "sb3_quad.algorithms.apg:APG",
    "ppo": "stable_baselines3.ppo.ppo:PPO",
}
BASES = {
    "callback": BaseCallback,
    "env_wrapper": gymnasium.Wrapper,
    "vec_env_wrapper": VecEnvWrapper,
}
"""The keys of the settings that name classes, and the base class that each asks for."""
# A training job sets these itself, so they are not settings of an algorithm.
_SET_BY_JOB = (
    "policy",
    "env",
    "expert",
    "initial_policy",
    "cost",
    "policy_kwargs",
    "verbose",
    "tensorboard_log",
    "device",
    "seed",
)
_LINEAR = "lin_"


def get_algorithm(name: str) -> type[BaseAlgorithm]:
    """Return the class of an algorithm.

    :raises ConfigError: an unknown name.
    """
    refuse_unknown("algorithm", [name], ALGORITHMS)
    return pkgutil.resolve_name(ALGORITHMS[name])  # type: ignore[no-any-return]


def takes_expert(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the algorithm learns from an expert."""
    return "expert" in inspect.signature(algorithm.__init__).parameters


def constructor_parameters(algorithm: type) -> dict[str, inspect.Parameter]:
    """Return the keywords of a constructor, an algorithm's or a policy's, that settings may give.

    Each annotation is a type. It is Any where an annotation is missing or has a name that cannot be
    resolved.
    """
    # SB3's GymEnv contains "VecEnv" as a string, which only some of its modules can resolve.
    try:
        types = typing.get_type_hints(
            algorithm.__init__,  # type: ignore[misc]
            localns={"VecEnv": VecEnv},
            include_extras=True,
        )
    except NameError:
        types = {}
    parameters = {}
    for name, parameter in inspect.signature(algorithm).parameters.items():
        if (
            name not in _SET_BY_JOB
            and not name.startswith("_")
            and parameter.kind is not parameter.VAR_KEYWORD
        ):
            parameters[name] = parameter.replace(annotation=types.get(name, Any))
    return parameters


def convert(value: Any, parameter: inspect.Parameter, where: str) -> Any:
    """Convert ``value`` to what the constructor's ``parameter``, whose annotation is a type,
    accepts.

    Strings become literals or, as ``lin_x``, SB3's ``LinearSchedule(x, 0, 1)``, which every SB3 can
    unpickle.

    :raises ConfigError: text instead of a number, a fraction instead of a whole number, another
        type; NaN or infinity; a number out of range, also at the start of a schedule.
    """
    if not (isinstance(value, str) and value.startswith(_LINEAR)):
        if isinstance(value, str):
            value = parse_value(value)
        return check(parameter.annotation, value, where)
    start = check(float, value.removeprefix(_LINEAR), f"{where}: the number after {_LINEAR}")
    check(parameter.annotation, start, where)
    schedule = LinearSchedule(start, 0.0, 1.0)
    with suppress(ConfigError):
        check(parameter.annotation, schedule, where)
        return schedule
    raise ConfigError(f"{where} is {value!r}, but it takes no schedule")


def as_list(value: Any) -> Any:
    """Return a list or tuple as it is, None as an empty list, anything else as its only entry."""
    if value is None:
        return []
    return value if isinstance(value, (list, tuple)) else [value]


def qualified_classes(value: Any, where: str) -> list[tuple[str, StrDict]]:
    """Return ``package.module.Class`` and keywords of each class, from any of rl-zoo's three forms.

    These are a name, ``{name: keywords}``, or a list of both.

    :raises ConfigError: another form, or see :func:`import_class`.
    """
    classes = []
    for entry in as_list(value):
        form = {entry: None} if isinstance(entry, str) else entry
        if not isinstance(form, dict) or len(form) != 1:
            raise ConfigError(
                f"{where}: {entry!r} must be package.module.Class, "
                "or {package.module.Class: {…}}"
            )
        for name, keywords in form.items():
            import_class(name, where)
            classes.append((name, parse_mapping(keywords, f"{where}.{name}")))
    return classes


def import_class(path: str, where: str) -> Any:
    """Import the class at ``package.module.Class``.

    :param where: the key that names it, one of ``BASES``.
    :raises ConfigError: a module or a name that does not exist, or anything but a class of the kind
        that the key requires.
    """
    named = import_name(path, where)
    base = BASES[where]
    if not (isinstance(named, type) and issubclass(named, base)):
        raise ConfigError(
            f"{where}: {path} is not a {base.__name__}; "
            f"name a subclass of {base.__module__}.{base.__name__}"
        )
    return named


def instance(path: str, where: str, *arguments: Any, **keywords: Any) -> Any:
    """Make an instance of the class at ``package.module.Class``.

    :raises ConfigError: see :func:`import_class`; or the class does not take these keywords.
    """
    # A user's class may raise anything.
    with raised_as(ConfigError, f"{where}: {path} cannot be made with {keywords}"):
        return import_class(path, where)(*arguments, **keywords)
