"""A multilayer perceptron and its gradients, computed by :mod:`.kernel` on as many cores as are free."""

import os
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn

from sb3_quad.algorithms.networks.kernel import CONTROL, LINEAR, RELU, ROWS, TANH, forward, gradient
from sb3_quad.algorithms.networks.losses import TERMS
from sb3_quad.base.arrays import Float32Array, FloatArray, IntArray

CHUNKS = 16  # at most, of a mini-batch: what a thread takes at once
WORTHWHILE = 4  # blocks; fewer are done before another thread has woken
REST = 100  # calls without helpers after one kept a call waiting: its core is busy with something else
_ACTIVATIONS = {nn.Tanh: TANH, nn.ReLU: RELU}
_NO_ONE = np.empty(0)


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
        self._packed = np.zeros((2, self._size), np.float32)  # with the weights as they are, and transposed
        self._copies: list[tuple[Float32Array, Float32Array]] = []  # from PyTorch's memory into these
        for layer, at, rows, columns in self._places():
            weight, bias, middle = layer.weight.detach().numpy(), layer.bias.detach().numpy(), at + rows * columns
            plain, transposed = self._packed[0, at:middle].reshape(rows, -1), self._packed[1, at:middle].reshape(columns, -1)
            self._copies.append((plain[: weight.shape[0], : weight.shape[1]], weight))
            self._copies.append((transposed[: weight.shape[1], : weight.shape[0]], weight.T))
            self._copies.append((self._packed[:, middle : middle + len(bias)], bias))

    @staticmethod
    def fits(modules: Sequence[nn.Module]) -> bool:
        """Whether these are linear layers and activations in turn, in float32 on the CPU, and nobody listens to them."""
        linear = modules[::2]
        return (
            len(modules) % 2 == 1
            and all(type(each) is nn.Linear and each.bias is not None for each in linear)
            and all(each.weight.dtype == th.float32 and each.weight.device.type == "cpu" for each in linear)
            and all(type(each) in _ACTIVATIONS for each in modules[1::2])
            and not any(each._forward_hooks or each._forward_pre_hooks or each._backward_hooks for each in modules)
        )

    def __call__(self, x: Float32Array) -> Float32Array:
        """The outputs (n, outputs) for x (n, inputs)."""
        out = np.empty((len(x), self._layers[-1].out_features), np.float32)
        _helpers.run(forward, len(x), x, self._widths, self._kinds, self._pack()[0], out)
        return out

    def gradient(
        self, x: Float32Array, index: IntArray, targets: Float32Array, loss: Any, log_std: th.Tensor | None = None
    ) -> FloatArray:
        """Set the gradient of a loss over the rows ``index`` of x and ``targets`` as ``.grad`` of all parameters.

        The number of threads changes no bit of it.

        :param loss: of dtype ``LOSS``, (1,).
        :param log_std: of an actor, (a,); its gradient is set, too.
        :return: the terms of the loss, sums over the rows.
        """
        stds = _NO_ONE if log_std is None else log_std.detach().double().numpy()
        chunks = _chunks(len(index))
        sums, terms = np.empty((chunks, self._size + len(stds)), np.float32), np.empty((chunks, TERMS))
        _helpers.run(
            gradient, len(index), x, index, self._widths, self._kinds, *self._pack(), targets, loss, stds, sums, terms
        )
        total = th.from_numpy(sums.sum(axis=0))
        for layer, at, rows, columns in self._places():
            middle = at + rows * columns
            of_weights = total[at:middle].view(rows, columns)[: layer.out_features, : layer.in_features]
            layer.weight.grad = of_weights.contiguous()
            layer.bias.grad = total[middle : middle + layer.out_features]
        if log_std is not None:
            log_std.grad = total[self._size :]
        result: FloatArray = terms.sum(axis=0)
        return result

    def parameters(self) -> Iterator[nn.Parameter]:
        """PyTorch's, by layers."""
        return (parameter for layer in self._layers for parameter in (layer.weight, layer.bias))

    def _places(self) -> Iterator[tuple[Any, int, int, int]]:
        """Of each layer where its parameters begin, and its padded outputs and inputs."""
        at = 0
        for layer, columns, rows in zip(self._layers, self._widths.tolist(), self._widths[1:].tolist(), strict=False):
            yield layer, at, rows, columns
            at += rows * (columns + 1)

    def _pack(self) -> Float32Array:
        for there, here in self._copies:
            there[...] = here
        return self._packed


def _chunks(n: int) -> int:
    return min(CHUNKS, -(-n // ROWS))


class _Helpers:
    """Threads that take chunks of a call, too. A call returns when all chunks are done, and waits for nobody without one."""

    def __init__(self) -> None:
        self.threads = 1
        self._begun = 0
        self._resting = 0
        self._calls: queue.SimpleQueue[tuple[Callable[..., bool], Any]] = queue.SimpleQueue()

    def run(self, function: Callable[..., bool], n: int, *arguments: npt.NDArray[Any]) -> None:
        """Call a function of :mod:`.kernel` for n rows."""
        chunks = _chunks(n)
        control = np.zeros(CONTROL, dtype=np.int64)
        control[0] = chunks
        count = min(self.threads, chunks) - 1 if n > (WORTHWHILE - 1) * ROWS else 0
        if self._resting > 0:
            self._resting -= 1
            count = 0
        while self._begun < count:
            threading.Thread(target=self._help, daemon=True, name="sb3_quad networks").start()
            self._begun += 1
        for _ in range(count):
            self._calls.put((function, (control, False, chunks, *arguments)))
        if function(control, True, chunks, *arguments):
            self._resting = REST

    def _help(self) -> None:
        while True:
            function, arguments = self._calls.get()
            function(*arguments)
            del arguments


_helpers = _Helpers()


def _renew() -> None:
    global _helpers
    _helpers = _Helpers()  # a forked child has no threads but the one that forked


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def share_out() -> None:
    """From now on PyTorch has one thread, and as many as it had share the work of every :class:`Perceptron`.

    PyTorch's own threads wait for one another at every operation: on a machine that does something else beside they are up to
    ten times slower than one.
    """
    if _helpers.threads == 1:
        _helpers.threads = th.get_num_threads()
        th.set_num_threads(1)


@contextmanager
def shared_out(compiled: bool) -> Iterator[None]:
    """:func:`share_out` within the block.

    :param compiled: whether there is work for perceptrons; else nothing is changed.
    """
    before = th.get_num_threads(), _helpers.threads
    if compiled:
        share_out()
    try:
        yield
    finally:
        th.set_num_threads(before[0])
        _helpers.threads = before[1]
