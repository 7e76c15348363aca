"""The settings of a training next to its metrics, in TensorBoard."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam

from sb3_quad.base.types import StrMapping

# TensorBoard shows these next to the settings, under HPARAMS.
METRICS = ("eval/success_rate", "eval/mean_reward", "rollout/ep_rew_mean")


class HyperparameterLog(BaseCallback):
    """Logs settings when the training begins; only TensorBoard shows them, under HPARAMS.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(800, callback=HyperparameterLog({"n_steps": 100, "gamma": model.gamma}))

    :param settings: by name; what is neither a number nor a boolean is shown as text.
    """

    def __init__(self, settings: StrMapping, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._settings = settings

    def _on_training_start(self) -> None:
        shown = {}
        for name, value in self._settings.items():
            # TensorBoard accepts only plain values.
            shown[name] = value if isinstance(value, (bool, int, float)) else str(value)
        self.logger.record(
            "hparams",
            HParam(shown, dict.fromkeys(METRICS, 0.0)),
            exclude=("stdout", "log", "json", "csv"),
        )

    def _on_step(self) -> bool:
        return True
