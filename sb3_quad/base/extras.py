"""Packages that only some commands need."""

from __future__ import annotations

import importlib
from typing import Any

from sb3_quad.base.errors import MissingExtra


def require(module: str, extra: str, what: str) -> Any:
    """The module, imported.

    :param extra: of this package, which brings it.
    :param what: needs it, for the message.
    :raises MissingExtra: it cannot be imported; the message says what to install.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(f"{what} needs {module} ({error}): pip install 'sb3_quad[{extra}]'") from None
