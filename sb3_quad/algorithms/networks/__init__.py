"""Networks that train faster than layer by layer, with the same results."""

from sb3_quad.algorithms.networks.losses import LOSS
from sb3_quad.algorithms.networks.mlp import Perceptron, share_out, shared_out

__all__ = ["LOSS", "Perceptron", "share_out", "shared_out"]
