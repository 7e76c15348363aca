"""The tasks (thesis 4.2): where an episode starts, how its control steps are rewarded, and when it
is over.

A task is data. :mod:`.sampling` begins episodes from it, :mod:`.reward` scores their control steps.
:data:`TASKS` and :data:`MIXTURES` hold those that have a name.
"""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.envs.simulation.checks import per_row
from sb3_quad.envs.simulation.state import first_rows

Length = Annotated[float, Field(ge=0, le=1e6)]  # m
PositiveLength = Annotated[float, Field(gt=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Speed = Annotated[float, Field(ge=0, le=1e3)]  # m/s, rad/s
Cost = Annotated[float, Field(ge=0, le=1e6)]


class Task(Frozen):
    """A task: start distribution, reward coefficients (Eqs. 4.5-4.9) and limits; units m, s, rad.

    Frozen. ``task_kwargs`` of the environments override its fields by name.
    """

    name: str = Field(default="custom", min_length=1)
    """what the task is called"""
    start_position: tuple[Coordinate, Coordinate, PositiveLength] = (0.0, 0.0, 15.0)
    """r0, world frame, m, above the ground"""
    target_distance: Length = 0.0
    """|r_T - r0|, m, at most max_distance; 0 puts the target at r0"""
    nearest_target: Length | None = None
    """if given, |r_T - r0| is uniform between this and target_distance, m"""
    target_clearance: Length = 0.25
    """least height of a target above the ground, beyond the collision radius, where its distance
    from the start allows it, m"""
    random_attitude: bool = False
    """start attitude uniform on SO(3), otherwise level"""
    velocity_std: Speed = 0.0
    """standard deviation of v at the start, per axis, m/s"""
    body_rates_std: Speed = 0.0
    """standard deviation of the body rates at the start, per axis, rad/s"""
    hit_rates_std: Speed = 0.0
    """standard deviation of the body rates that a hit adds at the start, per axis, rad/s"""
    max_distance: PositiveLength = 30.0
    """distance from the target beyond which the episode terminates, m"""
    success_distance: PositiveLength = 0.1
    """greatest final distance from the target that counts as a success, m"""
    success_tilt: PositiveFloat = np.pi
    """greatest final tilt that counts as a success, rad"""
    touchdown_speed: Speed = 0.0
    """if given, an episode succeeds by landing, which costs nothing: it touches the ground slower
    than this, m/s, within success_tilt, and within success_distance across the ground
    """
    position_cost: Cost = 0.003
    """per m and control step (Eq. 4.5)"""
    precision_cost: Cost = 0.0
    """per control step, times d / (d + precision_range) of the distance d"""
    precision_range: PositiveLength = 0.3
    """distance at which half of precision_cost is due, m"""
    tilt_cost: Cost = 0.002
    """per rad and control step (Eq. 4.6)"""
    body_rates_cost: Cost = 0.0005
    """per rad/s and control step (Eq. 4.7)"""
    collision_cost: Cost = 15.0
    """for touching the ground (Eq. 4.8)"""
    out_of_range_cost: Cost = 15.0
    """for leaving max_distance (Eq. 4.9)"""
    calm_cost: Cost = 0.0
    """per rad/s of body rates, and per 10/s by which commands change, at the target and control
    step; half of it at a distance of 0.5 m
    """

    @model_validator(mode="after")
    def _nearest_first(self) -> "Task":
        target = self.target_distance
        nearest = self.nearest_target
        most = self.max_distance
        if nearest is not None and nearest > target:
            raise ValueError(f"nearest_target {nearest} exceeds target_distance {target}")
        if target > most:
            raise ValueError(
                f"target_distance {target:g} exceeds max_distance {most:g}:"
                " every episode would end at once"
            )
        return self

    def parameters(self) -> FloatArray:
        """Return the numbers for compiled code, in the order of :data:`TASK`, shape (columns,)."""
        values = dict(self)
        if self.nearest_target is None:
            values["nearest_target"] = self.target_distance
        return np.hstack([values[name] for name in TASK]).astype(np.float64)


TASK = dict.fromkeys(list(Task.model_fields)[1:], 1) | {"start_position": 3}
"""Columns of a table of tasks: how many numbers each field of :class:`Task` has."""
T = first_rows(TASK)
SCORED = list(TASK)[list(TASK).index("max_distance") :]
"""The fields that every control step needs: all from ``max_distance`` on, a number each."""

RECOVERED = {"success_distance": 0.25, "success_tilt": np.radians(10.0)}
"""The criteria of success of tasks whose target is their start."""
# Random attitude, velocity and body rates, at a random distance from the target.
_THROWN_AWAY: Any = {
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
    # Something hits the vehicle on its way to the target.
    "after_hit": Task(name="after_hit", **_THROWN_AWAY, hit_rates_std=25.0),
    # It needs a reference that leads down to the ground.
    "landing": Task(
        name="landing",
        start_position=(0.0, 0.0, 2.0),
        velocity_std=0.5,
        touchdown_speed=0.3,
        success_tilt=np.radians(10.0),
    ),
    "far_tracking": Task(name="far_tracking", target_distance=25.0, nearest_target=10.0),
}


class Mixture(NamedTuple):
    """A mixture of tasks that has a name.

    :param weights: weight of each task, by its name. Their order decides which random numbers
        select which task.
    :param task_kwargs: fields of :class:`Task` to override in each; the user's own take precedence.
    :param max_episode_steps: control steps of an episode, unless the user says how many.
    """

    weights: Mapping[str, float]
    task_kwargs: Mapping[str, Any]
    max_episode_steps: int


MIXTURES: Mapping[str, Mixture] = {
    # Training with a reward that is steep near the target, and targets up to 25 m away.
    "thesis_recovery": Mixture(
        weights={"state_recovery": 0.6, "far_tracking": 0.4},
        task_kwargs={"precision_cost": 0.03, "nearest_target": 0.0},
        max_episode_steps=500,
    ),
}
TASK_NAMES = (*TASKS, *MIXTURES)
TaskSpec: TypeAlias = "str | Task | Mapping[str, float]"


def find_mixture(task: Any) -> Mixture | None:
    """Return the mixture of that name; None if ``task`` is anything else."""
    return MIXTURES.get(task) if isinstance(task, str) else None


def in_words(task: TaskSpec) -> str:
    """Return the name of a task, or the shares of a mixture.

    >>> in_words({"target_tracking": 4, "state_recovery": 1})
    '80% target_tracking, 20% state_recovery'
    """
    mixture = find_mixture(task)
    if mixture is not None:
        return f"{task} ({in_words(mixture.weights)})"
    if isinstance(task, Task):
        return task.name
    if isinstance(task, str):
        return task
    shares = np.diff(resolve_tasks(task)[1], prepend=0.0)
    return ", ".join(f"{share:.0%} {name}" for name, share in zip(task, shares, strict=True))


def resolve_tasks(
    task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the parameters and the cumulative weights of K tasks.

    :param task: a name, a :class:`Task`, or a mixture ``{name: weight}``.
    :param task_kwargs: fields of :class:`Task` to override, in every task of a mixture.
    :return: parameters (K, columns), see :data:`TASK`; cumulative weights (K,), the last one 1.
    :raises ConfigError: an unknown name or field, or a value or weight out of range.
    """
    overrides = dict(task_kwargs or {})
    mixture = find_mixture(task)
    if mixture is not None:
        task = mixture.weights
        overrides = {**mixture.task_kwargs, **overrides}
    if isinstance(task, Mapping):
        if not task:
            raise ConfigError(
                "task: the mixture names no task; give at least one, such as"
                " {'target_tracking': 1.0}"
            )
        tasks = [_resolve(name, TASKS, overrides) for name in task]
        weights = list(task.values())
    else:
        tasks = [_resolve(task, TASK_NAMES, overrides)]
        weights = [1.0]
    shares = per_row("task: the weights", weights, len(weights))[0]
    if (shares < 0).any() or not shares.any():
        raise ConfigError(
            f"task: the weights {shares.tolist()} must not be negative, and not all zero"
        )
    cumulative = np.cumsum(shares / shares.sum())
    cumulative[-1] = 1.0
    return np.stack([task.parameters() for task in tasks]), cumulative


def _resolve(task: Any, names: Collection[str], overrides: dict[str, Any]) -> Task:
    if isinstance(task, str) and task in TASKS:
        task = TASKS[task]
    if not isinstance(task, Task):
        raise ConfigError(unknown("task", task, names))
    return validate(Task, {**dict(task), **overrides}, "task_kwargs")
