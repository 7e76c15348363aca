"""The infos of a step, which cost time only for rows that someone looks at."""

from collections.abc import Iterator
from typing import Any

from sb3_quad.base.types import StrDict


class Infos(list[Any]):
    """One dictionary for each row, each new in this step, so that anybody may keep it or write into
    it. None stands for one that is empty until somebody looks at it.
    """

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return [*self][row]
        info = super().__getitem__(row)
        if info is None:
            info = self[row] = {}
        return info

    def __iter__(self) -> Iterator[StrDict]:
        self[:] = [{} if info is None else info for info in super().__iter__()]
        return super().__iter__()

    def __eq__(self, other: object) -> bool:
        return [*self] == other

    def copy(self) -> list[StrDict]:
        """Return a plain list of these dictionaries."""
        return [*self]
