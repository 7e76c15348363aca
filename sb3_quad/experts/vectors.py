"""Vectors and matrices as tuples, for compiled code: numba keeps them in registers."""

from sb3_quad.simulation.compiled import inlined


@inlined
def vector_at(array, row, column):
    """Return three rows of a column, from ``row`` on."""
    return array[row, column], array[row + 1, column], array[row + 2, column]


@inlined
def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    """Return a × b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inlined
def total(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def difference(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def divided(a, divisor):
    """Return a / divisor."""
    return a[0] / divisor, a[1] / divisor, a[2] / divisor
