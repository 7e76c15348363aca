"""Leaving a training when someone asks for it."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.files import save_model
from sb3_quad.base.signals import StopSignals


class StopOnSignal(BaseCallback):
    """Makes Ctrl-C (SIGINT) and SIGTERM end ``model.learn`` after the step, and saves the model, whole or not at all.

    For your own scripts; ``sb3-quad train`` does more (resumable runs). A second signal interrupts at once, without saving.
    ``learn`` returns as usual and the script continues; ``signal`` tells whether one came.

    >>> import signal
    >>> from stable_baselines3 import PPO
    >>> from stable_baselines3.common.callbacks import ConvertCallback
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> stop = StopOnSignal("interrupted.zip")
    >>> press = ConvertCallback(lambda at, _: at["self"].num_timesteps < 1000 or not signal.raise_signal(signal.SIGINT))
    >>> _ = model.learn(1_000_000, callback=[press, stop])  # and Ctrl-C, which `press` stands for here
    SIGINT after 1,000 timesteps: model saved to interrupted.zip
    >>> stop.signal, PPO.load("interrupted.zip", device="cpu").num_timesteps
    ('SIGINT', 1000)

    To continue: ``PPO.load("interrupted.zip", env).learn(n, reset_num_timesteps=False)``. While ``learn`` runs, signals are
    held back. If an exception ends it, the next signal is held back too.

    :param path: where the model goes; an existing file is replaced.
    :raises ConfigError: where the model is saved, a folder that cannot be written.
    """

    signal = ""
    """The name of the signal that ended the training, empty if none did."""
    exit_code = 0
    """For ``sys.exit``, as a shell expects it: 130 after SIGINT, 143 after SIGTERM; 0 if none came."""

    def __init__(self, path: str | Path, verbose: int = 1) -> None:
        super().__init__(verbose)
        self._path = Path(path)

    def _on_training_start(self) -> None:
        self.signal, self.exit_code = "", 0
        self._signals = StopSignals()
        self._signals.__enter__()

    def _on_step(self) -> bool:
        return self._signals.received is None

    def _on_training_end(self) -> None:
        self.signal, self.exit_code = self._signals.name, self._signals.exit_code
        try:
            if self.signal:
                save_model(self.model, self._path)
                if self.verbose:
                    print(f"{self.signal} after {self.num_timesteps:,} timesteps: model saved to {self._path}")
        finally:
            self._signals.__exit__(None, None, None)
