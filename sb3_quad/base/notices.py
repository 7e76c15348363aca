"""Lines on stderr that a program says once, whoever uses the package."""

import functools
import sys


@functools.cache
def tell(line: str) -> None:
    """Say so on stderr; a line that was said is not said again."""
    sys.stderr.write(f"sb3_quad: {line}\n")
