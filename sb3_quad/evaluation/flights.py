"""Fly a controller over fresh episodes, and measure the true state along the way.

Two conventions follow from the expert's numbers in the thesis (4.3.1). The time to a tolerance is
the end of the first control step after which |r - r_T| is within it. The path length is that of the
whole episode of 15 s, not only of the way until arrival.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.agents.agent_settings import (
    settings_of_model,
    unlike_trained,
    warn_of_observation,
)
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.algorithms.controller import Controller
from sb3_quad.algorithms.labelling import refuse_other_action, warn_of_vehicle
from sb3_quad.algorithms.networks import one_thread_by_default
from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.base.files import write_arrays
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import (
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    StrDict,
    StrPath,
)
from sb3_quad.envs import MAX_EPISODE_STEPS
from sb3_quad.envs.batch_env import quadcopter_spaces
from sb3_quad.envs.simulation.batch import MAX_ROWS, QuadcopterBatch
from sb3_quad.envs.simulation.checks import per_row, whole_number
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.simulation.state import TARGET
from sb3_quad.envs.vehicles.vehicle import Vehicle, first_vehicle
from sb3_quad.evaluation.following import Following
from sb3_quad.evaluation.hooks import Arrivals, Course, Hook, Motion
from sb3_quad.evaluation.hover import HOVERED, Hover
from sb3_quad.evaluation.scenarios.sample import Plan

TOLERANCES = (0.1, 0.2, 0.5, 1.0)  # m
ACTIONS = quadcopter_spaces()[1]
LARGEST_SEED = 2**53  # Seeds that the package itself makes are smaller.


@dataclass(frozen=True, eq=False)
class Flights:
    """The metrics of n episodes, one per row."""

    #: (n,), survived and ended at the (last) target: the task's success_distance and success_tilt;
    #: or landed there
    success: BoolArray
    survival: BoolArray  #: (n,), neither collision nor out of range: the thesis's success
    collision: BoolArray  #: (n,), touched the ground otherwise than by landing
    reward: FloatArray  #: (n,), sum of the rewards
    length: IntArray  #: (n,), control steps
    flown: FloatArray  #: (n,), time flown until the loss or the end, s
    #: By tolerance (m): time until |r - r_T| is first within it, s, (n,); NaN if it never was. On a
    #: course, only the distance to the last waypoint counts.
    time_to: Mapping[float, FloatArray]
    #: By tolerance (m): time after which |r - r_T| stays within it to the end, s, (n,); NaN if the
    #: flight ended outside or was lost.
    settling_time: Mapping[float, FloatArray]
    path_length: FloatArray  #: (n,), m, over the whole episode
    final_error: FloatArray  #: (n,), |r - r_T| at the end, m
    #: (n, 3), r - r_T at the end, world frame, m; NaN if the flight was lost
    final_offset: FloatArray
    #: (n,), time until it was stable again, s; NaN if it never was, see Motion
    recovery_time: FloatArray
    #: (n,), largest distance from the straight line to the target, m; NaN if there is no line
    cross_track_error: FloatArray
    #: (n,), root mean square of the body rates in hover at the target, rad/s; NaN if it did not
    #: hover there, see Hover
    hover_body_rates: FloatArray
    hover_tilt: FloatArray  #: (n,), likewise, of the tilt, degrees
    hover_command_change: FloatArray  #: (n,), likewise, of the change of commands, 1/s
    #: (n,), root mean square of |r - r_T|, m. This and the next four are for targets that move or
    #: turn, after the first 2 s; NaN if the flight was lost or its target rests.
    rms_error: FloatArray
    greatest_error: FloatArray  #: (n,), largest |r - r_T|, m
    path_error: FloatArray  #: (n,), root mean square of its part across the target's velocity, m
    lag: FloatArray  #: (n,), how late the flight is on its path, s, see Following
    heading_error: FloatArray  #: (n,), root mean square, degrees; NaN if none is commanded
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


def fly(
    controller: Any,
    task: Any = "target_tracking",
    n_episodes: int = 240,
    seed: int = 0,
    vehicle: str | Vehicle | None = None,
    noise: float = 0.05,
    tolerances: Sequence[float] | float = TOLERANCES,
    hooks: Sequence[Hook] = (),
    record: StrPath | None = None,
    **environment: Any,
) -> Flights:
    """Fly ``n_episodes`` episodes.

    Number k is the first episode of an environment that is reset with
    ``row_seeds(seed, n_episodes)[k]`` (:func:`~sb3_quad.base.seeds.row_seeds`).

    :param controller: an expert or its name, such as ``"pid"``, asked by ``actions(state)`` for the
        true state, or the estimate with ``noise.estimator``; an SB3 model, its zip or the name of a
        shipped one, asked by ``predict(observation, deterministic=True)``; or a function from
        observations (n, observation size) to actions (n, 4).
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``vehicle``,
        ``noise`` and ``environment``: ``task_kwargs``, ``reference``, ``observation_std`` and
        ``observation_mean``. Give what an agent was trained to observe by
        :func:`~sb3_quad.env_kwargs`; you are warned where it differs.
    :param vehicle: None: the one that the agent was trained on, else ``itm``. The agent flies in
        the ``rotor_layout`` of its own, unless you give another.
    :param tolerances: of arrival, |r - r_T|, m; one or several.
    :param hooks: are called along the way.
    :param record: an ``.npz`` file for the observations and actions of all control steps, which
        ``DAgger(demonstrations=...)`` and ``dataset.load`` take; an existing one is replaced.
    :raises ConfigError: an unknown name or keyword, a seed below 0, or fewer than one episode.
    :raises ControllerError: a controller of another kind, or one that fails in flight.
    """
    seeds = episode_seeds(seed, n_episodes)
    limits = per_row("tolerances", tolerances, np.size(tolerances))[0].tolist()
    if min(limits, default=1.0) <= 0.0:
        raise ConfigError(f"tolerances {limits}: must be greater than 0 m")
    layout = environment.get("rotor_layout")
    flown = "itm" if vehicle is None else vehicle
    name = str(controller)
    if not isinstance(controller, (str, Path)):
        name = type(controller).__name__
    action = environment.get("action", "thrusts")
    controller = resolve_expert(controller, flown, "controller", layout, action)
    own = settings_of_model(controller)
    if own is not None:
        if vehicle is None:
            flown = own.vehicle
        # A model flies with its rotors where it knows them.
        if layout is None:
            environment["rotor_layout"] = own.layout
        environment.setdefault("action", own.action)
    environment.setdefault("max_episode_steps", MAX_EPISODE_STEPS)
    settings = FlightSettings().with_changes(task=task, vehicle=flown, noise=noise, **environment)
    warn_of_differences(name, controller, settings)
    return fly_settings(controller, settings, seeds, limits, hooks, record=record)


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


# It is long because its parts would share the arrays that each step changes.
def fly_settings(
    controller: Any,
    settings: FlightSettings,
    seeds: Sequence[int],
    tolerances: Sequence[float] = TOLERANCES,
    hooks: Sequence[Hook] = (),
    plan: Plan | None = None,
    deterministic: bool = True,
    record: StrPath | None = None,
) -> Flights:
    """Fly the first episode of each seed, as :func:`fly` does, with one record of settings. PyTorch
    has one thread meanwhile, unless you gave it another number.

    :param plan: the events of the episodes.
    :param deterministic: whether a policy gives the mean of its actions, or a sample.
    """
    limit = settings.max_episode_steps
    if isinstance(limit, list):
        raise ConfigError(f"max_episode_steps {limit}: must be one number, for all flights")
    plan = plan or Plan()
    course = Course(plan.waypoints, plan.radius)
    refuse_other_action(type(controller).__name__, controller, settings.action)
    seen: list[Float32Array] = []
    done: list[Float32Array] = []
    # Rows that are lost stay so, and flights end by their plan.
    endless = settings.with_changes(max_episode_steps=ENDLESS)
    fleet = QuadcopterBatch(len(seeds), endless, autoreset=False)
    fleet.seed(seeds)
    with one_thread_by_default():
        observations, _ = quadcopter_spaces(fleet.observation.size)
        pilot = Controller(
            controller, ACTIONS, observations, fleet.estimated_state, deterministic=deterministic
        )
        following = Following(fleet.moves)
        measuring = [
            course,
            Arrivals(tolerances, course),
            Motion(),
            Hover(course),
            following,
        ]
        watching = [*measuring, *hooks]
        control_step = fleet.vehicle_list[0].control_step
        fleet.reset()
        for name, values in plan.start.items():
            fleet.fix(name, values.T)
        observation = fleet.observe()
        # The state is a live view: copy what later steps need.
        state = fleet.true_state()
        start = state.copy()
        fleet.clear_outcome()
        # The outcome of the flights so far; for a lost flight it no longer changes.
        outcome = fleet.outcome.copy()
        flying = outcome["truncated"].copy()  # a flight survives until it is lost
        total = np.zeros(fleet.n)
        for hook in watching:
            hook.on_start(state, fleet.vehicle_list[0])

        for step in range(1, settings.longest_episode + 1):
            # Disturbances of the plan begin and end between two control steps.
            if step - 1 in plan.wrenches:
                fleet.wrench[:] = plan.wrenches[step - 1].T
            actions = _ask(pilot, observation, flying, (step - 1) * control_step)
            if record is not None:
                seen.append(observation[flying])
                # As the environment clips them.
                done.append(actions[flying].clip(-1.0, 1.0))
            observation, rewards, _ = fleet.step(actions)
            state = fleet.true_state()
            # This step also counts for the flights that it has ended.
            outcome[flying] = fleet.outcome[flying]
            total += np.where(flying, rewards, 0.0)
            flying = outcome["truncated"].copy()
            for hook in watching:
                hook.after_step(step, state, actions, flying)
            if not flying.any():
                break
            # Rows that have reached a waypoint see the next one from the next step on.
            onward, targets = course.next_targets()
            if onward.size and step < settings.longest_episode:
                fleet.state[TARGET, onward] = targets.T
                observation = fleet.observe()

        if record is not None:
            write_arrays(record, observations=np.concatenate(seen), actions=np.concatenate(done))
        measured: StrDict = {}
        for hook in measuring:
            measured |= hook.results()
        # Neither a course nor a moving target has a straight line to deviate from.
        measured["cross_track_error"][following.moves | (plan.waypoints.size > 0)] = np.nan
        for name in HOVERED:
            measured[name][following.moves] = np.nan
        offset = state.position - state.target
        return Flights(
            success=outcome["success"] & course.on_last,
            survival=flying | outcome["success"],
            collision=outcome["collision"],
            reward=total,
            length=outcome["length"],
            flown=outcome["length"] * control_step,
            final_error=outcome["distance"],
            final_offset=np.where(flying[:, None], offset, np.nan),
            start=start.array[:13].T,
            target=start.target,
            **measured,
        )


def _ask(
    pilot: Controller, observation: Float32Array, flying: BoolArray, time: float
) -> Float32Array:
    """Return the actions, (n, 4); an error says when it came, s."""
    try:
        return pilot.actions(observation, flying)
    except ControllerError as error:
        raise ControllerError(f"{error}, after {time:.2f} s") from error
