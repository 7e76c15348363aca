"""Tasks, observations and random numbers: what the compiled array functions must be, worked out
again in numpy.
"""

import math

import numba
import numpy as np
import pytest

from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import (
    DEFAULT_STD,
    FEATURE_NAMES,
    GROUPS,
    OBSERVATION_SIZE,
    turn_features,
)
from sb3_quad.envs.simulation.random import EPISODE, STEP, philox
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    QUATERNION,
    ROTOR_SPEEDS,
    TARGET,
    VELOCITY,
    QuadcopterState,
)
from sb3_quad.envs.simulation.tasks import SCORED, TASK, T, Task, resolve_tasks
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import load_vehicle

ITM = load_vehicle("itm")


def start(n, task, seed=0, **task_kwargs):
    """n rows at the start of their first episode."""
    rows = QuadcopterBatch(
        n, FlightSettings(task=task, task_kwargs=task_kwargs), n_threads=1, autoreset=False
    )
    rows.seed(range(seed, seed + n))
    rows.reset()
    return rows


def observations(rows, noise):
    rows.set_noise(noise)
    return rows.observe()


def scores(rows):
    """The outcome of a control step that has left the rows as they are."""
    rows.score(np.zeros((rows.n, 4)))
    return rows.outcome


# --- random numbers


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (0x00000000, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        (0xFFFFFFFF, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ],
)
def test_philox_gives_the_published_numbers(word, expected):
    in_compiled_code = numba.njit(lambda w: philox(w, w, w, w, w, w))
    assert in_compiled_code(np.uint32(word)) == expected


def noise_of(n, steps, task="state_recovery"):
    """Standard normals as they come out of observations, (steps, n, 15)."""
    rows = start(n, task)
    clean = observations(rows, 0.0)[:, 3:].astype(
        np.float64
    )  # the first three are zero in state recovery
    normals = []
    for _ in range(steps):
        rows.streams[STEP] += 1
        normals.append(observations(rows, 1.0)[:, 3:] / clean - 1.0)
    return np.array(normals)


def test_noise_is_standard_normal_and_independent():
    normals = noise_of(500, 400)
    flat = normals.ravel()
    count = flat.size  # 3,000,000: five standard errors below
    assert abs(flat.mean()) < 5 / math.sqrt(count)
    assert abs(flat.std() - 1.0) < 5 / math.sqrt(2 * count)
    assert abs((flat**3).mean()) < 5 * math.sqrt(15 / count)
    assert abs((flat**4).mean() - 3.0) < 5 * math.sqrt(96 / count)
    assert 4.5 < np.abs(flat).max() < 6.6
    quantiles = {0.5: 0.0, 0.8413447: 1.0, 0.9772499: 2.0, 0.9986501: 3.0}
    for probability, expected in quantiles.items():
        assert np.quantile(flat, probability) == pytest.approx(expected, abs=0.02)
    by_feature = np.corrcoef(normals.reshape(-1, 15).T)
    by_row = np.corrcoef(normals.transpose(1, 0, 2).reshape(500, -1))
    by_step = np.corrcoef(normals.reshape(400, -1))
    for correlations, samples in ((by_feature, 200_000), (by_row, 6_000), (by_step, 7_500)):
        assert np.abs(correlations - np.eye(len(correlations))).max() < 6 / math.sqrt(samples)


# --- observation


def test_features_in_their_order():
    rows = start(200, "state_recovery", seed=5)
    rows.state[TARGET] += np.random.default_rng(0).normal(size=(3, 200))
    state = QuadcopterState(rows.state)
    body_to_world = state.rotation
    expected = np.concatenate(
        [
            state.position - state.target,
            body_to_world.transpose(0, 2, 1).reshape(-1, 9),
            np.einsum("nji,nj->ni", body_to_world, state.velocity),
            state.body_rates,
        ],
        axis=1,
    )
    np.testing.assert_allclose(observations(rows, 0.0), expected / DEFAULT_STD, atol=1e-6)
    assert len(FEATURE_NAMES) == OBSERVATION_SIZE == 18
    assert FEATURE_NAMES[GROUPS["body_rates"]] == ("body_rate_x", "body_rate_y", "body_rate_z")


def features_of(state):
    """The features of a state in their units, without noise, (n, 18)."""
    batch = QuadcopterBatch(state.n, FlightSettings(noise=0.0))
    batch.state[:] = state.array
    return batch.observe() * DEFAULT_STD


