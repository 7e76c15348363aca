"""The algorithms: DAgger, PPO and SAC with behavioural cloning, and the gradient of the model."""

from sb3_quad.algorithms.apg import APG
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.algorithms.ppo_bc import PPOBC
from sb3_quad.algorithms.sac_bc import SACBC

__all__ = ["APG", "PPOBC", "SACBC", "DAgger"]
