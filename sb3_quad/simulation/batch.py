"""n quadcopters as arrays: what all environments are made of."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import Arrays, BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import available_cpus
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.validate import validate
from sb3_quad.simulation.checks import load_vehicles, per_row, repeated, whole_number
from sb3_quad.simulation.compiled import compile_notice
from sb3_quad.simulation.frames import PositionIntegral
from sb3_quad.simulation.kernel import (
    CHUNK,
    FLY,
    LOOK,
    OUTCOME,
    SCORE,
    BatchArrays,
    rotor_wrenches,
    step,
)
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.simulation.random import new_streams
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.simulation.sampling import GUST_SIZE, GUST_VALUE
from sb3_quad.simulation.settings import FlightSettings, levels
from sb3_quad.simulation.state import (
    FORCE_WORLD,
    STATE_SIZE,
    TARGET,
    WRENCH_SIZE,
    P,
    QuadcopterState,
    drag_forces,
    make_wrench,
)
from sb3_quad.simulation.tasks import TaskSpec, resolve_tasks
from sb3_quad.simulation.threads import share_out
from sb3_quad.simulation.vehicle_distribution import NO_DISTRIBUTION
from sb3_quad.vehicles.vehicle import Vehicle

Rows: TypeAlias = "int | slice | Iterable[int] | npt.NDArray[Any] | None"
MAX_ROWS, MAX_THREADS = 2**20, 2**16
_NO_ACTIONS, _NO_REWARDS = np.zeros((0, 4), np.float32), np.zeros(0, np.float32)  # of a look
_KEPT = (  # all that future flight depends on
    *("state", "queue", "wrench", "streams", "task_index", "returns", "limits"),
    *("vehicles", "gust", "wind", "wind_gust", "frames", "integral"),
)


class QuadcopterBatch:
    """n quadcopters, each in an episode of its own; arrays in, arrays out.

    :param n_envs: number of rows, from 1 to 2^20.
    :param settings: how they fly.
    :param seed: of :func:`~sb3_quad.base.seeds.row_seeds`, which give each row a stream; None: the
        operating system's entropy.
    :param n_threads: threads that share the work, at most; None: the CPUs this process may use.
        Results do not depend on it.
    :param autoreset: whether a row that ends begins its next episode within the same step.
    :raises ConfigError: an argument that does not fit; a vehicle that cannot fly as the settings
        say.
    """

    _arrays: BatchArrays

    def __init__(
        self,
        n_envs: int,
        settings: FlightSettings | None = None,
        seed: int | None = None,
        n_threads: int | None = None,
        autoreset: bool = True,
    ) -> None:
        settings = settings or FlightSettings()
        n = self.n = whole_number("n_envs", n_envs, 1, MAX_ROWS)
        self.threads = (
            available_cpus()
            if n_threads is None
            else whole_number("n_threads", n_threads, 1, MAX_THREADS)
        )
        self.autoreset, self.observation = autoreset, settings.observation
        self.distribution, self.randomize = settings.vehicles, settings.randomize or Randomization()

        several = isinstance(settings.vehicle, (list, tuple))
        vehicles = load_vehicles(
            settings.vehicle if several else [settings.vehicle], settings.rotor_layout
        )
        self.vehicle_list: list[Vehicle] = repeated("vehicle", vehicles, n)
        for each in vehicles:
            self.randomize.check(
                each if self.distribution is None else self.distribution.weakest(each)
            )
        columns = self.vehicle_list if several else vehicles
        self.base_vehicles = np.stack([each.parameters() for each in columns], axis=1)
        own = n if self.distribution is not None or self.randomize.sets_vehicle else len(columns)
        self.vehicles = np.broadcast_to(self.base_vehicles, (len(self.base_vehicles), own)).copy()
        self.distribution_numbers = (
            NO_DISTRIBUTION if self.distribution is None else self.distribution.numbers()
        )
        self.randomize_numbers = self.randomize.numbers(vehicles[0].control_step)
        kinds = self.randomize.gusts, self.randomize.wind_gusts
        self.gust, self.wind_gust = (
            np.zeros((GUST_SIZE, 0 if each is None else n)) for each in kinds
        )
        self.wind = np.zeros((3, n))
        drags = (self.randomize.drag, self.distribution and self.distribution.drag)
        self.has_drag = bool(self.base_vehicles[P.drag_x : P.drag_z + 1].any()) or any(drags)

        integral = self.observation.position_integral
        depth = self.observation.ages[-1] + 1 if self.observation.is_extended else 0
        self.frames = np.zeros((n, depth, self.observation.frame_size), dtype=np.float32)
        self.ages = np.array(self.observation.ages, dtype=np.int64)
        self.integral = np.zeros((0 if integral is None else 3, n))
        self.integral_numbers = np.array(
            (integral or PositionIntegral()).numbers(vehicles[0].control_step)
        )
        self.last_observations = np.zeros((n, self.observation.size), dtype=np.float32)

        self.task: TaskSpec = settings.task
        self.task_kwargs = dict(settings.task_kwargs or {})
        self.task_parameters, self.task_weights = resolve_tasks(self.task, self.task_kwargs)
        self.task_index = np.zeros(n, dtype=np.int64)
        steps = settings.max_episode_steps
        steps_of_rows = repeated(
            "max_episode_steps", steps if isinstance(steps, list) else [steps], n
        )
        self.max_steps = np.array(steps_of_rows, dtype=np.int64)
        self.limits = self.max_steps.copy()  # control steps of the present episodes, at most
        self.state = np.zeros((STATE_SIZE, n))
        longest = (
            int(self.randomize.delay.high) if self.randomize.delay else 0
        )  # delay, control steps
        self.queue = np.zeros((max(longest, *(each.delay for each in vehicles)), 4, n))
        self.wrench = np.zeros((WRENCH_SIZE, n))
        self.streams = np.zeros((4, n), dtype=np.uint32)
        self.scaling = np.concatenate([DEFAULT_MEAN, DEFAULT_STD, np.zeros(2)])[
            :, None
        ]  # until rows are set apart
        self.returns = np.zeros(n)
        self.outcome = np.zeros(n, dtype=OUTCOME)
        self.physics_step, self.substeps = vehicles[0].physics_step, vehicles[0].substeps
        self.own_delays = self.randomize.delay is not None or bool(
            (self.base_vehicles[P.delay] != len(self.queue)).any()
        )
        self.own_arms = (
            len(columns) > 1 or self.distribution is not None or self.randomize.sets_arms
        )
        self.constants = np.array(
            [self.physics_step, self.substeps, self.own_delays, self.own_arms, autoreset],
            np.float64,
        )
        self._bind()
        self.set_noise(settings.noise)
        self._set_scaling(settings)
        with compile_notice():
            self.observe()
        self.seed([None] * n if seed is None else row_seeds(seed, n))

    def seed(self, seeds: Sequence[int | None], rows: Rows = None) -> None:
        """New streams of the given rows, from one seed each; their next reset begins the first
        episode.
        """
        self.streams[:, self.rows(rows)] = new_streams(seeds)

    def reset(self, rows: Rows = None) -> Float32Array:
        """Begin the next episode of the given rows (None: all); the observations of all rows,
        float32 (n, size).
        """
        return self._look(self.rows(rows))

    def stagger(self) -> None:
        """Truncate the present episodes at times spread evenly over ``max_episode_steps``; those
        that follow, after it.
        """
        self.limits[:] = self.max_steps - np.arange(self.n) * self.max_steps // self.n

    def observe(self) -> Float32Array:
        """The present observations, float32 (n, size), of ``observation.size``; the same numbers
        until the next step.
        """
        return self._look([])

    def step(self, actions: npt.NDArray[Any]) -> tuple[Float32Array, Float32Array, BoolArray]:
        """One control step of every row.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: observations float32 (n, size), rewards float32 (n,), done bool (n,): fresh arrays.
            Of rows that are done, ``outcome`` (fields total, reward, length, distance, collision,
            out_of_range, truncated, success) and ``last_observations`` tell how the episode ended,
            until the row's next one ends; without autoreset they are of every row's last step.
        """
        return self._move(FLY, actions)

    def score(
        self, actions: npt.NDArray[Any] | None = None
    ) -> tuple[Float32Array, Float32Array, BoolArray]:
        """As :meth:`step`, of a control step that another simulator has flown and written into
        ``state``.

        :param actions: for those that a policy is to see; None: zeros.
        """
        return self._move(SCORE, np.zeros((self.n, 4), np.float32) if actions is None else actions)

    def _move(
        self, mode: int, actions: npt.NDArray[Any]
    ) -> tuple[Float32Array, Float32Array, BoolArray]:
        array = np.ascontiguousarray(actions, dtype=np.float32)
        if array.shape != (self.n, 4):
            raise ValueError(
                f"actions of shape {array.shape}: must be ({self.n}, 4), one row per environment"
            )
        out = (
            np.empty(self.last_observations.shape, np.float32),
            np.empty(self.n, np.float32),
            np.empty(self.n, np.bool_),
        )
        if not self._step(mode, array, *out):
            row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
            raise ValueError(
                f"actions: row {row} is {array[row].tolist()}; every number must be finite"
            )
        return out

    def _look(self, resetting: Any) -> Float32Array:
        observations, dones = (
            np.empty(self.last_observations.shape, np.float32),
            np.zeros(self.n, np.bool_),
        )
        dones[resetting] = True
        self._step(LOOK, _NO_ACTIONS, observations, _NO_REWARDS, dones)
        return observations

    def _step(self, mode: int, *arrays: npt.NDArray[Any]) -> bool:
        chunks = min(self.threads, self.n // (2 * CHUNK))
        return bool(share_out(step, chunks - 1, mode, *arrays, *self._arrays))

    def turn_rotors(self, actions: npt.NDArray[Any]) -> FloatArray:
        """The rotors' part of a control step of row 0, for another simulator, whose part
        :meth:`score` judges.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: force (N) and torque (N m) of rotors and wrench in each physics step, body frame,
            (substeps, 2, 3); what the wrench has in the world frame acts besides.
        """
        wrenches = np.empty((self.substeps, 2, 3))
        a = self._arrays
        rotor_wrenches(
            actions,
            wrenches,
            a.state,
            a.queue,
            a.wrench,
            a.vehicles,
            self.physics_step,
            self.own_delays,
        )
        return wrenches

    def clear_outcome(self, rows: Rows = None) -> None:
        """Of rows that have just begun an episode: nothing has ended, and the distance is that of
        the start.
        """
        chosen = self.rows(rows)
        self.outcome[chosen] = 0
        self.outcome["truncated"][chosen] = True
        self.outcome["distance"][chosen] = QuadcopterState(self.state[:, chosen]).distance

    def rows(self, rows: Rows) -> IntArray:
        """Row numbers from None (all), a number, a slice or a sequence."""
        everything = np.arange(self.n, dtype=np.int64)
        if rows is None:
            return everything
        try:
            return np.atleast_1d(
                everything[rows if isinstance(rows, (int, slice, np.ndarray)) else list(rows)]
            )
        except (IndexError, TypeError):
            raise ConfigError(
                f"indices {rows!r}: must be row numbers of 0 to {self.n - 1}"
            ) from None

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, a live view but for gusts and drag, which is a part of its
        wrench.
        """
        vehicles = np.broadcast_to(self.vehicles, (len(self.vehicles), self.n))
        wrench = self.total_wrench()
        if self.has_drag:
            wrench = wrench.copy()
            wrench[FORCE_WORLD] += drag_forces(self.state, vehicles, self.total_wind())
        return QuadcopterState(self.state, vehicles, wrench)

    def total_wrench(self) -> FloatArray:
        """What pushes the rows in this control step, (WRENCH_SIZE, n): what was set or sampled, and
        gusts; without drag.
        """
        if self.randomize.gusts is None:
            return self.wrench
        total = self.wrench.copy()
        total[FORCE_WORLD] += self.gust[GUST_VALUE]
        return total

    def total_wind(self) -> FloatArray:
        """The velocity of the air in this control step, (3, n), world frame, m/s: what was set or
        sampled, and gusts.
        """
        return (
            self.wind
            if self.randomize.wind_gusts is None
            else self.wind + self.wind_gust[GUST_VALUE]
        )

    def snapshot(self) -> Arrays:
        """Copies of all that future flight depends on, by name."""
        return {name: getattr(self, name).copy() for name in _KEPT}

    def restore(self, snapshot: Arrays) -> None:
        """Undo what has happened since :meth:`snapshot`.

        :raises ConfigError: the snapshot is of other environments.
        """
        for name in dict.fromkeys((*_KEPT, *snapshot)):
            array: Any = snapshot.get(name)
            own = getattr(self, name) if name in _KEPT else None
            fits = (
                array is not None
                and own is not None
                and (array.dtype, array.shape) == (own.dtype, own.shape)
            )
            if not fits or (
                name == "task_index" and not ((array >= 0) & (array < self.task_weights.size)).all()
            ):
                found = "missing" if array is None else f"{array.dtype} of shape {array.shape}"
                raise ConfigError(
                    f"the saved state of the environments does not fit these ({name}: {found}); use the run's own settings"
                )
        for name in _KEPT:
            getattr(self, name)[...] = snapshot[name]

    def set_target(self, position: npt.ArrayLike, indices: Rows = None) -> None:
        """Move targets r_T, (3,) or (rows, 3), world frame, m; until the row's next reset."""
        chosen = self.rows(indices)
        self.state[TARGET, chosen] = per_row("target", position, chosen.size, 3)

    def set_wrench(
        self,
        force: npt.ArrayLike = (0.0, 0.0, 0.0),
        torque: npt.ArrayLike = (0.0, 0.0, 0.0),
        force_frame: str = "world",
        torque_frame: str = "body",
        indices: Rows = None,
    ) -> None:
        """Apply an external force (N) and torque (N m), (3,) or (rows, 3) each, at the centre of
        mass; until set anew.

        Without arguments, nothing pushes any more.

        :param force_frame: ``"world"`` or ``"body"``; ``torque_frame`` likewise.
        """
        chosen = self.rows(indices)
        vectors = [
            per_row(name, each, chosen.size, 3).T
            for name, each in (("force", force), ("torque", torque))
        ]
        self.wrench[:, chosen] = make_wrench(vectors[0], vectors[1], force_frame, torque_frame)

    def set_wind(self, velocity: npt.ArrayLike = (0.0, 0.0, 0.0), indices: Rows = None) -> None:
        """Set the velocity of the air, (3,) or (rows, 3), world frame, m/s; until set anew. It acts
        on vehicles with drag.
        """
        chosen = self.rows(indices)
        self.wind[:, chosen] = per_row("wind", velocity, chosen.size, 3)

    def set_noise(self, level: Any, indices: Rows = None) -> None:
        """Set the relative standard deviation of the observation noise, () or (rows,), or a
        ``Noise``; 0: none.
        """
        chosen = self.rows(indices)
        noise = validate(FlightSettings, {"noise": level}, "set_noise").noise
        relative, additive = (
            per_row("noise", each, chosen.size, None)[0] for each in levels(noise)
        )
        columns = self._columns(indices, one_for_all=not isinstance(noise, list))
        self.noise_level[columns], self.additive_level[columns] = (
            relative[: columns.size],
            additive[: columns.size],
        )

    def _set_scaling(self, settings: FlightSettings) -> None:
        """Set μ and σ of Eq. 3.16, (18,) or (n, 18) each; None leaves one as it is."""
        given = {"mean": settings.observation_mean, "std": settings.observation_std}
        for name, value in given.items():
            if value is None:
                continue
            values = per_row(f"observation_{name}", value, self.n, OBSERVATION_SIZE)
            if name == "std" and (values <= 0).any():
                raise ConfigError("observation_std: every value must be positive")
            columns = self._columns(None, one_for_all=np.ndim(value) < 2)
            getattr(self, name)[:, columns] = values[:, : columns.size]

    def _columns(self, rows: Rows, one_for_all: bool) -> IntArray:
        """The columns of noise level and scaling to write for some rows, which are set apart unless
        one serves all.
        """
        if self.mean.shape[1] < self.n:
            if rows is None and one_for_all:
                return np.zeros(1, dtype=np.int64)
            self.scaling = np.repeat(self.scaling, self.n, axis=1)
            self._bind()
        return self.rows(rows)

    def _bind(self) -> None:
        self.mean, self.std = (
            self.scaling[:OBSERVATION_SIZE],
            self.scaling[OBSERVATION_SIZE : 2 * OBSERVATION_SIZE],
        )
        self.noise_level, self.additive_level = self.scaling[-2:]
        self._arrays = BatchArrays(*(getattr(self, name) for name in BatchArrays._fields))
