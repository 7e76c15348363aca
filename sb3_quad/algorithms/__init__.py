"""The algorithms: DAgger, PPO and SAC with behavioural cloning, and the gradient of the model."""

from typing import TYPE_CHECKING

from sb3_quad.base.imports import lazy_names

if TYPE_CHECKING:
    from sb3_quad.algorithms.apg import APG
    from sb3_quad.algorithms.dagger import DAgger
    from sb3_quad.algorithms.ppo_bc import PPOBC
    from sb3_quad.algorithms.sac_bc import SACBC

__all__ = ["APG", "PPOBC", "SACBC", "DAgger"]

# Imported on first use: the names of modules below do not wait for torch.
_LAZY = {
    "APG": "sb3_quad.algorithms.apg",
    "DAgger": "sb3_quad.algorithms.dagger",
    "PPOBC": "sb3_quad.algorithms.ppo_bc",
    "SACBC": "sb3_quad.algorithms.sac_bc",
}

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
