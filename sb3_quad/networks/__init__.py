"""Networks that train faster than layer by layer, with the same results."""

from sb3_quad.networks.mlp import apply, fits, shared_out

__all__ = ["apply", "fits", "shared_out"]
