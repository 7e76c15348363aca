"""An exported file compared with the policy that it came from, in flights of the policy: the
largest difference.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.algorithms.chain import statistics_of
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.base.types import Float32Array, FloatArray
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import GROUPS, OBSERVATION_SIZE, turn_features
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.simulation.state import QuadcopterState, X
from sb3_quad.envs.simulation.tasks import TASKS, Task
from sb3_quad.envs.simulation.tracks import ACCELERATION_STD
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.export.load import Call

N_OBSERVATIONS = 10_000
# Control steps of a flight: for a policy that sees only the present features, and for one with a
# state
SHORT, LONG = 2, 1000
# A share of the range between least and greatest output: above rounding, which grows along a flight
# if an agent reacts strongly to its last actions, and far below any mistake
TOLERANCE = 1e-3
WIDE = TASKS["recovery_and_tracking"].model_copy(
    update={
        "target_distance": 30.0,
        "nearest_target": 0.0,
        "velocity_std": 4.0,
        "body_rates_std": 8.0,
    }
)
# Here the position integral is active from the first step on.
NEAR = Task(name="near", target_distance=1.0, nearest_target=0.0)
# References that files are checked with, slow enough to be followed for long.
MOVING = {
    "curve": "random_smooth",
    "speed": 1.5,
    "acceleration": 3.0,
    "heading": "random",
    "heading_rate": 1.0,
}
ROUNDING = 2e-6  # relative to the limits within which the position integral is active


class TrainedPolicy:
    """A trained policy in its own environment, with which an exported file must agree.

    :ivar action: what the policy's actions command.
    :ivar own: the vehicle in its own layout, which is the file's; ``vehicle``: in the layout that
        the policy knows.
    :ivar mean: μ of Eq. 3.16, (OBSERVATION_SIZE,), as in training; ``std``: σ, likewise;
        ``own_mean``: μ in the body frame of ``own``.
    :ivar clip: VecNormalize's bound of the scaled features; 0: none. Its statistics are part of μ
        and σ.
    :ivar observation: the frames that the policy sees.
    :ivar turn: from the vehicle's own axes and rotors, which are the file's, to that layout.

    :param settings: how the policy flies.
    :param vehicle: the vehicle that it flies; its layout may differ.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s) of the rotors; or ``rates``, the collective
        thrust (N) and body rates (rad/s), of a policy with ``action="rates"``.
    :raises ConfigError: a scaling that the environment refuses; a layout that does not fit;
        statistics for more than the present features; a policy of another output.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        settings: FlightSettings,
        vehicle: Vehicle,
        output: str = "thrusts",
    ) -> None:
        layout = settings.layout
        settings = settings.with_changes(vehicle=vehicle, rotor_layout=layout)
        mean, std = settings.scaling(1)
        self.model = model
        self.output = output
        self.action = settings.action
        self.own = vehicle
        self.vehicle = settings.load_vehicles()[0]
        self.mean = mean[:, 0]
        self.std = std[:, 0]
        self.observation = settings.observation
        self.clip = 0.0
        statistics = statistics_of(model)
        if statistics is not None:
            if self.observation.size != OBSERVATION_SIZE:
                raise ConfigError("VecNormalize with more than the present features has no export")
            self.clip = statistics.clip_obs
            self.mean = self.mean + self.std * statistics.obs_rms.mean
            self.std = self.std * np.sqrt(statistics.obs_rms.var + statistics.epsilon)
        self.turn = find_turn(vehicle, layout)
        if settings.action == "rates":
            low, high = 4.0 * np.array(self.vehicle.thrust_range)
            rates, _ = self.vehicle.rate_limits_and_gains
            self.limits = np.array([[low, *np.negative(rates)], [high, *rates]])
            if not np.allclose(self.turn.axes, np.eye(3)):
                raise ConfigError(
                    f"{vehicle.name}: its axes are turned from those of the agent's body rates; "
                    "turn rotor_positions in its file to the layout of the agent"
                )
        self.own_mean = self.mean @ turn_features(self.turn)

    def results(self, actions: Any) -> FloatArray:
        """Return rotor thrusts, N (Eq. 3.18), or speeds, rad/s (Eq. 2.4), of actions of any shape,
        or collective thrust and body rates, N and rad/s, of actions (..., 4), in float64.
        """
        if self.output == "rates":
            half = np.ptp(self.limits, axis=0) / 2.0
            commands: FloatArray = self.limits.mean(axis=0) + half * np.asarray(actions)
            return commands
        thrusts = self.vehicle.action_to_thrust(np.asarray(actions, np.float64))
        if self.output == "thrusts":
            return thrusts
        return np.sqrt(thrusts / self.vehicle.thrust_coefficient)


