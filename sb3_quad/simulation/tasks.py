"""The tasks (thesis 4.2): where an episode starts, what a control step is worth and when the
episode is over.

A task is data. :mod:`.sampling` begins episodes by it, :mod:`.reward` scores their control steps.
"""

from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field, PositiveFloat, field_validator, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.simulation.state import first_rows

Length = Annotated[float, Field(ge=0, le=1e6)]  # m
PositiveLength = Annotated[float, Field(gt=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Speed = Annotated[float, Field(ge=0, le=1e3)]  # m/s, rad/s
Cost = Annotated[float, Field(ge=0, le=1e6)]


class Task(Frozen):
    """A task: start distribution, reward coefficients (Eqs. 4.5-4.9) and limits; units m, s, rad.

    Frozen. ``task_kwargs`` of the environments override its fields by name.
    """

    name: str = Field(default="custom", min_length=1, description="what the task is called")
    start_position: tuple[Coordinate, Coordinate, Coordinate] = Field(
        default=(0.0, 0.0, 15.0), description="r0, world frame, m"
    )
    target_distance: Length = Field(
        default=0.0, description="|r_T - r0|, m, at most max_distance; 0: r0 itself"
    )
    nearest_target: Length | None = Field(
        default=None,
        description="if given, |r_T - r0| is uniform between this and target_distance, m",
    )
    target_clearance: Length = Field(
        default=0.25,
        description="no target is closer to the ground than the collision body plus this, m",
    )
    random_attitude: bool = Field(
        default=False, description="start attitude uniform on SO(3), else level"
    )
    velocity_std: Speed = Field(
        default=0.0, description="standard deviation of v at the start, per axis, m/s"
    )
    body_rates_std: Speed = Field(
        default=0.0, description="of the body rates at the start, per axis, rad/s"
    )
    hit_rates_std: Speed = Field(
        default=0.0, description="of what a hit adds to them, per axis, rad/s"
    )
    max_distance: PositiveLength = Field(
        default=30.0, description="farther from the target ends, m"
    )
    success_distance: PositiveLength = Field(
        default=0.1, description="a flight succeeds that ends this near its target, m"
    )
    success_tilt: PositiveFloat = Field(
        default=np.pi, description="and is tilted by no more than this, rad"
    )
    position_cost: Cost = Field(default=0.003, description="per m and control step (Eq. 4.5)")
    precision_cost: Cost = Field(
        default=0.0, description="per step, times d / (d + precision_range)"
    )
    precision_range: PositiveLength = Field(
        default=0.3, description="the distance at which half of it is due, m"
    )
    tilt_cost: Cost = Field(default=0.002, description="per rad and control step (Eq. 4.6)")
    body_rates_cost: Cost = Field(
        default=0.0005, description="per rad/s and control step (Eq. 4.7)"
    )
    collision_cost: Cost = Field(default=15.0, description="for touching the ground (Eq. 4.8)")
    out_of_range_cost: Cost = Field(default=15.0, description="for leaving max_distance (Eq. 4.9)")

    @field_validator("start_position")
    @classmethod
    def _above_ground(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if value[2] <= 0.0:
            raise ValueError("must lie above the ground (z > 0)")
        return value

    @model_validator(mode="after")
    def _nearest_first(self) -> "Task":
        if self.nearest_target is not None and self.nearest_target > self.target_distance:
            raise ValueError(
                f"nearest_target {self.nearest_target} exceeds target_distance {self.target_distance}"
            )
        if self.target_distance > self.max_distance:
            beyond = f"target_distance {self.target_distance:g} exceeds max_distance {self.max_distance:g}"
            raise ValueError(f"{beyond}: every episode would end at once")
        return self

    def parameters(self) -> FloatArray:
        """What compiled code needs, in the order of :data:`TASK`, shape (columns,)."""
        nearest = self.target_distance if self.nearest_target is None else self.nearest_target
        values = {**{name: getattr(self, name) for name in TASK}, "nearest_target": nearest}
        return np.hstack(list(values.values())).astype(np.float64)


TASK = {name: 3 if name == "start_position" else 1 for name in Task.model_fields if name != "name"}
"""Columns of a table of tasks: how many numbers each field of :class:`Task` is."""
T = first_rows(TASK)
SCORED = list(TASK)[list(TASK).index("max_distance") :]
"""The fields that every control step needs: all from ``max_distance`` on, a number each."""
S = first_rows(dict.fromkeys(SCORED, 1))

RECOVERED = {
    "success_distance": 0.25,
    "success_tilt": np.radians(10.0),
}  # of tasks whose target is their start
_THROWN_AWAY: Any = {  # from its target, which is somewhere else
    "target_distance": 25.0,
    "nearest_target": 0.0,
    "random_attitude": True,
    "velocity_std": 2.0,
    "body_rates_std": 4.0,
}
TASKS: Mapping[str, Task] = {
    "target_tracking": Task(name="target_tracking", target_distance=10.0),
    "state_recovery": Task(
        name="state_recovery",
        random_attitude=True,
        velocity_std=2.0,
        body_rates_std=4.0,
        **RECOVERED,
    ),
    "recovery_and_tracking": Task(name="recovery_and_tracking", **_THROWN_AWAY),
    "after_hit": Task(
        name="after_hit", **_THROWN_AWAY, hit_rates_std=25.0
    ),  # on its way when something hits it
    "far_tracking": Task(name="far_tracking", target_distance=25.0, nearest_target=10.0),
}
TaskSpec: TypeAlias = "str | Task | Mapping[str, float]"


def in_words(task: TaskSpec) -> str:
    """A task as it is called; a mixture such as ``80% target_tracking, 20% state_recovery``."""
    if not isinstance(task, Mapping):
        return task.name if isinstance(task, Task) else task
    shares = resolve_tasks(task)[1]
    return ", ".join(
        f"{share:.0%} {name}"
        for name, share in zip(task, np.diff(shares, prepend=0.0), strict=True)
    )


def resolve_tasks(
    task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None
) -> tuple[FloatArray, FloatArray]:
    """The K tasks of a name, a :class:`Task` or a mixture ``{name: weight}``: parameters (K,
    columns), see :data:`TASK`, and cumulative weights (K,), the last one 1.

    :param task_kwargs: fields of :class:`Task` to override, in every task of a mixture.
    :raises ConfigError: an unknown name or field, or a value or weight out of range.
    """
    weights = list(task.items()) if isinstance(task, Mapping) else [(task, 1.0)]
    if not weights:
        raise ConfigError(
            "task: the mixture names no task; give at least one, such as {'target_tracking': 1.0}"
        )
    parameters = np.stack(
        [_resolve(entry, dict(task_kwargs or {})).parameters() for entry, _ in weights]
    )
    try:
        shares = np.array([float(share) for _, share in weights])
    except (TypeError, ValueError):
        raise ConfigError(
            f"task: the weights {[share for _, share in weights]} must be numbers"
        ) from None
    if not np.isfinite(shares).all() or (shares < 0).any() or shares.sum() <= 0:
        raise ConfigError(
            f"task: the weights {shares.tolist()} must be finite, not negative and not all zero"
        )
    cumulative = np.cumsum(shares / shares.sum())
    cumulative[-1] = 1.0
    return parameters, cumulative


def _resolve(entry: Any, overrides: dict[str, Any]) -> Task:
    if isinstance(entry, Task):
        task = entry
    elif isinstance(entry, str) and entry in TASKS:
        task = TASKS[entry]
    else:
        raise ConfigError(unknown("task", entry, TASKS))
    return validate(Task, {**task.model_dump(), **overrides}, "task_kwargs")
