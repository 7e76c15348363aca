"""Settings of a training in TensorBoard, and runs of Weights & Biases."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import stable_baselines3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.runs import made_with

# TensorBoard shows these next to the settings, under HPARAMS.
METRICS = ("eval/success_rate", "eval/mean_reward", "rollout/ep_rew_mean")


class HyperparameterLog(BaseCallback):
    """Logs a job's settings when its training begins; only TensorBoard shows them."""

    def __init__(self, job: TrainingJob) -> None:
        super().__init__()
        config = job.config
        shown = {"algo": config.algo, "env": config.env_id, "seed": job.seed, **config.settings}
        # TensorBoard takes plain values alone.
        self._shown = {
            name: value if isinstance(value, (bool, int, float)) else str(value)
            for name, value in shown.items()
        }

    def _on_training_start(self) -> None:
        parameters = HParam(self._shown, dict.fromkeys(METRICS, 0.0))
        self.logger.record("hparams", parameters, exclude=("stdout", "log", "json", "csv"))

    def _on_step(self) -> bool:
        return True


@contextmanager
def tracked(job: TrainingJob) -> Iterator[None]:
    """Track the block in a run of Weights & Biases, if the job asks for it.

    The run is made as rl_zoo3 makes it, and shows what TensorBoard is given.

    :raises ConfigError: it cannot begin, for example without a login.
    """
    if not job.track:
        yield
        return
    # wandb is an extra, which JobOptions has checked.
    import wandb

    config = job.config
    try:
        run = wandb.init(
            name=f"{config.env_id}__{config.algo}__{job.seed}__{int(time.time())}",
            project=job.wandb_project_name,
            entity=job.wandb_entity,
            group=job.wandb_group,
            tags=[*(job.wandb_tags or ()), f"v{stable_baselines3.__version__}"],
            config={**job.arguments(), **config.settings, **made_with()},
            sync_tensorboard=True,
        )
    except wandb.Error as error:
        raise ConfigError(f"--track: {one_line(error)}") from None
    with run:
        yield
