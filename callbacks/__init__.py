"""Callbacks for any Stable-Baselines3 algorithm, one idea per file; docs/callbacks.md lists them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_quad.callbacks.best_model import BestModel
    from sb3_quad.callbacks.checkpoint import Checkpoint
    from sb3_quad.callbacks.coefficient_schedule import CoefficientSchedule
    from sb3_quad.callbacks.episode_log import EpisodeLog
    from sb3_quad.callbacks.flight_metrics import FlightMetrics
    from sb3_quad.callbacks.last_good import LastGoodModel
    from sb3_quad.callbacks.observation_statistics import ObservationStatistics
    from sb3_quad.callbacks.stop import StopOnSignal, StopWhen
    from sb3_quad.callbacks.trajectory_figures import TrajectoryFigures

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
    "BestModel": "best_model",
    "Checkpoint": "checkpoint",
    "CoefficientSchedule": "coefficient_schedule",
    "EpisodeLog": "episode_log",
    "FlightMetrics": "flight_metrics",
    "LastGoodModel": "last_good",
    "ObservationStatistics": "observation_statistics",
    "StopOnSignal": "stop",
    "StopWhen": "stop",
    "TrajectoryFigures": "trajectory_figures",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"sb3_quad.callbacks.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
