"""The algorithms: DAgger, and PPO and SAC with behavioural cloning."""

from typing import TYPE_CHECKING

from sb3_quad.base.imports import lazy_names

if TYPE_CHECKING:
    from sb3_quad.algorithms.dagger import DAgger
    from sb3_quad.algorithms.ppo_bc import PPOBC
    from sb3_quad.algorithms.sac_bc import SACBC

__all__ = ["PPOBC", "SACBC", "DAgger"]

# Imported on first use: the names of modules below do not wait for torch.
_LAZY = {
    "DAgger": "sb3_quad.algorithms.dagger",
    "PPOBC": "sb3_quad.algorithms.ppo_bc",
    "SACBC": "sb3_quad.algorithms.sac_bc",
}

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
