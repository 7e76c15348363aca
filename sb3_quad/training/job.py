"""What one training run is asked to do, beyond its settings."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch as th
from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveInt

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import check_seed
from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.training.config import TrainingConfig


def _check_device(device: str) -> str:
    """SB3 itself takes the CPU, without a word, where there is no CUDA."""
    if device.startswith("cuda") and not th.cuda.is_available():
        raise ConfigError(f"device {device}: PyTorch finds no CUDA here; give cpu or auto")
    return device


class TrainingJob(Frozen):
    """One run of the trainer. All its random numbers follow from ``seed``."""

    config: TrainingConfig = Field(description="the settings")
    log_folder: str = Field(default="logs", description="where run folders go")
    seed: Annotated[int, AfterValidator(check_seed)] = Field(default=0, description="of policy, environments and exploration")
    device: Annotated[str, AfterValidator(_check_device)] = Field(
        default="cpu", description="cpu, cuda or auto; small networks are fastest on the cpu"
    )
    trained_agent: str | None = Field(default=None, description="zip whose policy and critic to start from")
    eval_freq: int = Field(default=250_000, description="timesteps between evaluations; below 1 only one at the end")
    eval_episodes: int = Field(default=48, description="episodes of one evaluation; below 1 none at all")
    n_eval_envs: PositiveInt | None = Field(default=None, description="None: as many as episodes if batched, else 1")
    eval_env_kwargs: dict[str, Any] | None = Field(default=None, description="put over env_kwargs in evaluations")
    save_freq: int = Field(default=-1, description="timesteps between checkpoints; below 1 none")
    snapshot_every: NonNegativeFloat = Field(default=60.0, description="seconds between snapshots to resume from; 0: none")
    log_interval: PositiveInt = Field(default=1, description="rollouts between two lines of the log")
    tensorboard_log: str | None = Field(default=None, description="folder for TensorBoard")
    progress: bool = Field(default=False, description="whether to show a progress bar")
    verbose: int = Field(default=0, description="as in SB3")
    unique: bool = Field(default=False, description="add a UUID to the run folder's name")

    def for_evaluation(self, **changes: Any) -> TrainingConfig:
        """The settings with the environments as evaluations have them, and ``changes`` to their keywords."""
        keywords = {**self.config.env_kwargs, **self.config.eval_env_kwargs, **(self.eval_env_kwargs or {}), **changes}
        return self.config.model_copy(update={"env_kwargs": keywords})

    @property
    def flight_settings(self) -> FlightSettings:
        """How the agent is judged, in an environment of this package."""
        return self.for_evaluation().flight_settings

    def arguments(self) -> dict[str, Any]:
        """What args.yml holds: everything but the settings, which config.yml holds; and how evaluations fly."""
        names = {"algo": self.config.algo, "env": self.config.env_id, "env_kwargs": self.for_evaluation().env_kwargs}
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
    shares = {name: share / sum(task.values()) for name, share in task.items()} if isinstance(task, Mapping) else {}
    mixture = f", tasks {', '.join(f'{share:.0%} {name}' for name, share in shares.items())}" if shares else ""
    return (
        f"{config.algo} on {config.env_id}: {timesteps:,} timesteps{asked}, rollouts of {n_steps} steps, "
        f"{config.n_envs} environments ({config.vec_env}){mixture}{expert}, seed {job.seed}{start}{idle}"
    )
