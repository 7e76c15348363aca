"""The infos of a step, which cost time only for rows that someone looks at."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.base.types import Float32Array, StrDict


class Ended(NamedTuple):
    """What a step knows of the k rows that have ended, in arrays that no later step changes."""

    places: dict[int, int]
    """of each row, its place in the arrays"""
    outcomes: npt.NDArray[np.void]
    """(k,) of ``OUTCOME``"""
    observations: Float32Array
    """their last ones, (k, observation size)"""
    elapsed: float
    """s since the environment was made"""

    def info(self, row: int) -> StrDict:
        """Return the info of one of these rows."""
        k = self.places[row]
        total, _, length, distance, collision, out_of_range, truncated, success = (
            self.outcomes.item(k)
        )
        # Not by a loop over ``INFOS``, which takes twice as long.
        return {
            "terminal_observation": self.observations[k],
            "TimeLimit.truncated": truncated,
            "episode": {"r": round(total, 6), "l": length, "t": self.elapsed},
            "is_success": success,
            "survival": truncated,
            "distance": distance,
            "collision": collision,
            "out_of_range": out_of_range,
        }


class Infos(list[Any]):
    """One dictionary for each row, each new in this step, so that anybody may keep it or write into
    it. Until somebody looks at one, None stands for it.
    """

    def __init__(self, nothing: list[None], ended: Ended | None = None) -> None:
        super().__init__(nothing)
        self._ended = ended

    def _write(self, row: int) -> StrDict:
        """Write the info of a row."""
        info: StrDict = {}
        if self._ended is not None and row in self._ended.places:
            info = self._ended.info(row)
        self[row] = info
        return info

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return [*self][row]
        info = super().__getitem__(row)
        return self._write(row % len(self)) if info is None else info

    def __iter__(self) -> Iterator[StrDict]:
        if self._ended is not None:
            for row in self._ended.places:
                if super().__getitem__(row) is None:
                    self._write(row)
        self[:] = [{} if info is None else info for info in super().__iter__()]
        return super().__iter__()

    def __eq__(self, other: object) -> bool:
        return [*self] == other

    def copy(self) -> list[StrDict]:
        """Return a plain list of these dictionaries."""
        return [*self]
