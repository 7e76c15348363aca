"""SOAP: Adam in the basis in which the gradients of a layer are uncorrelated."""

from collections.abc import Callable, Iterable
from typing import Any

import torch as th

# Decay of the second moments of a matrix's gradients, and number of updates between two bases
MOMENT_DECAY = 0.95
REFRESH = 5
# Updates until the learning rate is the full one. Second moments of a few gradients say little,
# while an update moves the weights equally far along every eigenvector.
WARM_UP = 30


class SOAP(th.optim.Adam):
    """Adam that scales a weight matrix in the eigenbasis of its gradients' second moments.

    Adam scales each weight by the size of its own gradients. Here the weights of a layer are first
    rotated into the eigenbases of ``E[G Gᵀ]`` and ``E[Gᵀ G]``, where the gradients G hardly
    correlate, so that an update of the same length lowers the cost further. Biases have Adam's own
    updates. Source: N. Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam" (2024,
    arXiv 2409.11321).

    Its state contains everything that Adam's does, so that ``PPO.load`` accepts it as Adam's.

    :param params: parameters to learn, or groups of them, as for ``torch.optim.Adam``.
    :param lr: the learning rate, which is reached after ``WARM_UP`` updates.
    :param betas: decay of the momentum, and of the second moments of biases.
    :param eps: added to the root of the second moments, by which an update is divided.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-5,
    ) -> None:
        super().__init__(params, lr, betas, eps)

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Take one step along the gradients; ``closure`` is evaluated first, as in PyTorch."""
        loss = None
        if closure is not None:
            with th.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update(parameter, group)
        return loss

    def _update(self, parameter: th.Tensor, group: dict[str, Any]) -> None:
        gradient = parameter.grad
        assert gradient is not None
        is_matrix = parameter.ndim == 2
        state = self.state[parameter]
        # An Adam state from a zip has no matrix moments.
        if not state or (is_matrix and "moments" not in state):
            state["step"] = th.tensor(0.0)
            state["exp_avg"] = th.zeros_like(parameter)
            state["exp_avg_sq"] = th.zeros_like(parameter)
            if is_matrix:
                state["turned_sq"] = th.zeros_like(parameter)
                state["moments"] = [parameter.new_zeros(n, n) for n in parameter.shape]
        beta, beta_squared = group["betas"]
        state["step"] += 1
        state["exp_avg"].lerp_(gradient, 1.0 - beta)
        state["exp_avg_sq"].lerp_(gradient.square(), 1.0 - beta_squared)
        momentum, squares = state["exp_avg"], state["exp_avg_sq"]
        if is_matrix:
            left, right = self._bases(state, gradient)
            squares = state["turned_sq"]
            squares.lerp_((left.T @ gradient @ right).square(), 1.0 - MOMENT_DECAY)
            beta_squared = MOMENT_DECAY
            momentum = left.T @ momentum @ right
        n = state["step"].item()
        deviation = (squares / (1.0 - beta_squared**n)).sqrt() + group["eps"]
        update = momentum / (1.0 - beta**n) / deviation
        if is_matrix:
            update = left @ update @ right.T
        parameter.sub_(update, alpha=group["lr"] * min(1.0, n / WARM_UP))

    @staticmethod
    def _bases(state: dict[str, Any], gradient: th.Tensor) -> list[th.Tensor]:
        """Return the eigenvectors of both second moments, the columns of two matrices."""
        for moment, product in zip(
            state["moments"], (gradient @ gradient.T, gradient.T @ gradient), strict=True
        ):
            moment.lerp_(product, 1.0 - MOMENT_DECAY)
        if "bases" not in state:
            # The power iteration sorts by falling eigenvalues. In another order it would exchange
            # the vectors, and updates would be divided by the moments of other ones.
            state["bases"] = [th.linalg.eigh(moment)[1].flip(1) for moment in state["moments"]]
        elif state["step"] % REFRESH == 0:
            # One step of the power iteration: the moments have changed little since the last one.
            state["bases"] = [
                th.linalg.qr(moment @ basis)[0]
                for moment, basis in zip(state["moments"], state["bases"], strict=True)
            ]
        bases: list[th.Tensor] = state["bases"]
        return bases
