"""Following a reference: the compiled functions that move targets along the tables of
:mod:`.references`.

``course`` (COURSE_SIZE, n) says where each row is: the target of its episode, from which the
reference moves, and the first row of its piece in the table, below zero for a target that rests.
``numbers`` int64 (3,) are :meth:`.references.Tracks.numbers`.

A step writes the positions of references to the state. :func:`complete` writes their other
quantities only when somebody reads them, which saves a third of the cost of references.
"""

import numpy as np
from numba import float32

from sb3_quad.base.compiled import LANES, called, compiled, inlined, inner
from sb3_quad.envs.simulation.observation import heading_of
from sb3_quad.envs.simulation.random import REFERENCE, STEP, uniforms
from sb3_quad.envs.simulation.state import (
    REFERENCE_PARTS,
    STATE_SIZE,
    X,
    first_rows,
)
from sb3_quad.envs.simulation.vectors import vector, vector_at

COURSE = {"anchor": 3, "begin": 1}
COURSE_SIZE = sum(COURSE.values())
C = first_rows(COURSE)
# The first columns of two parts in a table
ACCELERATION = first_rows(REFERENCE_PARTS).target_acceleration
AHEAD = first_rows(REFERENCE_PARTS).target_ahead
# σ of a previewed acceleration, m/s²
ACCELERATION_STD = 5.0


@inlined
def _row_at(begin, step, numbers):
    """Return the row of the table at a control step of an episode."""
    length = numbers[0]
    at = step % length if numbers[1] != 0 else min(step, length - 1)
    return np.int64(begin) + at


@inlined
def _first_row(i, streams, numbers):
    """Return the first row of the piece of the table that row i's stream chooses."""
    return numbers[0] * np.int64(uniforms(streams, i, REFERENCE)[0] * numbers[2])


@called
def start_course(i, state, streams, course, numbers):
    """Let row i's reference begin at its target, with a piece that its own stream chooses."""
    for axis in range(3):
        course[C.anchor + axis, i] = state[X.target + axis, i]
    course[C.begin, i] = _first_row(i, streams, numbers)


@called
def deepest(i, streams, table, numbers):
    """Return how far below its start row i's reference goes, m."""
    begin = _first_row(i, streams, numbers)
    lowest = 0.0
    for row in range(begin, begin + numbers[0]):
        lowest = min(lowest, table[row, 2])
    return -lowest


@called
def follow(b, ahead, state, streams, course, table, numbers):
    """Load the targets of a block's rows as they are ``ahead`` control steps from now."""
    for lane in range(LANES):
        i = b.row[lane]
        begin = course[C.begin, i]
        if begin < 0.0:
            for k in range(X.target, STATE_SIZE):
                b.state[k, lane] = state[k, i]
            continue
        # With an unsigned index, numba does not check whether it counts from the end.
        row = np.uint64(_row_at(begin, streams[STEP, i] + ahead, numbers))
        # A loop of a fixed length: a variable one would take five times as long.
        for k in range(AHEAD):
            b.state[X.target + k, lane] = table[row, np.uint64(k)]
        for axis in range(3):
            b.state[X.target + axis, lane] += course[C.anchor + axis, i]


@compiled
def complete(state, streams, course, table, numbers):
    """Write to the state how the references move now, and their headings, in place."""
    for i in range(state.shape[1]):
        begin = course[C.begin, i]
        if begin >= 0.0:
            row = _row_at(begin, streams[STEP, i], numbers)
            state[X.target_velocity :, i] = table[row, 3:]


@inner
def observe_preview(b, count, previews, course, table, numbers, out):
    """Write what the rows of a block observe of their references' future: the acceleration in each
    of the given control steps from now, in the frame of the present heading, at the end of ``out``.

    A reference without a table keeps its present acceleration.

    :param previews: int64 (previews,), control steps; ``out`` float32 (n, size).
    """
    scale = float32(1.0 / ACCELERATION_STD)
    for lane in range(count):
        i = b.row[lane]
        cosine, sine = heading_of(b, lane)
        at = out.shape[1] - 3 * len(previews)
        for ahead in previews:
            x, y, z = vector(b.target_acceleration, lane)
            if table.shape[0] > 0 and course[C.begin, i] >= 0.0:
                step = b.stream[STEP, lane] + ahead
                row = _row_at(course[C.begin, i], step, numbers)
                x, y, z = vector_at(table.T, ACCELERATION, row)
            out[i, at] = scale * float32(cosine * x + sine * y)
            out[i, at + 1] = scale * float32(cosine * y - sine * x)
            out[i, at + 2] = scale * float32(z)
            at += 3
