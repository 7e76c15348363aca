"""Vectors and matrices as tuples, for compiled code: numba keeps them in registers."""

from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.physics import rotation_rows


@compiled(inline="always")
def vector_at(array, row, column):
    """Return three rows of a column, from ``row`` on."""
    return array[row, column], array[row + 1, column], array[row + 2, column]


@compiled(inline="always")
def rotations_at(state, row, column):
    """Return R, body to world, and Rᵀ, world to body, of the quaternion from ``row`` on."""
    w = state[row, column]
    x, y, z = vector_at(state, row + 1, column)
    return rotation_rows(w, x, y, z), rotation_rows(w, -x, -y, -z)


@compiled(inline="always")
def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(inline="always")
def cross(a, b):
    """Return a × b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled(inline="always")
def difference(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled(inline="always")
def divided(a, divisor):
    """Return a / divisor."""
    return a[0] / divisor, a[1] / divisor, a[2] / divisor


@compiled(inline="always")
def rotated(rotation, a):
    """Return R a."""
    return dot(rotation[0], a), dot(rotation[1], a), dot(rotation[2], a)


@compiled(inline="always")
def plus_dot(start, a, b):
    """Return start + a · b, summed from left to right."""
    return start + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(inline="always")
def plus_rotated(start, rotation, a):
    """Return start + R a."""
    return (
        plus_dot(start[0], rotation[0], a),
        plus_dot(start[1], rotation[1], a),
        plus_dot(start[2], rotation[2], a),
    )
