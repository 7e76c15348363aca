"""Multilayer perceptrons, forward and backward, compiled.

Blocks of rows go through all layers while they are in the cache. A block holds ``size`` rows of the
mini-batch side by side, (width, size), so that every loop over rows is a vector loop. The size is
``ROWS``, or ``FEW`` for so few rows that half of a block would be empty. Loops are compiled for
both: with a size that is not known in advance they take up to a fifth longer. Widths are padded to
multiples of 4 with zeros. The parameters of a layer are contiguous: weights (outputs, inputs), then
biases. A chunk is a number of blocks; its sums do not depend on the thread that computes it.
"""

from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sb3_quad.base.compiled import compiled, inner
from sb3_quad.base.types import Float32Array, IntArray
from sb3_quad.fast.losses import actor_loss, critic_loss
from sb3_quad.fast.tiles import HEIGHT, WIDTH, add_to_tile

# Rows per block: loops are long, yet a layer of 64 units and its gradients fit into half a
# megabyte.
ROWS = 256
FEW = 128
LINEAR, TANH, RELU = range(3)
_0, _1, _2, _3, _4 = (np.uint64(number) for number in range(5))
# Inputs per tile, so that their rows stay in the L1 cache: of a product, and of its gradient
_INPUTS = 32
_TILE = np.uint64(16)
# Not "nnan": NaN and infinity must stay what they are
_FAST = {"reassoc", "contract", "nsz"}
# Beyond this, tanh is 1 in float32
_END = np.float32(7.90531110763549805)


class Layers(NamedTuple):
    """The layers of a perceptron.

    :param widths: padded widths of all layers, the inputs first.
    :param kinds: the activation of each but the first.
    :param parameters: the parameters of all layers, one layer after another.
    """

    widths: IntArray
    kinds: IntArray
    parameters: Float32Array


@inner
def _multiply(w, x, h):
    """h = w x; w (rows, columns), x (columns, size), h (rows, size)."""
    rows, columns = w.shape
    for first in range(0, columns, _INPUTS):
        last = min(columns, first + _INPUTS)
        for j in range(0, rows, HEIGHT):
            for i in range(0, x.shape[1], WIDTH):
                add_to_tile(w, x, h, j, i, first, last)


@inner(fastmath=_FAST)
def _add_products(g, x, dw, size):
    """dw += g xᵀ; g (rows, size), x (columns, size), dw (rows, columns)."""
    rows = uint64(dw.shape[0])
    columns = uint64(dw.shape[1])
    for tile in range(_0, columns, _TILE):
        for j in range(_0, rows, _2):
            for k in range(tile, min(columns, tile + _TILE), _4):
                a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = float32(0.0)
                for i in range(size):
                    x0, x1, x2, x3 = x[k, i], x[k + _1, i], x[k + _2, i], x[k + _3, i]
                    g0 = g[j, i]
                    g1 = g[j + _1, i]
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


@inner(fastmath=_FAST)
def _activate(h, bias, kind, size):
    """h = f(h + bias), (rows, size).

    tanh is the quotient of polynomials that Eigen uses, exact to 4e-7.
    """
    for j in range(h.shape[0]):
        b = bias[j]
        if kind == TANH:
            for i in range(size):
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
                # The last term makes NaN and infinity come out as NaN.
                h[j, i] = u * p / q + float32(0.0) * x
        elif kind == RELU:
            for i in range(size):
                x = h[j, i] + b
                h[j, i] = x if not x < float32(0.0) else float32(0.0)
        else:
            for i in range(size):
                h[j, i] += b


@inner(fastmath=_FAST)
def _activation_vjp(g, h, kind, db, size):
    """g = g f'(x) with h = f(x), both (rows, size).

    db (rows,) += the sums of g over the rows of the mini-batch.
    """
    for j in range(g.shape[0]):
        total = float32(0.0)
        for i in range(size):
            if kind == TANH:
                g[j, i] *= float32(1.0) - h[j, i] * h[j, i]
            elif kind == RELU:
                g[j, i] = g[j, i] if h[j, i] > float32(0.0) else float32(0.0)
            total += g[j, i]
        db[j] += total


