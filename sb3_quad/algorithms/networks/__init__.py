"""Networks that train faster than layer by layer, with the same results."""

from sb3_quad.algorithms.networks.gradients import (
    Batch,
    Network,
    act,
    gradient_norms,
    gradients,
    mean_actions,
    network_of,
    state_values,
)
from sb3_quad.algorithms.networks.losses import BC_FILTERS, CLONING_LOSSES, CloningLoss, Loss
from sb3_quad.algorithms.networks.perceptron import one_torch_thread, use_one_torch_thread

__all__ = [
    "BC_FILTERS",
    "CLONING_LOSSES",
    "Batch",
    "CloningLoss",
    "Loss",
    "Network",
    "act",
    "gradient_norms",
    "gradients",
    "mean_actions",
    "network_of",
    "one_torch_thread",
    "state_values",
    "use_one_torch_thread",
]
