"""Callbacks for any Stable-Baselines3 algorithm; docs/callbacks.md lists them."""

from sb3_quad.callbacks.best_model import BestModel
from sb3_quad.callbacks.every import Checkpoint, EpisodeLog, ProgressLine
from sb3_quad.callbacks.snapshot import SnapshotFile

__all__ = [
    "BestModel",
    "Checkpoint",
    "EpisodeLog",
    "ProgressLine",
    "SnapshotFile",
]
