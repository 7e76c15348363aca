"""The PyBullet environment: Gymnasium's and SB3's contracts, its physics against written-out
equations, bad input.
"""

import copy
import pickle
import re
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_quad.envs.batch_env import FlightKeywords
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.simulation.settings import FlightSettings

IDS = ["QuadTargetTracking-v0", "QuadStateRecovery-v0"]


@pytest.fixture
def env():
    made = QuadcopterEnv(noise=0.0)
    yield made
    made.close()


@pytest.mark.parametrize(("env_id", "render_mode"), zip(IDS, [None, "rgb_array"], strict=True))
def test_both_checkers_pass(env_id, render_mode, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium's checker warns that the observation is unbounded, by design (thesis 3.3.1).
        warnings.filterwarnings(
            "ignore", message=".*A Box observation space m[a-z]+imum value is -?infinity.*"
        )
        env = gymnasium.make(env_id, render_mode=render_mode)
        check_env(
            env.unwrapped
        )  # makes one in human mode, too: without a display that flies without a window
        env = gymnasium.make(env_id, render_mode=render_mode)
        sb3_check_env(env.unwrapped, skip_render_check=render_mode is None)
        env.close()


def test_hovers_on_zero_action(env):
    env.reset(seed=0, options={"target": (1.0, 2.0, 15.0)})
    for _ in range(100):
        _, reward, terminated, truncated, info = env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().position[0], [0, 0, 15], atol=1e-9)
    np.testing.assert_allclose(info["distance"], np.sqrt(5.0))
    np.testing.assert_allclose(reward, -0.003 * np.sqrt(5.0))
    assert info["survival"] and not info["is_success"] and not terminated and not truncated


def test_ends_on_touching_the_ground(env):
    env.reset(
        seed=0,
        options={"state": {"position": (0, 0, 0.3), "velocity": (0, 0, -2)}, "target": (0, 0, 5)},
    )
    for _ in range(100):
        _, reward, terminated, _, info = env.step(-np.ones(4, dtype=np.float32))
        height = env.true_state().position[0, 2]
        assert (
            terminated
            == (height <= env.vehicle.collision_radius)
            == info["collision"]
            == (not info["survival"])
        )
        if terminated:
            break
    assert terminated and reward < -15 and not info["out_of_range"]
    assert height > 0.1  # stopped on the step of the contact, before it bounces


def test_a_wrench_acts_until_another_is_set(env):
    env.reset(seed=0)
    env.set_wrench(force=(1.727, 0, 0))
    for _ in range(10):
        env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().velocity[0], [0.1, 0, 0], atol=1e-12)
    env.set_wrench()
    env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().velocity[0], [0.1, 0, 0], atol=1e-12)


def test_fixed_start(env):
    start = {
        "position": (1, 2, 3),
        "quaternion": (0, -2, 0, 0),
        "velocity": (2, 2, 0),
        "body_rates": (4, 4, 4),
    }
    observation, info = env.reset(seed=0, options={"state": start, "target": (1, 2, 4)})
    state = env.true_state()
    np.testing.assert_array_equal(state.position[0], [1, 2, 3])
    np.testing.assert_array_equal(state.quaternion[0], [0, -1, 0, 0])
    np.testing.assert_array_equal(state.body_rates[0], [4, 4, 4])
    np.testing.assert_allclose(
        observation * env.observation_std,
        [0, 0, -1, 1, 0, 0, 0, -1, 0, 0, 0, -1, 2, -2, 0, 4, 4, 4],
        atol=1e-6,
    )
    assert info["distance"] == 1.0


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full(4, np.nan), "finite"),
        (np.zeros(3), r"\(3,\).*\(4,\)"),
        (np.zeros((1, 4)), r"\(1, 4\).*\(4,\)"),
    ],
)
def test_bad_actions_raise(env, action, message):
    env.reset(seed=0)
    before = env.true_state().copy().array
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.true_state().array, before)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_flies_on_by_itself(copied):
    env = QuadcopterEnv("state_recovery", vehicles={"distribution": "raptor"})
    env.reset(seed=1)
    action = np.full(4, 0.1, dtype=np.float32)
    for _ in range(20):
        env.step(action)
    other = copied(env)
    ahead = [other.step(action)[0] for _ in range(20)]
    np.testing.assert_allclose([env.step(action)[0] for _ in range(20)], ahead, atol=1e-6)
    env.close()
    other.step(action)
    other.close()


def test_closing_twice_leaves_other_environments_open():
    first, second = QuadcopterEnv(), QuadcopterEnv()
    with pytest.raises(gymnasium.error.ResetNeeded):
        first.step(np.zeros(4, dtype=np.float32))
    first.reset(seed=0), second.reset(seed=0)
    first.close()
    first.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        first.step(np.zeros(4, dtype=np.float32))
    third = QuadcopterEnv()  # takes the client number that is free again
    third.reset(seed=1)
    first.close()
    for env in (second, third):
        assert np.isfinite(env.step(np.zeros(4, dtype=np.float32))[0]).all()
        env.close()
    first.reset(seed=0)  # opens a new simulation
    first.step(np.zeros(4, dtype=np.float32))
    first.close()


def test_the_manual_lists_every_argument():
    table = (QuadcopterEnv.__doc__ or "").split("## Arguments")[1].split("## While")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.strip().startswith("| `")]
    listed = {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}
    drawn = {"render_mode", "render_width", "render_height"}
    # max_episode_steps is an argument of gymnasium.make.
    assert listed == {*FlightSettings.model_fields, *drawn} - {"max_episode_steps"}


def test_the_typed_keywords_are_the_flight_settings():
    typed = {"task", *FlightKeywords.__annotations__}
    assert typed == FlightSettings.model_fields.keys()
