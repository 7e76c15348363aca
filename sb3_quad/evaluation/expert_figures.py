"""The name in version 0.1 of :mod:`sb3_quad.evaluation.expert_metrics`."""

from sb3_quad.evaluation.expert_metrics import measure_expert

__all__ = ["measure_expert"]
