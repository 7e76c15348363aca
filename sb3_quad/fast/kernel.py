"""Multilayer perceptrons, forward and backward, compiled.

Blocks of ``ROWS`` rows of a mini-batch go through all layers while they are in the cache. The units
of a row lie side by side, (rows, units), as the mini-batch has them. Widths, and the rows of a
block, are padded to multiples of 4 with zeros. A chunk is a number of blocks; its sums do not
depend on the thread that computes it.
"""

from typing import NamedTuple

import numpy as np
from numba import float32

from sb3_quad.base.compiled import compiled, inner
from sb3_quad.base.types import Float32Array, IntArray
from sb3_quad.fast.losses import actor_loss, critic_loss
from sb3_quad.fast.tiles import multiply, padded

# Rows per block: few enough for a layer of 64 units and its gradients to fit into half a megabyte
ROWS = 256
LINEAR, TANH, RELU = range(3)
# Rows of a block for some rows of the mini-batch
_padded = inner(padded)
# Not "nnan": NaN and infinity must stay what they are
_FAST = {"reassoc", "contract", "nsz"}
# Beyond this, tanh is 1 in float32
_END = np.float32(7.90531110763549805)


class Layers(NamedTuple):
    """The layers of a perceptron.

    :param widths: padded widths of all layers, the inputs first.
    :param kinds: the activation of each but the first.
    :param parameters: one layer after another, the weights (inputs, outputs), then the biases.
    :param weights: the weights (outputs, inputs) at the same places, which :func:`_backward` needs.
    """

    widths: IntArray
    kinds: IntArray
    parameters: Float32Array
    weights: Float32Array


@inner(fastmath=_FAST)
def _activate(h, bias, kind):
    """h = f(h + bias), (rows, units).

    tanh is the quotient of polynomials that Eigen uses, exact to 4e-7.
    """
    for i in range(h.shape[0]):
        if kind == TANH:
            for j in range(h.shape[1]):
                x = h[i, j] + bias[j]
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
                h[i, j] = u * p / q + float32(0.0) * x
        elif kind == RELU:
            for j in range(h.shape[1]):
                x = h[i, j] + bias[j]
                h[i, j] = x if not x < float32(0.0) else float32(0.0)
        else:
            for j in range(h.shape[1]):
                h[i, j] += bias[j]


@inner(fastmath=_FAST)
def _activation_vjp(g, h, kind, db):
    """g = g f'(x) with h = f(x), both (rows, units).

    db (units,) += the sums of g over the rows.
    """
    for i in range(g.shape[0]):
        for j in range(g.shape[1]):
            if kind == TANH:
                g[i, j] *= float32(1.0) - h[i, j] * h[i, j]
            elif kind == RELU:
                g[i, j] = g[i, j] if h[i, j] > float32(0.0) else float32(0.0)
            db[j] += g[i, j]


@inner
def _load(rows, index, first, count, h):
    """Gather ``count`` rows of (m, units), from ``first`` on in ``index``, into a block.

    The block has zeros around them.
    """
    given = rows.shape[1]
    for i in range(count):
        row = rows[index[first + i]]
        for k in range(given):
            h[i, k] = row[k]
        h[i, given:] = 0.0
    h[count:] = 0.0


@inner
def _layer(scratch, at, size, width):
    """Return a layer's ``width`` units at a place in the scratch memory, (size, width)."""
    return scratch[at : at + size * width].reshape(size, width)


@inner
def _forward(scratch, x, index, first, count, layers):
    """Compute all layers of a block, which follow one another in memory, the inputs first.

    :return: where the outputs begin.
    """
    widths, kinds, parameters, _ = layers
    size = _padded(count)
    _load(x, index, first, count, _layer(scratch, 0, size, widths[0]))
    at = 0
    place = 0
    for layer in range(1, len(widths)):
        inputs = widths[layer - 1]
        outputs = widths[layer]
        before = _layer(scratch, at, size, inputs)
        at += size * inputs
        middle = place + inputs * outputs
        h = _layer(scratch, at, size, outputs)
        multiply(before, parameters[place:middle].reshape(inputs, outputs), h, False)
        place = middle + outputs
        _activate(h, parameters[middle:place], kinds[layer - 1])
    return at


