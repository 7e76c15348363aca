"""Fly a controller over fresh episodes, and measure the true state along the way.

Two conventions follow from the expert's numbers in the thesis (4.3.1). The time to a tolerance is
the end of the first control step after which |r - r_T| is within it. The path length is that of the
whole episode of 15 s, not only of the way until arrival.
"""

import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_quad.agents.agent_settings import (
    settings_of_model,
    unlike_trained,
    warn_of_observation,
)
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.algorithms.controller import Controller
from sb3_quad.algorithms.labelling import warn_of_vehicle
from sb3_quad.base.errors import ConfigError, ControllerError, raised_as, refuse_unknown, unknown
from sb3_quad.base.files import write_arrays
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, IntArray, StrPath
from sb3_quad.envs.batch_env import quadcopter_spaces
from sb3_quad.envs.simulation import MAX_EPISODE_STEPS
from sb3_quad.envs.simulation.batch import MAX_ROWS
from sb3_quad.envs.simulation.checks import per_row, whole_number
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import TARGET, QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle, first_vehicle
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.following import Following
from sb3_quad.evaluation.scenarios.sample import Plan
from sb3_quad.evaluation.supervisor import Supervisor

TOLERANCES = (0.1, 0.2, 0.5, 1.0)  # m
NEAR = 0.1  # m; overshoot is judged by it, or by the tightest tolerance if it is not among them
ACTIONS = quadcopter_spaces()[1]
# A vehicle is stable while its tilt (rad) and its rate of roll and pitch together (rad/s) are below
# these for at least HOLD (s).
TILT = np.radians(45.0)
RATE = 2.0
HOLD = 0.2
LARGEST_SEED = 2**53  # Seeds that the package itself makes are smaller.

Reward: TypeAlias = Callable[[QuadcopterState, Float32Array], npt.ArrayLike]
"""A reward of your own: a function from the state after a control step and the actions (n, 4) that
led to it to rewards (n,).
"""


OwnReward: TypeAlias = str | Reward | None
"""A reward of your own as it is given: a function or ``package.module:function``; None: none."""


@dataclass(frozen=True, eq=False)
class Flights:
    """The metrics of n episodes, one per row."""

    #: (n,), survived and ended at the (last) target: the task's success_distance and success_tilt
    success: BoolArray
    survival: BoolArray  #: (n,), neither collision nor out of range: the thesis's success
    collision: BoolArray  #: (n,), touched the ground
    reward: FloatArray  #: (n,), sum of the rewards
    own_reward: FloatArray  #: (n,), sum of your own reward; NaN if you gave none
    length: IntArray  #: (n,), control steps
    flown: FloatArray  #: (n,), time flown until the loss or the end, s
    #: By tolerance (m): time until |r - r_T| is first within it, s, (n,); NaN if it never was. On a
    #: course, only the distance to the last waypoint counts.
    time_to: Mapping[float, FloatArray]
    #: By tolerance (m): time after which |r - r_T| stays within it to the end, s, (n,); NaN if the
    #: flight ended outside or was lost.
    settling_time: Mapping[float, FloatArray]
    #: (n,), largest |r - r_T| since it was first within NEAR, m; NaN if it never was
    overshoot: FloatArray
    path_length: FloatArray  #: (n,), m, over the whole episode
    final_error: FloatArray  #: (n,), |r - r_T| at the end, m
    #: (n, 3), r - r_T at the end, world frame, m; NaN if the flight was lost
    final_offset: FloatArray
    #: (n,), time until it was stable again, s; NaN if it never was, see Motion
    recovery_time: FloatArray
    #: (n,), largest distance from the straight line to the target, m; NaN if there is no line
    cross_track_error: FloatArray
    #: (n,), root mean square of |r - r_T|, m. This and the next four are for targets that move or
    #: turn, after the first 2 s; NaN if the flight was lost or its target rests.
    rms_error: FloatArray
    greatest_error: FloatArray  #: (n,), largest |r - r_T|, m
    path_error: FloatArray  #: (n,), root mean square of its part across the target's velocity, m
    lag: FloatArray  #: (n,), how late the flight is on its path, s, see Following
    heading_error: FloatArray  #: (n,), root mean square, degrees; NaN if none is commanded
    cut_by_supervisor: BoolArray  #: (n,), whether the firmware would have cut it, see Supervisor
    #: (n,), longest time that the specific force along body z stayed below 0.5 g, s; NaN if the
    #: vehicle has no supervisor
    low_force_time: FloatArray
    #: (n, W), time until each waypoint was reached, s; NaN if it never was; W = 0 without waypoints
    waypoint_times: FloatArray
    #: (n, 13), position, quaternion (w, x, y, z; body to world), velocity (world), body rates
    #: (body); SI
    start: FloatArray
    target: FloatArray  #: (n, 3), the first target, m

    @property
    def n(self) -> int:
        """Number of episodes."""
        return int(self.success.size)

    @staticmethod
    def concatenate(parts: Sequence["Flights"]) -> "Flights":
        """Join several parts in order."""
        return Flights(**_joined([vars(part) for part in parts]))


