"""How fast each way of training learns: recoveries and settling time over CPU seconds.

    python examples/learning_speed.py learning_speed.csv learning_speed.png

Every method flies the vehicle, noise and delay of the thesis, and is evaluated along the way on the
same fresh episodes: recoveries from the thesis's starts, and targets 10 m away. Evaluations are not
counted. "From the clone" starts from the agent of `clone of the PID`, whose training is counted.
Use one thread (``OMP_NUM_THREADS=1``), so that CPU seconds are seconds of one core. A seed takes
about ten minutes; ``--cpu-seconds`` ends each training earlier.
"""

import argparse
import csv
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import APG, QuadcopterVecEnv, fly
from sb3_quad.base.seeds import seed_for
from sb3_quad.training.config import TrainingJob, load_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.trainer import build_model

RECOVERY = "QuadStateRecovery-v0"
CLONE = "clone of the PID"
# Settings of each method, and whether it begins from the clone
METHODS: dict[str, tuple[str, str, dict[str, Any], bool]] = {
    CLONE: ("dagger", "QuadTargetTracking-v0", {}, False),
    "PPO": ("ppo", RECOVERY, {}, False),
    "PPO with cloning": ("ppo_bc", RECOVERY, {}, True),
    "SAC with cloning": ("sac_bc", RECOVERY, {"policy_kwargs": None}, True),
    "DAgger from the geometric expert": ("dagger", RECOVERY, {"expert": "geometric"}, False),
    "model's gradient from the clone": (
        "apg",
        RECOVERY,
        {"learning_rate": "lin_1e-2", "n_timesteps": 20_736_000},
        True,
    ),
}
FROM_NOTHING = "model's gradient from nothing"
FIRST = 1.0  # CPU seconds until the first evaluation; each later one waits for a quarter more
COLUMNS = ("method", "seed", "cpu_s", "timesteps", "recoveries", "survival", "settling_time_s")


class Evaluations(BaseCallback):
    """Evaluates a model during its training, at times that are even on a logarithmic axis."""

    def __init__(
        self, method: str, seed: int, spent: float, limit: float, rows: list[tuple[Any, ...]]
    ) -> None:
        super().__init__()
        self.method = method
        self.run_seed = seed
        self.spent = spent
        self.limit = limit
        self.rows = rows
        self.due = max(FIRST, 1.1 * spent)

    def _on_training_start(self) -> None:
        self.start = time.process_time()
        if self.spent:
            self.evaluate()

    def _on_step(self) -> bool:
        return self.cpu < self.limit

    def _on_rollout_end(self) -> None:
        if self.cpu >= self.due:
            self.evaluate()
            self.due = 1.25 * self.cpu

    @property
    def cpu(self) -> float:
        """CPU seconds of training so far."""
        return self.spent + time.process_time() - self.start

    def evaluate(self) -> None:
        """Fly the episodes of the evaluation and record the results."""
        cpu = self.cpu
        recoveries = fly(self.model, "state_recovery", 960, seed=1_000)
        targets = fly(self.model, "target_tracking", 240, seed=2_000)
        settling = targets.settling_time[0.1]
        settled = np.isfinite(settling)
        # A mean over the few that settle would look too good.
        mean = float(settling[settled].mean()) if settled.mean() > 0.9 else np.nan
        row = (
            self.method,
            self.run_seed,
            round(cpu, 2),
            self.num_timesteps,
            round(float(recoveries.success.mean()), 5),
            round(float(recoveries.survival.mean()), 5),
            round(mean, 3),
        )
        self.rows.append(row)
        print(*row, flush=True)
        self.start = time.process_time() - (cpu - self.spent)