def test_turned_features_are_those_of_the_turned_vehicle():
    """A body whose axes are turned about z sees the same flight in its own axes."""
    turn = find_turn(load_vehicle("hummingbird"), ITM)
    state = QuadcopterState(start(50, "recovery_and_tracking", seed=2).state)
    turned = state.copy()
    angle = -turn.angle / 2.0
    w, x, y, z = state.array[QUATERNION]
    c, s = math.cos(angle), math.sin(angle)
    turned.array[QUATERNION] = (w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s)
    turned.array[BODY_RATES] = turn.axes @ state.array[BODY_RATES]
    matrix = turn_features(turn)
    np.testing.assert_allclose(features_of(state) @ matrix.T, features_of(turned), atol=1e-5)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(OBSERVATION_SIZE), atol=1e-12)


def test_a_number_is_short_for_relative_noise():
    first, second = (
        QuadcopterVecEnv(8, noise=noise, seed=1).reset() for noise in (0.05, {"relative": 0.05})
    )
    np.testing.assert_array_equal(first, second)
    assert FlightSettings(noise=0.1).model_dump(mode="json")["noise"] == 0.1


# --- starts


def test_target_tracking_starts():
    rows = start(8_000, "target_tracking")
    state = QuadcopterState(rows.state)
    np.testing.assert_array_equal(state.position, np.tile([0.0, 0.0, 15.0], (8_000, 1)))
    np.testing.assert_array_equal(state.quaternion, np.tile([1.0, 0, 0, 0], (8_000, 1)))
    assert not state.velocity.any() and not state.body_rates.any()
    np.testing.assert_allclose(rows.state[ROTOR_SPEEDS], ITM.hover_rotor_speed)
    np.testing.assert_allclose(rows.queue, ITM.hover_rotor_speed)
    direction = (state.target - state.position) / 10.0
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)
    np.testing.assert_allclose(direction.mean(axis=0), 0.0, atol=5 * math.sqrt(1 / 3 / 8_000))
    np.testing.assert_allclose(direction.T @ direction / 8_000, np.eye(3) / 3, atol=0.015)


