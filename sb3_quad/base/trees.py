"""Trees in files from strangers, checked before anything else walks over them."""

from collections.abc import Callable, Collection
from typing import Any


def walk(root: Any, held: Callable[[Any], Collection[Any]], most: int, deepest: int = 50) -> int:
    """Walk over everything that an object contains, and return how much of ``most`` is left.

    A few lines of a file can contain an object so many times, or so deep, that a program that
    copies or shows it never ends. Here each object counts as often as it occurs.

    :param held: returns what an object contains.
    :param most: the maximum number of objects.
    :param deepest: the maximum depth.
    :raises ValueError: there are more, or one contains itself.
    """
    for part in held(root):
        most -= 1
        if most < 0 or deepest == 0:
            raise ValueError("too many values, or too deep; one that is repeated counts each time")
        most = walk(part, held, most, deepest - 1)
    return most
