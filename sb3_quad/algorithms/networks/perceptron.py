"""A multilayer perceptron and its gradients, computed by :mod:`.kernel` on as many threads as
PyTorch had.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_quad.algorithms.networks.kernel import LINEAR, RELU, ROWS, TANH, Layers, forward, gradient
from sb3_quad.algorithms.networks.losses import TERMS, Loss
from sb3_quad.base.arrays import Float32Array, FloatArray, IntArray

CHUNKS = (
    16  # at most, of a mini-batch: their sums are added up, so the number of threads changes no bit
)
WORTHWHILE = 4  # blocks; fewer are done before another thread has woken
PARTS = 4  # of a mini-batch for each thread: one that is held up does fewer of them
CACHE_LINE = 64  # bytes; vectors that straddle two take a third longer
_ACTIVATIONS = {nn.Tanh: TANH, nn.ReLU: RELU}
_TYPES = tuple(
    Loss.__annotations__.values()
)  # of its fields: an int where a float is meant would be compiled anew
_NONE = np.empty(0)


class Perceptron:
    """Linear layers with tanh or ReLU between them, whose parameters stay PyTorch's.

    :param modules: see :meth:`fits`.
    """

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        self._layers: list[Any] = [*modules[::2]]
        self._kinds = np.array([*(_ACTIVATIONS[type(each)] for each in modules[1::2]), LINEAR])
        sizes = [self._layers[0].in_features, *(each.out_features for each in self._layers)]
        self._widths = np.array([-(-size // 4) * 4 for size in sizes])
        self._size = int((self._widths[1:] * (self._widths[:-1] + 1)).sum())
        self._packed = np.zeros(
            (2, self._size), np.float32
        )  # with the weights as they are, and transposed
        self._copies: list[
            tuple[Float32Array, Float32Array]
        ] = []  # from PyTorch's memory into these
        for layer, at, rows, columns in self._places():
            weight, bias, middle = (
                layer.weight.detach().numpy(),
                layer.bias.detach().numpy(),
                at + rows * columns,
            )
            plain, transposed = (
                self._packed[0, at:middle].reshape(rows, -1),
                self._packed[1, at:middle].reshape(columns, -1),
            )
            self._copies.append((plain[: weight.shape[0], : weight.shape[1]], weight))
            self._copies.append((transposed[: weight.shape[1], : weight.shape[0]], weight.T))
            self._copies.append((self._packed[:, middle : middle + len(bias)], bias))

    @staticmethod
    def fits(modules: Sequence[nn.Module]) -> bool:
        """Whether these are linear layers and activations in turn, in float32 on the CPU, without
        hooks.
        """
        linear = modules[::2]
        return (
            len(modules) % 2 == 1
            and all(type(each) is nn.Linear and each.bias is not None for each in linear)
            and all(
                each.weight.dtype == th.float32 and each.weight.device.type == "cpu"
                for each in linear
            )
            and all(type(each) in _ACTIVATIONS for each in modules[1::2])
            and not any(
                each._forward_hooks or each._forward_pre_hooks or each._backward_hooks
                for each in modules
            )
        )

    def __call__(self, x: Float32Array) -> Float32Array:
        """The outputs (n, outputs) for x (n, inputs)."""
        out = np.empty((len(x), self._layers[-1].out_features), np.float32)
        self._compute(forward, len(x), x, np.arange(len(x)), out)
        return out

    def gradient(
        self,
        x: Float32Array,
        index: IntArray,
        targets: Float32Array,
        loss: Loss,
        log_std: th.Tensor | None = None,
    ) -> FloatArray:
        """Set the gradient of a loss over the rows ``index`` of x and ``targets`` as ``.grad`` of
        all parameters.

        :param log_std: of an actor, (a,); its gradient is set, too.
        :return: the terms of the loss, sums over the rows.
        """
        stds = _NONE if log_std is None else log_std.detach().double().numpy()
        chunks = _chunks(len(index))
        sums, terms = (
            np.empty((chunks, self._size + len(stds)), np.float32),
            np.empty((chunks, TERMS)),
        )
        typed = Loss(*(kind(value) for kind, value in zip(_TYPES, loss, strict=True)))
        self._compute(gradient, len(index), x, index, targets, typed, stds, sums, terms)
        total = th.from_numpy(sums.sum(axis=0))
        for layer, at, rows, columns in self._places():
            middle = at + rows * columns
            of_weights = total[at:middle].view(rows, columns)[
                : layer.out_features, : layer.in_features
            ]
            layer.weight.grad = of_weights.contiguous()
            layer.bias.grad = total[middle : middle + layer.out_features]
        if log_std is not None:
            log_std.grad = total[self._size :]
        result: FloatArray = terms.sum(axis=0)
        return result

    def parameters(self) -> list[nn.Parameter]:
        """PyTorch's, by layers."""
        return [parameter for layer in self._layers for parameter in (layer.weight, layer.bias)]

    def _places(self) -> Iterator[tuple[Any, int, int, int]]:
        """Of each layer where its parameters begin, and its padded outputs and inputs."""
        at = 0
        for layer, columns, rows in zip(
            self._layers, self._widths.tolist(), self._widths[1:].tolist(), strict=False
        ):
            yield layer, at, rows, columns
            at += rows * (columns + 1)

    def _compute(self, function: Callable[..., None], n: int, *arguments: Any) -> None:
        """Call a function of :mod:`.kernel` for all chunks of n rows, on several threads where that
        is worthwhile.
        """
        for there, here in self._copies:
            there[...] = here
        layers = Layers(self._widths, self._kinds, *self._packed)
        chunks, threads = _chunks(n), _threads if n > (WORTHWHILE - 1) * ROWS else 1
        size = -(-chunks // (PARTS * threads)) if threads > 1 else chunks
        firsts = iter(
            range(0, chunks, size)
        )  # each part is taken by one thread: `next` holds Python's lock

        def work() -> None:
            scratch = _aligned(int(self._widths.sum() + 2 * self._widths.max()) * ROWS)
            for first in firsts:
                function(first, min(first + size, chunks), chunks, scratch, layers, *arguments)

        helpers = [_pool.submit(work) for _ in range(threads - 1)] if _pool is not None else []
        work()
        for helper in helpers:
            if (
                not helper.cancel()
            ):  # one that has not begun is not waited for: its core is busy with something else
                helper.result()


def _chunks(n: int) -> int:
    return min(CHUNKS, -(-n // ROWS))


def _aligned(size: int) -> Float32Array:
    """Room for ``size`` numbers that begins with a cache line."""
    room = np.empty(size + CACHE_LINE // 4, np.float32)
    return room[-room.ctypes.data % CACHE_LINE // 4 :][:size]


_threads = 1  # that share the work of every perceptron
_pool: ThreadPoolExecutor | None = None  # of the others


def use_one_torch_thread() -> None:
    """From now on PyTorch has one thread, and as many as it had share the work of every
    :class:`Perceptron`.

    PyTorch's own threads wait for one another at every operation: on a machine that does something
    else beside they are up to ten times slower than one.
    """
    global _threads, _pool
    if _threads == 1 and th.get_num_threads() > 1:
        _threads = th.get_num_threads()
        _pool = ThreadPoolExecutor(_threads - 1, "sb3_quad networks")
        th.set_num_threads(1)


@contextmanager
def one_torch_thread(compiled: bool) -> Iterator[None]:
    """:func:`use_one_torch_thread` within the block.

    :param compiled: whether there is work for perceptrons; else nothing is changed.
    """
    global _threads, _pool
    before = th.get_num_threads(), _threads, _pool
    if compiled:
        use_one_torch_thread()
    try:
        yield
    finally:
        th.set_num_threads(before[0])
        if _pool is not before[2] and _pool is not None:
            _pool.shutdown()
        _threads, _pool = before[1:]
