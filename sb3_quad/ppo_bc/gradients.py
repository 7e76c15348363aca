"""Which term of a loss pulls how hard: PPO's gradient clip is joint, so a large term starves the others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch as th


def gradient_norms(terms: Mapping[str, th.Tensor], parameters: Iterable[th.nn.Parameter]) -> dict[str, float]:
    """The norm of each term's own gradient over all parameters; the graph stays for the real backward pass."""
    shared = list(parameters)
    norms = {}
    for name, term in terms.items():
        gradients = th.autograd.grad(term, shared, retain_graph=True, allow_unused=True)
        squares = [gradient.square().sum() for gradient in gradients if gradient is not None]
        norms[name] = float(th.stack(squares).sum().sqrt()) if squares else 0.0
    return norms
