"""Types that appear in many signatures, named once."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

StrDict = dict[str, Any]
StrMapping = Mapping[str, Any]

# Receives one line of progress, such as ``print``.
Report = Callable[[str], None]

StrPath = str | Path
