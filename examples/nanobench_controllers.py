"""Clone a Crazyflie's controller from NanoBench's flights, as its BC-MLP does.

    git clone https://github.com/syediu/nanobench-iros2026
    python examples/nanobench_controllers.py nanobench-iros2026/datasets/dataset

Both learn from the same logs, and fly the first repetitions of ten curves, which neither has seen,
in a network that predicts the next row, as in the benchmark's second task. It is trained here by
the benchmark's settings, since the checkpoint in its repository is one of two epochs.
"""

import argparse
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_quad import DAgger

SEEN = [
    *("px", "py", "pz"),
    *("est_stateEstimate_vx", "est_stateEstimate_vy", "est_stateEstimate_vz"),
    *(f"att_stateEstimate_q{part}" for part in "wxyz"),
    *("sp_ctrltarget_x", "sp_ctrltarget_y", "sp_ctrltarget_z", "pwr_pm_vbat"),
]
MOTORS = ["motor_motor_m1", "motor_motor_m2", "motor_motor_m3", "motor_motor_m4"]
# Of what is seen, the vehicle's motion changes these, within these limits.
LIMITS = np.array([5.0] * 6 + [1.0] * 4)
MOVING = len(LIMITS)
CURVES = (
    *("B2_circle_slow", "B3_figure8_medium", "B5_helix_fast", "B5_helix_medium", "B5_helix_slow"),
    *("B7_oval_fast", "B7_oval_medium", "B8_star_medium", "B8_star_slow", "B9_trefoil_medium"),
)
LOST = 2.0  # m from the logged position


class Nowhere(gym.Env):
    """DAgger clones recorded flights alone; its own flights lead nowhere."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (len(SEEN),), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (len(MOTORS),), np.float32)

    def reset(self, *, seed=None, options=None):
        """Return zeros."""
        return np.zeros(len(SEEN), np.float32), {}

    def step(self, action):
        """Stay."""
        return np.zeros(len(SEEN), np.float32), 0.0, False, False, {}


def read(path):
    """Rows in the air: what the controller sees (n, 14), and the motors in [-1, 1], (n, 4)."""
    log = pd.read_csv(path)
    log["pwr_pm_vbat"] = log["pwr_pm_vbat"].replace(0.0, np.nan).ffill().bfill()
    log = log[log[MOTORS[0]] > 1000]
    motors = log[MOTORS].to_numpy(np.float32) / 65535
    return log[SEEN].to_numpy(np.float32), 2.0 * motors.clip(0.0, 1.0) - 1.0


def fit(network, loss, inputs, targets, batch_size, epochs, parameters=()):
    """Adam with the benchmark's rate."""
    optimizer = th.optim.Adam([*network.parameters(), *parameters], 1e-3)
    for _ in range(epochs):
        for rows in th.randperm(len(inputs)).split(batch_size):
            optimizer.zero_grad()
            loss(network, inputs[rows], targets[rows]).backward()
            optimizer.step()


def perceptron(activation, *sizes):
    """A network with linear outputs."""
    layers = [(nn.Linear(*pair), activation()) for pair in pairwise(sizes)]
    return nn.Sequential(*chain.from_iterable(layers))[:-1]


def predictor(seen, motors, changes):
    """A network from a scaled row and the motors to the row's change."""
    network = perceptron(nn.ReLU, len(SEEN) + len(MOTORS), 256, 256, 256, len(SEEN))

    def loss(network, inputs, targets):
        disturbed = inputs.clone()
        disturbed[:, len(SEEN) :] += 0.04 * th.randn(len(inputs), len(MOTORS))
        return nn.functional.mse_loss(network(disturbed), targets)

    fit(network, loss, th.from_numpy(np.hstack([seen, motors])), th.from_numpy(changes), 1024, 60)
    return network


def their_clone(seen, motors, seed):
    """BC-MLP: 600 epochs of the log-likelihood, less 0.001 of the entropy, as imitation learns."""
    th.manual_seed(seed)
    network = perceptron(nn.Tanh, len(SEEN), 32, 32, len(MOTORS))
    log_std = th.zeros(len(MOTORS), requires_grad=True)

    def loss(network, inputs, targets):
        error = (targets - network(inputs)) / log_std.exp()
        return (error.square() / 2 + 0.999 * log_std).sum(dim=1).mean()

    fit(network, loss, th.from_numpy(seen), th.from_numpy(motors), 512, 600, [log_std])
    return lambda rows: network(th.from_numpy(rows)).numpy()


def our_clone(seen, motors, seed):
    """DAgger's defaults, without an expert."""
    with TemporaryDirectory() as folder:
        flights = Path(folder) / "flights.npz"
        np.savez(flights, observations=seen, actions=motors)
        env = make_vec_env(Nowhere, 1)
        agent = DAgger("MlpPolicy", env, demonstrations=flights, beta=0, seed=seed, device="cpu")
    agent.learn(25_000)
    return lambda rows: agent.predict(rows, deterministic=True)[0]


def fly(policy, plant, seen, mean, std):
    """The root mean square distance from the logged positions, m, and the share flown."""
    state = seen[0]
    errors = [0.0]
    for logged in seen[1:]:
        row = (state - mean) / std
        inputs = np.hstack([row, policy(row[None])[0].clip(-1.0, 1.0)])
        state = (row + plant(th.from_numpy(inputs)).numpy()) * std + mean
        state[:MOVING] = state[:MOVING].clip(-LIMITS, LIMITS)
        state[6:MOVING] /= np.linalg.norm(state[6:MOVING])
        state[MOVING:] = logged[MOVING:]
        error = float(np.linalg.norm(state[:3] - logged[:3]))
        if not error <= LOST:
            break
        errors.append(error)
    return float(np.sqrt(np.mean(np.square(errors)))), len(errors) / len(seen)


@th.no_grad()
def judge(policy, plant, tests, mean, std):
    """Fly each curve; print the errors, their mean, and that of the motors along the logs."""
    errors, mistakes = [], []
    for name, (seen, motors) in tests.items():
        error, share = fly(policy, plant, seen, mean, std)
        errors.append(error)
        mistakes.append(np.square(policy((seen - mean) / std).clip(-1.0, 1.0) - motors).mean() / 4)
        print(f"  {name}: {error:.3f} m, {share:.0%} flown")
    print(f"  mean {np.mean(errors):.3f} m; squared error of the motors {np.mean(mistakes):.5f}")


def main():
    """Train the plant, then both clones with each seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the benchmark's CSV files")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    th.set_num_threads(1)
    th.manual_seed(42)
    tests = {curve: read(options.folder / f"{curve}_rep1.csv") for curve in CURVES}
    paths = sorted(options.folder.glob("*.csv"))
    logs = [read(path) for path in paths if path.stem.removesuffix("_rep1") not in CURVES]
    rows = np.concatenate([seen for seen, _ in logs])
    mean, std = rows.mean(axis=0), rows.std(axis=0)
    scaled = [(seen - mean) / std for seen, _ in logs]
    before = np.concatenate([seen[:-1] for seen in scaled])
    motors = np.concatenate([motors[:-1] for _, motors in logs])
    changes = np.concatenate([np.diff(seen, axis=0) for seen in scaled])
    changes[:, MOVING:] = 0.0
    plant = predictor(before, motors, changes)
    for seed in options.seeds:
        for learn in (our_clone, their_clone):
            began = process_time()
            policy = learn(before, motors, seed)
            print(f"{learn.__name__}, seed {seed}: {process_time() - began:.0f} CPU s")
            judge(policy, plant, tests, mean, std)


if __name__ == "__main__":
    main()
