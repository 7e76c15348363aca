"""Imports that wait until they are needed, and those of packages that only some commands need."""

import importlib
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from sb3_quad.base.errors import ConfigError, MissingExtra


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose names are imported on first use (PEP 562).

    :param package: its ``__name__``.
    :param modules: by name, the module that has it.
    """

    def get(name: str) -> Any:
        if name in modules:
            return getattr(importlib.import_module(modules[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules})

    return get, names


def import_name(text: str) -> Any:
    """What is at ``package.module:name`` or ``package.module.name``, which the user names."""
    search_present_folder(text.partition(":")[0])
    return pkgutil.resolve_name(text)


def search_present_folder(module: str) -> None:
    """Let a module that is not installed be imported from the present folder, where installed
    commands do not look.
    """
    here = os.getcwd()
    if here not in sys.path and importlib.util.find_spec(module.partition(".")[0]) is None:
        sys.path.append(here)


def import_packages(packages: Iterable[str], where: str) -> None:
    """Import modules that the user names, as those that register further environments.

    :param where: they are named, for the message.
    :raises ConfigError: one that cannot be imported.
    """
    for package in packages:
        try:
            search_present_folder(package)
            importlib.import_module(package)
        except (Exception, SystemExit) as error:  # whatever the module does when it is imported
            raise ConfigError(
                f"{where} {package}: cannot be imported ({type(error).__name__}: {error})"
            ) from None


def require(module: str, extra: str, what: str) -> Any:
    """The module, imported.

    :param extra: of this package, which brings it; empty: none does.
    :param what: needs it, for the message.
    :raises MissingExtra: it cannot be imported; the message says what to install.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        install = f"'.[{extra}]' from a clone of sb3_quad" if extra else module.replace("_", "-")
        raise MissingExtra(f"{what} needs {module} ({error}): pip install {install}") from None
