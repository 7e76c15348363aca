"""What else flies the vehicle at hand: agents of the package and experts.

Before a stage they fly it on the same episodes as the agent of the stage before, so that training
starts from what is best there, and hands over nothing that is worse.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.agents.pretrained import load_pretrained, pretrained_names
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.zips import load_model
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import save_model
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import BoolArray, FloatArray, Report
from sb3_quad.evaluation.flights import Flights, episode_seeds, fly_settings
from sb3_quad.training.config import TrainingJob, as_agent, build_config
from sb3_quad.training.hand_over import is_below

EPISODES = 60  # of each task
TOLERANCE = 0.1  # m, of the settling time
# A rival takes the place of an agent that loses this many more of its flights.
LOST = 0.02


class Flown(NamedTuple):
    """How one of them flew: the flights of all tasks in a row.

    :param job: the job of a stage that starts from it; an expert has none.
    """

    label: str
    job: TrainingJob | None
    rewards: FloatArray
    survival: BoolArray
    line: str

    def is_above(self, other: "Flown") -> bool:
        """Whether it loses fewer flights, or earns more on the same episodes beyond chance."""
        more = self.survival.mean() - other.survival.mean()
        return bool(more >= LOST or (more >= 0.0 and is_below(other.rewards, self.rewards)))


def with_vehicle(job: TrainingJob) -> bool:
    """Whether a job is for a vehicle that the user gave, without wrappers, which no rival knows."""
    config = job.config
    wrapped = config.env_wrapper or config.vec_env_wrapper or config.normalize
    given = config.env_kwargs.keys() & {"vehicle", "vehicles"}
    return bool(config.task) and given == {"vehicle"} and not wrapped


def fly_rivals(names: list[str], job: TrainingJob, folder: Path, report: Report) -> list[Flown]:
    """Fly each of the rivals on the vehicle of a job, and report a line on it.

    An agent goes to ``<folder>/<name>.zip``, which says that it flies this vehicle.
    """
    flown = []
    for name in names:
        try:
            flown.append(_fly_rival(name, job, folder))
        except ConfigError as error:
            # Its rotors may be in other places.
            report(f"{name} cannot fly this vehicle: {error}")
            continue
        report(flown[-1].line)
    return flown


def _fly_rival(name: str, job: TrainingJob, folder: Path) -> Flown:
    config = job.config
    if name not in pretrained_names():
        layout = config.flight_settings.rotor_layout
        expert = resolve_expert(name, config.env_kwargs["vehicle"], layout=layout)
        return _flown(name, expert, job, None)
    agent = load_pretrained(name)
    settings = {**config.settings, **as_agent(agent, config, {})}
    path = folder / f"{name}.zip"
    own = job.model_copy(
        update={
            "config": build_config(config.algo, config.env_id, settings, name),
            "initial_policy": str(path),
        }
    )
    own.flight_settings.write_into(agent)
    save_model(agent, path)
    return _flown(name, agent, own, own)


def best_start(flown: list[Flown]) -> TrainingJob:
    """Return the job of the agent to start from.

    The first one goes on unless it is clearly behind: a smaller network learns faster.
    """
    first, *others = flown
    assert first.job is not None
    job = first.job
    for rival in others:
        if rival.job is not None and rival.is_above(first):
            job = rival.job
    return job


def fly_agent(label: str, job: TrainingJob) -> Flown:
    """Fly the agent that a job starts from."""
    return _flown(label, load_model(str(job.initial_policy)), job, job)


def _flown(label: str, pilot: Any, how: TrainingJob, job: TrainingJob | None) -> Flown:
    seeds = episode_seeds(seed_for("evaluation", how.seed), EPISODES)
    own = how.flight_settings
    parts = []
    for task in (own.task, *how.config.eval_tasks):
        settings = own.with_changes(task=task, max_episode_steps=own.longest_episode)
        parts.append(fly_settings(pilot, settings, seeds, tolerances=[TOLERANCE]))
    flights = Flights.concatenate(parts)
    settled = flights.settling_time[TOLERANCE]
    time = "none settles"
    if not np.isnan(settled).all():
        time = f"settling time {np.nanmean(settled):.2f} s"
    line = (
        f"{label}: survival {100 * flights.survival.mean():.1f} %, {time}, "
        f"final error {np.median(flights.final_error):.3f} m, "
        f"mean reward {flights.reward.mean():.2f}"
    )
    return Flown(label, job, flights.reward, flights.survival, line)
