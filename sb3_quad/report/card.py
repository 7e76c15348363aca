"""The card of a trained policy: what was measured, how it was made, how it is loaded; in Markdown, as model hubs show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.records import Estimate, Metrics
from sb3_quad.evaluation.summary import summarise

FIRST_SEED = 20_000_000  # of the judged episodes; far from any that a training or the tables of the docs have seen
N_EPISODES, N_RECOVERIES = 960, 4  # the recoveries are so many times as many
DISTANCES = (10.0, 15.0, 20.0)  # m
NEAR = 0.1  # m
RECOVERY = "state recovery"


@dataclass(frozen=True)
class Origin:
    """Where a policy comes from.

    :param command: what was typed.
    :param facts: further rows, such as seed, commit and versions.
    """

    command: str
    facts: Mapping[str, str]


def measure(policy: Any, n_episodes: int = N_EPISODES, **settings: Any) -> dict[str, Metrics]:
    """The rows of the table, by name: recoveries, then targets at each distance.

    :param settings: ``vehicle``, ``noise`` and ``observation_std``, as :func:`~sb3_quad.evaluation.flights.fly` takes them.
    """
    parts = [fly(policy, "state_recovery", n_episodes, FIRST_SEED + k * n_episodes, **settings) for k in range(N_RECOVERIES)]
    rows = {RECOVERY: summarise(Flights.concatenate(parts))}
    for distance in DISTANCES:
        task: dict[str, Any] = {"task_kwargs": {"target_distance": distance}}
        flown = fly(policy, "target_tracking", n_episodes, FIRST_SEED + int(1000 * distance), **task, **settings)
        rows[f"targets {distance:.0f} m away"] = summarise(flown)
    return rows


def write_card(name: str, rows: Mapping[str, Metrics], origin: Origin, settings: Mapping[str, Any]) -> str:
    """The card of a policy, Markdown."""
    vehicle, noise = settings["vehicle"], settings["noise"]
    return "\n".join(
        [
            f"# {name}",
            "",
            f"A policy for the vehicle `{vehicle}`: it recovers from random attitudes, velocities and body rates, and flies",
            "to targets. It reads the 18 features of `sb3_quad`'s environments, scaled as there, and gives four actions in",
            "[-1, 1], the thrusts of the rotors.",
            "",
            "## Measured",
            "",
            f"{_counts(rows)}; {100 * noise:g} % observation noise, the mean action. 95 % intervals.",
            "",
            *_table(rows),
            "",
            "## How it was trained",
            "",
            "```bash",
            origin.command,
            "```",
            "",
            "| | |",
            "|---|---|",
            *(f"| {key} | {value} |" for key, value in origin.facts.items()),
            "",
            "## Loading it",
            "",
            "```python",
            "from stable_baselines3 import PPO",
            "",
            f'model = PPO.load("{name}.zip", device="cpu")  # the file beside this card',
            "```",
            "",
        ]
    )


def _counts(rows: Mapping[str, Metrics]) -> str:
    targets = [figures.n for row, figures in rows.items() if row != RECOVERY]
    return f"{rows[RECOVERY].n:,} fresh recoveries and {targets[0]:,} fresh targets at each distance"


def _table(rows: Mapping[str, Metrics]) -> Sequence[str]:
    lines = [
        f"| | success | mean reward | time to {NEAR:g} m | final error: median | largest |",
        "|---|---|---|---|---|---|",
    ]
    for row, figures in rows.items():
        arrival = next(entry for entry in figures.arrivals if entry.tolerance == NEAR)
        recovery = row == RECOVERY  # begins at its target
        cells = [
            row,
            _share(figures.success),
            f"{figures.reward.value:.2f}",
            "–" if recovery or arrival.time is None else f"{arrival.time.value:.2f} s",
            *("–" if e is None else f"{e:.3f} m" for e in (figures.final_error_median, figures.final_error_max)),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _share(estimate: Estimate) -> str:
    return f"{100 * estimate.value:.2f} % ({100 * estimate.low:.2f} … {100 * estimate.high:.2f})"
