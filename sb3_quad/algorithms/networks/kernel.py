"""Multilayer perceptrons, forward and backward, compiled: blocks of rows go through all layers while they are in the cache.

A block holds ``ROWS`` rows of the mini-batch side by side, (width, ROWS), so that every loop over rows is a vector loop.
Widths are padded to multiples of 4 with zeros. A layer's parameters lie in a row: weights (outputs, inputs), then biases.
"""

import numpy as np
from numba import carray, float32, uint64

from sb3_quad.algorithms.networks.losses import actor_loss, critic_loss
from sb3_quad.simulation.compiled import atomic_add, atomic_get, compiled, give_way, pointer

ROWS = 256  # of a block: long loops, and yet a layer of 64 in half a megabyte of cache with all that goes with it
LINEAR, TANH, RELU = range(3)
LEFT, DONE, CONTROL = 0, 16, 32  # places, each on a cache line of its own, and size of the control array
ALIGNED = 16  # float32 numbers in a cache line: vectors that straddle two take a third longer
SPIN = 20_000  # looks at a chunk that another thread still has, before that is let have the core: some 30 microseconds
LATE = SPIN + 5_000  # looks, with that: longer than a chunk takes
_0, _1, _2, _3, _4 = (np.uint64(number) for number in range(5))
_TILE = np.uint64(16)  # inputs at once: their rows stay in the first cache
_FAST = {"reassoc", "contract", "nsz"}  # not "nnan": what is not finite must stay so
_END = np.float32(7.90531110763549805)  # beyond, float32's tanh is 1


@compiled(fastmath=_FAST)
def _multiply(w, x, h):
    """h = w x; w (rows, columns), x (columns, ROWS), h (rows, ROWS)."""
    rows, columns = uint64(w.shape[0]), uint64(w.shape[1])  # unsigned: Python's indices from the end would cost a third
    for tile in range(_0, columns, _TILE):
        for j in range(_0, rows, _2):
            for k in range(tile, min(columns, tile + _TILE), _4):
                a0, a1, a2, a3 = w[j, k], w[j, k + _1], w[j, k + _2], w[j, k + _3]
                b0, b1, b2, b3 = w[j + _1, k], w[j + _1, k + _1], w[j + _1, k + _2], w[j + _1, k + _3]
                if k == _0:
                    for i in range(ROWS):
                        x0, x1, x2, x3 = x[k, i], x[k + _1, i], x[k + _2, i], x[k + _3, i]
                        h[j, i] = a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3
                        h[j + _1, i] = b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3
                else:
                    for i in range(ROWS):
                        x0, x1, x2, x3 = x[k, i], x[k + _1, i], x[k + _2, i], x[k + _3, i]
                        h[j, i] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3
                        h[j + _1, i] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3


@compiled(fastmath=_FAST)
def _add_products(g, x, dw):
    """dw += g xᵀ; g (rows, ROWS), x (columns, ROWS), dw (rows, columns)."""
    rows, columns = uint64(dw.shape[0]), uint64(dw.shape[1])
    for tile in range(_0, columns, _TILE):
        for j in range(_0, rows, _2):
            for k in range(tile, min(columns, tile + _TILE), _4):
                a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = float32(0.0)
                for i in range(ROWS):
                    x0, x1, x2, x3 = x[k, i], x[k + _1, i], x[k + _2, i], x[k + _3, i]
                    g0, g1 = g[j, i], g[j + _1, i]
                    a0 += g0 * x0
                    a1 += g0 * x1
                    a2 += g0 * x2
                    a3 += g0 * x3
                    b0 += g1 * x0
                    b1 += g1 * x1
                    b2 += g1 * x2
                    b3 += g1 * x3
                for row, sums in ((j, (a0, a1, a2, a3)), (j + _1, (b0, b1, b2, b3))):
                    dw[row, k] += sums[0]
                    dw[row, k + _1] += sums[1]
                    dw[row, k + _2] += sums[2]
                    dw[row, k + _3] += sums[3]


