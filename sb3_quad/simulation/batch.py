"""n quadcopters as arrays: what the vectorised environments of Stable-Baselines3 and Gymnasium share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.engine.batch_kernel import ADDRESSED, MAX_STEPS
from sb3_quad.simulation.engine.streams import new_streams, stream_key
from sb3_quad.simulation.engine.threads import available_cpus, compilation_notice, run
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.simulation.state import STATE_SIZE, QuadcopterState
from sb3_quad.simulation.tasks import TaskSpec, TaskTable, resolve_tasks
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

FloatArray = npt.NDArray[np.float64]
Rows: TypeAlias = "int | slice | Iterable[int] | npt.NDArray[Any] | None"


class QuadcopterBatch:
    """n quadcopters, each in an episode of its own; arrays in, arrays out.

    :param n_envs: number of rows, at least 1.
    :param task: name, :class:`~sb3_quad.simulation.tasks.Task`, or mixture ``{name: weight}`` drawn from at each reset.
    :param task_kwargs: fields of the task to override.
    :param vehicle: name, path or :class:`Vehicle`; or a sequence of ``n_envs`` of them whose time steps and delays agree.
    :param noise: relative standard deviation of the observation noise, shape () or (n_envs,).
    :param observation_mean: μ of Eq. 3.16, shape (18,) or (n_envs, 18); None: zero.
    :param observation_std: σ of Eq. 3.16, likewise; None: Table A.2.
    :param max_episode_steps: control steps after which an episode is truncated.
    :param seed: row i draws from the stream of ``seed + i``; None: from the operating system's entropy.
    :param n_threads: threads that share the work, at most; None: the CPUs this process may use. Results do not depend on it.
    """

    def __init__(
        self,
        n_envs: int,
        task: TaskSpec = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        vehicle: Any = "itm",
        noise: Any = 0.05,
        observation_mean: Any = None,
        observation_std: Any = None,
        max_episode_steps: int = 1500,
        seed: int | None = None,
        n_threads: int | None = None,
    ) -> None:
        n = self.n = _whole_number("n_envs", n_envs)
        self.max_episode_steps = _whole_number("max_episode_steps", max_episode_steps)
        one_each = isinstance(vehicle, Sequence) and not isinstance(vehicle, str)
        self.vehicle_list = _vehicles(vehicle if one_each else [vehicle] * n, n)
        first = self.vehicle_list[0]
        self.substeps = first.substeps
        columns = self.vehicle_list if one_each else self.vehicle_list[:1]
        self.vehicles = np.stack([each.parameters() for each in columns], axis=1)
        self.threads = available_cpus() if n_threads is None else _whole_number("n_threads", n_threads)
        self.physics_step = np.array([first.physics_step])
        self.state = np.zeros((STATE_SIZE, n))
        self.queue = np.zeros((first.delay, 4, n))
        self.wrench = np.zeros((12, n))
        self.streams = np.zeros((4, n), dtype=np.uint32)
        self.task_index = np.zeros(n, dtype=np.int64)
        # One column serves all rows until rows are set apart.
        self.noise_level = np.zeros(1)
        self.mean = np.zeros((OBSERVATION_SIZE, 1))
        self.std = np.ones((OBSERVATION_SIZE, 1))
        self.returns = np.zeros(n)
        self.distance = np.zeros(n)
        self.collided = np.zeros(n, dtype=np.bool_)
        self.out_of_range = np.zeros(n, dtype=np.bool_)
        self.truncated = np.zeros(n, dtype=np.bool_)
        self.final_observation = np.zeros((n, OBSERVATION_SIZE), dtype=np.float32)
        self.final_return = np.zeros(n)
        self.final_length = np.zeros(n, dtype=np.int64)
        self.tasks: TaskTable = resolve_tasks(task, task_kwargs)
        self.set_noise(noise)
        self.set_observation_scaling(
            DEFAULT_MEAN if observation_mean is None else observation_mean,
            DEFAULT_STD if observation_std is None else observation_std,
        )
        self._bind()
        with compilation_notice():
            self.observe()
        self.seed([None if seed is None else seed + row for row in range(n)])

    def seed(self, seeds: Sequence[int | None], rows: Rows = None) -> None:
        """New streams of the given rows, from one seed each; their next reset begins the first episode."""
        keys = [stream_key(seeding.np_random(None if each is None else int(each))[0]) for each in seeds]
        self.streams[:, self.rows(rows)] = new_streams(np.array(keys, dtype=np.uint64))

    def reset(self, rows: Rows = None) -> npt.NDArray[np.float32]:
        """Begin the next episode of the given rows (None: all); the observations of all rows, float32 (n, 18)."""
        return self._observe(self.rows(rows))

    def observe(self) -> npt.NDArray[np.float32]:
        """The present observations, float32 (n, 18); the same numbers until the next step."""
        return self._observe([])

    def _observe(self, resetting: Any) -> npt.NDArray[np.float32]:
        observations = np.empty((self.n, OBSERVATION_SIZE), dtype=np.float32)
        done = np.zeros(self.n, dtype=np.bool_)
        done[resetting] = True
        actions, rewards = np.zeros((self.n, 4), dtype=np.float32), np.empty(self.n, dtype=np.float32)
        self.job[MAX_STEPS] = 0
        run(self.job, self.n, self.threads, (actions, observations, rewards, done))
        self.job[MAX_STEPS] = self.max_episode_steps
        return observations

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """One control step of every row; rows that end begin their next episode.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: observations float32 (n, 18), rewards float32 (n,), done bool (n,): fresh arrays. Of rows that are done,
            ``final_observation``, ``final_return``, ``final_length``, ``truncated``, ``collided``, ``out_of_range`` and
            ``distance`` tell how the episode ended, until the row's next one ends.
        """
        actions = self._as_actions(actions)
        observations = np.empty((self.n, OBSERVATION_SIZE), dtype=np.float32)
        rewards = np.empty(self.n, dtype=np.float32)
        done = np.empty(self.n, dtype=np.bool_)
        if not run(self.job, self.n, self.threads, (actions, observations, rewards, done)):
            row = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise ValueError(f"actions: row {row} is {actions[row].tolist()}; every number must be finite")
        return observations, rewards, done

    def _as_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        array = np.ascontiguousarray(actions, dtype=np.float32)
        if array.shape != (self.n, 4):
            raise ValueError(f"actions of shape {array.shape}: must be ({self.n}, 4), one row per environment")
        return array

    def rows(self, rows: Rows) -> npt.NDArray[np.int64]:
        """Row numbers from None (all), a number, a slice or a sequence."""
        everything = np.arange(self.n, dtype=np.int64)
        if rows is None:
            return everything
        try:
            return np.atleast_1d(everything[rows if isinstance(rows, (int, slice, np.ndarray)) else list(rows)])
        except (IndexError, TypeError):
            raise ConfigError(f"indices {rows!r}: must be row numbers of 0 to {self.n - 1}") from None

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, a live view."""
        return QuadcopterState(self.state)

    def set_target(self, position: Any, rows: Rows = None) -> None:
        """Targets r_T, (3,) or (rows, 3), world frame, m; until the row's next reset."""
        chosen = self.rows(rows)
        self.state[17:20, chosen] = _per_row("target", position, chosen.size, 3)

    def set_wrench(
        self,
        force: Any = (0.0, 0.0, 0.0),
        torque: Any = (0.0, 0.0, 0.0),
        force_frame: str = "world",
        torque_frame: str = "body",
        rows: Rows = None,
    ) -> None:
        """External force (N) and torque (N m) at the centre of mass, (3,) or (rows, 3) each; until set anew.

        :param force_frame: ``"world"`` or ``"body"``; ``torque_frame`` likewise.
        """
        chosen = self.rows(rows)
        values = np.zeros((12, chosen.size))
        for name, value, frame, offset in (("force", force, force_frame, 0), ("torque", torque, torque_frame, 6)):
            if frame not in ("world", "body"):
                raise ConfigError(f"{name}_frame {frame!r}: must be 'world' or 'body'")
            start = offset + (3 if frame == "body" else 0)
            values[start : start + 3] = _per_row(name, value, chosen.size, 3)
        self.wrench[:, chosen] = values

    def set_noise(self, level: Any, rows: Rows = None) -> None:
        """Relative standard deviation of the observation noise, () or (rows,); 0: none."""
        chosen = self.rows(rows)
        levels = _per_row("noise", level, chosen.size, None)[0]
        if (levels < 0).any():
            raise ConfigError(f"noise {level!r}: must not be negative")
        if rows is None and self.noise_level.size == 1 and np.ndim(level) == 0:
            self.noise_level[:] = levels[0]
            return
        self._set_rows_apart()
        self.noise_level[chosen] = levels

    def set_observation_scaling(self, mean: Any = None, std: Any = None, rows: Rows = None) -> None:
        """μ and σ of Eq. 3.16, (18,) or (rows, 18) each; None leaves one as it is."""
        chosen = self.rows(rows)
        means = None if mean is None else _per_row("observation_mean", mean, chosen.size, OBSERVATION_SIZE)
        stds = None if std is None else _per_row("observation_std", std, chosen.size, OBSERVATION_SIZE)
        if stds is not None and (stds <= 0).any():
            raise ConfigError("observation_std: every value must be positive")
        together = rows is None and self.mean.shape[1] == 1 and np.ndim(mean) < 2 and np.ndim(std) < 2
        if not together:
            self._set_rows_apart()
        columns = np.zeros(1, dtype=np.int64) if together else chosen
        if means is not None:
            self.mean[:, columns] = means[:, : columns.size]
        if stds is not None:
            self.std[:, columns] = stds[:, : columns.size]

    def _set_rows_apart(self) -> None:
        """A noise level and a scaling for each row."""
        if self.mean.shape[1] < self.n:
            self.noise_level = np.repeat(self.noise_level, self.n)
            self.mean = np.repeat(self.mean, self.n, axis=1)
            self.std = np.repeat(self.std, self.n, axis=1)
            self._bind()

    def _bind(self) -> None:
        """Write down for the compiled step where all arrays are; again whenever one is replaced."""
        self.arrays = {name: getattr(self, name) for name in ADDRESSED[:-4] if not name.startswith("task_")}
        self.arrays |= {"task_index": self.task_index}
        self.arrays |= {"task_parameters": self.tasks.parameters, "task_weights": self.tasks.weights}
        sizes = (self.n, self.queue.shape[0], self.substeps, self.max_episode_steps)
        columns = (self.tasks.weights.size, self.vehicles.shape[1], self.mean.shape[1])
        addresses = [self.arrays[name].ctypes.data for name in ADDRESSED[:-4]]
        self.job = np.array([*sizes, *columns, *addresses, 0, 0, 0, 0], dtype=np.int64)

    def set_max_episode_steps(self, steps: int) -> None:
        """Control steps after which an episode is truncated, for all rows from the next step on."""
        self.max_episode_steps = _whole_number("max_episode_steps", steps)
        self._bind()

    def set_task(self, task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None) -> None:
        """The task of all episodes that begin from now on; episodes under way end as they began."""
        new = resolve_tasks(task, task_kwargs)
        used, index = np.unique(self.task_index, return_inverse=True)
        parameters = np.concatenate([self.tasks.parameters[used], new.parameters])
        # A cumulative weight of 0 is never drawn: the old tasks stay in the table only for rows still flying them.
        weights = np.concatenate([np.zeros(used.size), new.weights])
        tasks = (*(self.tasks.tasks[k] for k in used), *new.tasks)
        self.task_index[:] = index
        self.tasks = TaskTable(parameters, weights, tasks)
        self._bind()


