"""A multilayer perceptron and its gradients, by :mod:`.kernel`, on the threads that PyTorch had."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_quad.algorithms.networks.kernel import (
    FEW,
    LINEAR,
    RELU,
    ROWS,
    TANH,
    Layers,
    are_few,
    forward,
    gradient,
    pullback,
)
from sb3_quad.algorithms.networks.losses import TERMS, Loss
from sb3_quad.base.types import Float32Array, FloatArray, IntArray

# A mini-batch is cut into at most this many chunks. Their sums are added up in order, so that the
# number of threads changes no bit.
CHUNKS = 16
# Fewer blocks than this are done before another thread has woken.
WORTHWHILE = 4
# Parts of a mini-batch for each thread. One that is held up does fewer of them.
PARTS = 4
# Bytes; vectors that straddle two cache lines take a third longer.
CACHE_LINE = 64
_ACTIVATIONS = {nn.Tanh: TANH, nn.ReLU: RELU}
# Types of the loss's fields; numba would compile again for an int where it had a float.
_TYPES = tuple(Loss.__annotations__.values())
_NONE = np.empty(0)
_NOT_KEPT = np.empty((0, 0), np.float32)


class Perceptron:
    """Linear layers with tanh or ReLU between them, whose parameters stay PyTorch's.

    :param modules: see :meth:`fits`.
    """

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        self._layers: list[Any] = [*modules[::2]]
        self._kinds = np.array([*(_ACTIVATIONS[type(layer)] for layer in modules[1::2]), LINEAR])
        # Widths are padded to multiples of 4.
        sizes = [self._layers[0].in_features, *(layer.out_features for layer in self._layers)]
        self._widths = np.array([-(-size // 4) * 4 for size in sizes])
        before = self._widths[:-1]
        after = self._widths[1:]
        self._size = int((after * (before + 1)).sum())
        units = self._widths.sum() + 2 * self._widths.max()
        self._scratch_size = int(units) * ROWS
        # Parameters with the weights as they are, and with the weights transposed
        self._packed = np.zeros((2, self._size), np.float32)
        # Views of those and of PyTorch's memory, which :meth:`pack` copies into them
        self._copies: list[tuple[Float32Array, Float32Array]] = []
        own = [parameter.detach().numpy() for parameter in self.parameters()]
        for packed, transposed in zip(self._packed, (False, True), strict=True):
            views = self._views(packed, transposed)
            self._copies.extend(zip(views, own, strict=True))

    def _views(self, packed: Float32Array, transposed: bool) -> list[Float32Array]:
        """Return the views of :meth:`parameters` in an array of all layers' parameters.

        :param transposed: whether each layer's weights lie there as (inputs, outputs).
        """
        views: list[Float32Array] = []
        start = 0
        for i, layer in enumerate(self._layers):
            columns, rows = self._widths[i : i + 2].tolist()
            middle = start + rows * columns
            weights = packed[start:middle].reshape(rows, columns)
            if transposed:
                weights = packed[start:middle].reshape(columns, rows).T
            views.append(weights[: layer.out_features, : layer.in_features])
            views.append(packed[middle : middle + layer.out_features])
            start = middle + rows
        return views

    @staticmethod
    def fits(modules: Sequence[nn.Module]) -> bool:
        """Return whether these are linear layers and activations in turn that can be compiled.

        Parameters must be float32 on the CPU, none may be frozen, and no module may have hooks.
        """
        for i, module in enumerate(modules):
            if module._forward_hooks or module._forward_pre_hooks or module._backward_hooks:
                return False
            if i % 2 == 1:
                fits = type(module) in _ACTIVATIONS
            else:
                parameters = [*module.parameters()]
                fits = type(module) is nn.Linear and len(parameters) == 2
                for parameter in parameters:
                    fits &= parameter.dtype == th.float32 and parameter.device.type == "cpu"
                    fits &= parameter.requires_grad
            if not fits:
                return False
        return len(modules) % 2 == 1

    def pack(self) -> None:
        """Take the parameters as they are now, for calls that keep what the layers give."""
        for packed, parameter in self._copies:
            packed[...] = parameter

    def __call__(self, x: Float32Array, activations: Float32Array = _NOT_KEPT) -> Float32Array:
        """Return the outputs (n, outputs) for x (n, inputs).

        :param activations: of :meth:`allocate`, is written for :meth:`pullback`. The parameters are
            then those of the last :meth:`pack`, else those of now.
        """
        if activations is _NOT_KEPT:
            self.pack()
        out = np.empty((len(x), self._layers[-1].out_features), np.float32)
        self._compute(forward, len(x), x, np.arange(len(x)), out, activations)
        return out

    def gradient(
        self,
        x: Float32Array,
        index: IntArray,
        targets: Float32Array,
        loss: Loss,
        log_std: th.Tensor | None = None,
    ) -> FloatArray:
        """Set ``.grad`` of all parameters to the gradient of a loss.

        :param index: the rows of x and ``targets`` that the loss is of.
        :param log_std: of an actor, (a,); its gradient is set, too.
        :return: the terms of the loss, sums over the rows.
        """
        self.pack()
        stds = _NONE if log_std is None else log_std.detach().double().numpy()
        chunks = _chunks(len(index))
        sums = np.empty((chunks, self._size + len(stds)), np.float32)
        terms = np.empty((chunks, TERMS))
        typed = Loss(*(kind(value) for kind, value in zip(_TYPES, loss, strict=True)))
        self._compute(gradient, len(index), x, index, targets, typed, stds, sums, terms)
        total = self.set_gradients(sums)
        if log_std is not None:
            log_std.grad = total[self._size :]
        result: FloatArray = terms.sum(axis=0)
        return result

    def allocate(self, calls: int, n: int) -> tuple[Float32Array, Float32Array]:
        """Return memory for what :meth:`pullback` needs of some calls with n rows each.

        :return: for what the layers give, (calls, ...), and for the sums of all calls.
        """
        rows = FEW if are_few(n) else ROWS
        blocks = -(-n // rows)
        size = int(self._widths.sum()) * rows
        activations = _aligned(calls * blocks * size).reshape(calls, blocks, size)
        return activations, np.empty((_chunks(n), self._size), np.float32)

    def pullback(
        self, activations: Float32Array, grad_outputs: Float32Array, sums: Float32Array
    ) -> Float32Array:
        """Carry a gradient with respect to the outputs (n, outputs) back to the inputs.

        :param activations: what a call has written.
        :param sums: the gradient with respect to the parameters is added to it.
        :return: the gradient with respect to the inputs, (n, inputs).
        """
        n = len(grad_outputs)
        grad_inputs = np.empty((n, self._layers[0].in_features), np.float32)
        self._compute(pullback, n, activations, np.arange(n), grad_outputs, grad_inputs, sums)
        return grad_inputs

    def set_gradients(self, sums: Float32Array) -> th.Tensor:
        """Set ``.grad`` of all parameters, given sums (chunks, size); return their sum."""
        total = sums.sum(axis=0)
        for parameter, view in zip(self.parameters(), self._views(total, False), strict=True):
            parameter.grad = th.from_numpy(view).contiguous()
        return th.from_numpy(total)

    def parameters(self) -> list[nn.Parameter]:
        """Return PyTorch's parameters, by layers."""
        return [parameter for layer in self._layers for parameter in (layer.weight, layer.bias)]

    def _compute(self, function: Callable[..., None], n: int, *arguments: Any) -> None:
        """Call a function of :mod:`.kernel` for all chunks of n rows.

        Where that is worthwhile, several threads share them.
        """
        layers = Layers(self._widths, self._kinds, *self._packed)
        chunks = _chunks(n)
        threads = _threads if n > (WORTHWHILE - 1) * ROWS else 1
        size = -(-chunks // (PARTS * threads)) if threads > 1 else chunks
        # Each part is taken by one thread: `next` holds Python's lock.
        firsts = iter(range(0, chunks, size))

        def work() -> None:
            scratch = _aligned(self._scratch_size)
            for first in firsts:
                function(first, min(first + size, chunks), chunks, scratch, layers, *arguments)

        helpers = [_pool.submit(work) for _ in range(threads - 1)]
        work()
        for helper in helpers:
            # Do not wait for one that has not begun: its core is busy with something else.
            if not helper.cancel():
                helper.result()


def _chunks(n: int) -> int:
    return min(CHUNKS, -(-n // ROWS))


def _aligned(size: int) -> Float32Array:
    """Return memory for ``size`` numbers that begins with a cache line."""
    memory = np.empty(size + CACHE_LINE // 4, np.float32)
    to_next_line = -memory.ctypes.data % CACHE_LINE // 4
    return memory[to_next_line : to_next_line + size]


# Threads that share the work of every perceptron, and the pool of all but the first. None of its
# threads begins before there is work for it.
_threads = 1
_pool = ThreadPoolExecutor(1)


def use_one_torch_thread() -> None:
    """Give PyTorch one thread from now on; its others share the work of every :class:`Perceptron`.

    PyTorch's own threads wait for one another at every operation. On a machine that does something
    else at the same time they are up to ten times slower than one.
    """
    global _threads, _pool
    if _threads == 1 and th.get_num_threads() > 1:
        _threads = th.get_num_threads()
        _pool = ThreadPoolExecutor(_threads - 1, "sb3_quad networks")
        th.set_num_threads(1)


@contextmanager
def one_torch_thread(compiled: bool) -> Iterator[None]:
    """Call :func:`use_one_torch_thread` for the block alone.

    :param compiled: whether there is work for perceptrons; else nothing is changed.
    """
    global _threads, _pool
    torch_threads = th.get_num_threads()
    threads = _threads
    pool = _pool
    if compiled:
        use_one_torch_thread()
    try:
        yield
    finally:
        th.set_num_threads(torch_threads)
        if _pool is not pool:
            _pool.shutdown()
        _threads = threads
        _pool = pool
