"""Trees in files from strangers, before anything else walks over them."""

from collections.abc import Callable, Collection
from typing import Any


def walk(root: Any, held: Callable[[Any], Collection[Any]], most: int, deepest: int = 50) -> int:
    """Walk over all that an object holds, and return how much of ``most`` is left.

    A few lines of a file can hold an object so many times, or so deep, that a program that copies
    or shows it does not come to an end. Here each counts as often as it is held.

    :param held: returns what an object holds.
    :param most: how many there may be.
    :param deepest: in how many others one may be.
    :raises ValueError: there are more, or one holds itself.
    """
    for part in held(root):
        most -= 1
        if most < 0 or deepest == 0:
            raise ValueError("too many values, or too deep; one that is repeated counts each time")
        most = walk(part, held, most, deepest - 1)
    return most
