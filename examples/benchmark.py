"""Measure how many control steps per second this machine flies, differentiates and trains.

    python examples/benchmark.py
    python examples/benchmark.py --sizes 240 4096 --seconds 1

The batch flies random actions, with noise, rewards and resets. The gradient is a recorded flight
of 32 steps and its way back. A training step is one of a whole loop: rollout and update.

The last line compares a core of your machine with a core of the one on which the CPU seconds in the
documentation were measured: at 0.5, expect twice as many. It counts CPU seconds, so other programs
hardly matter.
"""

import argparse
import itertools
from collections.abc import Callable
from functools import partial
from time import process_time
from timeit import Timer
from typing import Any

import numpy as np

from sb3_quad import APG, PPOBC, DAgger, QuadcopterVecEnv

TASK = "state_recovery"
# Control steps/s of one core of the reference machine, with 240 rows
REFERENCE_ROWS = 240
REFERENCE_RATE = 9.15e6
RECORDED = 32  # control steps
TRAINED_ROWS = 256

# How many control steps a call flies, and the call
Subject = tuple[int, Callable[[], Any]]


def flying(rows: int) -> Subject:
    """A step of the batch."""
    env = QuadcopterVecEnv(rows, TASK, seed=0)
    env.reset()
    random = np.random.default_rng(0)
    actions = itertools.cycle(random.uniform(-1.0, 1.0, (16, rows, 4)).astype(np.float32))
    return rows, lambda: env.step(next(actions))


def differentiating() -> Subject:
    """Recorded flights of random actions, and the gradient of a cost of them."""
    env = QuadcopterVecEnv(TRAINED_ROWS, TASK, seed=0)
    tape = env.record(RECORDED)
    random = np.random.default_rng(0)
    actions = random.uniform(-1.0, 1.0, (RECORDED, TRAINED_ROWS, 4)).astype(np.float32)

    def cost(states: Any, actions: Any, counts: Any) -> tuple[float, Any, Any]:
        gradient = np.zeros_like(states)
        gradient[:, :3] = 2.0 * states[:, :3]
        return np.square(states[:, :3]).sum(), gradient, np.zeros_like(actions)

    def call() -> None:
        observations = tape.reset()
        nothing = np.zeros_like(observations)
        for action in actions:
            tape.step(action)
        tape.begin(cost)
        for step in reversed(range(RECORDED)):
            tape.backward(step, nothing)

    return RECORDED * TRAINED_ROWS, call


def training(algorithm: type) -> Subject:
    """One iteration of a training with the algorithm's own defaults."""
    env = QuadcopterVecEnv(TRAINED_ROWS, TASK, seed=0)
    expert = {} if algorithm is APG else {"expert": "pid"}
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", **expert)
    steps = model.n_steps * TRAINED_ROWS
    return steps, lambda: model.learn(steps)


def main() -> None:
    """Measure one after the other, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 240, 1024, 4096])
    parser.add_argument("--seconds", type=float, default=3.0, help="of each one (%(default)s)")
    options = parser.parse_args()
    subjects = {}
    for rows in options.sizes:
        subjects[f"batch, {rows} rows"] = partial(flying, rows)
    subjects["gradient"] = partial(differentiating)
    for algorithm in (DAgger, PPOBC, APG):
        subjects[f"{algorithm.__name__}, whole loop"] = partial(training, algorithm)
    for name, make in subjects.items():
        steps, call = make()
        call()  # compiles, and fills caches
        timer = Timer(call)
        count, elapsed = timer.autorange()
        count = max(1, round(count * options.seconds / elapsed))
        print(f"{name}: {steps * count / timer.timeit(count):,.0f} control steps/s")
    steps, call = flying(REFERENCE_ROWS)
    count, seconds = Timer(call, timer=process_time).autorange()
    speed = steps * count / seconds / REFERENCE_RATE
    print(f"this machine: {speed:.2f} times the reference, core by core")


if __name__ == "__main__":
    main()