def test_state_recovery_starts():
    rows = start(8_000, "state_recovery")
    state = QuadcopterState(rows.state)
    np.testing.assert_array_equal(state.target, state.position)
    np.testing.assert_allclose(np.linalg.norm(rows.state[QUATERNION], axis=0), 1.0)
    rotation = state.rotation
    np.testing.assert_allclose(rotation.mean(axis=0), 0.0, atol=5 * math.sqrt(1 / 3 / 8_000))
    angle = np.arccos(np.clip((np.trace(rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
    for theta in (0.5, 1.0, 2.0, 3.0):  # uniform on SO(3): P(angle < θ) = (θ - sin θ) / π
        assert (angle < theta).mean() == pytest.approx(
            (theta - math.sin(theta)) / math.pi, abs=0.02
        )
    for values, std in ((state.velocity, 2.0), (state.body_rates, 4.0)):
        np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=5 * std / math.sqrt(8_000))
        np.testing.assert_allclose(values.std(axis=0), std, rtol=5 / math.sqrt(2 * 8_000))
    together = np.corrcoef(
        np.concatenate([rows.state[QUATERNION], rows.state[VELOCITY.start : BODY_RATES.stop]])
    )
    assert np.abs(together - np.eye(10)).max() < 0.04


@pytest.mark.parametrize("distance", [15.0, 40.0])
def test_targets_are_never_below_ground(distance):
    rows = start(5_000, "target_tracking", target_distance=distance, max_distance=60.0)
    state = QuadcopterState(rows.state)
    np.testing.assert_allclose(state.distance, distance)
    height = state.target[:, 2]
    lowest = max(15.0 - distance, ITM.collision_radius + 0.25)
    assert height.min() >= lowest - 1e-9
    assert height.mean() == pytest.approx((lowest + 15.0 + distance) / 2, rel=0.03)


def test_a_reset_touches_the_rows_it_names_and_counts_their_episodes():
    rows = start(5, "state_recovery")
    before, streams = rows.state.copy(), rows.streams.copy()
    rows.streams[STEP] = 9
    rows.reset(np.array([1, 3]))
    np.testing.assert_array_equal(rows.state[:, [0, 2, 4]], before[:, [0, 2, 4]])
    assert (
        rows.state[QUATERNION.start : BODY_RATES.stop, [1, 3]]
        != before[QUATERNION.start : BODY_RATES.stop, [1, 3]]
    ).all()
    assert rows.streams[EPISODE].tolist() == [1, 2, 1, 2, 1] and rows.streams[STEP].tolist() == [
        9,
        0,
        9,
        0,
        9,
    ]
    np.testing.assert_array_equal(rows.streams[:2], streams[:2])


def test_a_mixture_samples_tasks_by_their_weights():
    rows = start(8_000, {"target_tracking": 3.0, "state_recovery": 1.0})
    recovery = rows.task_index == 1
    assert recovery.mean() == pytest.approx(0.25, abs=0.02)
    state = QuadcopterState(rows.state)
    np.testing.assert_allclose(state.distance, np.where(recovery, 0.0, 10.0))
    assert (np.linalg.norm(state.velocity, axis=1) > 0).tolist() == recovery.tolist()
    never = start(1000, {"target_tracking": 0.0, "state_recovery": 1.0})
    assert (never.task_index == 1).all()


# --- reward and ends


def test_reward_and_ends_of_each_task():
    rows = start(300, {"target_tracking": 1.0, "state_recovery": 1.0})
    rng = np.random.default_rng(0)
    rows.state[:3] += rng.normal(size=(3, 300)) * 12
    rows.task_parameters[1, T.tilt_cost] = 0.5
    got, state = scores(rows), QuadcopterState(rows.state)
    tilt_cost = np.where(rows.task_index == 1, 0.5, 0.002)
    collided, away = state.position[:, 2] <= 0.135, state.distance > 30.0
    assert 3 < collided.sum() < 100 and 3 < away.sum() < 100
    expected = -0.003 * state.distance - tilt_cost * np.arccos(
        np.clip(state.rotation[:, 2, 2], -1, 1)
    )
    expected -= 0.0005 * np.linalg.norm(state.body_rates, axis=1) + 15.0 * collided + 15.0 * away
    np.testing.assert_allclose(got["reward"], expected, atol=1e-12)
    np.testing.assert_allclose(got["distance"], state.distance)
    np.testing.assert_array_equal(got["collision"], collided)
    np.testing.assert_array_equal(got["out_of_range"], away)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.7, math.pi - 1e-6, math.pi])
def test_tilt_is_exact_at_every_angle(angle):
    rows = start(1, "target_tracking", tilt_cost=1.0, position_cost=0.0, body_rates_cost=0.0)
    rows.state[QUATERNION, 0] = (
        math.cos(angle / 2),
        0.6 * math.sin(angle / 2),
        0.8 * math.sin(angle / 2),
        0.0,
    )
    assert scores(rows)["reward"][0] == pytest.approx(-angle, rel=1e-12, abs=1e-12)


def test_a_slow_level_touch_at_the_target_is_a_landing_and_any_other_a_collision():
    rows = start(5, "landing", touchdown_speed=0.3)
    rows.state[:] = 0.0
    rows.state[QUATERNION.start] = 1.0
    rows.state[2] = ITM.collision_radius - 1e-3
    rows.state[0, :2] = 0.09, 0.11  # away from the target, which is further down
    rows.state[TARGET.stop - 1] = -0.5
    rows.state[VELOCITY.stop - 1] = -0.29, -0.29, -0.31, -0.29, 0.0
    rows.state[QUATERNION.start + 1, 3] = 0.1  # tilted by 11 degrees
    rows.state[2, 4] = 0.5  # above the ground
    rows.state[TARGET.stop - 1, 4] = 0.5
    rows.state[QUATERNION] /= np.linalg.norm(rows.state[QUATERNION], axis=0)
    outcome = scores(rows)
    assert outcome["success"].tolist() == [True, False, False, False, False]
    assert outcome["collision"].tolist() == [False, True, True, True, False]
    assert outcome["truncated"].tolist() == [False, False, False, False, True]
    assert (outcome["reward"] > -1.0).tolist() == [True, False, False, False, True]


# --- tasks as data


def test_task_specifications():
    own = Task(name="own", target_distance=3.0)
    np.testing.assert_array_equal(resolve_tasks(own)[0], own.parameters()[None])
    assert list(TASK)[-len(SCORED) :] == SCORED  # the kernel copies them as one piece
    parameters, weights = resolve_tasks(
        {"target_tracking": 1, "state_recovery": 3}, {"max_distance": 50}
    )
    assert weights.tolist() == [0.25, 1.0]
    assert parameters[:, T.max_distance].tolist() == [50.0, 50.0]
    assert parameters.shape == (2, sum(TASK.values()))


def test_a_named_mixture_is_the_mixture_written_out():
    task = {"state_recovery": 0.6, "far_tracking": 0.4}
    costs = {"precision_cost": 0.03, "nearest_target": 0.0}
    settings = (
        FlightSettings(task="thesis_recovery"),
        FlightSettings(task=task, task_kwargs=costs, max_episode_steps=500),
    )
    named, written_out = (QuadcopterBatch(40, each, seed=0) for each in settings)
    named.reset(), written_out.reset()
    theirs = written_out.snapshot()
    for name, array in named.snapshot().items():
        np.testing.assert_array_equal(array, theirs[name])
    np.testing.assert_array_equal(named.max_steps, written_out.max_steps)
    np.testing.assert_array_equal(named.task_parameters, written_out.task_parameters)
