"""What one training run is asked to do, beyond its settings."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.tasks import in_words
from sb3_quad.training.config import TrainingConfig
from sb3_quad.training.options import JobOptions


class TrainingJob(JobOptions):
    """One run of the trainer."""

    config: TrainingConfig = Field(description="the settings")

    def for_evaluation(self, **changes: Any) -> TrainingConfig:
        """The settings with the environments as evaluations have them, and ``changes`` to their
        keywords.
        """
        keywords = {
            **self.config.env_kwargs,
            **self.config.eval_env_kwargs,
            **(self.eval_env_kwargs or {}),
            **changes,
        }
        return self.config.model_copy(update={"env_kwargs": keywords})

    @property
    def flight_settings(self) -> FlightSettings:
        """How the agent is judged, in an environment of this package."""
        return self.for_evaluation().flight_settings

    def arguments(self) -> dict[str, Any]:
        """What args.yml holds: everything but the settings, which config.yml holds; and how
        evaluations fly.
        """
        names = {
            "algo": self.config.algo,
            "env": self.config.env_id,
            "env_kwargs": self.for_evaluation().env_kwargs,
        }
        return {**names, **self.model_dump(exclude={"config"})}


def describe(job: TrainingJob) -> str:
    """One line that says what is about to be trained: whole rollouts, as SB3 does."""
    config = job.config
    n_steps = config.rollout_steps
    rollouts = -(-config.n_timesteps // (n_steps * config.n_envs))
    timesteps = rollouts * n_steps * config.n_envs
    asked = "" if timesteps == config.n_timesteps else f" ({config.n_timesteps:,} were asked for)"
    updates = rollouts
    if config.is_off_policy:
        steps = config.keyword("gradient_steps")
        updates *= n_steps * config.n_envs if steps < 0 else steps
    warming = updates <= config.hyperparams.get("critic_warmup", 0)
    idle = "; critic_warmup lasts all of it, so that the policy will not learn" if warming else ""
    start = f", from {job.trained_agent}" if job.trained_agent else ""
    expert = f", expert {config.expert}" if config.expert is not None else ""
    task = config.env_kwargs.get("task")
    mixture = f", tasks {in_words(task)}" if isinstance(task, Mapping) else ""
    return (
        f"{config.algo} on {config.env_id}: {timesteps:,} timesteps{asked}, rollouts of {n_steps} steps, "
        f"{config.n_envs} environments ({config.vec_env}){mixture}{expert}, seed {job.seed}{start}{idle}"
    )
