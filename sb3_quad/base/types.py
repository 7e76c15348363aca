"""Types that appear in many signatures, named once."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[np.uint8]
AnyArray = npt.NDArray[Any]
Arrays = dict[str, AnyArray]

StrDict = dict[str, Any]
StrMapping = Mapping[str, Any]
StrPath = str | Path

# Receives one line of progress, such as ``print``.
Report = Callable[[str], None]
