"""What one training run is asked to do, beyond its settings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.seeds import check_seed
from sb3_quad.settings.config import TrainingConfig
from sb3_quad.settings.flight import FlightSettings


@dataclass(frozen=True)
class TrainingJob:
    """One run of the trainer.

    :param config: the settings.
    :param log_folder: where run folders go.
    :param seed: of the policy, the environments (number i gets ``seed + i``) and the exploration.
    :param device: cpu, cuda or auto; the small networks here are fastest on the cpu.
    :param trained_agent: zip whose policy and critic to start from.
    :param eval_freq: timesteps between evaluations; below 1 only one at the end.
    :param eval_episodes: episodes of one evaluation; below 1 none at all.
    :param n_eval_envs: environments to evaluate in; None for as many as episodes if batched, else 1.
    :param eval_env_kwargs: put over the settings' ``env_kwargs`` in the evaluation's environments.
    :param save_freq: timesteps between checkpoints; below 1 none.
    :param log_interval: rollouts between two lines of the log.
    :param tensorboard_log: folder for TensorBoard, None for none.
    :param progress: whether to show a progress bar.
    :param verbose: as in SB3.
    :param unique: add a UUID to the run folder's name.
    """

    config: TrainingConfig
    log_folder: str = "logs"
    seed: int = 0
    device: str = "cpu"
    trained_agent: str | None = None
    eval_freq: int = 250_000
    eval_episodes: int = 48
    n_eval_envs: int | None = None
    eval_env_kwargs: dict[str, Any] | None = None
    save_freq: int = -1
    log_interval: int = 1
    tensorboard_log: str | None = None
    progress: bool = False
    verbose: int = 0
    unique: bool = False

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if self.n_eval_envs is not None and self.n_eval_envs < 1:
            raise ConfigError(f"n_eval_envs {self.n_eval_envs}: must be at least 1")
        if self.log_interval < 1:
            raise ConfigError(f"log_interval {self.log_interval}: must be at least 1")

    @property
    def for_evaluation(self) -> TrainingConfig:
        """The settings with the environments as evaluations have them."""
        return self.config.for_evaluation(self.eval_env_kwargs)

    @property
    def flight_settings(self) -> FlightSettings:
        """How the agent is judged, in an environment of this package."""
        return self.for_evaluation.flight_settings

    def arguments(self) -> dict[str, Any]:
        """What args.yml holds: everything but the settings, which config.yml holds."""
        plain = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "config"}
        return {"algo": self.config.algo, "env": self.config.env_id, **plain}

    @staticmethod
    def from_arguments(config: TrainingConfig, arguments: dict[str, Any], where: str | Path) -> TrainingJob:
        """The job that :meth:`arguments` came from.

        :raises ConfigError: an argument that no job has, or of another type.
        """
        names = {entry.name for entry in fields(TrainingJob)} - {"config"}
        given = {key: value for key, value in arguments.items() if key not in ("algo", "env", "env_kwargs")}
        for key in given:
            if key not in names:
                raise ConfigError(f"{where}: {unknown('argument', key, names)}")
        try:
            return TrainingJob(config, **given)
        except TypeError as error:
            raise ConfigError(f"{where}: {error}") from None


def describe(job: TrainingJob) -> str:
    """One line that says what is about to be trained."""
    config = job.config
    start = f", from {job.trained_agent}" if job.trained_agent else ""
    expert = f", expert {config.expert}" if config.expert is not None else ""
    return (
        f"{config.algo} on {config.env_id}: {config.n_timesteps:,} timesteps, {config.n_envs} environments "
        f"({config.vec_env}){expert}, seed {job.seed}{start}"
    )
