"""Classes that settings name by ``package.module.Class``: callbacks and wrappers of the user's."""

from typing import Any

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.imports import import_name
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.types import StrDict

BASES: dict[str, type] = {
    "callback": BaseCallback,
    "env_wrapper": gymnasium.Wrapper,
    "vec_env_wrapper": VecEnvWrapper,
}
"""The keys of the settings that name classes, and the base class that each asks for."""


def as_list(value: Any) -> Any:
    """Return a list or tuple as it is, None as an empty list, anything else as its only entry."""
    if value is None:
        return []
    return value if isinstance(value, (list, tuple)) else [value]


def qualified_classes(value: Any, where: str) -> list[tuple[str, StrDict]]:
    """Return ``package.module.Class`` and keywords of each class, from any of rl-zoo's three forms.

    These are a name, ``{name: keywords}``, or a list of both.

    :raises ConfigError: another form, or as :func:`import_class`.
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
            import_class(str(name), where)
            classes.append((str(name), parse_mapping(keywords, f"{where}.{name}")))
    return classes


def import_class(path: str, where: str) -> Any:
    """Import the class at ``package.module.Class``.

    :param where: the key that names it, one of ``BASES``.
    :raises ConfigError: a module or a name that does not exist, or anything but a class of the kind
        that the key is for.
    """
    try:
        named = import_name(path)
    except (Exception, SystemExit) as error:  # the module may do anything when it is imported
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{where}: {path} cannot be imported ({reason})") from None
    base = BASES[where]
    if not (isinstance(named, type) and issubclass(named, base)):
        raise ConfigError(
            f"{where}: {path} is not a {base.__name__}; "
            f"name a subclass of {base.__module__}.{base.__name__}"
        )
    return named


def instance(path: str, where: str, *arguments: Any, **keywords: Any) -> Any:
    """Make an instance of the class at ``package.module.Class``.

    :raises ConfigError: as :func:`import_class`; or the class does not take these keywords.
    """
    try:
        return import_class(path, where)(*arguments, **keywords)
    except SB3QuadError:
        raise
    except Exception as error:  # a user's class may raise anything
        raise ConfigError(
            f"{where}: {path} cannot be made with {keywords} ({type(error).__name__}: {error})"
        ) from error