@inner
def _touch(rows, index, first, count):
    """Prefetch rows, many at a time: otherwise each gather stalls where they lie far apart."""
    total = float32(0.0)
    for i in range(first, first + count):
        total += rows[index[i], 0] + rows[index[i], rows.shape[1] - 1]
    return total


@inner
def _load(rows, index, first, count, h, size):
    """Gather ``count`` rows of (m, size), from ``first`` on in ``index``, into a block.

    The block is (width, size), with zeros around the rows.
    """
    h[0, 0] = _touch(rows, index, first, count)
    for k in range(h.shape[0]):
        for i in range(count if k < rows.shape[1] else 0, size):
            h[k, i] = 0.0
    for i in range(count):
        row = rows[index[first + i]]
        for k in range(rows.shape[1]):
            h[k, i] = row[k]


@inner
def _layer(scratch, at, width, size):
    """Return the ``width`` units of a layer at a place in the scratch memory, (width, size)."""
    return scratch[at : at + width * size].reshape(width, size)


@inner
def _forward(scratch, x, index, first, count, layers, size):
    """Compute all layers of a block, which follow one another in memory, the inputs first.

    :return: where the outputs begin.
    """
    widths, kinds, parameters = layers
    _load(x, index, first, count, _layer(scratch, 0, widths[0], size), size)
    at = 0
    place = 0
    for layer in range(1, len(widths)):
        rows = widths[layer]
        columns = widths[layer - 1]
        before = _layer(scratch, at, columns, size)
        at += columns * size
        middle = place + rows * columns
        h = _layer(scratch, at, rows, size)
        _multiply(parameters[place:middle].reshape(rows, columns), before, h)
        _activate(h, parameters[middle : middle + rows], kinds[layer - 1], size)
        place = middle + rows
    return at


@inner
def _backward(activations, scratch, layers, sums, last_layer, size):
    """Add the gradient of a block with respect to the parameters to ``sums``.

    ``activations`` holds the block's layers. ``scratch`` holds the gradient with respect to the
    outputs, after the memory for the layers. From there on, the gradients of two layers alternate.

    :param last_layer: 1: stop at the parameters of the first layer; 0: continue to the inputs.
    :return: where the gradient of that layer begins.
    """
    widths, kinds, parameters = layers
    here = widths.sum() * size
    there = here + widths.max() * size
    at = here - widths[-1] * size
    place = len(sums)
    for layer in range(len(widths) - 1, 0, -1):
        rows = widths[layer]
        columns = widths[layer - 1]
        g = _layer(scratch, here, rows, size)
        h = _layer(activations, at, rows, size)
        at -= columns * size
        place -= rows * (columns + 1)
        middle = place + rows * columns
        _activation_vjp(g, h, kinds[layer - 1], sums[middle : middle + rows], size)
        _add_products(
            g,
            _layer(activations, at, columns, size),
            sums[place:middle].reshape(rows, columns),
            size,
        )
        if layer > last_layer:
            weights = parameters[place:middle].reshape(rows, columns)
            _multiply(weights.T, g, _layer(scratch, there, columns, size))
            here, there = there, here
    return here


