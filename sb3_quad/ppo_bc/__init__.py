"""PPO with a weighted behavioural-cloning loss (thesis 4.2.2, Eq. 4.4)."""

from sb3_quad.ppo_bc.ppo_bc import PPOBC

__all__ = ["PPOBC"]
