"""What a run of a sweep leaves beside its folder: how it ended, and its agent's flights in numbers."""

from typing import Literal, TypeAlias

from pydantic import Field

from sb3_quad.base.validate import Frozen

Numbers: TypeAlias = tuple[float | None, ...]
SUCCESS, SURVIVAL, REWARD, ERROR, TIME = "success", "survival", "reward", "final_error", "time"
MEASURES = (SUCCESS, SURVIVAL, REWARD, ERROR, TIME)
"""Of an episode: 0 or 1, 0 or 1, sum, m (None: lost), s to the tightest tolerance, or, where it
starts at its target, until stable (None: never)."""


class RunRecord(Frozen):
    """How a run ended."""

    name: str
    configuration: str
    seed: int
    state: Literal["finished", "failed", "interrupted"]
    message: str = Field(default="", description="why it failed, in one line")
    agent: str = Field(default="", description="the zip that flew, relative to the run's folder")
    weights: str = Field(default="", description="SHA-256 of that agent's parameters")
    timesteps: int = 0
    seconds: float = Field(default=0.0, description="wall-clock time of the training; of a run that was resumed, since then")
    flights: dict[str, dict[str, Numbers]] = Field(
        default={}, description="by scenario and measure, a number for each episode, the same episodes in every run"
    )
