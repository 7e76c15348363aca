"""A multilayer perceptron and its gradients, by :mod:`.kernel`, on the threads that PyTorch had."""

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
import torch as th
from torch import nn

from sb3_quad.algorithms.buffers import Batch
from sb3_quad.base.types import AnyArray, Float32Array, FloatArray, IntArray
from sb3_quad.fast.kernel import (
    LINEAR,
    RELU,
    ROWS,
    TANH,
    Layers,
    forward,
    gradient,
    pullback,
)
from sb3_quad.fast.losses import TERMS, Numbers
from sb3_quad.fast.tiles import padded

# A mini-batch is cut into at most this many chunks. Their sums are added up in order, so that
# results do not depend on the number of threads, to the bit.
CHUNKS = 16
# With fewer blocks than this, the work is done before another thread wakes up.
WORTHWHILE = 4
# Parts of a mini-batch per thread, so that a thread that is held up can do fewer of them.
PARTS = 4
# Bytes; vectors that straddle two cache lines take a third longer.
CACHE_LINE = 64
_ACTIVATIONS = {nn.Tanh: TANH, nn.ReLU: RELU}
_NONE = np.empty(0)
_NOT_KEPT = np.empty((0, 0), np.float32)


class Perceptron:
    """Linear layers with tanh or ReLU between them, whose parameters stay PyTorch's.

    :param modules: see :meth:`fits`.
    """

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        self._linear: list[Any] = [*modules[::2]]
        kinds = np.array([*(_ACTIVATIONS[type(layer)] for layer in modules[1::2]), LINEAR])
        sizes = [self._linear[0].in_features, *(layer.out_features for layer in self._linear)]
        widths = np.array([padded(size) for size in sizes])
        self._units = int(widths.sum())
        self._scratch_size = (self._units + 2 * int(widths.max())) * ROWS
        self._size = int((widths[1:] * (widths[:-1] + 1)).sum())
        parameters, weights = (_aligned(self._size) for _ in range(2))
        for packed in (parameters, weights):
            packed.fill(0.0)
        self._layers = Layers(widths, kinds, parameters, weights)
        # Views of those, each with the view of PyTorch's memory that :meth:`pack` copies into it
        own = [parameter.detach().numpy() for parameter in self.parameters()]
        self._copies = [*zip(self._views(parameters), own, strict=True)]
        transposed = [*zip(self._views(weights, "C"), own, strict=True)]
        self._copies_backward = self._copies + transposed[::2]

    def _views(self, packed: Float32Array, order: Literal["F", "C"] = "F") -> list[Float32Array]:
        """Return the views of :meth:`parameters` in an array of all layers' parameters.

        :param order: ``"F"``: weights lie as in ``Layers.parameters``; ``"C"``: ``Layers.weights``.
        """
        views: list[Float32Array] = []
        start = 0
        for i, layer in enumerate(self._linear):
            inputs, outputs = self._layers.widths[i : i + 2].tolist()
            middle = start + inputs * outputs
            weights = packed[start:middle].reshape(outputs, inputs, order=order)
            views.append(weights[: layer.out_features, : layer.in_features])
            views.append(packed[middle : middle + layer.out_features])
            start = middle + outputs
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

    def pack(self, backward: bool = True) -> None:
        """Copy the current parameters, for calls that keep activations.

        :param backward: also copy what the backward pass needs.
        """
        for packed, parameter in self._copies_backward if backward else self._copies:
            packed[...] = parameter

    def __call__(
        self, observations: AnyArray, activations: Float32Array = _NOT_KEPT
    ) -> Float32Array:
        """Return the outputs (n, outputs) for observations (n, ...).

        :param activations: memory from :meth:`allocate`, written for :meth:`pullback`. The call
            then uses the parameters of the last :meth:`pack`, otherwise the current ones.
        """
        if activations is _NOT_KEPT:
            self.pack(backward=False)
        n = len(observations)
        out = np.empty((n, self._linear[-1].out_features), np.float32)
        self._compute(forward, n, _flat(observations), _all_rows(n), out, activations)
        return out

    def gradient(self, batch: Batch, loss: Numbers, log_std: th.Tensor | None = None) -> FloatArray:
        """Set ``.grad`` of all parameters to the gradient of a loss.

        :param log_std: log_std of an actor, (a,); its gradient is set, too.
        :return: the terms of the loss, means over the rows.
        """
        self.pack()
        rows = batch.rows
        stds = _NONE if log_std is None else log_std.detach().double().numpy()
        chunks = _chunks(len(rows))
        sums = np.empty((chunks, self._size + len(stds)), np.float32)
        terms = np.empty((chunks, TERMS))
        x = _flat(batch.observations)
        self._compute(gradient, len(rows), x, rows, batch.targets, loss, stds, sums, terms)
        total = self.set_gradients(sums)
        if log_std is not None:
            log_std.grad = total[self._size :]
        return np.asarray(terms.sum(axis=0) / len(rows))

    def allocate(self, calls: int, n: int) -> tuple[Float32Array, Float32Array]:
        """Return memory for what :meth:`pullback` needs from ``calls`` calls with n rows each.

        :return: memory for the activations, (calls, ...), and for the sums of all calls.
        """
        blocks = -(-n // ROWS)
        size = self._units * min(ROWS, padded(n))
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
        grad_inputs = np.empty((n, self._linear[0].in_features), np.float32)
        self._compute(pullback, n, activations, _all_rows(n), grad_outputs, grad_inputs, sums)
        return grad_inputs

    def set_gradients(self, sums: Float32Array) -> th.Tensor:
        """Set ``.grad`` of all parameters, given sums (chunks, size); return their sum."""
        total = sums.sum(axis=0)
        for parameter, view in zip(self.parameters(), self._views(total), strict=True):
            parameter.grad = th.from_numpy(np.ascontiguousarray(view))
        return th.from_numpy(total)

    def parameters(self) -> list[nn.Parameter]:
        """Return PyTorch's parameters, by layers."""
        return [parameter for layer in self._linear for parameter in (layer.weight, layer.bias)]

    def _compute(self, function: Callable[..., None], n: int, *arguments: Any) -> None:
        """Call a function of :mod:`.kernel` for all chunks of n rows.

        Where that is worthwhile, several threads share them.
        """
        chunks = _chunks(n)
        threads = _threads if n > (WORTHWHILE - 1) * ROWS else 1
        if threads == 1:
            function(0, chunks, chunks, _scratch(self._scratch_size), self._layers, *arguments)
            return
        size = -(-chunks // (PARTS * threads))
        # Each part goes to one thread only, since `next` holds Python's global lock.
        firsts = iter(range(0, chunks, size))

        def work() -> None:
            scratch = _scratch(self._scratch_size)
            for first in firsts:
                function(
                    first, min(first + size, chunks), chunks, scratch, self._layers, *arguments
                )

        helpers = [_pool.submit(work) for _ in range(threads - 1)]
        work()
        for helper in helpers:
            # Do not wait for one that has not begun: its core is busy with something else.
            if not helper.cancel():
                helper.result()


def _flat(observations: AnyArray) -> Float32Array:
    return np.ascontiguousarray(observations, dtype=np.float32).reshape(len(observations), -1)


@functools.lru_cache(maxsize=8)
def _all_rows(n: int) -> IntArray:
    """Return the numbers of n rows, which nobody writes to."""
    return np.arange(n)


def _chunks(n: int) -> int:
    return min(CHUNKS, -(-n // ROWS))


def _aligned(size: int) -> Float32Array:
    """Return memory for ``size`` numbers that begins at a cache line."""
    memory = np.empty(size + CACHE_LINE // 4, np.float32)
    to_next_line = -memory.ctypes.data % CACHE_LINE // 4
    return memory[to_next_line : to_next_line + size]


def _scratch(size: int) -> Float32Array:
    """Return this thread's memory for ``size`` numbers, which its next call gets, too."""
    memory: Float32Array | None = getattr(_own, "memory", None)
    if memory is None or len(memory) < size:
        memory = _own.memory = _aligned(size)
    return memory


_own = threading.local()
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
def one_torch_thread() -> Iterator[None]:
    """Call :func:`use_one_torch_thread` for the duration of the block."""
    global _threads, _pool
    torch_threads = th.get_num_threads()
    threads = _threads
    pool = _pool
    use_one_torch_thread()
    try:
        yield
    finally:
        th.set_num_threads(torch_threads)
        # A process that is forked later would not have these threads.
        if _pool is not pool:
            _pool.shutdown()
        _threads = threads
        _pool = pool
