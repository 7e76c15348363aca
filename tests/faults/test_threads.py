"""Threads and interrupts: a step is done whole or not begun, and no memory is written that is not
the step's own.
"""

import multiprocessing
import subprocess
import sys
import threading

import numpy as np
import pytest

from sb3_quad.envs.simulation.batch import QuadcopterBatch

# After every interrupt a batch flies on as one whose steps are not interrupted. A timer interrupts
# at any moment of a step; more threads than cores make workers late.
INTERRUPTED = """
import random, signal, sys
import numpy as np
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation import threads

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
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


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


@pytest.mark.slow
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_a_forked_child_can_step():
    env = QuadcopterBatch(300, seed=0, n_threads=2)
    env.reset()
    actions = np.zeros((300, 4), np.float32)
    env.step(actions)
    child = multiprocessing.get_context("fork").Process(
        target=from_threads, args=(lambda: env.step(actions), 1)
    )
    child.start()
    child.join(30)
    alive = child.is_alive()
    child.kill()
    assert not alive and child.exitcode == 0
