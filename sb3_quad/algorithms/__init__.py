"""The algorithms: DAgger, PPO with behavioural cloning, and the gradient of the model."""

from sb3_quad.algorithms.apg import APG
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.algorithms.ppo_bc import PPOBC

__all__ = ["APG", "PPOBC", "DAgger"]
