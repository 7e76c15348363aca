"""The two tasks (thesis 4.2) and one that is both: where an episode starts, what a step is worth and when it is over.

A task is data, one row of a table; the functions that read the table are in envs/episodes.py, for both environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, field_validator, model_validator

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.episodes import reset_rows, score

__all__ = ["TASKS", "TASK_PARAMETERS", "Task", "TaskSpec", "TaskTable", "reset_rows", "resolve_tasks", "score"]

FloatArray = npt.NDArray[np.float64]


NotNegative = Annotated[float, Field(ge=0)]


class Task(Frozen):
    """A task: start distribution, reward coefficients (Eqs. 4.5-4.9) and limits; units m, s, rad.

    Frozen. ``task_kwargs`` of the environments override its fields by name.
    """

    name: str = Field(default="custom", min_length=1, description="what the task is called")
    start_position: tuple[float, float, float] = Field(default=(0.0, 0.0, 15.0), description="r0, world frame, m")
    target_distance: NotNegative = Field(default=0.0, description="|r_T - r0|, m; 0: the target is r0")
    nearest_target: NotNegative | None = Field(
        default=None, description="if given, |r_T - r0| is uniform between this and target_distance, m"
    )
    target_clearance: NotNegative = Field(
        default=0.25, description="no target is closer to the ground than the collision body plus this, m"
    )
    random_attitude: bool = Field(default=False, description="start attitude uniform on SO(3), else level")
    velocity_std: NotNegative = Field(default=0.0, description="standard deviation of v at the start, per axis, m/s")
    body_rates_std: NotNegative = Field(default=0.0, description="of the body rates at the start, per axis, rad/s")
    max_distance: Annotated[float, Field(gt=0)] = Field(default=30.0, description="farther from the target ends, m")
    position_cost: NotNegative = Field(default=0.003, description="per m and control step (Eq. 4.5)")
    tilt_cost: NotNegative = Field(default=0.002, description="per rad and control step (Eq. 4.6)")
    body_rates_cost: NotNegative = Field(default=0.0005, description="per rad/s and control step (Eq. 4.7)")
    collision_cost: NotNegative = Field(default=15.0, description="for touching the ground (Eq. 4.8)")
    out_of_range_cost: NotNegative = Field(default=15.0, description="for leaving max_distance (Eq. 4.9)")

    @field_validator("start_position")
    @classmethod
    def _above_ground(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if value[2] <= 0.0:
            raise ValueError("must lie above the ground (z > 0)")
        return value

    @model_validator(mode="after")
    def _nearest_first(self) -> Task:
        if self.nearest_target is not None and self.nearest_target > self.target_distance:
            raise ValueError(f"nearest_target {self.nearest_target} exceeds target_distance {self.target_distance}")
        return self

    def parameters(self) -> FloatArray:
        """What the compiled functions need, shape (len(TASK_PARAMETERS),)."""
        nearest = self.target_distance if self.nearest_target is None else self.nearest_target
        others = (float(getattr(self, name)) for name in TASK_PARAMETERS[4:])
        return np.array([*self.start_position, nearest, *others], dtype=np.float64)


TASK_PARAMETERS = (
    *("start_x", "start_y", "start_z", "nearest_target", "target_distance", "target_clearance"),
    *("random_attitude", "velocity_std", "body_rates_std"),
    *("max_distance", "position_cost", "tilt_cost", "body_rates_cost", "collision_cost", "out_of_range_cost"),
)

TASKS: Mapping[str, Task] = {
    "target_tracking": Task(name="target_tracking", target_distance=10.0),
    "state_recovery": Task(name="state_recovery", random_attitude=True, velocity_std=2.0, body_rates_std=4.0),
    "recovery_and_tracking": Task(
        name="recovery_and_tracking",
        target_distance=25.0,
        nearest_target=0.0,
        random_attitude=True,
        velocity_std=2.0,
        body_rates_std=4.0,
    ),
    "far_tracking": Task(name="far_tracking", target_distance=25.0, nearest_target=10.0),
}
TaskSpec: TypeAlias = "str | Task | Mapping[str, float]"


class TaskTable(NamedTuple):
    """The tasks an environment draws from at each reset; K rows."""

    parameters: FloatArray
    """(K, len(TASK_PARAMETERS))"""
    weights: FloatArray
    """(K,), cumulative, the last one 1"""
    tasks: tuple[Task, ...]


def resolve_tasks(task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None) -> TaskTable:
    """The table of a task by name, of a :class:`Task`, or of a mixture ``{name: weight}``.

    :param task_kwargs: fields of :class:`Task` to override, in every task of a mixture.
    :raises ConfigError: an unknown name or field, or a value or weight out of range.
    """
    weights = dict(task) if isinstance(task, Mapping) else {task: 1.0}
    if not weights:
        raise ConfigError("task: the mixture names no task; give at least one, such as {'target_tracking': 1.0}")
    tasks = tuple(_resolve(entry, dict(task_kwargs or {})) for entry in weights)
    try:
        shares = np.array([float(share) for share in weights.values()])
    except (TypeError, ValueError):
        raise ConfigError(f"task: the weights {list(weights.values())} must be numbers") from None
    if not np.isfinite(shares).all() or (shares < 0).any() or shares.sum() <= 0:
        raise ConfigError(f"task: the weights {shares.tolist()} must be finite, not negative and not all zero")
    cumulative = np.cumsum(shares / shares.sum())
    cumulative[-1] = 1.0
    return TaskTable(np.stack([entry.parameters() for entry in tasks]), cumulative, tasks)


def _resolve(entry: Any, overrides: dict[str, Any]) -> Task:
    if isinstance(entry, Task):
        task = entry
    elif isinstance(entry, str) and entry in TASKS:
        task = TASKS[entry]
    else:
        raise ConfigError(unknown("task", entry, TASKS))
    for key in overrides:
        if key not in Task.model_fields:
            raise ConfigError(f"task_kwargs: {unknown('field', key, Task.model_fields)}")
    try:
        return Task.model_validate({**task.model_dump(), **overrides})
    except ValidationError as error:
        raise ConfigError(f"task_kwargs: {'; '.join(_explain(item) for item in error.errors())}") from None


def _explain(item: Any) -> str:
    return f"{'.'.join(map(str, item['loc']))}: {item['msg'].removeprefix('Value error, ')}"