@compiled(fastmath=_FAST)
def _activate(h, bias, kind):
    """h = f(h + bias), (rows, ROWS). tanh is the quotient of polynomials that Eigen uses, exact to 4e-7."""
    for j in range(h.shape[0]):
        b = bias[j]
        if kind == TANH:
            for i in range(ROWS):
                x = h[j, i] + b
                u = min(max(x, -_END), _END)
                s = u * u
                p = float32(-2.76076847742355e-16) * s + float32(2.00018790482477e-13)
                p = p * s + float32(-8.60467152213735e-11)
                p = p * s + float32(5.12229709037114e-08)
                p = p * s + float32(1.48572235717979e-05)
                p = p * s + float32(6.37261928875436e-04)
                p = p * s + float32(4.89352455891786e-03)
                q = float32(1.19825839466702e-06) * s + float32(1.18534705686654e-04)
                q = q * s + float32(2.26843463243900e-03)
                q = q * s + float32(4.89352518554385e-03)
                h[j, i] = u * p / q + float32(0.0) * x  # what is not finite goes on as NaN
        elif kind == RELU:
            for i in range(ROWS):
                x = h[j, i] + b
                h[j, i] = x if not x < float32(0.0) else float32(0.0)
        else:
            for i in range(ROWS):
                h[j, i] += b


@compiled(fastmath=_FAST)
def _undo_activation(g, h, kind, db):
    """g = g f'(x), by h = f(x), both (rows, ROWS); db (rows,) += its sums over the rows of the mini-batch."""
    for j in range(g.shape[0]):
        total = float32(0.0)
        for i in range(ROWS):
            if kind == TANH:
                g[j, i] *= float32(1.0) - h[j, i] * h[j, i]
            elif kind == RELU:
                g[j, i] = g[j, i] if h[j, i] > float32(0.0) else float32(0.0)
            total += g[j, i]
        db[j] += total


@compiled
def _aligned(address):
    """The first place from ``address`` on where a cache line begins."""
    return (address + 63) // 64 * 64


@compiled
def _touch(rows, index, first, count):
    """Have rows brought into the cache, many at a time; where they lie far apart, each would else be waited for."""
    total = float32(0.0)
    for i in range(first, first + count):
        total += rows[index[i], 0] + rows[index[i], rows.shape[1] - 1]
    return total


@compiled
def _load(rows, index, first, count, h):
    """Rows of (m, size) into a block, (width, ROWS), zeros around them: the ``count`` from ``first`` on in ``index``."""
    h[0, 0] = _touch(rows, index, first, count)
    for k in range(h.shape[0]):
        for i in range(count if k < rows.shape[1] else 0, ROWS):
            h[k, i] = 0.0
    for i in range(count):
        row = rows[index[first + i]]
        for k in range(rows.shape[1]):
            h[k, i] = row[k]


@compiled
def _through(at, widths, kinds, parameters):
    """All layers of a block, which lie behind one another from ``at`` on, the inputs first; where the outputs begin."""
    place = parameters.ctypes.data
    for layer in range(1, len(widths)):
        rows, columns = widths[layer], widths[layer - 1]
        x = carray(pointer(at), (columns, ROWS), np.float32)
        at += 4 * columns * ROWS
        h = carray(pointer(at), (rows, ROWS), np.float32)
        _multiply(carray(pointer(place), (rows, columns), np.float32), x, h)
        _activate(h, carray(pointer(place + 4 * rows * columns), (rows,), np.float32), kinds[layer - 1])
        place += 4 * rows * (columns + 1)
    return at


@compiled
def _back(at, widths, kinds, transposed, sums, sides):
    """The gradient by the parameters, added to ``sums``, of a block whose outputs' gradient lies in the first of ``sides``.

    :param at: where the block's outputs begin; :param transposed: weights as (inputs, outputs).
    """
    last, place = len(widths) - 1, 4 * len(sums)
    g = carray(pointer(sides[0]), (widths[last], ROWS), np.float32)
    for layer in range(last, 0, -1):
        rows, columns = widths[layer], widths[layer - 1]
        h = carray(pointer(at), (rows, ROWS), np.float32)
        at -= 4 * columns * ROWS
        x = carray(pointer(at), (columns, ROWS), np.float32)
        place -= 4 * rows * (columns + 1)
        here = sums.ctypes.data + place
        _undo_activation(g, h, kinds[layer - 1], carray(pointer(here + 4 * rows * columns), (rows,), np.float32))
        _add_products(g, x, carray(pointer(here), (rows, columns), np.float32))
        if layer > 1:
            y = carray(pointer(sides[(last - layer + 1) % 2]), (columns, ROWS), np.float32)
            _multiply(carray(pointer(transposed.ctypes.data + place), (columns, rows), np.float32), g, y)
            g = y


