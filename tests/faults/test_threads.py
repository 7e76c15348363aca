"""Threads and interrupts: a step is done whole or not begun, and no memory is written that is not the step's own."""

import multiprocessing
import subprocess
import sys
import threading

import numpy as np
import pytest

from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv, QuadcopterVectorEnv
from sb3_quad.simulation.batch import QuadcopterBatch

TASK = {"target_tracking": 1.0, "state_recovery": 1.0}

# After every interrupt a batch flies on as one whose steps are not interrupted. A timer interrupts at any moment of a step;
# more threads than cores make workers late.
INTERRUPTED = """
import random, signal, sys
import numpy as np
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation import threads

threads.REST = 0  # so that no step does without its threads
rows = 1280
random.seed(0)
actions = np.random.default_rng(0).uniform(-1.0, 1.0, (rows, 4)).astype(np.float32)
batch = QuadcopterBatch(rows, FlightSettings(max_episode_steps=200), seed=1, n_threads=8)
other = QuadcopterBatch(rows, FlightSettings(max_episode_steps=200), seed=2, n_threads=1)
batch.reset()
signal.signal(signal.SIGALRM, signal.default_int_handler)
steps = 0
for interrupt in range(400):
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(2e-5, 3e-3))
        while True:
            batch.step(actions)
            batch.observe()
            if steps % 50 == 0:
                batch.set_max_episode_steps(200)
            steps += 1
    except KeyboardInterrupt:
        pass
    other.restore(batch.snapshot())
    for _ in range(2):
        for ours, theirs in zip(batch.step(actions), other.step(actions), strict=True):
            np.testing.assert_array_equal(ours, theirs)
assert steps > 100, steps
"""


def from_threads(call, n=4):
    """Call from several threads at once; what they raised."""
    errors = []

    def loop():
        try:
            call()
        except Exception as error:  # told to the test
            errors.append(error)

    threads = [threading.Thread(target=loop) for _ in range(n)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


@pytest.mark.slow
def test_interrupted_steps_leave_nothing_behind():
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("make", [QuadcopterVecEnv, QuadcopterVectorEnv])
def test_one_environment_is_stepped_from_several_threads(make):
    env = make(1000, TASK, seed=0, n_threads=3, max_episode_steps=50)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 4)).astype(np.float32)
    kept = []

    def fly():
        for k in range(150):
            observations, rewards = env.step(actions)[:2]
            kept.append((observations, observations.copy(), rewards, rewards.copy()))
            if k % 20 == 0:
                batch = getattr(env, "batch", env)
                batch.set_noise(np.full(1000, 0.01))
                batch.set_task(TASK if k % 40 else "state_recovery")

    assert from_threads(fly) == []
    for observations, then, rewards, rewards_then in kept:  # no step writes into another's arrays
        np.testing.assert_array_equal(observations, then)
        np.testing.assert_array_equal(rewards, rewards_then)
    batch = getattr(env, "batch", env)
    assert np.isfinite(batch.state).all() and (batch.task_index < batch.tasks.weights.size).all()


def test_several_environments_share_the_workers():
    """Each in a thread of its own, they fly as they do one after the other."""
    actions = np.zeros((400, 4), np.float32)

    def flown(seed):
        batch = QuadcopterBatch(400, seed=seed, n_threads=4)
        batch.reset()
        return [batch.step(actions)[0] for _ in range(100)][-1]

    expected = [flown(seed) for seed in range(4)]
    results = {}
    seeds = iter(range(4))
    assert from_threads(lambda: results.update({(seed := next(seeds)): flown(seed)})) == []
    for seed in range(4):
        np.testing.assert_array_equal(results[seed], expected[seed])


def test_one_pybullet_environment_is_stepped_from_several_threads():
    env = QuadcopterEnv(task_kwargs={"start_position": (0.0, 0.0, 500.0), "max_distance": 1e4})
    env.reset(seed=0)
    action = env.vehicle.hover_action * np.ones(4, np.float32)

    def fly():
        for _ in range(100):
            env.step(action)

    assert from_threads(fly) == []
    assert env.batch.streams[3, 0] == 400  # as many control steps as there were calls
    assert abs(env.true_state().position[0, 2] - 500.0) < 0.1
    env.close()


@pytest.mark.slow
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_a_fork_while_a_step_is_under_way_can_step():
    env = QuadcopterBatch(300, seed=0, n_threads=2)
    env.reset()
    actions = np.zeros((300, 4), np.float32)
    with env.lock:  # as of another thread's step
        child = multiprocessing.get_context("fork").Process(target=from_threads, args=(lambda: env.step(actions), 1))
        child.start()
        child.join(30)
        alive = child.is_alive()
        child.kill()
    assert not alive and child.exitcode == 0
