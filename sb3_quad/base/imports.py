"""Imports that wait until they are needed, and imports of optional packages."""

import importlib
import importlib.util
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any

from sb3_quad.base.errors import ConfigError, MissingExtra, raised_as


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package that imports its names on first use
    (PEP 562).

    :param package: The package's ``__name__``.
    :param modules: The module that defines each name.
    """

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules})

    return get, names


def import_name(text: str, where: str) -> Any:
    """Import ``package.module:name``, ``package.module.name`` or a module, as given by the user.

    :param where: The flag or key that names it, for the error message.
    :raises ConfigError: It cannot be imported.
    :raises MissingExtra: It needs a package that is not installed.
    """
    # The module's own code may raise anything.
    with raised_as(ConfigError, f"{where} {text}: cannot be imported"):
        # Python searches the working directory only for scripts, not for installed commands.
        here = os.getcwd()
        package = re.split("[.:]", text)[0]
        if here not in sys.path and importlib.util.find_spec(package) is None:
            sys.path.append(here)
        return pkgutil.resolve_name(text)


def require(module: str, extra: str, what: str) -> Any:
    """Import a module that only some features need.

    :param extra: The extra of this package that installs it.
    :param what: The feature, for the error message.
    :raises MissingExtra: It cannot be imported. The message says what to install.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(
            f"{what} needs {module} ({error}): pip install '.[{extra}]' from a clone of sb3_quad"
        ) from None
