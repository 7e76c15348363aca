"""Other controllers of the vehicle at hand: agents of the package and experts.

Before a stage they fly it on the same episodes as the agent of the stage before, so that training
starts from what is best there, and hands over nothing that is worse.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.agents.pretrained import load_pretrained, pretrained_names
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.labelling import refuse_other_action
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import save_model
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import Report, StrDict
from sb3_quad.evaluation.flights import Flights, episode_seeds, fly_settings
from sb3_quad.training.config import TrainingJob, as_agent, build_config, merged
from sb3_quad.training.hand_over import is_below

EPISODES = 60  # of each task
TOLERANCE = 0.1  # m, of the settling time
# One that loses this share of the flights more is behind, or that fails in as many more, whatever
# it earns.
LOST = 0.02
# Training continues from the agent of the stage before, whose network is smaller and learns faster,
# unless it earns this share less than another one.
HEAD_START = 0.2
# Nor does it from one that takes this many times as long to settle: it swings at its target, and
# its gradients may diverge.
SLOW = 1.5


class Flown(NamedTuple):
    """How one of them flew: the flights of all tasks in a row.

    :param job: a job that starts from it, an agent.
    """

    label: str
    flights: Flights
    job: TrainingJob | None = None

    def is_behind(self, other: "Flown", margin: float = 0.0) -> bool:
        """Whether it loses more flights, fails in more, or earns less; rewards on the same
        episodes, beyond chance.

        :param margin: the share of the other's mean reward that it may earn less. With one, it is
            behind if it settles much later, too.
        """
        flights, others = self.flights, other.flights
        lost = others.survival.mean() - flights.survival.mean()
        if lost >= LOST:
            return True
        if lost < 0.0:
            return False
        failed = others.success.mean() - flights.success.mean()
        if abs(failed) >= LOST:
            return bool(failed > 0.0)
        if margin > 0.0 and self.settling_time > SLOW * other.settling_time:
            return True
        least = others.reward - margin * abs(others.reward.mean())
        return is_below(flights.reward, least)

    @property
    def settling_time(self) -> float:
        """The mean over the flights that settle, s; infinite if none does."""
        times = self.flights.settling_time[TOLERANCE]
        settled = times[np.isfinite(times)]
        return float(settled.mean()) if settled.size else math.inf

    def __str__(self) -> str:
        flights = self.flights
        return (
            f"{self.label}: survival {100 * flights.survival.mean():.1f} %, "
            f"settling time {self.settling_time:.2f} s, "
            f"final error {np.median(flights.final_error):.3f} m, "
            f"mean reward {flights.reward.mean():.2f}"
        )


def with_vehicle(job: TrainingJob) -> bool:
    """Whether a job is for a vehicle that the user gave, is evaluated, and has no wrappers, which
    no rival knows.
    """
    config = job.config
    if not config.task or "vehicle" not in config.env_kwargs or job.eval_episodes < 1:
        return False
    wrapped = config.env_wrapper or config.vec_env_wrapper or config.normalize
    return not (wrapped or config.flight_settings.vehicles)


def fly_rivals(
    agent: Flown, job: TrainingJob, names: list[str], changes: StrDict, folder: Path, report: Report
) -> list[Flown]:
    """Fly the rivals of an agent on the vehicle of a job, and report a line on each of them all.

    An agent among them goes to ``<folder>/<name>.zip``, which says that it flies this vehicle.

    :param agent: what the job would start from; it comes first in the result.
    :param changes: to the settings of the job, if it starts from a rival.
    """
    config = job.config
    tasks = " and ".join(map(str, (job.flight_settings.task, *config.eval_tasks)))
    report(f"on this vehicle, {EPISODES} flights of {tasks} each:")
    report(str(agent))
    flown = [agent]
    for name in names:
        try:
            if name in pretrained_names():
                rival = load_pretrained(name)
                refuse_other_action(name, rival, config.flight_settings.action)
                settings = merged({**config.settings, **as_agent(rival, config, {})}, changes, name)
                own_config = build_config(config.algo, config.env_id, settings, name)
                path = str(folder / f"{name}.zip")
                own = job.model_copy(update={"config": own_config, "initial_policy": path})
                own.flight_settings.write_into(rival)
                save_model(rival, path)
                flown.append(Flown(name, _fly(rival, own), own))
            else:
                layout = config.flight_settings.rotor_layout
                action = config.flight_settings.action
                vehicle = config.env_kwargs["vehicle"]
                expert = resolve_expert(name, vehicle, layout=layout, action=action)
                flown.append(Flown(name, _fly(expert, job)))
        except ConfigError as error:
            # Its rotors may be in other places.
            report(f"{name}: cannot fly this vehicle ({error})")
        else:
            report(str(flown[-1]))
    return flown


def best_of(flown: list[Flown], margin: float = 0.0) -> Flown:
    """Return the best agent; one that comes first has to be beaten, see :meth:`Flown.is_behind`."""
    best, *others = flown
    for other in others:
        if other.job is not None and best.is_behind(other, margin):
            best = other
    return best


def fly_agent(label: str, job: TrainingJob) -> Flown:
    """Fly the agent that a job starts from."""
    return Flown(label, _fly(load_model(str(job.initial_policy)), job), job)


def _fly(pilot: Any, job: TrainingJob) -> Flights:
    seeds = episode_seeds(seed_for("evaluation", job.seed), EPISODES)
    own = job.flight_settings
    parts = []
    for task in (own.task, *job.config.eval_tasks):
        settings = own.with_changes(task=task, max_episode_steps=own.longest_episode)
        parts.append(fly_settings(pilot, settings, seeds, tolerances=[TOLERANCE]))
    return Flights.concatenate(parts)
