"""Following a reference: the compiled functions that move targets along the tables of
:mod:`.references`.

``course`` (COURSE_SIZE, n) says where each row is: the target of its episode, from which the
reference moves, and the first row of its piece in the table, below zero for a target that rests.
``numbers`` int64 (3,) are :meth:`.references.Tracks.numbers`.
"""

import numpy as np
from numba import float32, uint32

from sb3_quad.simulation.compiled import LANES, compiled, inlined
from sb3_quad.simulation.observation import heading_of
from sb3_quad.simulation.random import REFERENCE, STEP, uniforms
from sb3_quad.simulation.state import STATE_SIZE, X, first_rows

COURSE = {"anchor": 3, "begin": 1}
COURSE_SIZE = sum(COURSE.values())
C = first_rows(COURSE)
# σ of a previewed acceleration, m/s²
ACCELERATION_STD = 5.0


@inlined
def _row_at(begin, step, numbers):
    """Return the row of the table at a control step of an episode."""
    length = numbers[0]
    if numbers[1] == 0:
        return np.int64(begin) + min(step, length - 1)
    # A division of 32 bits takes a fraction of one of 64.
    return np.int64(begin) + np.int64(uint32(step) % uint32(length))


@compiled
def start_course(i, state, streams, course, table, numbers):
    """Let row i's reference begin at its target, in place, by a piece from its own stream."""
    u = uniforms(streams, i, 1, REFERENCE)
    length = numbers[0]
    begin = length * np.int64(u[0] * numbers[2])
    for axis in range(3):
        course[C.anchor + axis, i] = state[X.target + axis, i]
    course[C.begin, i] = begin
    for k in range(3, STATE_SIZE - X.target):
        state[X.target + k, i] = table[begin, k]


@compiled
def deepest(i, streams, table, numbers):
    """Return how far below its start row i's reference goes, m."""
    begin = numbers[0] * np.int64(uniforms(streams, i, 1, REFERENCE)[0] * numbers[2])
    return max(0.0, -table[begin : begin + numbers[0], 2].min())


@compiled
def follow(b, first, count, state, streams, course, table, numbers):
    """Move the targets of a block to where their references are after this control step."""
    for lane in range(LANES):
        i = b.row[lane]
        begin = course[C.begin, i]
        if begin < 0.0:
            for k in range(X.target, STATE_SIZE):
                b.state[k, lane] = state[k, i]
            continue
        # Without a sign, numba does not look whether an index counts from the end.
        row = np.uint64(_row_at(begin, np.int64(streams[STEP, i]) + 1, numbers))
        for k in range(STATE_SIZE - X.target):
            b.state[X.target + k, lane] = table[row, np.uint64(k)]
        for axis in range(3):
            b.state[X.target + axis, lane] += course[C.anchor + axis, i]
    # Quantity by quantity: neighbours in memory are written together.
    for k in range(X.target, STATE_SIZE):
        for lane in range(count):
            state[k, first + lane] = b.state[k, lane]


@compiled
def observe_preview(b, count, previews, course, table, numbers, out):
    """Write what the rows of a block see of their references' future: the acceleration in each of
    the given control steps from now, in the frame of the present heading, at the end of ``out``.

    A reference without a table keeps its present acceleration.

    :param previews: int64 (previews,), control steps; ``out`` float32 (n, size).
    """
    scale = float32(1.0 / ACCELERATION_STD)
    for lane in range(count):
        i = b.row[lane]
        cosine, sine = heading_of(b, lane)
        at = out.shape[1] - 3 * len(previews)
        for ahead in previews:
            x, y, z = (
                b.state[X.target_acceleration, lane],
                b.state[X.target_acceleration + 1, lane],
                b.state[X.target_acceleration + 2, lane],
            )
            if table.shape[0] > 0 and course[C.begin, i] >= 0.0:
                step = np.int64(b.stream[STEP, lane]) + ahead
                row = table[_row_at(course[C.begin, i], step, numbers)]
                x, y, z = row[6], row[7], row[8]
            out[i, at] = scale * float32(cosine * x + sine * y)
            out[i, at + 1] = scale * float32(cosine * y - sine * x)
            out[i, at + 2] = scale * float32(z)
            at += 3
