"""Measure sb3_quad and other projects on one core: simulation, gradients and trainings.

    make compare-projects                       # installs the others into .venv-transfer
    make compare-projects ARGS="--only batch"   # the rows that have this in their names

Rates are control steps of 10 ms per CPU second, so other programs hardly matter. Ours observe with
noise, reward and begin episodes again; the others only move their vehicles.

A training starts from nothing and ends when it reaches its last goal, at the end of its recipe, or
after 600 CPU seconds. Goals are shares of 960 fresh recoveries that succeed; to fly them takes no
part of the time.
"""

import argparse
import importlib
import os
import subprocess
import sys
from functools import partial
from time import process_time
from timeit import Timer

import numpy as np

RECORDED = 32  # control steps of which a gradient is taken
GOALS = (0.9, 0.99)
BUDGET = 600.0  # CPU s
EVERY = 8  # rollouts between two evaluations


def rate(make, *arguments):
    """Control steps per CPU second, the best of five tries.

    :param make: returns how many control steps a call flies, and the call.
    """
    steps, call = make(*arguments)
    call()  # compiles
    timer = Timer(call, timer=process_time)
    count, _ = timer.autorange()
    return f"{steps * count / min(timer.repeat(5, count)):,.0f} control steps per CPU second"


def ours(call, *rows):
    """A call of examples/benchmark.py."""
    import benchmark

    return getattr(benchmark, call)(*rows)


def elsewhere(project, cell, rows):
    """A simulator as the transfer table flies it."""
    from flights import sample_starts

    simulator = importlib.import_module(f"in_{project}").CELLS[cell].make(rows)
    simulator.reset(sample_starts("targets", rows, 0)[0])
    return rows, partial(simulator.step, np.full((rows, 4), simulator.hover))


def crazyflow(rows, gradient=False):
    """Its first principles with its own defaults, as its benchmark flies them."""
    import jax
    import jax.numpy as jnp
    from crazyflow.control import Control
    from crazyflow.sim import Sim
    from crazyflow.sim.functional import rotor_vel_control

    sim = Sim(n_worlds=rows, control=Control.rotor_vel)
    sim.reset()
    physics = sim.build_step_fn()
    commands = jnp.full((RECORDED, rows, 1, 4), 15000.0)  # rpm

    @jax.jit
    def step(data, command):
        data = physics(rotor_vel_control(data, command), 5)  # of 2 ms
        return data, jnp.square(data.states.pos).sum()

    def fly():
        sim.data, _ = jax.block_until_ready(step(sim.data, commands[0]))

    def cost(commands):
        return jax.lax.scan(step, sim.data, commands)[1].sum()

    if not gradient:
        return rows, fly
    slope = jax.jit(jax.grad(cost))
    return RECORDED * rows, lambda: jax.block_until_ready(slope(commands))


def imitate_and_descend(watch):
    """DAgger and APG, the recipe of docs/apg.md."""
    from stable_baselines3.common.utils import LinearSchedule

    from sb3_quad import APG, DAgger, QuadcopterVecEnv

    tasks = {"state_recovery": 0.65, "target_tracking": 0.35}
    harder = {"velocity_std": 2.6, "body_rates_std": 5.5}
    env = QuadcopterVecEnv(256, task=tasks, seed=0)
    clone = DAgger("MlpPolicy", env, expert="geometric", seed=0).learn(500_000, watch)
    env = QuadcopterVecEnv(128, task=tasks, task_kwargs=harder, seed=1)
    descent = LinearSchedule(1.2e-2, 0.0, 1.0)
    agent = APG("MlpPolicy", env, descent, initial_policy=clone, seed=0)
    agent.learn(240 * 128 * 300, watch)


def reinforce(watch):
    """SB3's PPO, with the settings of ppo.yml."""
    from stable_baselines3 import PPO

    from sb3_quad import QuadcopterVecEnv
    from sb3_quad.training.config import load_config

    recipe = load_config("ppo", "QuadStateRecovery-v0")
    env = QuadcopterVecEnv(recipe.n_envs, seed=0, **recipe.env_kwargs)
    settings = {"policy_kwargs": recipe.policy_kwargs, **recipe.hyperparams}
    agent = PPO(recipe.policy, env, **settings, seed=0, device="cpu")
    agent.learn(recipe.n_timesteps, watch)


def train(learn):
    """When it reached each goal, and its best share."""
    from stable_baselines3.common.callbacks import BaseCallback

    from sb3_quad import fly

    class Watch(BaseCallback):
        began = process_time()
        rollouts = 0
        best = 0.0
        spent = 0.0
        reached: dict[float, float] = {}

        def _on_step(self):
            return process_time() - self.began < BUDGET and len(self.reached) < len(GOALS)

        def _on_rollout_end(self):
            self.rollouts += 1
            if self.rollouts % EVERY == 0:
                self.evaluate()

        def _on_training_end(self):
            self.evaluate()

        def evaluate(self):
            self.spent = process_time() - self.began
            share = float(fly(self.model, "state_recovery", 960, seed=5).success.mean())
            self.best = max(self.best, share)
            for goal in GOALS:
                if share >= goal:
                    self.reached.setdefault(goal, round(self.spent))
            self.began = process_time() - self.spent

    watch = Watch()
    learn(watch)
    ended = f"{watch.num_timesteps:,} timesteps in {watch.spent:.0f} CPU s"
    return f"{watch.reached} CPU s, {watch.best:.2%} at best, {ended}"


SUBJECTS = {
    "gradient of 256: sb3_quad": partial(rate, ours, "differentiating"),
    "gradient of 256: crazyflow": partial(rate, crazyflow, 256, True),
    "recoveries: sb3_quad": partial(train, imitate_and_descend),
    "recoveries: SB3's PPO in sb3_quad": partial(train, reinforce),
}
for rows in (256, 4096):
    batch = f"batch of {rows}: "
    SUBJECTS[batch + "sb3_quad"] = partial(rate, ours, "flying", rows)
    SUBJECTS[batch + "crazyflow"] = partial(rate, crazyflow, rows)
    SUBJECTS[batch + "l2f"] = partial(rate, elsewhere, "l2f", "l2f_crazyflie", rows)
    SUBJECTS[batch + "RotorPy"] = partial(rate, elsewhere, "rotorpy", "crazyflie", rows)


def main():
    """Measure each in a process of its own."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--others", help="the Python that has the other projects")
    parser.add_argument("--only", default="", help="a part of a row's name")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
        print(f"{options.measure}: {SUBJECTS[options.measure]()}")
        return
    for name in SUBJECTS:
        if options.only in name:
            python = sys.executable if "sb3_quad" in name else options.others
            subprocess.run([python, __file__, "--measure", name], check=True)


if __name__ == "__main__":
    main()