@compiled
def gradient(
    first_chunk, last_chunk, chunks, scratch, layers, x, index, targets, loss, log_std, sums, terms
):
    """Write the gradient of a loss (:mod:`.losses`) with respect to all parameters into ``sums``.

    A block stays in the cache for its forward and its backward pass. Further arguments are as for
    :func:`forward`.

    :param targets: (m, columns), the targets of the loss in the same rows.
    :param loss: :class:`~sb3_quad.fast.losses.Numbers`.
    :param log_std: log_std of the actions, (a,); of size 0 for a critic.
    :param sums: float32 (chunks, parameters + a), the gradient of each chunk.
    :param terms: float64 (chunks, TERMS), likewise, the terms of the loss.
    """
    size = ROWS
    n = len(index)
    n_parameters = len(layers.parameters)
    outputs = layers.widths[-1]
    blocks = (n + size - 1) // size
    past_layers = layers.widths.sum() * size
    for chunk in range(first_chunk, last_chunk):
        sums[chunk, :] = 0.0
        terms[chunk, :] = 0.0
        for block in range(chunk * blocks // chunks, (chunk + 1) * blocks // chunks):
            first = block * size
            count = min(size, n - first)
            at = _forward(scratch, x, index, first, count, layers, size)
            y = _layer(scratch, at, outputs, size)
            g = _layer(scratch, past_layers, outputs, size)
            g[:, :] = 0.0
            g[0, 0] = 0.0 * _touch(targets, index, first, count)
            g_log_std = sums[chunk, n_parameters:]
            if len(log_std) > 0:
                actor_loss(
                    y, index, first, count, targets, loss, log_std, g, g_log_std, terms[chunk]
                )
            else:
                critic_loss(y, index, first, count, targets, loss, g, terms[chunk])
            _backward(scratch, scratch, layers, sums[chunk, :n_parameters], 1, size)


def for_blocks(size):
    """Return two compiled functions for blocks of ``size`` rows: ``forward`` and ``pullback``."""

    @compiled
    def forward(first_chunk, last_chunk, chunks, scratch, layers, x, index, out, activations):
        """Write the outputs (b, outputs) for the rows ``index`` (b,) of x (m, inputs) into ``out``.

        It does so for the chunks from ``first_chunk`` up to ``last_chunk``, of ``chunks`` in all.

        :param scratch: a thread's own memory, aligned to cache lines: ``ROWS`` numbers for each
            unit of all layers, and twice for the widest layer's gradients.
        :param layers: :class:`Layers`.
        :param activations: (blocks, ``size`` numbers for each unit), written for ``pullback``; or
            (0, any), to keep nothing.
        """
        n = len(index)
        blocks = (n + size - 1) // size
        for block in range(first_chunk * blocks // chunks, last_chunk * blocks // chunks):
            first = block * size
            count = min(size, n - first)
            own = activations[block] if len(activations) else scratch
            at = _forward(own, x, index, first, count, layers, size)
            h = _layer(own, at, layers.widths[-1], size)
            for i in range(count):
                for j in range(out.shape[1]):
                    out[first + i, j] = h[j, i]

    @compiled
    def pullback(
        first_chunk, last_chunk, chunks, scratch, layers, activations, index, grad_outputs,
        grad_inputs, sums,
    ):  # fmt: skip
        """Carry a gradient with respect to the outputs back to the inputs, and add the one with
        respect to all parameters.

        Arguments are as for ``forward``, and:

        :param activations: what ``forward`` has written for the same rows.
        :param grad_outputs: (m, outputs).
        :param grad_inputs: float32 (m, inputs), is written to.
        :param sums: float32 (chunks, parameters), to which the gradient of each chunk is added.
        """
        blocks = (len(index) + size - 1) // size
        past_layers = layers.widths.sum() * size
        for chunk in range(first_chunk, last_chunk):
            for block in range(chunk * blocks // chunks, (chunk + 1) * blocks // chunks):
                first = block * size
                count = min(size, len(index) - first)
                g = _layer(scratch, past_layers, layers.widths[-1], size)
                _load(grad_outputs, index, first, count, g, size)
                here = _backward(activations[block], scratch, layers, sums[chunk], 0, size)
                g = _layer(scratch, here, layers.widths[0], size)
                for i in range(count):
                    for k in range(grad_inputs.shape[1]):
                        grad_inputs[index[first + i], k] = g[k, i]

    return forward, pullback