def _joined(parts: Sequence[Any]) -> Any:
    """Join arrays, including those within mappings."""
    if not isinstance(parts[0], Mapping):
        return np.concatenate(parts)
    joined = {}
    for key in parts[0]:
        joined[key] = _joined([part[key] for part in parts])
    return joined


def arrival_tolerance(tolerances: Iterable[float]) -> float:
    """Return the tolerance, m, by which overshoot and the settling time are judged."""
    return min(tolerances, key=lambda tolerance: (tolerance != NEAR, tolerance))


class Hook:
    """Called during a flight; a subclass overrides the methods that it needs."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        """See the state in which the flights start."""

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        """See the state before a control step.

        :param observation: (n, observation size).
        :param wrench: (n, WRENCH_SIZE), that acts during the step.
        :param flying: (n,), the flights that are still in the air.
        """

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        """See the state after control step ``step``.

        :param actions: (n, 4), that led to this state.
        :param flying: (n,), the flights that continue.
        """


def fly(
    controller: Any,
    task: Any = "target_tracking",
    n_episodes: int = 240,
    seed: int = 0,
    vehicle: str | Vehicle | None = None,
    noise: float = 0.05,
    backend: str = "batch",
    tolerances: Sequence[float] | float = TOLERANCES,
    hooks: Sequence[Hook] = (),
    reward: Reward | None = None,
    record: StrPath | None = None,
    **environment: Any,
) -> Flights:
    """Fly ``n_episodes`` episodes.

    Number k is the first episode of an environment that is reset with
    ``row_seeds(seed, n_episodes)[k]`` (:func:`~sb3_quad.base.seeds.row_seeds`).

    :param controller: an expert or its name, such as ``"pid"``, asked by ``actions(state)`` for the
        true state; an SB3 model, its zip or the name of a shipped one, asked by
        ``predict(observation, deterministic=True)``; or a function from observations
        (n, observation size) to actions (n, 4).
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``vehicle``,
        ``noise`` and ``environment``: ``task_kwargs``, ``reference``, ``observation_std`` and
        ``observation_mean``. Give what an agent was trained to observe by
        :func:`~sb3_quad.env_kwargs`; you are warned where it differs.
    :param vehicle: None: the one that the agent was trained on, else ``itm``. The agent flies in
        the ``rotor_layout`` of its own, unless you give another.
    :param backend: ``batch``, or ``pybullet`` for the reference.
    :param tolerances: of arrival, |r - r_T|, m; one or several.
    :param hooks: are called along the way.
    :param reward: a reward of your own, ``reward(state, actions)`` -> (n,) for the state after each
        control step and the actions (n, 4); its sums are ``Flights.own_reward``. A class is
        instantiated for these episodes and may remember.
    :param record: an ``.npz`` file for the observations and actions of all control steps, which
        ``DAgger(demonstrations=...)`` and ``dataset.load`` take; an existing one is replaced.
    :raises ConfigError: an unknown name, backend or keyword, a seed below 0, or fewer than one
        episode.
    :raises ControllerError: a controller of another kind, or a controller or reward that fails in
        flight.
    """
    valid = {*inspect.signature(fly).parameters, *FlightSettings.model_fields} - {"environment"}
    for key in environment.keys() - valid:
        raise ConfigError(f"fly: {unknown('keyword', key, valid)}")
    seeds = episode_seeds(seed, n_episodes)
    limits = per_row("tolerances", tolerances, np.size(tolerances))[0].tolist()
    if min(limits, default=1.0) <= 0.0:
        raise ConfigError(f"tolerances {limits}: must be greater than 0 m")
    layout = environment.get("rotor_layout")
    flown = "itm" if vehicle is None else vehicle
    name = str(controller)
    if not isinstance(controller, (str, Path)):
        name = type(controller).__name__
    controller = resolve_expert(controller, flown, "controller", layout)
    own = settings_of_model(controller)
    if own is not None:
        if vehicle is None:
            flown = own.vehicle
        # A model flies with its rotors where it knows them.
        if layout is None:
            environment["rotor_layout"] = own.layout
    environment.setdefault("max_episode_steps", MAX_EPISODE_STEPS)
    settings = FlightSettings().with_changes(task=task, vehicle=flown, noise=noise, **environment)
    refuse_several_limits(settings)
    warn_of_differences(name, controller, settings)
    return fly_settings(
        controller, settings, seeds, backend, limits, hooks, reward=reward, record=record
    )


def refuse_several_limits(settings: FlightSettings) -> None:
    """Refuse a limit for each row, since flights end together."""
    if isinstance(settings.max_episode_steps, list):
        raise ConfigError(
            f"max_episode_steps {settings.max_episode_steps}: must be one number, the limit of all"
            " flights"
        )


def warn_of_differences(name: str, controller: Any, settings: FlightSettings) -> None:
    """Warn if a controller flies another vehicle than it knows, or observes something else.

    :param name: what the warning calls it.
    """
    warn_of_observation(name, controller, settings)
    # A distribution has no particular vehicle.
    if settings.vehicles is not None:
        return
    warn_of_vehicle(controller, settings.load_vehicles())
    own = settings_of_model(controller)
    if own is not None:
        notice = unlike_trained(name, own, first_vehicle(settings.vehicle))
        if notice:
            warnings.warn(f"{notice}; sb3_quad.env_kwargs(agent) gives its own", stacklevel=3)


def episode_seeds(seed: int, n_episodes: int) -> list[int]:
    """Return the seed of each flight.

    :raises ConfigError: anything but whole numbers, a seed below 0, or no flights.
    """
    n = whole_number("n_episodes", n_episodes, 1, MAX_ROWS)
    return row_seeds(whole_number("seed", seed, 0, LARGEST_SEED), n)


# It is long because its parts would share a dozen arrays that each step changes.
def fly_settings(
    controller: Any,
    settings: FlightSettings,
    seeds: Sequence[int],
    backend: str = "batch",
    tolerances: Sequence[float] = TOLERANCES,
    hooks: Sequence[Hook] = (),
    plan: Plan | None = None,
    deterministic: bool = True,
    reward: Reward | None = None,
    record: StrPath | None = None,
) -> Flights:
    """Fly the first episode of each seed, as :func:`fly` does, with one record of settings.

    :param plan: the events of the episodes.
    :param deterministic: whether a policy gives the mean of its actions, or a sample.
    """
    refuse_unknown("backend", [backend], FLEETS)
    plan = plan or Plan()
    if isinstance(reward, type):
        # A stateful reward, for example of changing actions, is instantiated afresh for these
        # episodes.
        reward = reward()
    with closing(FLEETS[backend](seeds, settings)) as fleet:
        observations, _ = quadcopter_spaces(fleet.observation.size)
        pilot = Controller(
            controller, ACTIONS, observations, fleet.true_state, deterministic=deterministic
        )
        vehicle = fleet.vehicle_list[0]
        observation = fleet.begin(plan.start)
        # The state is a live view: copy what later steps need.
        state = fleet.true_state()
        start = state.copy()
        position = start.position
        fleet.clear_outcome()
        # The outcome of the flights so far; for a lost flight it no longer changes.
        outcome = fleet.outcome.copy()
        distance = outcome["distance"]
        flying = outcome["truncated"].copy()  # a flight survives until it is lost
        course = Waypoints(plan, fleet.n)
        arrivals = Arrivals(tolerances, course.to_last(distance))
        motion = Motion(start, vehicle.control_step)
        following = Following(fleet.n, vehicle.control_step)
        supervisor = Supervisor(fleet.vehicle_list)
        total = np.zeros(fleet.n)
        own_total = np.full(fleet.n, np.nan if reward is None else 0.0)
        path_length = np.zeros(fleet.n)
        observed = []  # for ``record``, as is ``acted``
        acted = []
        for hook in hooks:
            hook.on_start(state, vehicle)

        for step in range(1, settings.longest_episode + 1):
            time = step * vehicle.control_step
            # Disturbances of the plan begin and end between two control steps.
            if step - 1 in plan.wrenches:
                fleet.wrench[:] = plan.wrenches[step - 1].T
            try:
                actions = pilot.actions(observation, flying)
            except ControllerError as error:
                before = time - vehicle.control_step
                raise ControllerError(f"{error}, after {before:.2f} s") from error
            for hook in hooks:
                hook.before_step(state, observation, fleet.total_wrench().T, flying)
            if record is not None:
                observed.append(observation[flying])
                # Clip them as the environment does.
                acted.append(actions[flying].clip(-1.0, 1.0))
            observation, rewards, _ = fleet.step(actions)
            state = fleet.true_state()

            # This step also counts for the flights that it has ended.
            outcome[flying] = fleet.outcome[flying]
            total += np.where(flying, rewards, 0.0)
            if reward is not None:
                own_total += _ask_reward(reward, state, actions, flying)
            way = np.linalg.norm(state.position - position, axis=1)
            path_length += np.where(flying, way, 0.0)
            position = state.position.copy()
            arrivals.update(time, course.to_last(distance))

            # From here on, only the flights that continue count.
            flying = outcome["truncated"].copy()
            motion.update(step, state, flying)
            supervisor.update(state, flying)
            if fleet.moves:
                following.update(step, state, flying)
            for hook in hooks:
                hook.after_step(step, state, actions, flying)
            # The outcome of the last step refers to the target until then.
            on_last = course.on_last
            if not flying.any():
                break
            # Rows that have reached a waypoint see the next one from the next step on.
            onward = course.update(time, distance, flying)
            if onward.size and step < settings.longest_episode:
                fleet.state[TARGET, onward] = plan.waypoints[course.next[onward]].T
                observation = fleet.observe()

        if record is not None:
            write_arrays(
                record, observations=np.concatenate(observed), actions=np.concatenate(acted)
            )
        # A lost flight has no time after which it stays at its target.
        settling_time = np.where(flying, arrivals.settling_time, np.nan)
        offset = state.position - state.target
        # Neither a course nor a moving target has a straight line to deviate from.
        has_no_line = following.moves | (plan.waypoints.size > 0)
        return Flights(
            success=outcome["success"] & on_last,
            survival=flying,
            collision=outcome["collision"],
            reward=total,
            own_reward=own_total,
            length=outcome["length"],
            flown=outcome["length"] * vehicle.control_step,
            time_to=dict(zip(tolerances, arrivals.time_to, strict=True)),
            settling_time=dict(zip(tolerances, settling_time, strict=True)),
            overshoot=arrivals.overshoot,
            path_length=path_length,
            final_error=distance,
            final_offset=np.where(flying[:, None], offset, np.nan),
            recovery_time=motion.recovery_time,
            cross_track_error=np.where(has_no_line, np.nan, motion.cross_track_error),
            **following.errors(flying),
            cut_by_supervisor=supervisor.cut,
            low_force_time=supervisor.longest,
            waypoint_times=course.times,
            start=start.array[:13].T,
            target=start.target,
        )


def _ask_reward(
    reward: Reward, state: QuadcopterState, actions: Float32Array, flying: BoolArray
) -> FloatArray:
    """Return the rewards of a user's function, which may do anything, as (n,) numbers.

    :param flying: (n,), the flights whose rewards count; the others get 0.
    """
    name = f"reward {reward_name(reward)}"
    with raised_as(ControllerError, f"{name}: fails"):
        values = np.asarray(reward(state, actions), dtype=np.float64)
    if values.shape != (state.n,):
        raise ControllerError(f"{name}: gives shape {values.shape}, must be ({state.n},)")
    wrong = np.flatnonzero(flying & ~np.isfinite(values))
    if wrong.size:
        raise ControllerError(f"{name}: gives {values[wrong][0]} in row {wrong[0]}, must be finite")
    return np.where(flying, values, 0.0)


def reward_name(reward: OwnReward) -> str:
    """Return the name of a reward of your own; empty if there is none."""
    if reward is None or isinstance(reward, str):
        return reward or ""
    # Instances of a class have no ``__name__``.
    return str(getattr(reward, "__name__", type(reward).__name__))


class Arrivals:
    """Tracks when n flights come within T tolerances of their targets.

    ``time_to`` (T, n): time until |r - r_T| is first within each tolerance, s. ``settling_time``
    (T, n): time since when it has stayed within it, s. ``overshoot`` (n,): the largest |r - r_T|,
    m, since it was first within :func:`arrival_tolerance`. NaN if that has not happened.

    :param tolerances: m.
    :param distance: |r - r_T| at the start, (n,), m; infinite before the last waypoint.
    """

    def __init__(self, tolerances: Sequence[float], distance: FloatArray) -> None:
        self._limits = np.array(tolerances)[:, None]
        self.time_to = np.full((len(tolerances), len(distance)), np.nan)
        self.settling_time = self.time_to.copy()
        self.overshoot = np.full(len(distance), np.nan)
        self._first = self.overshoot.copy()
        if tolerances:
            # A view, which shows later arrivals.
            self._first = self.time_to[[*tolerances].index(arrival_tolerance(tolerances))]
        self.update(0.0, distance)

    def update(self, time: float, distance: FloatArray) -> None:
        """See |r - r_T|, (n,), m, after a control step that ends at ``time``, s.

        For a lost flight, it is the last value.
        """
        inside = distance <= self._limits
        np.fmin(self.time_to, np.where(inside, time, np.nan), out=self.time_to)
        self.settling_time = _since(self.settling_time, inside, time)
        arrived = np.isfinite(self._first)
        np.fmax(self.overshoot, distance, out=self.overshoot, where=arrived)


def _since(times: FloatArray, holds: BoolArray, time: float) -> FloatArray:
    """Return the time since when a condition has held, given whether it ``holds`` now; otherwise
    NaN.
    """
    return np.where(holds, np.fmin(times, time), np.nan)


class Waypoints:
    """The waypoints of n flights: which of them each has reached, and when.

    ``times`` (n, W): time until each of W waypoints was reached, s; NaN: not yet. ``next`` (n,):
    the number of the present one.
    """

    def __init__(self, plan: Plan, n: int) -> None:
        self._radius = plan.radius
        self._count = len(plan.waypoints)
        self.next = np.zeros(n, dtype=np.int64)
        self.times = np.full((n, self._count), np.nan)

    def update(self, time: float, distance: FloatArray, flying: BoolArray) -> IntArray:
        """See |r - r_T|, (n,), m, at ``time``, s; return the rows that get their next target."""
        near = flying & (distance <= self._radius)
        reached = np.flatnonzero(near & (self.next < self._count))
        self.times[reached, self.next[reached]] = time
        self.next[reached] += 1
        return reached[self.next[reached] < self._count]

    @property
    def on_last(self) -> BoolArray:
        """Whether the present target is the last one, (n,); always without waypoints."""
        return self.next >= self._count - 1

    def to_last(self, distance: FloatArray) -> FloatArray:
        """Return |r - r_T|, (n,), m, of the flights on the way to their last target; inf for the
        others.
        """
        return np.where(self.on_last, distance, np.inf)


class Motion:
    """Tracks when n flights become stable, and how far they deviate from their straight line.

    ``recovery_time`` (n,), s: the beginning of the first 0.2 s in which the tilt stays below 45°
    and the body rate of roll and pitch together below 2 rad/s; NaN if there is none. The thesis
    reads such a time from Fig. 4.9. ``cross_track_error`` (n,): the largest distance from the
    straight line through start and target, m, on the way and beyond: the oscillations of 4.3.1; NaN
    if both are the same point.

    :param state: state at the start.
    :param control_step: s.
    """

    def __init__(self, state: QuadcopterState, control_step: float) -> None:
        way = state.target - state.position
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self._control_step = control_step
        self._start = state.position
        self._direction = np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)
        self._stable_since = np.zeros(state.n)  # NaN while it is not stable
        self.recovery_time = np.full(state.n, np.nan)
        self.cross_track_error = np.where(length[:, 0] > 0.0, 0.0, np.nan)
        self.update(0, state, np.ones(state.n, bool))

    def update(self, step: int, state: QuadcopterState, flying: BoolArray) -> None:
        """See the state after control step ``step``; only the flights (n,) that continue count."""
        time = step * self._control_step
        # The cosine of the tilt is the z-z element of the rotation matrix.
        x, y = state.quaternion.T[1:3]
        upright = 1.0 - 2.0 * (x * x + y * y) > np.cos(TILT)
        stable = upright & (np.hypot(*state.body_rates.T[:2]) < RATE)
        self._stable_since = _since(self._stable_since, stable, time)
        # Allow half a step, since times are multiples of steps only up to rounding.
        held = flying & (time - self._stable_since > HOLD - 0.5 * self._control_step)
        np.fmin(self.recovery_time, self._stable_since, out=self.recovery_time, where=held)
        # The part of the way flown that lies across the line.
        flown = state.position - self._start
        along = (flown * self._direction).sum(axis=1, keepdims=True) * self._direction
        across = np.linalg.norm(flown - along, axis=1)
        error = self.cross_track_error
        np.maximum(error, across, out=error, where=flying)
