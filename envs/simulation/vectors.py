"""Vectors, matrices and polynomials as tuples, for compiled code: numba keeps them in registers.

A vector is (x, y, z), a matrix three such rows. Arrays hold a number in each row, and a vehicle, or
a lane of a block, in each column.
"""

from sb3_quad.base.compiled import inlined


@inlined
def vector_at(array, row, column):
    """Return three rows of a column, from ``row`` on."""
    return array[row, column], array[row + 1, column], array[row + 2, column]


@inlined
def vector(rows, lane):
    """Return x, y and z of a lane."""
    return rows[0, lane], rows[1, lane], rows[2, lane]


@inlined
def four(rows, lane):
    """Return the four numbers of a lane, such as those of its quaternion."""
    return rows[0, lane], rows[1, lane], rows[2, lane], rows[3, lane]


@inlined
def store(rows, lane, a):
    """Write a vector to a lane."""
    rows[0, lane], rows[1, lane], rows[2, lane] = a


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
def add(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def subtract(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def multiply(a, b):
    """Return the products of the components of a and b."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inlined
def scaled(factor, a):
    """Return factor times a."""
    return factor * a[0], factor * a[1], factor * a[2]


@inlined
def divide(a, divisor):
    """Return a / divisor."""
    return a[0] / divisor, a[1] / divisor, a[2] / divisor


@inlined
def transposed(matrix):
    """Return the transpose of a matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    return (xx, yx, zx), (xy, yy, zy), (xz, yz, zz)


@inlined
def matvec(matrix, a):
    """Return matrix times a."""
    return dot(matrix[0], a), dot(matrix[1], a), dot(matrix[2], a)


@inlined
def turn(rows, k, lane, cosine, sine):
    """Turn rows k and k + 1 of a lane, which are x and y, to axes at an angle, in place."""
    x, y = rows[k, lane], rows[k + 1, lane]
    rows[k, lane] = cosine * x + sine * y
    rows[k + 1, lane] = cosine * y - sine * x


@inlined
def polynomial(x, coefficients):
    """Return a polynomial of x by Horner's scheme. The coefficient of the highest power comes
    first.
    """
    value = coefficients[0]
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value