def train(
    method: str,
    seed: int,
    clone: str | None,
    spent: float,
    limit: float,
    rows: list[tuple[Any, ...]],
) -> tuple[BaseAlgorithm, float]:
    """Train by one method; return the model and the CPU seconds."""
    algo, env_id, overrides, _ = METHODS[method]
    config = load_config(algo, env_id, overrides=overrides)
    env = make_environments(config, config.n_envs, seed_for("training", seed), staggered=True)
    job = TrainingJob(config=config, seed=seed, trained_agent=clone)
    begun = time.process_time()
    model = build_model(job, env)
    # The actor of SAC first imitates the clone, which takes time.
    spent += time.process_time() - begun
    evaluations = Evaluations(method, seed, spent, spent + limit, rows)
    model.learn(config.n_timesteps, evaluations)
    evaluations.evaluate()
    return model, evaluations.cpu


def train_from_nothing(seed: int, limit: float, rows: list[tuple[Any, ...]]) -> None:
    """Train only by the model's gradient, on windows of a second that continue their flights."""
    tasks = {"state_recovery": 0.6, "target_tracking": 0.4}
    env = QuadcopterVecEnv(256, task=tasks, seed=seed_for("training", seed))
    rate = LinearSchedule(4e-3, 8e-5, 1.0)
    model = APG("MlpPolicy", env, n_steps=100, continue_flights=True, learning_rate=rate, seed=seed)
    evaluations = Evaluations(FROM_NOTHING, seed, 0.0, limit, rows)
    model.learn(256 * 100 * 1500, evaluations)
    evaluations.evaluate()


def draw(rows: list[dict[str, str]], path: str) -> None:
    """Draw recoveries and settling time of every method over CPU seconds."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    unsettled = []
    for number, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        for seed in dict.fromkeys(row["seed"] for row in rows):
            own = [row for row in rows if row["method"] == method and row["seed"] == seed]
            seconds = [float(row["cpu_s"]) for row in own]
            label = method if seed == rows[0]["seed"] else None
            style: dict[str, Any] = {"color": f"C{number}", "marker": ".", "linewidth": 1.2}
            shares = [100.0 * float(row["recoveries"]) for row in own]
            times = [float(row["settling_time_s"]) for row in own]
            left.plot(seconds, shares, label=label, **style)
            right.plot(seconds, times, **style)
        if not any(row["settling_time_s"] != "nan" for row in rows if row["method"] == method):
            unsettled.append(method)
    for axes, title in ((left, "recoveries, %"), (right, "settling time (0.1 m), 10 m away, s")):
        axes.set_xscale("log")
        axes.set_xlabel("CPU seconds of one core")
        axes.set_title(title, loc="left", fontweight="bold", fontsize=10)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    left.set_ylim(-3, 103)
    left.set_xlim(0.5)
    right.set_xlim(left.get_xlim())
    right.set_ylim(0.0, 14.0)
    left.legend(frameon=False, fontsize=8)
    # Without a note, a missing curve looks like a mistake.
    if unsettled:
        text = "no curve, since 10 % of flights or more never settle:\n" + "\n".join(unsettled)
        right.text(0.02, 0.98, text, transform=right.transAxes, va="top", fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Train all methods, write the table, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("csv", help="table to write")
    parser.add_argument("picture", help="picture to draw")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--methods", nargs="+", default=[*METHODS, FROM_NOTHING])
    parser.add_argument("--cpu-seconds", type=float, default=np.inf, help="of each training")
    parser.add_argument("--draw", action="store_true", help="draw the table that is there")
    arguments = parser.parse_args()

    limit = arguments.cpu_seconds
    if not arguments.draw:
        rows: list[tuple[Any, ...]] = []
        for seed in arguments.seeds:
            clone, spent = train(CLONE, seed, None, 0.0, limit, rows)
            path = f"{arguments.csv}.clone.zip"
            clone.save(path)
            for method in arguments.methods:
                if method == FROM_NOTHING:
                    train_from_nothing(seed, limit, rows)
                elif method != CLONE:
                    from_clone = METHODS[method][3]
                    start = path if from_clone else None
                    train(method, seed, start, spent * from_clone, limit, rows)
        with open(arguments.csv, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerows([COLUMNS, *rows])
    with open(arguments.csv, newline="") as file:
        draw(list(csv.DictReader(file)), arguments.picture)


if __name__ == "__main__":
    main()