def _whole_number(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ConfigError(f"{name} {value!r}: must be a whole number of at least 1")
    return int(value)


def _vehicles(given: Sequence[Any], n: int) -> list[Vehicle]:
    if len(given) != n:
        raise ConfigError(f"vehicle: {len(given)} vehicles for {n} environments; give one, or one for each")
    loaded = {key: load_vehicle(each) for key, each in {id(each): each for each in given}.items()}  # each file once
    vehicles = [loaded[id(each)] for each in given]
    first = vehicles[0]
    for row, each in enumerate(vehicles):
        if (each.delay, each.physics_step, each.substeps) != (first.delay, first.physics_step, first.substeps):
            raise ConfigError(f"vehicle of row {row}: delay, physics_step and control_step must be those of row 0")
    return vehicles


def _per_row(name: str, value: Any, rows: int, size: int | None) -> FloatArray:
    """``value`` of shape (size,) or (rows, size) as (size, rows); with no size, () or (rows,) as (1, rows)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} {value!r}: must be numbers") from None
    inner = () if size is None else (size,)
    if array.shape not in (inner, (rows, *inner)):
        raise ConfigError(f"{name} of shape {array.shape}: must be {inner}, or {(rows, *inner)} for {rows} rows")
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} {array.tolist()}: every number must be finite")
    return np.ascontiguousarray(np.broadcast_to(array, (rows, *inner)).T).reshape(-1, rows)
