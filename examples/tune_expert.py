"""Search for the geometric expert's gains for a vehicle, by CMA-ES (Hansen, through Optuna).

    pip install '.[tune]'                                                     # from a clone
    python examples/tune_expert.py my.yaml -o tuned.yaml -n 300
    sb3-quad train --algo dagger --expert geometric --env-kwargs vehicle:tuned.yaml

Gains are judged by recoveries first, then by the settling time at targets 7 to 20 m away and by the
overshoot rate, on the same episodes each time. The file contains the vehicle with the new gains, or
with the original ones if these are as good on episodes that the search has not seen. Ctrl-C writes
the best so far. OUTPUT.journal keeps the study, and the same command continues it.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.base.types import BoolArray
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.gains import GAIN_NAMES, GeometricGains
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.evaluation.flights import Flights, fly, fly_settings
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.experts.geometric import GeometricExpert

NEAR = 0.1  # m
CLOSE = 1.5  # m; the cost of a low flight falls by a factor of e over this height

# Weights, in seconds of settling time: of the share of crashes, of the share of flights close to
# the ground, of the overshoot rate, of the reward of a recovery.
LOST = 1500.0
TOO_LOW = 1000.0
LEFT = 0.5
RECOVERY_REWARD = 0.25

TARGETS = {"target_distance": 20.0, "nearest_target": 7.0}  # m

# Control steps of each kind of flight.
DESCENT_STEPS = 400
TRACKING_STEPS = 800
RECOVERY_STEPS = 1000

# Slow descents help agents that imitate the expert inexactly. The expert itself does not need them,
# so its own flights cannot find this gain.
SEARCHED = tuple(name for name in GAIN_NAMES if name != "descent_deceleration")
RANGE = 2.0  # each gain lies between its first value divided by this and multiplied by this


class Lowest(Hook):
    """The lowest height of each flight, m."""

    def on_start(self, state: QuadcopterState, vehicle: Any) -> None:
        self.height = state.position[:, 2].copy()

    def after_step(
        self, step: int, state: QuadcopterState, actions: Any, flying: BoolArray
    ) -> None:
        self.height = np.minimum(self.height, np.where(flying, state.position[:, 2], 0.0))


class Objective:
    """The cost of gains, to be minimised: 1500 for crashing always, then seconds.

    Sensible gains recover from nearly all starts, so most starts do not distinguish them. Of
    ``starts`` recoveries only one in sixty is flown: those on which the first gains come closest to
    the ground. The others count as recovered.
    """

    def __init__(self, vehicle: Vehicle, starts: int, targets: int, seed: int) -> None:
        self.vehicle = vehicle
        self.starts = starts
        seeds = row_seeds(seed_for("search", seed), starts + max(targets // 2, 1))
        first = GeometricExpert(vehicle)
        _, lowest = self.fly(first, "state_recovery", seeds[:starts], DESCENT_STEPS)
        lowest_first = np.argsort(lowest.height)
        hardest = np.sort(lowest_first[: max(starts // 60, 1)])
        self.hardest = [seeds[row] for row in hardest]
        self.tracking = seeds[:targets]
        self.recovery = seeds[starts:]

    def __call__(self, gains: GeometricGains) -> float:
        expert = GeometricExpert(self.vehicle, gains)
        hard, lowest = self.fly(expert, "state_recovery", self.hardest, DESCENT_STEPS)
        tracking, _ = self.fly(expert, "target_tracking", self.tracking, TRACKING_STEPS)
        recovery, _ = self.fly(expert, "state_recovery", self.recovery, RECOVERY_STEPS)

        # Ordinary recoveries find gains that crash from starts other than the hardest.
        lost = (~hard.survival).sum() / self.starts + (~recovery.survival).mean()
        # The height distinguishes narrow escapes from safe ones.
        low = np.exp(-np.maximum(lowest.height, 0.0) / CLOSE).sum() / self.starts
        # A flight that does not settle counts as twice its length.
        never = 2 * TRACKING_STEPS * self.vehicle.control_step
        settling = np.nan_to_num(tracking.settling_time[NEAR], nan=never).mean()
        left = (tracking.survival & (tracking.overshoot > NEAR)).mean()
        reward = recovery.reward.mean()
        return float(
            LOST * lost + TOO_LOW * low + settling + LEFT * left - RECOVERY_REWARD * reward
        )

    def fly(
        self, expert: GeometricExpert, task: str, seeds: Sequence[int], steps: int
    ) -> tuple[Flights, Lowest]:
        """Fly the first episode of each seed, on the true state."""
        keywords: dict[str, Any] = {"task": task, "max_episode_steps": steps}
        if task == "target_tracking":
            keywords["task_kwargs"] = TARGETS
        settings = FlightSettings(vehicle=self.vehicle, noise=0.0, **keywords)
        lowest = Lowest()
        return fly_settings(expert, settings, seeds, hooks=[lowest]), lowest


def with_values(gains: GeometricGains, values: dict[str, float]) -> GeometricGains:
    """Replace some gains, rounded to four digits."""
    rounded = {name: float(f"{value:.4g}") for name, value in values.items()}
    return GeometricGains.model_validate({**gains.model_dump(exclude={"measured"}), **rounded})


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> dict[str, Any]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never gets within 0.1 m, or never stays there, counts as ``time_limit``
    control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_episode_steps": time_limit}
    recovery = Flights.concatenate(
        [fly(expert, "state_recovery", episodes, seed, **keywords) for seed in seeds]
    )
    tracking = fly(expert, "target_tracking", episodes, seeds[0], **keywords)
    never = time_limit * vehicle.control_step
    time_to = np.nan_to_num(tracking.time_to[NEAR], nan=never)
    settling_time = np.nan_to_num(tracking.settling_time[NEAR], nan=never)
    return {
        "recovery_survival": round(float(recovery.survival.mean()), 5),
        "recovery_episodes": recovery.n,
        "tracking_survival": round(float(tracking.survival.mean()), 5),
        "tracking_episodes": tracking.n,
        "time_to_0_1_m": round(float(time_to.mean()), 3),  # s, mean
        "settling_time": round(float(settling_time.mean()), 3),  # s, mean
        "tracking_reward": round(float(tracking.reward.mean()), 3),  # mean (Eqs. 4.5-4.9)
        "observation_noise": 0.0,
        "seeds": [*seeds],
    }


def fresh_cost(metrics: dict[str, Any]) -> float:
    """The cost of gains on fresh episodes, with the same weights, s."""
    lost = LOST * (1.0 - metrics["recovery_survival"])
    return lost + metrics["settling_time"]


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("vehicle", nargs="?", default="itm", help="name or YAML file (itm)")
    parser.add_argument("-o", "--output", type=Path, help="YAML file to write (VEHICLE_tuned.yaml)")
    parser.add_argument(
        "-n", "--trials", type=int, default=800, help="gains to try, earlier ones included (800)"
    )
    parser.add_argument(
        "--starts", type=int, default=40_000, help="recoveries to choose from (40000)"
    )
    parser.add_argument("--targets", type=int, default=300, help="tracking episodes (300)")
    parser.add_argument(
        "--episodes", type=int, default=960, help="fresh episodes at the end, of four sets (960)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the search and its episodes (0)"
    )
    return parser.parse_args()


def main() -> None:
    """Search, measure on fresh episodes, write the file."""
    options = parse_options()
    vehicle = load_vehicle(options.vehicle)
    output = options.output or Path(f"{vehicle.name}_tuned.yaml")
    first = GeometricExpert(vehicle).gains
    start = {name: getattr(first, name) for name in SEARCHED}
    sampler = optuna.samplers.CmaEsSampler(x0=start, seed=options.seed, popsize=16)
    storage = JournalStorage(JournalFileBackend(str(output.with_suffix(".journal"))))
    name = (
        f"{vehicle.name}, seed {options.seed}, {options.starts} starts, {options.targets} targets"
    )
    study = optuna.create_study(
        study_name=name, storage=storage, sampler=sampler, load_if_exists=True
    )
    if not study.trials:
        study.enqueue_trial(start)
    objective = Objective(vehicle, options.starts, options.targets, options.seed)

    def cost(trial: optuna.Trial) -> float:
        values = {}
        for name, x in start.items():
            values[name] = trial.suggest_float(name, x / RANGE, x * RANGE, log=True)
        return objective(with_values(first, values))

    try:
        study.optimize(
            cost, n_trials=max(options.trials - len(study.trials), 0), show_progress_bar=True
        )
    except KeyboardInterrupt:
        print("interrupted: writing the best so far")

    tried = [first, with_values(first, study.best_params)]
    seeds = row_seeds(seed_for("expert", options.seed), 4)
    measured = []
    for name, gains in zip(("before", "found"), tried, strict=True):
        expert = GeometricExpert(vehicle, gains)
        metrics = measure_expert(expert, vehicle, seeds, options.episodes)
        measured.append(metrics)
        print(f"{name}: {metrics!r}")
    best = 1
    if fresh_cost(measured[1]) >= fresh_cost(measured[0]):
        best = 0
        print(
            "the search found nothing better on fresh episodes: "
            "the file keeps the gains that it began with"
        )
    chosen = tried[best].model_copy(update={"measured": measured[best]})
    tuned = vehicle.model_copy(update={"geometric_gains": chosen})
    output.write_text(
        yaml.safe_dump(tuned.model_dump(mode="json", exclude_none=True), sort_keys=False)
    )
    print(f"{len(study.trials)} gains tried, least cost {study.best_value:.3f}; saved {output}")


if __name__ == "__main__":
    main()
