"""What others see of a training: its settings in TensorBoard, and a run of Weights & Biases."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import stable_baselines3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.runs import made_with

METRICS = (
    "eval/success_rate",
    "eval/mean_reward",
    "rollout/ep_rew_mean",
)  # beside the settings, under HPARAMS


class HyperparameterLog(BaseCallback):
    """Logs a job's settings when its training begins; only TensorBoard shows them."""

    def __init__(self, job: TrainingJob) -> None:
        super().__init__()
        given = {
            **job.config.settings,
            "algo": job.config.algo,
            "env": job.config.env_id,
            "seed": job.seed,
        }
        self._shown = {
            name: value if isinstance(value, (bool, int, float)) else str(value)
            for name, value in given.items()
        }

    def _on_training_start(self) -> None:
        shown = HParam(self._shown, dict.fromkeys(METRICS, 0.0))
        self.logger.record("hparams", shown, exclude=("stdout", "log", "json", "csv"))

    def _on_step(self) -> bool:
        return True


@contextmanager
def tracked(job: TrainingJob) -> Iterator[None]:
    """Where the job is to be tracked, a run of Weights & Biases as rl_zoo3 makes it: it takes what
    TensorBoard is given.

    :raises ConfigError: it cannot begin, for example without a login.
    """
    if not job.track:
        yield
        return
    import wandb

    try:
        run = wandb.init(
            name=f"{job.config.env_id}__{job.config.algo}__{job.seed}__{int(time.time())}",
            project=job.wandb_project_name,
            entity=job.wandb_entity,
            group=job.wandb_group,
            tags=[*(job.wandb_tags or ()), f"v{stable_baselines3.__version__}"],
            config={**job.arguments(), **job.config.settings, **made_with()},
            sync_tensorboard=True,
        )
    except wandb.Error as error:
        raise ConfigError(f"--track: {one_line(error)}") from None
    with run:
        yield