@inner
def _backward(activations, scratch, count, layers, sums, last_layer):
    """Add the gradient of a block with respect to the parameters to ``sums``.

    ``activations`` holds the block's layers. ``scratch`` holds the gradient with respect to the
    outputs, after the memory for the layers. From there on, the gradients of two layers alternate.

    :param last_layer: 1: stop at the parameters of the first layer; 0: continue to the inputs.
    :return: where the gradient of that layer begins.
    """
    widths, kinds, _, weights = layers
    size = _padded(count)
    here = widths.sum() * size
    there = here + widths.max() * size
    at = here - widths[-1] * size
    place = len(sums)
    for layer in range(len(widths) - 1, 0, -1):
        inputs = widths[layer - 1]
        outputs = widths[layer]
        g = _layer(scratch, here, size, outputs)
        h = _layer(activations, at, size, outputs)
        at -= size * inputs
        before = _layer(activations, at, size, inputs)
        place -= (inputs + 1) * outputs
        middle = place + inputs * outputs
        _activation_vjp(g, h, kinds[layer - 1], sums[middle : middle + outputs])
        multiply(before.T, g, sums[place:middle].reshape(inputs, outputs), True)
        if layer > last_layer:
            following = weights[place:middle].reshape(outputs, inputs)
            multiply(g, following, _layer(scratch, there, size, inputs), False)
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
    n = len(index)
    n_parameters = len(layers.parameters)
    outputs = layers.widths[-1]
    blocks = (n + ROWS - 1) // ROWS
    for chunk in range(first_chunk, last_chunk):
        sums[chunk, :] = 0.0
        terms[chunk, :] = 0.0
        for block in range(chunk * blocks // chunks, (chunk + 1) * blocks // chunks):
            first = block * ROWS
            count = min(ROWS, n - first)
            size = _padded(count)
            at = _forward(scratch, x, index, first, count, layers)
            y = _layer(scratch, at, size, outputs)
            g = _layer(scratch, layers.widths.sum() * size, size, outputs)
            g[:, :] = 0.0
            g_log_std = sums[chunk, n_parameters:]
            if len(log_std) > 0:
                actor_loss(
                    y, index, first, count, targets, loss, log_std, g, g_log_std, terms[chunk]
                )
            else:
                critic_loss(y, index, first, count, targets, loss, g, terms[chunk])
            _backward(scratch, scratch, count, layers, sums[chunk, :n_parameters], 1)


@compiled
def forward(first_chunk, last_chunk, chunks, scratch, layers, x, index, out, activations):
    """Write the outputs (b, outputs) for the rows ``index`` (b,) of x (m, inputs) into ``out``.

    It does so for the chunks from ``first_chunk`` up to ``last_chunk``, of ``chunks`` in all.

    :param scratch: a thread's own memory, aligned to cache lines: ``ROWS`` numbers for each unit of
        all layers, and twice for the widest layer's gradients.
    :param layers: :class:`Layers`.
    :param activations: (blocks, rows of a block times all units), written for :func:`pullback`; or
        (0, any), to keep nothing.
    """
    n = len(index)
    blocks = (n + ROWS - 1) // ROWS
    for block in range(first_chunk * blocks // chunks, last_chunk * blocks // chunks):
        first = block * ROWS
        count = min(ROWS, n - first)
        own = activations[block] if len(activations) else scratch
        at = _forward(own, x, index, first, count, layers)
        h = _layer(own, at, _padded(count), layers.widths[-1])
        out[first : first + count] = h[:count, : out.shape[1]]


@compiled
def pullback(
    first_chunk, last_chunk, chunks, scratch, layers, activations, index, grad_outputs, grad_inputs,
    sums,
):  # fmt: skip
    """Carry a gradient with respect to the outputs back to the inputs, and add the one with respect
    to all parameters.

    Arguments are as for :func:`forward`, and:

    :param activations: what ``forward`` has written for the same rows.
    :param grad_outputs: (m, outputs).
    :param grad_inputs: float32 (m, inputs), is written to.
    :param sums: float32 (chunks, parameters), to which the gradient of each chunk is added.
    """
    n = len(index)
    blocks = (n + ROWS - 1) // ROWS
    for chunk in range(first_chunk, last_chunk):
        for block in range(chunk * blocks // chunks, (chunk + 1) * blocks // chunks):
            first = block * ROWS
            count = min(ROWS, n - first)
            size = _padded(count)
            g = _layer(scratch, layers.widths.sum() * size, size, layers.widths[-1])
            _load(grad_outputs, index, first, count, g)
            here = _backward(activations[block], scratch, count, layers, sums[chunk], 0)
            g = _layer(scratch, here, size, layers.widths[0])
            for i in range(count):
                grad_inputs[index[first + i]] = g[i, : grad_inputs.shape[1]]
