"""Callbacks for any Stable-Baselines3 algorithm; docs/callbacks.md lists them."""

from typing import TYPE_CHECKING

from sb3_quad.base.imports import lazy_names

if TYPE_CHECKING:
    from sb3_quad.callbacks.best_model import BestModel as BestModel
    from sb3_quad.callbacks.coefficient_schedule import CoefficientSchedule as CoefficientSchedule
    from sb3_quad.callbacks.episodes import EpisodeLog as EpisodeLog
    from sb3_quad.callbacks.episodes import FlightMetrics as FlightMetrics
    from sb3_quad.callbacks.every import Checkpoint as Checkpoint
    from sb3_quad.callbacks.interruption import LastGoodModel as LastGoodModel
    from sb3_quad.callbacks.interruption import StopOnSignal as StopOnSignal
    from sb3_quad.callbacks.observation_statistics import ObservationStatistics as ObservationStatistics

_LAZY = {  # imported on first use: naming one waits for none of the others
    "BestModel": "sb3_quad.callbacks.best_model",
    "Checkpoint": "sb3_quad.callbacks.every",
    "CoefficientSchedule": "sb3_quad.callbacks.coefficient_schedule",
    "EpisodeLog": "sb3_quad.callbacks.episodes",
    "FlightMetrics": "sb3_quad.callbacks.episodes",
    "LastGoodModel": "sb3_quad.callbacks.interruption",
    "ObservationStatistics": "sb3_quad.callbacks.observation_statistics",
    "StopOnSignal": "sb3_quad.callbacks.interruption",
}
__all__ = list(_LAZY)

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
