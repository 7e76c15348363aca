"""SAC that also learns from an expert: its transitions, its actions, its proposals."""

from sb3_quad.sac_bc.sac_bc import SACBC

__all__ = ["SACBC"]
