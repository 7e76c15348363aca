"""Row numbers that follow from names, so that none is counted by hand."""

from collections import namedtuple
from collections.abc import Mapping
from itertools import accumulate
from typing import Any


def first_rows(sizes: Mapping[str, int]) -> Any:
    """The first row of each quantity, by its name, where ``sizes`` are how many rows each takes.

    Compiled code reads the numbers as constants.

    >>> first_rows({"position": 3, "quaternion": 4})
    Rows(position=0, quaternion=3)
    """
    starts = [0, *accumulate(sizes.values())]
    rows: Any = namedtuple("Rows", list(sizes))  # type: ignore[misc]
    return rows._make(starts[:-1])


def row_slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """The rows of each quantity, by its name."""
    return {name: slice(start, start + sizes[name]) for name, start in first_rows(sizes)._asdict().items()}
