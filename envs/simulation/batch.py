"""n quadcopters as arrays: the part that all environments share."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np

from sb3_quad.base.compiled import compile_notice
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import available_cpus
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import AnyArray, Arrays, BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.base.validate import validate
from sb3_quad.envs.simulation.checks import per_row, repeated, whole_number
from sb3_quad.envs.simulation.estimator import (
    ESTIMATE_SIZE,
    EstimatorError,
    estimated,
)
from sb3_quad.envs.simulation.frames import PositionIntegral
from sb3_quad.envs.simulation.kernel import (
    BATCH_ARGUMENTS,
    CHUNK,
    FLY,
    LOOK,
    OUTCOME,
    SCORE,
    rotor_wrenches,
    step,
)
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.random import STEP, new_streams
from sb3_quad.envs.simulation.randomization import Randomization
from sb3_quad.envs.simulation.recordings import (
    WIND_COLUMNS,
    WRENCH_COLUMNS,
    WRENCH_ROWS,
    starts_of,
)
from sb3_quad.envs.simulation.references import NO_TRACKS
from sb3_quad.envs.simulation.sampling import GUST_SIZE, GUST_VALUE
from sb3_quad.envs.simulation.settings import FlightSettings, estimator_of, levels
from sb3_quad.envs.simulation.state import (
    FELT,
    FORCE_BODY,
    FORCE_WORLD,
    REFERENCE,
    ROTOR_SPEEDS,
    STATE,
    STATE_SIZE,
    STILL,
    TORQUE_BODY,
    WRENCH_SIZE,
    P,
    QuadcopterState,
    W,
    X,
    air_wrenches,
    ground_effects,
    rotor_momenta,
    row_slices,
    thrusts_far_from_ground,
)
from sb3_quad.envs.simulation.tasks import T, resolve_tasks
from sb3_quad.envs.simulation.threads import share_out
from sb3_quad.envs.simulation.tracks import COURSE_SIZE, C, complete
from sb3_quad.envs.simulation.vehicle_distribution import NO_DISTRIBUTION
from sb3_quad.envs.vehicles.vehicle import Vehicle

Rows: TypeAlias = "int | slice | Iterable[int] | AnyArray | None"
StepResult: TypeAlias = tuple[Float32Array, Float32Array, BoolArray]
MAX_ROWS = 2**20
MAX_THREADS = 2**16
_NO_ROWS = np.zeros(0, np.int64)
# A snapshot keeps these: future flight depends on nothing else.
_KEPT = (
    "state",
    "queue",
    "filtered_rates",
    "wrench",
    "streams",
    "task_index",
    "returns",
    "last_actions",
    "limits",
    "vehicles",
    "gust",
    "wind",
    "wind_gust",
    "chances",
    "estimate",
    "frames",
    "integral",
    "course",
    "scaling_of_rows",
)


class QuadcopterBatch:
    """n quadcopters, each in its own episode; arrays in, arrays out.

    :param n_envs: number of rows, from 1 to 2^20.
    :param settings: how they fly.
    :param seed: for :func:`~sb3_quad.base.seeds.row_seeds`, which gives each row a stream; None:
        the operating system's entropy.
    :param n_threads: threads that share the work, at most; None: the CPUs this process may use.
        Results do not depend on it.
    :param autoreset: whether a row that ends begins its next episode within the same step.
    :raises ConfigError: an argument that does not fit; a vehicle that cannot fly with these
        settings.
    """

    _arguments: dict[str, Any]

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
        if n_threads is None:
            self.threads = available_cpus()
        else:
            self.threads = whole_number("n_threads", n_threads, 1, MAX_THREADS)
        # A thread pays off from two chunks on.
        self.helpers = min(self.threads, n // (2 * CHUNK)) - 1
        self.autoreset = autoreset

        vehicles = self._set_vehicles(settings)
        control_step = vehicles[0].control_step
        self.physics_step = vehicles[0].physics_step
        self.substeps = vehicles[0].substeps
        self.randomize_numbers = self.randomize.numbers(control_step)
        # An array without columns means that gusts, frames or the integral are switched off.
        self.gust = np.zeros((GUST_SIZE, n * bool(self.randomize.gusts)))
        self.wind = np.zeros((3, n))
        self.wind_gust = np.zeros((GUST_SIZE, n * bool(self.randomize.wind_gusts)))

        self._set_recordings(settings, control_step)
        self.estimator = estimator_of(settings.noise)
        self.estimate = np.zeros((ESTIMATE_SIZE, n * (self.estimator is not None)))
        self.estimator_numbers = (self.estimator or EstimatorError()).numbers(control_step)

        # Commands wait in a queue that is as long as the longest delay of any episode.
        delays = [vehicle.delay for vehicle in vehicles]
        if self.randomize.delay is not None:
            delays.append(int(self.randomize.delay.high))
        self.queue = np.zeros((max(delays), 4, n))
        # An array without columns means that actions are thrusts.
        self.filtered_rates = np.zeros((3, n * (settings.action == "rates")))
        self._due = np.zeros(4)

        # The frames that a policy sees besides the present features.
        self.observation = settings.observation
        integral = self.observation.position_integral
        depth = (self.observation.ages[-1] + 1) * self.observation.is_extended
        self.frames = np.zeros((n, depth, self.observation.frame_size), dtype=np.float32)
        self.ages = np.array(self.observation.ages, dtype=np.int64)
        self.integral = np.zeros((3 * bool(integral), n))
        self.integral_numbers = np.array((integral or PositionIntegral()).numbers(control_step))
        self.last_observations = np.zeros((n, self.observation.size), dtype=np.float32)

        # An array without columns means that targets rest.
        tracks = (
            NO_TRACKS if settings.reference is None else settings.reference.tracks(control_step)
        )
        self.previews = np.array(self.observation.preview or (), dtype=np.int64)
        # A preview reads all rows of the state that describe the target's motion.
        self.moves = settings.reference is not None or self.previews.size > 0
        self.tracks = tracks.table
        self.track_numbers = tracks.numbers()
        self.course = np.zeros((COURSE_SIZE, n * (len(tracks.table) > 0)))

        self.task_parameters, self.task_weights = resolve_tasks(settings.task, settings.task_kwargs)
        self._refuse_starts_on_the_ground()
        self.task_index = np.zeros(n, dtype=np.int64)
        steps = np.array(settings.max_episode_steps, dtype=np.int64, ndmin=1)
        self.max_steps = steps[repeated("max_episode_steps", steps.size, n)]
        # The current episodes may be shorter, see stagger.
        self.limits = self.max_steps.copy()

        self._state = np.zeros((STATE_SIZE, n))
        # Whether a step has moved references since their velocities were last written
        self._is_behind = False
        self.wrench = np.zeros((WRENCH_SIZE, n))
        self.streams = np.zeros((4, n), dtype=np.uint32)
        self.returns = np.zeros(n)
        is_calm = self.task_parameters[:, T.calm_cost].any()
        self.last_actions = np.zeros((n * is_calm, 4), np.float32)
        self.outcome = np.zeros(n, dtype=OUTCOME)
        # μ and σ of Eq. 3.16, then the levels of the noise
        self.scaling_of_rows = np.vstack([*settings.scaling(n), np.zeros((2, n))])
        self.set_noise(settings.noise)
        with compile_notice():
            self.observe()
        self.seed([None] * n if seed is None else row_seeds(seed, n))

    def _set_vehicles(self, settings: FlightSettings) -> list[Vehicle]:
        """Load the vehicles, check that all can be flown, and return the different ones.

        ``base_vehicles`` and ``vehicles`` have a column for each row if rows differ, otherwise one
        for all.
        """
        self.distribution = settings.vehicles
        self.randomize = settings.randomize or Randomization()
        vehicles = settings.load_vehicles()
        rows = repeated("vehicle", len(vehicles), self.n)
        self.vehicle_list: list[Vehicle] = [vehicles[row] for row in rows]
        self.base_vehicles = np.stack([vehicle.parameters() for vehicle in vehicles], axis=1)
        if len(vehicles) > 1:
            self.base_vehicles = np.take(self.base_vehicles, rows, axis=1)
        self.vehicles = self.base_vehicles.copy()
        if self.distribution is not None or self.randomize.sets_vehicle:
            self.vehicles = np.broadcast_to(self.base_vehicles, (len(self.vehicles), self.n)).copy()

        # Without air, the compiled step is spared its terms.
        still = (self.base_vehicles[P.rotor_drag_x : P.rate_limit_x] == STILL).all()
        self.in_air = self.randomize.sets_air or not still

        # All vehicles can fly if the hardest to fly can.
        hardest = vehicles
        self.distribution_numbers = NO_DISTRIBUTION
        if self.distribution is not None:
            hardest = [self.distribution.hardest(vehicle) for vehicle in vehicles]
            self.distribution_numbers = self.distribution.numbers()
        for vehicle in hardest:
            self.randomize.hardest(vehicle)
        if self.randomize.wind or self.randomize.wind_gusts:
            self.warn_without_drag("randomize")
        return vehicles

    def _set_recordings(self, settings: FlightSettings, dt: float) -> None:
        """Read the logs that are replayed, for control steps of ``dt``, s."""
        self.chances = np.zeros(self.n * bool(settings.wrench or settings.wind))
        self.wrench_record, self.wind_record = np.zeros((0, WRENCH_SIZE)), np.zeros((0, 3))
        if settings.wrench is not None:
            table = settings.wrench.table(WRENCH_COLUMNS, dt)
            self.wrench_record = np.zeros((len(table), WRENCH_SIZE))
            self.wrench_record[:, WRENCH_ROWS[: table.shape[1]]] = table
        if settings.wind is not None:
            self.wind_record = settings.wind.table(WIND_COLUMNS, dt)
            self.warn_without_drag("wind")
        self.wrench_starts = starts_of(settings.wrench, dt, self.wrench_record)
        self.wind_starts = starts_of(settings.wind, dt, self.wind_record)

    def _refuse_starts_on_the_ground(self) -> None:
        lowest = self.task_parameters[:, T.start_position + 2].min()
        radius = self.base_vehicles[P.collision_radius].max()
        if lowest <= radius:
            raise ConfigError(
                f"start_position: z {lowest:g} touches the ground, and every episode would end at"
                f" once; it must exceed the collision radius, {radius:g} m"
            )

    def seed(self, seeds: Sequence[int | None], rows: Rows = None) -> None:
        """Give rows new random streams, from one seed each. Their next reset begins their first
        episode.
        """
        self.streams[:, self.rows(rows)] = new_streams(seeds)

    def reset(self, rows: Rows = None) -> Float32Array:
        """Begin the next episode of the given rows, None for all.

        :return: the observations of all rows, float32 (n, size).
        """
        return self._run(LOOK, np.zeros((self.n, 4)), self.rows(rows))[0]

    def stagger(self) -> None:
        """Stagger the present episodes: row i of n is truncated after (n - i) / n of
        ``max_episode_steps``. Later episodes have their full length.
        """
        self.limits[:] = self.max_steps - np.arange(self.n) * self.max_steps // self.n

    def observe(self) -> Float32Array:
        """Return the present observations, float32 (n, ``observation.size``). They are the same
        numbers, noise included, until the next step.
        """
        return self.reset(())

    def step(self, actions: AnyArray) -> StepResult:
        """Fly a control step of every row.

        Where a row is done, ``outcome`` (fields total, reward, length, distance, collision,
        out_of_range, truncated, success) and ``last_observations`` hold how its episode ended until
        its next one ends. Without autoreset ``outcome`` is that of every row's last step.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: observations float32 (n, size), rewards float32 (n,), done bool (n,): fresh arrays.
        :raises ValueError: actions of another shape, or not finite.
        """
        return self._run(FLY, actions)

    def step_on(self, actions: AnyArray, substeps: int) -> StepResult:
        """Like :meth:`step`, but no row begins another episode, and there is no time limit.

        :param substeps: physics steps in this control step, which lasts as long as any.
        """
        step = self.physics_step * self.substeps / substeps
        return self._run(FLY, actions, physics_step=step, substeps=substeps, autoreset=False)

    def score(self, actions: AnyArray) -> StepResult:
        """Score a control step that another simulator has flown and written into ``state``;
        otherwise like :meth:`step`.

        :param actions: those that the policy sees in its next observation.
        """
        return self._run(SCORE, actions)

    def _run(
        self, mode: int, actions: AnyArray, begins: IntArray = _NO_ROWS, **changes: Any
    ) -> StepResult:
        """Call the compiled step with fresh arrays for its results.

        :param begins: numbers of the rows whose next episode LOOK begins.
        :param changes: arguments of the compiled step in this call, instead of the batch's own.
        """
        array = np.ascontiguousarray(actions, dtype=np.float32)
        if array.shape != (self.n, 4):
            raise ValueError(
                f"actions of shape {array.shape}: must be ({self.n}, 4), one row per environment"
            )
        observations = np.empty_like(self.last_observations)
        rewards = np.empty(self.n, np.float32)
        dones = np.zeros(self.n, np.bool_)
        if begins.size:
            dones[begins] = True
        results = observations, rewards, dones
        arguments = self._arguments | changes if changes else self._arguments
        self._is_behind = len(self.tracks) > 0
        if not share_out(step, self.helpers, mode, array, *results, *arguments.values()):
            row, _ = np.argwhere(~np.isfinite(array))[0]
            raise ValueError(
                f"actions: row {row} is {array[row].tolist()}; every number must be finite"
            )
        return results

    def turn_rotors(self, actions: AnyArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Advance the rotors of row 0 by a control step, for another simulator that moves the body.

        It writes the state after each of these parts, and :meth:`score` scores the step. In each
        physics step it adds :meth:`total_wrench`, and :meth:`air_on` if ``feels_air``.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: for each part force (N) and torque (N m) of the rotors in each physics step, body
            frame, (steps, 2, 3), and their speeds before these and after each, (steps + 1, 4).
        """
        # A rate loop feels how the body turns.
        parts = self.substeps if self.filtered_rates.size else 1
        for part in range(parts):
            steps = self.substeps // parts
            wrenches = np.zeros((steps, 2, 3))
            speeds = np.empty((steps + 1, 4))
            rotor_wrenches(
                part == 0,
                actions,
                self._due,
                wrenches,
                speeds,
                self.state,
                self.queue,
                self.filtered_rates,
                self.vehicles,
                self.physics_step,
                self.in_air,
            )
            yield wrenches, speeds

    def air_on(
        self, rotors: FloatArray, speeds: FloatArray, step: int, state: FloatArray
    ) -> FloatArray:
        """Return the wrench of the air in a physics step of row 0, (WRENCH_SIZE,).

        :param rotors: what :meth:`turn_rotors` gives, and ``speeds``, of which ``step`` is the one.
        :param state: (STATE_SIZE, 1), before the step; its rotor speeds are not read.
        """
        vehicle = self.vehicles[:, :1]
        state[ROTOR_SPEEDS, 0] = speeds[step + 1]
        wrench = air_wrenches(state, vehicle, self.total_wind()[:, :1])[:, 0]
        gained = ground_effects(state, vehicle)[0] - 1.0
        wrench[FORCE_BODY] += gained * rotors[step, 0]
        wrench[TORQUE_BODY] += gained * rotors[step, 1]
        before, after = rotor_momenta(vehicle, speeds[step : step + 2].T)
        wrench[W.torque_body + 2] += (before - after) / self.physics_step
        return wrench

    def clear_outcome(self, rows: Rows = None) -> None:
        """Clear ``outcome`` of rows that have just begun an episode; its distance is that of the
        start.
        """
        chosen = self.rows(rows)
        self.outcome[chosen] = 0
        self.outcome["truncated"][chosen] = True
        self.outcome["distance"][chosen] = QuadcopterState(self.state[:, chosen]).distance

    def rows(self, rows: Rows) -> IntArray:
        """Return row numbers from None (all), a number, a slice or a sequence.

        :raises ConfigError: no such rows.
        """
        everything = np.arange(self.n, dtype=np.int64)
        if rows is None:
            return everything
        try:
            selected = rows if isinstance(rows, (int, slice, np.ndarray)) else list(rows)
            return np.atleast_1d(everything[selected])
        except (IndexError, TypeError):
            raise ConfigError(
                f"indices {rows!r}: must be row numbers from 0 to {self.n - 1}"
            ) from None

    def true_state(self) -> QuadcopterState:
        """Return the true state of all rows.

        It is a live view, except that gusts and the forces and moments of the air, which are a part
        of its wrench, are those of this control step.
        """
        vehicles = np.broadcast_to(self.vehicles, (len(self.vehicles), self.n))
        wrench = self.total_wrench()
        if self.feels_air:
            wrench = wrench + air_wrenches(self.state, vehicles, self.total_wind())
            thrust = thrusts_far_from_ground(self.state, vehicles)
            wrench[W.force_body + 2] += (ground_effects(self.state, vehicles) - 1.0) * thrust
        return QuadcopterState(self.state, vehicles, wrench)

    def estimated_state(self) -> QuadcopterState:
        """Return the state that the vehicles themselves would know: with the errors of
        ``noise.estimator`` a copy, else the true one.
        """
        state = self.true_state()
        if not self.estimate.size:
            return state
        array = estimated(state.array, self.estimate)
        return QuadcopterState(array, state.vehicles, state.wrench)

    @property
    def feels_air(self) -> bool:
        """Whether some vehicle has drag or another term of :mod:`.aerodynamics`."""
        return self.in_air or self.feels_wind

    @property
    def feels_wind(self) -> bool:
        """Whether wind acts on some vehicle."""
        return bool(self.vehicles[FELT].any())

    def warn_without_drag(self, what: str) -> None:
        """Warn that the wind has no effect, and say what set it, unless it may act on a vehicle of
        a later episode.
        """
        names = ("drag", "rotor_drag", "translational_lift", "airspeed_moment")
        may_feel = any(getattr(self.randomize, name) is not None for name in names)
        if self.distribution is not None and self.distribution.drag is not None:
            may_feel = True
        if not may_feel and not self.feels_wind:
            warnings.warn(
                f"{what}: wind acts through drag, and {self.vehicle_list[0].name} has none;"
                " give a vehicle with drag, or randomize.drag",
                stacklevel=3,
            )

    def total_wrench(self) -> FloatArray:
        """Return the external wrench of this control step, (WRENCH_SIZE, n): the one that was set
        or sampled, gusts, and the recorded one; without drag.
        """
        total = self.wrench
        if len(self.wrench_record):
            total = total + self._recorded(self.wrench_record, self.wrench_starts)
        if self.randomize.gusts is not None:
            total = total.copy()
            total[FORCE_WORLD] += self.gust[GUST_VALUE]
        return total

    def total_wind(self) -> FloatArray:
        """Return the velocity of the air in this control step, (3, n), world frame, m/s: the one
        that was set or sampled, gusts, and the recorded one.
        """
        total = self.wind
        if len(self.wind_record):
            total = total + self._recorded(self.wind_record, self.wind_starts)
        if self.randomize.wind_gusts is not None:
            total = total + self.wind_gust[GUST_VALUE]
        return total

    def _recorded(self, record: FloatArray, starts: IntArray) -> FloatArray:
        """Return what a recording adds in this control step, (size, n)."""
        begins = starts[(self.chances * len(starts)).astype(np.int64)]
        return np.asarray(record[(begins + self.streams[STEP]) % len(record)].T)

    @property
    def state(self) -> FloatArray:
        """The state of all rows, (STATE_SIZE, n); see :data:`.state.STATE`.

        A step changes it in place, except for the motion and heading of references, which are those
        of when the state was asked for.
        """
        if self._is_behind:
            complete(self._state, self.streams, self.course, self.tracks, self.track_numbers)
            self._is_behind = False
        return self._state

    def snapshot(self) -> Arrays:
        """Return copies of everything that future flight depends on, by name."""
        return {name: getattr(self, name).copy() for name in _KEPT}

    def restore(self, snapshot: Arrays) -> None:
        """Undo everything that has happened since :meth:`snapshot`.

        :param snapshot: from environments with arrays of these types and shapes.
        :raises ConfigError: its episodes are of tasks that these environments do not have.
        """
        if not np.isin(snapshot["task_index"], np.arange(self.task_weights.size)).all():
            raise ConfigError("task_index refers to tasks that the environments do not have")
        for name in _KEPT:
            getattr(self, name)[...] = snapshot[name]
        self._bind()
        self._notice_motion()

    def fix(self, quantity: str, values: FloatArray) -> None:
        """Replace a quantity of :data:`.state.STATE` that an episode has begun with, in all rows.

        A reference that moves begins at the new target.

        :param values: (size, n).
        """
        self.state[row_slices(STATE)[quantity]] = values
        if quantity == "target" and self.course.size:
            self.course[: C.begin] = values
        if quantity == "body_rates" and self.filtered_rates.size:
            self.filtered_rates[:] = values

    def set_reference(self, reference: FloatArray, rows: IntArray) -> None:
        """Set the reference of these rows, (REFERENCE_SIZE, rows)."""
        self.state[REFERENCE, rows] = reference
        if self.course.size:
            self.course[C.begin, rows] = -1.0
        self._notice_motion()

    def _notice_motion(self) -> None:
        """Let steps read how targets move and turn, once one of them does."""
        if not self.moves and self.state[X.target_velocity :].any():
            self.moves = True
            self._bind()

    def set_noise(self, level: Any, indices: Rows = None) -> None:
        """Set the relative standard deviation of the observation noise, () or (rows,), or a
        ``Noise``; 0 switches it off. The estimator's errors stay.
        """
        noise = validate(FlightSettings, {"noise": level}, "set_noise").noise
        if estimator_of(noise) not in (None, self.estimator):
            raise ConfigError("set_noise: estimator: give it to the environment when you make it")
        relative, additive = levels(noise)
        chosen = self.rows(indices)
        self.scaling_of_rows[-2, chosen] = per_row("noise", relative, chosen.size)
        self.scaling_of_rows[-1, chosen] = additive
        self._bind()

    def _bind(self) -> None:
        self.scaling = self.scaling_of_rows
        # One column serves all rows if they do not differ.
        if (self.scaling == self.scaling[:, :1]).all():
            self.scaling = self.scaling[:, :1].copy()
        self.mean = self.scaling[:OBSERVATION_SIZE]
        self.std = self.scaling[OBSERVATION_SIZE : 2 * OBSERVATION_SIZE]
        self.noise_level, self.additive_level = self.scaling[-2:]
        self._arguments = {name: getattr(self, name) for name in BATCH_ARGUMENTS}
