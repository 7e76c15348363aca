"""The name in version 0.1 of :mod:`sb3_quad.simulation.state`."""

from sb3_quad.simulation.state import QuadcopterState

__all__ = ["QuadcopterState"]
