"""Copies and pickles of environments fly as the original does, and apart from it."""

import copy
import gc
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import sb3_quad  # noqa: F401  (registers the environments)
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv, QuadcopterVectorEnv
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings

ROWS, STEPS = 130, 60
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (2 * STEPS, ROWS, 4)).astype(np.float32)
TASK = {"target_tracking": 1.0, "state_recovery": 1.0}

FLY_ON = """
import pickle, sys
import numpy as np
env, actions = pickle.load(sys.stdin.buffer)
pickle.dump([env.step(action)[:3] for action in actions], sys.stdout.buffer)
"""


def fly(env, actions=ACTIONS[STEPS:]):
    return [env.step(action)[:3] for action in actions]


def elsewhere(env, actions=ACTIONS[STEPS:]):
    """The rest of the flight, by another process."""
    command = [sys.executable, "-c", FLY_ON]
    done = subprocess.run(command, input=pickle.dumps((env, actions)), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return pickle.loads(done.stdout)


def assert_same(flights, others):
    assert len(flights) == len(others)
    for ours, theirs in zip(flights, others, strict=True):
        for one, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(one, other)


def unpickled(env):
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("make", [QuadcopterVecEnv, QuadcopterVectorEnv])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, copy.copy, unpickled, elsewhere])
def test_a_copy_flies_the_same_and_apart(make, duplicate):
    env = make(ROWS, TASK, seed=4, max_episode_steps=90)
    env.reset()
    fly(env, ACTIONS[:STEPS])
    getattr(env, "batch", env).set_noise(np.linspace(0.0, 0.1, ROWS))  # rows are set apart
    other = duplicate(env)
    before = getattr(env, "batch", env).state.copy()
    flown = other if duplicate is elsewhere else fly(other)
    np.testing.assert_array_equal(getattr(env, "batch", env).state, before)
    assert_same(fly(env), flown)


def test_a_copy_outlives_the_original():
    env = QuadcopterVecEnv(ROWS, seed=4)
    env.reset()
    expected = fly(copy.deepcopy(env))
    other = copy.deepcopy(env)
    del env
    gc.collect()
    assert_same(expected, fly(other))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, unpickled, elsewhere])
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_a_copy_of_a_pybullet_environment_has_a_simulation_of_its_own(duplicate, render_mode):
    """The original and its copy agree to the bit, which poses that PyBullet gives and takes would not."""
    env = gymnasium.make("QuadStateRecovery-v0", render_mode=render_mode, render_width=32, render_height=32)
    env.reset(seed=1)
    fly(env, ACTIONS[:STEPS, 0])
    env.unwrapped.set_wrench((0.3, 0.0, 0.1), (0.0, 0.001, 0.0))
    other = duplicate(env) if duplicate is not elsewhere else None
    flown = elsewhere(env, ACTIONS[STEPS:, 0]) if other is None else fly(other, ACTIONS[STEPS:, 0])
    assert_same(fly(env, ACTIONS[STEPS:, 0]), flown)
    if other is not None:
        if render_mode is not None:
            np.testing.assert_array_equal(env.render(), other.render())
        env.close()
        fly(other, ACTIONS[:2, 0])
        other.close()


def test_copies_draw_the_same_picture():
    env = QuadcopterVecEnv(2, seed=0, render_mode="rgb_array", render_rows=[0, 1], render_width=32, render_height=32)
    env.reset()
    other = copy.deepcopy(env)
    for _ in range(3):
        fly(env, ACTIONS[:5, :2]), fly(other, ACTIONS[:5, :2])
        np.testing.assert_array_equal(env.render(), other.render())
    env.close()
    assert other.render().any()
    other.close()


def test_a_closed_environment_is_copied():
    env = QuadcopterEnv()
    env.close()
    other = copy.copy(env)
    assert other.reset(seed=0)[0] in other.observation_space
    other.close()


@pytest.mark.parametrize(
    ("name", "wrong", "says"),
    [
        ("task_index", np.full(3, 7), "task_index"),
        ("streams", np.zeros((4, 2), np.uint32), r"\(4, 2\)"),
        ("state", np.zeros((20, 3), np.float32), "float32"),
        ("vehicles", np.zeros((3, 3)), "vehicles"),
    ],
)
def test_arrays_that_compiled_code_would_misread_are_refused(name, wrong, says):
    batch = QuadcopterBatch(3, FlightSettings(task=TASK), seed=0)
    batch.reset()
    before = batch.snapshot()
    with pytest.raises(ConfigError, match=says):
        batch.restore({**before, name: wrong})
    for key, array in batch.snapshot().items():
        np.testing.assert_array_equal(array, before[key])
