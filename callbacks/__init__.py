"""Callbacks for any Stable-Baselines3 algorithm, one idea per file; docs/callbacks.md lists them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_quad.base.lazy import lazy_names

if TYPE_CHECKING:
    from sb3_quad.callbacks.best_model import BestModel
    from sb3_quad.callbacks.checkpoint import Checkpoint
    from sb3_quad.callbacks.coefficient_schedule import CoefficientSchedule
    from sb3_quad.callbacks.episode_log import EpisodeLog
    from sb3_quad.callbacks.flight_metrics import FlightMetrics
    from sb3_quad.callbacks.observation_statistics import ObservationStatistics
    from sb3_quad.callbacks.stop import StopOnSignal, StopWhen
    from sb3_quad.callbacks.trajectory_figures import TrajectoryFigures
    from sb3_quad.training.last_good import LastGoodModel

__all__ = [
    "BestModel",
    "Checkpoint",
    "CoefficientSchedule",
    "EpisodeLog",
    "FlightMetrics",
    "LastGoodModel",
    "ObservationStatistics",
    "StopOnSignal",
    "StopWhen",
    "TrajectoryFigures",
]

_LAZY = {  # imported on first use: naming one waits for none of the others
    "BestModel": "sb3_quad.callbacks.best_model",
    "Checkpoint": "sb3_quad.callbacks.checkpoint",
    "CoefficientSchedule": "sb3_quad.callbacks.coefficient_schedule",
    "EpisodeLog": "sb3_quad.callbacks.episode_log",
    "FlightMetrics": "sb3_quad.callbacks.flight_metrics",
    "LastGoodModel": "sb3_quad.training.last_good",
    "ObservationStatistics": "sb3_quad.callbacks.observation_statistics",
    "StopOnSignal": "sb3_quad.callbacks.stop",
    "StopWhen": "sb3_quad.callbacks.stop",
    "TrajectoryFigures": "sb3_quad.callbacks.trajectory_figures",
}

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