def compare(
    trained: TrainedPolicy,
    call: Call,
    by: str,
    n: int = N_OBSERVATIONS,
    relates: bool = False,
) -> tuple[float, int]:
    """Compare a file with the policy that it came from, in the policy's flights.

    The flights start at any attitude, up to 30 m from references that move and turn, with normal
    velocities of σ = 4 m/s and body rates of σ = 8 rad/s per axis, twice those at the start of an
    episode. A policy that sees only the present features flies two steps each time, so that half of
    the observations are such starts. The flights of a policy with a state are longer, and half of
    them start within 1 m.

    :param by: the program that runs the file, for the message.
    :param n: maximum number of observations, since a flight may end early.
    :param relates: whether the file also makes observations relative to references.
    :return: the largest difference of any result, N or rad/s, and the number of observations that
        were compared.
    :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not
        finite.
    """
    # Far and fast starts, or long flights for a policy with a state.
    task: Any = WIDE
    steps = SHORT
    if trained.observation.is_extended:
        task = {"recovery_and_tracking": 1.0, NEAR: 1.0}
        steps = LONG
    settings = FlightSettings().with_changes(
        task=task,
        **dict(trained.observation),
        observation_mean=trained.mean,
        observation_std=trained.std,
        vehicle=trained.vehicle,
        action=trained.action,
        max_episode_steps=ENDLESS,
        noise=0.0,
        reference=MOVING,
    )
    batch = QuadcopterBatch(max(n // steps, 1), settings, seed=0, autoreset=False)
    observation = batch.reset()
    compared = np.ones(batch.n, bool)
    # The file flies the vehicle in its own axes and order of rotors.
    turned = turn_features(trained.turn)
    integral = trained.observation.position_integral
    file_state = None
    error = 0.0
    count = 0
    for _ in range(steps):
        state = batch.true_state()
        if integral is not None:
            # So close to a limit, rounding may begin to integrate one step earlier or later.
            speed = np.linalg.norm(state.velocity - state.target_velocity, axis=1)
            for norm, limit in ((state.distance, integral.distance), (speed, integral.speed)):
                compared &= np.abs(norm / limit - 1.0) > ROUNDING
        references = []
        if relates:
            cosine, sine, rate = state.array[X.target_heading : X.target_heading_rate + 1]
            numbers = np.column_stack([state.target_velocity, np.arctan2(sine, cosine), rate])
            references = [numbers.astype(np.float32, order="C")]
        features = features_of(trained, observation, state, rests=relates)
        features[:, :OBSERVATION_SIZE] = features[:, :OBSERVATION_SIZE] @ turned
        results, file_state = call(features.astype(np.float32), file_state, *references)
        if trained.clip:
            observation = observation.clip(-trained.clip, trained.clip)
        actions, _ = trained.model.predict(observation, deterministic=True)
        if trained.output != "rates":
            results = results[:, trained.turn.order]
        difference = np.abs(results - trained.results(actions))
        error = float(np.max(difference[compared], initial=error))  # NaN stays
        count += compared.sum()
        # After a flight is lost, it is no longer compared.
        observation, _, lost = batch.step(actions)
        compared &= ~lost
    allowed = TOLERANCE * np.ptp(trained.results([[-1.0] * 4, [1.0] * 4]), axis=0).min()
    # Negated, so that NaN fails as well.
    if not error <= allowed:
        raise ExportError(
            f"the exported policy differs from the trained one by {error:.3g}, "
            f"{allowed:.3g} is allowed ({by}); nothing was written"
        )
    return error, count


def features_of(
    trained: TrainedPolicy, observation: Float32Array, state: QuadcopterState, rests: bool
) -> FloatArray:
    """Return what a file takes where the policy observes: its present features in physical units,
    and the previewed accelerations, (n, OBSERVATION_SIZE + 3 * previews).

    :param observation: of the policy, (n, ...), without noise; it begins with the present frame.
    :param state: the true state that it shows; headings are commanded.
    :param rests: return them as if the target rested in the world's axes, for a file that makes
        them relative to the reference itself.
    """
    n_ahead = 3 * len(trained.observation.preview or ())
    features = observation[:, :OBSERVATION_SIZE] * trained.std + trained.mean
    ahead = observation[:, observation.shape[1] - n_ahead :] * ACCELERATION_STD
    # From the world's axes to the reference's heading, column by column
    cosine, sine = state.target_heading.T
    zero = np.zeros(state.n)
    turns = np.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, zero + 1.0]]).T
    if trained.observation.position_integral is not None:
        # The policy sees the position with the integral added, which the file adds itself.
        offset = (state.position - state.target)[:, :, None]
        features[:, GROUPS["position"]] = (turns @ offset)[:, :, 0]
    if rests:
        to_body = features[:, GROUPS["rotation"]].reshape(-1, 3, 3) @ turns
        features[:, GROUPS["rotation"]] = to_body.reshape(-1, 9)
        features[:, GROUPS["velocity"]] += (to_body @ state.target_velocity[:, :, None])[:, :, 0]
        features[:, GROUPS["body_rates"]] += (
            state.array[X.target_heading_rate][:, None] * to_body[:, :, 2]
        )
        position = features[:, None, GROUPS["position"]] @ turns
        features[:, GROUPS["position"]] = position[:, 0]
        ahead = (ahead.reshape(state.n, -1, 3) @ turns).reshape(ahead.shape)
    return np.hstack([features, ahead])