@compiled
def _finish(control, chunks):
    """Wait for the chunks that other threads still have; whether one of them has lost its core meanwhile."""
    looks = 0
    while atomic_get(control, DONE) < chunks:
        looks += 1
        if looks > SPIN:
            give_way()
    return looks > LATE


@compiled
def forward(control, main, chunks, x, widths, kinds, parameters, out):
    """The outputs of all rows of x (n, inputs), into ``out`` (n, outputs).

    Takes chunks of blocks as long as there are any; ``main`` then waits until all are done.

    :param control: int64 (CONTROL,): chunks left and done, shared by all threads.
    :param widths: of all layers, the inputs first, padded; :param kinds: the activation of each but the first.
    :return: whether ``main`` had to wait.
    """
    n = len(x)
    blocks, index = (n + ROWS - 1) // ROWS, np.arange(n)
    scratch = np.empty(widths.sum() * ROWS + ALIGNED, np.float32)
    while True:
        number = chunks - atomic_add(control, LEFT, -1)
        if number >= chunks:
            return main and _finish(control, chunks)
        for block in range(number * blocks // chunks, (number + 1) * blocks // chunks):
            first, begin = block * ROWS, _aligned(scratch.ctypes.data)
            count = min(ROWS, n - first)
            _load(x, index, first, count, carray(pointer(begin), (widths[0], ROWS), np.float32))
            at = _through(begin, widths, kinds, parameters)
            h = carray(pointer(at), (out.shape[1], ROWS), np.float32)
            for i in range(count):
                for j in range(out.shape[1]):
                    out[first + i, j] = h[j, i]
        atomic_add(control, DONE, 1)


@compiled
def gradient(control, main, chunks, x, index, widths, kinds, parameters, transposed, targets, loss, log_std, sums, terms):
    """The gradient of a loss (:mod:`.losses`) by all parameters; a block stays in the cache for its way forth and back.

    :param x: (m, inputs), and :param targets: (m, columns) of the loss, of which the rows ``index`` (n,) are meant.
    :param transposed: the parameters with each layer's weights as (inputs, outputs).
    :param log_std: of the actions, (a,); of size 0 for a critic.
    :param sums: (chunks, parameters + a): the part of each chunk, so that threads do not change what their sum is.
    :param terms: float64 (chunks, TERMS), likewise, what the loss adds up for the log.
    """
    n, size = len(index), len(transposed)
    blocks, widest = (n + ROWS - 1) // ROWS, widths.max() * ROWS
    scratch = np.empty((widths.sum() * ROWS) + 2 * widest + ALIGNED, np.float32)
    begin = _aligned(scratch.ctypes.data)
    first_side = begin + 4 * widths.sum() * ROWS
    sides = first_side, first_side + 4 * widest
    while True:
        number = chunks - atomic_add(control, LEFT, -1)
        if number >= chunks:
            return main and _finish(control, chunks)
        sums[number, :] = 0.0
        terms[number, :] = 0.0
        for block in range(number * blocks // chunks, (number + 1) * blocks // chunks):
            first = block * ROWS
            count = min(ROWS, n - first)
            _load(x, index, first, count, carray(pointer(begin), (widths[0], ROWS), np.float32))
            at = _through(begin, widths, kinds, parameters)
            y = carray(pointer(at), (widths[-1], ROWS), np.float32)
            g = carray(pointer(sides[0]), (widths[-1], ROWS), np.float32)
            g[:, :] = 0.0
            g[0, 0] = 0.0 * _touch(targets, index, first, count)
            if len(log_std) > 0:
                actor_loss(y, index, first, count, targets, loss, log_std, g, sums[number, size:], terms[number])
            else:
                critic_loss(y, index, first, count, targets, loss, g, terms[number])
            _back(at, widths, kinds, transposed, sums[number, :size], sides)
        atomic_add(control, DONE, 1)
