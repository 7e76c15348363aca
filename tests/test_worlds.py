"""Random worlds: the same in both environments, of the row's own stream, within their ranges, and told to who asks."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.experts import geometric
from sb3_quad.experts.geometric import GeometricExpert, told_cautious, told_geometric
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QUATERNION, VELOCITY, P, W
from sb3_quad.vehicles.vehicle import load_vehicle

WORLDS = {
    "mass": [0.8, 1.25],
    "inertia": [0.7, 1.4],
    "motor_gain": [0.6, 1.6],
    "thrust": [0.9, 1.0],
    "arm": [0.9, 1.1],
    "center_of_mass": [-0.01, 0.01],
    "delay": [0, 3],
    "force": {"magnitude": [0, 5]},
    "torque": {"magnitude": [0, 0.1], "axes": [1, 1, 0.33]},
    "gusts": {"std": [0, 1], "time_constant": 0.5},
}
MEMORY = {"last_action": True, "history": [0, 1, 3], "position_integral": {}}


def episode(env, seed, actions):
    """States, observations and rewards of an episode until it ends."""
    observation, _ = env.reset(seed=seed)
    states, observations, rewards = [env.true_state().array[:, 0].copy()], [observation], []
    for action in actions:
        observation, reward, terminated, _, _ = env.step(action)
        states.append(env.true_state().array[:, 0].copy())
        observations.append(observation)
        rewards.append(reward)
        if terminated:
            break
    return map(np.array, (states, observations, rewards))


@settings(max_examples=15)
@given(
    st.integers(0, 2**32),
    st.sets(st.sampled_from(sorted(WORLDS)), min_size=1),
    st.sampled_from(["target_tracking", "state_recovery"]),
    st.sampled_from(["world", "body"]),
    st.booleans(),
)
def test_a_row_and_pybullet_fly_the_same_world(seed, names, task, frame, remembers):
    worlds = {name: WORLDS[name] for name in names}
    for name in {"force", "torque"} & names:
        worlds[name] = {**worlds[name], "frame": frame}
    keywords = {"task": task, "randomize": worlds, **(MEMORY if remembers else {})}
    n, steps = 3, 120
    actions = np.random.default_rng(seed).uniform(-0.6, 0.9, (steps, n, 4)).astype(np.float32)
    batch = QuadcopterBatch(n, FlightSettings(**keywords), seed=seed, autoreset=False)
    observations = [batch.reset()]
    states, rewards = [batch.state.copy()], []
    for action in actions:
        observation, reward, _ = batch.step(action)
        observations.append(observation)
        states.append(batch.state.copy())
        rewards.append(reward)
    single = QuadcopterEnv(**keywords)
    for row, own in enumerate(row_seeds(seed, n)):
        state, observation, reward = episode(single, own, actions[:, row])
        ours = np.array(states)[: len(state), :, row]
        ours[:, QUATERNION] *= np.sign((ours[:, QUATERNION] * state[:, QUATERNION]).sum(axis=1))[:, None]  # q is -q
        np.testing.assert_allclose(ours, state, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(np.array(rewards)[: len(reward), row], reward, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(np.array(observations)[: len(observation), row], observation, atol=5e-5)
    single.close()


def test_an_episode_has_a_world_of_its_own_within_the_ranges():
    n = 2000
    batch = QuadcopterBatch(n, FlightSettings(randomize={**WORLDS, "share": 0.7, "wrench_share": 0.6}), seed=0)
    nominal = load_vehicle("itm").parameters()
    batch.reset()
    first = batch.vehicles.copy()
    batch.reset()
    assert (batch.vehicles[P.mass] != first[P.mass]).mean() > 0.8
    factors = batch.vehicles / nominal[:, None]
    changed = factors[P.mass] != 1.0
    assert changed.mean() == pytest.approx(0.7, abs=0.05)
    assert (batch.vehicles[:, ~changed] == nominal[:, None]).all()
    for row, (low, high) in {P.mass: (0.8, 1.25), P.motor_gain: (0.6, 1.6), P.thrust_middle: (0.9, 1.0)}.items():
        values = factors[row, changed]
        assert values.min() >= low and values.max() <= high
        assert np.median(np.log(values)) == pytest.approx(np.log(low * high) / 2, abs=0.05 * np.log(high / low))
    inertia = batch.vehicles[[P.ixx, P.iyy, P.izz]]
    assert (2 * inertia.max(axis=0) <= inertia.sum(axis=0) * (1 + 1e-12)).all()
    assert [*np.unique(batch.vehicles[P.delay, changed])] == [0, 1, 2, 3]
    force = np.linalg.norm(batch.wrench[W.force_world : W.force_world + 3], axis=0)
    assert (force > 0).mean() == pytest.approx(0.6, abs=0.05)
    assert force.max() <= 5 and np.median(force[force > 0]) == pytest.approx(2.5, abs=0.3)
    torque = np.abs(batch.wrench[W.torque_body : W.torque_body + 3]).max(axis=1)
    assert torque[:2] == pytest.approx(0.1, abs=0.01) and torque[2] == pytest.approx(0.033, abs=0.003)


def test_a_copy_on_pybullet_flies_on_in_its_world():
    env = QuadcopterEnv(randomize={"mass": [0.5, 0.6], "inertia": [0.5, 0.6]}, noise=0.0)
    env.reset(seed=1)
    env.step(np.full(4, 0.3, np.float32))
    other = copy.deepcopy(env)
    for _ in range(20):
        np.testing.assert_array_equal(*(each.step(np.full(4, 0.3, np.float32))[0] for each in (env, other)))
    env.close()
    other.close()


def test_a_nominal_world_is_the_one_without_randomize():
    plain = QuadcopterVecEnv(64, task="state_recovery", seed=4)
    other = QuadcopterVecEnv(64, task="state_recovery", seed=4, randomize={"mass": [0.5, 1.2], "share": 0.0})
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 64, 4)).astype(np.float32)
    for env in (plain, other):
        env.reset()
    for action in actions:
        for ours, theirs in zip(plain.step(action)[:3], other.step(action)[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(("std", "unit", "newtons"), [(2.0, "SI", 2.0), (0.1, "weight", 0.1 * 1.727 * 9.81)])
def test_gusts_have_the_spread_and_the_memory_that_were_asked_for(std, unit, newtons):
    gusts = {"std": std, "unit": unit, "time_constant": 0.2}
    batch = QuadcopterBatch(4000, FlightSettings(randomize={"gusts": gusts}, max_episode_steps=10**6), seed=0)
    batch.reset()
    gusts = [batch.gust[:3].copy()]
    for _ in range(40):
        batch.step(np.zeros((4000, 4), np.float32))
        gusts.append(batch.gust[:3].copy())
    assert np.std(gusts[0], axis=1) == pytest.approx(newtons, rel=0.05)
    assert np.std(gusts[-1], axis=1) == pytest.approx(newtons, rel=0.05)
    normal = (gusts[-1] / newtons) ** 4  # whose mean is 3 if the gusts are
    assert np.mean(normal) == pytest.approx(3.0, abs=0.25)
    for steps in (10, 20):
        kept = [np.corrcoef(gusts[0][axis], gusts[steps][axis])[0, 1] for axis in range(3)]
        assert kept == pytest.approx([np.exp(-steps * 0.01 / 0.2)] * 3, abs=0.05)


def test_a_wrench_that_is_set_lasts_until_the_next_episode_brings_its_own():
    batch = QuadcopterBatch(2, FlightSettings(randomize={"force": [1.0, 1.0]}), seed=0)
    batch.reset()
    batch.set_wrench([3.0, 0.0, 0.0])
    batch.step(np.zeros((2, 4), np.float32))
    assert batch.wrench[W.force_world].tolist() == [3.0, 3.0]
    batch.reset(0)
    assert np.linalg.norm(batch.wrench[:, 0]) == pytest.approx(1.0) and batch.wrench[W.force_world, 1] == 3.0


@pytest.mark.parametrize("task", ["target_tracking", "state_recovery"])
def test_the_told_expert_stays_where_the_other_is_pushed_away(task):
    worlds = {"mass": [0.8, 1.2], "motor_gain": [0.7, 1.5], "force": [1.0, 4.0], "torque": {"magnitude": [0.0, 0.1]}}
    worlds["torque"]["axes"] = [1, 1, 0.33]
    errors = {}
    for expert in (GeometricExpert(), told_geometric()):
        batch = QuadcopterBatch(240, FlightSettings(task=task, randomize=worlds), seed=0, autoreset=False)
        batch.reset()
        for _ in range(1000):
            batch.step(expert.actions(batch.true_state()))
        errors[expert._told is not None] = np.median(batch.outcome["distance"])
    assert errors[True] < 0.01 < 0.1 < errors[False]


def test_who_is_told_of_a_nominal_world_flies_as_the_others():
    batch = QuadcopterBatch(240, FlightSettings(task="state_recovery"), seed=0)
    batch.reset()
    gains = GeometricExpert().gains
    plain = GeometricExpert(gains=gains.model_copy(update={"yaw_rate": geometric._TOLD_YAW * gains.yaw_rate}))
    told = told_geometric()
    for _ in range(100):
        state = batch.true_state()
        np.testing.assert_allclose(told.actions(state), plain.actions(state), atol=1e-5)
        batch.step(plain.actions(state))


def test_who_is_cautious_falls_less_fast_where_the_rotors_lift_hardly_more_than_weight_and_push():
    worlds = {"mass": [1.2, 1.25], "force": {"magnitude": [2, 4], "direction": [0, 0, -1]}}
    descent, survival = {}, {}
    for expert in (told_geometric(), told_cautious()):
        batch = QuadcopterBatch(480, FlightSettings(randomize=worlds), seed=0, autoreset=False)
        batch.reset()
        lowest, lost = np.zeros(480), np.zeros(480, bool)
        for _ in range(600):
            lost |= batch.step(expert.actions(batch.true_state()))[2]
            lowest = np.minimum(lowest, batch.state[VELOCITY][2])
        descent[expert.reserve > 0], survival[expert.reserve > 0] = -lowest.min(), 1.0 - lost.mean()
    assert survival[False] < survival[True] and descent[False] > 1.5 * descent[True]


@pytest.mark.parametrize(("told", "reserve"), [(True, -0.1), (False, 0.1)])
def test_a_reserve_is_for_who_is_told_and_not_negative(told, reserve):
    with pytest.raises(ConfigError, match="reserve"):
        GeometricExpert(told=told, reserve=reserve)


def test_several_vehicles_are_given_round():
    names = ["itm", "crazyflie", "hummingbird"]
    env = QuadcopterVecEnv(7, vehicle=names, seed=0, randomize={"mass": [0.9, 1.1]})
    assert [each.name for each in env.get_attr("vehicle")] == [names[row % 3] for row in range(7)]
    env.reset()
    for row, factor in enumerate(env.batch.vehicles[P.mass] / env.batch.base_vehicles[P.mass]):
        assert 0.9 <= factor <= 1.1, row


@pytest.mark.parametrize(
    ("worlds", "says"),
    [
        ({"weight": [1, 2]}, "unknown key 'weight'"),
        ({"mass": [1.25, 0.8]}, "exceeds"),
        ({"mass": [0, 2]}, "0.1"),
        ({"mass": [1.0, 1.6]}, "cannot hover"),
        ({"mass": [1, 2, 3]}, "must be [low, high]"),
        ({"motor_gain": [1, 10], "thrust": [1, 1]}, None),
        ({"delay": [0, 0.5]}, "whole control steps"),
        ({"delay": [0, 1000]}, "whole control steps"),
        ({"force": {"magnitude": [-1, 1]}}, "greater than or equal to 0"),
        ({"force": {"magnitude": [0, 1], "direction": [0, 0, 0]}}, "must not be zero"),
        ({"center_of_mass": {"low": -1, "high": 1, "distribution": "log_uniform"}}, "greater than 0"),
        ({"gusts": {"std": [0, 1], "time_constant": 0}}, "greater than 0"),
        ({"share": 1.5}, "share"),
        ("mass", "randomize"),
    ],
)
def test_worlds_that_cannot_be_are_refused_in_one_line(worlds, says):
    if says is None:
        QuadcopterVecEnv(1, randomize=worlds)
        return
    with pytest.raises(ConfigError, match=r".*") as error:
        QuadcopterVecEnv(1, randomize=worlds)
    assert says in str(error.value) and "\n" not in str(error.value)
