"""A multilayer perceptron as one function of PyTorch, computed by :mod:`.kernel` on as many cores as are free."""

import math
import os
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_quad.networks.kernel import ALIGNED, CONTROL, LINEAR, RELU, ROWS, TANH, backward, forward

CHUNKS = 8  # at most, of a mini-batch: what a thread takes at once
WORTHWHILE = 4  # blocks; fewer are done before another thread has woken
REST = 100  # calls without helpers after one kept a call waiting: its core is busy with something else
_ACTIVATIONS = {nn.Tanh: TANH, nn.ReLU: RELU}


def fits(modules: Sequence[nn.Module]) -> bool:
    """Whether these are linear layers with tanh or ReLU between them, in float32 on the CPU, and nobody listens to them."""
    linear, between = modules[::2], modules[1::2]
    return (
        len(modules) % 2 == 1
        and all(type(each) is nn.Linear and each.bias is not None for each in linear)
        and all(each.weight.dtype == th.float32 and each.weight.device.type == "cpu" for each in linear)
        and all(type(each) in _ACTIVATIONS for each in between)
        and not any(each._forward_hooks or each._forward_pre_hooks or each._backward_hooks for each in modules)
    )


def apply(modules: Sequence[nn.Module], x: th.Tensor) -> th.Tensor:
    """The output, (n, outputs), of modules that :func:`fits`, for x (n, inputs), by which there is no gradient."""
    linear = modules[::2]
    kinds = [*(_ACTIVATIONS[type(each)] for each in modules[1::2]), LINEAR]  # type: ignore[index]
    parameters = [parameter for each in linear for parameter in (each.weight, each.bias)]
    if not th.is_grad_enabled():
        return _forward(x, kinds, parameters, keep=False)[0]
    result: th.Tensor = _Mlp.apply(x, kinds, *parameters)  # type: ignore[no-untyped-call]
    return result


def _forward(x: th.Tensor, kinds: list[int], parameters: Sequence[th.Tensor], keep: bool) -> tuple[th.Tensor, Any]:
    """The output, and what :meth:`_Mlp.backward` needs if it is to ``keep`` that."""
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))
    widths = np.array([-(-size // 4) * 4 for size in (x.shape[1], *(len(bias) for _, bias in layers))])
    packed, transposed = _pack(layers, widths, keep)
    rows, blocks = x.detach().contiguous().numpy(), -(-len(x) // ROWS)
    shape = blocks if keep else 0, int(widths.sum()), ROWS
    buffer = np.empty(math.prod(shape) + ALIGNED, np.float32)
    first = -buffer.ctypes.data % 64 // 4
    kept = buffer[first : first + math.prod(shape)].reshape(shape)
    out = np.empty((len(rows), len(parameters[-1])), np.float32)
    _helpers.run(forward, blocks, rows, widths, np.array(kinds), packed, kept, out)
    return th.from_numpy(out), (layers, widths, np.array(kinds), transposed, kept)


class _Mlp(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: th.Tensor, kinds: list[int], *parameters: th.Tensor) -> th.Tensor:
        out, ctx.held = _forward(x, kinds, parameters, keep=True)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        layers, widths, kinds, transposed, kept = ctx.held
        sums = np.empty((min(CHUNKS, len(kept)), len(transposed)), np.float32)
        _helpers.run(backward, len(kept), gradients[0].contiguous().numpy(), widths, kinds, transposed, kept, sums)
        flat = th.from_numpy(sums).sum(0)
        result: list[th.Tensor | None] = [None, None]
        at = 0
        for (weight, bias), rows, columns in zip(layers, widths[1:].tolist(), widths[:-1].tolist(), strict=True):
            middle, end = at + rows * columns, at + rows * (columns + 1)
            result.append(flat[at:middle].view(rows, columns)[: weight.shape[0], : weight.shape[1]])
            result.append(flat[middle : middle + len(bias)])
            at = end
        return tuple(result)


def _pack(layers: Sequence[tuple[th.Tensor, th.Tensor]], widths: Any, for_backward: bool) -> tuple[Any, Any]:
    """The parameters behind one another, padded; and with the weights transposed, or None."""
    size = int((widths[1:] * (widths[:-1] + 1)).sum())
    packed = np.zeros(size, np.float32)
    transposed = np.zeros(size, np.float32) if for_backward else None
    at = 0
    for (weight, bias), rows, columns in zip(layers, widths[1:].tolist(), widths[:-1].tolist(), strict=True):
        w, end = weight.detach().numpy(), at + rows * columns
        packed[at:end].reshape(rows, columns)[: w.shape[0], : w.shape[1]] = w
        packed[end : end + len(bias)] = bias.detach().numpy()
        if transposed is not None:
            transposed[at:end].reshape(columns, rows)[: w.shape[1], : w.shape[0]] = w.T
        at = end + rows
    return packed, transposed


class _Helpers:
    """Threads that take chunks of a call, too. A call returns when all chunks are done, and waits for nobody without one."""

    def __init__(self) -> None:
        self.threads = 1
        self._begun = 0
        self._resting = 0
        self._calls: queue.SimpleQueue[tuple[Callable[..., bool], Any]] = queue.SimpleQueue()

    def run(self, function: Callable[..., bool], blocks: int, *arguments: Any) -> None:
        chunks = min(CHUNKS, blocks)
        control = np.zeros(CONTROL, dtype=np.int64)
        control[0] = chunks
        count = min(self.threads, chunks) - 1 if blocks >= WORTHWHILE else 0
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


@contextmanager
def shared_out(compiled: bool) -> Iterator[None]:
    """Within the block PyTorch has one thread, and as many as it had before take part in :func:`apply`.

    PyTorch's own threads wait for one another at every operation: on a machine that does something else beside they are up to
    ten times slower than one.

    :param compiled: whether the policy's networks are :func:`apply`'s; else nothing is changed.
    """
    before = th.get_num_threads(), _helpers.threads
    if compiled and before[1] == 1:
        th.set_num_threads(1)
        _helpers.threads = before[0]
    try:
        yield
    finally:
        if compiled and before[1] == 1:
            th.set_num_threads(before[0])
            _helpers.threads = 1
