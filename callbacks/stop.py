"""Leaving a training when someone asks for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.files import save_model
from sb3_quad.base.signals import StopSignals


class StopWhen(BaseCallback):
    """Ends the training after the first step at which ``asked()`` is true; nothing is interrupted half-way.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1_000_000, callback=StopWhen(lambda: model.num_timesteps >= 1000))
    >>> model.num_timesteps
    1000

    :param asked: such as ``lambda: signals.received is not None``.
    """

    def __init__(self, asked: Callable[[], bool], verbose: int = 0) -> None:
        super().__init__(verbose)
        self._asked = asked

    def _on_step(self) -> bool:
        return not self._asked()


class StopOnSignal(BaseCallback):
    """Makes Ctrl-C (SIGINT) and SIGTERM end ``model.learn`` after the step, and saves the model, whole or not at all.

    For scripts of one's own; ``sb3-quad train`` does more (resumable runs). A second signal interrupts at once, without
    saving. ``learn`` returns as ever, so what follows it in the script is run: look at ``signal`` to tell.

    >>> import signal
    >>> from stable_baselines3 import PPO
    >>> from stable_baselines3.common.callbacks import ConvertCallback
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> stop = StopOnSignal("interrupted.zip")
    >>> press = ConvertCallback(lambda at, _: at["self"].num_timesteps < 1000 or not signal.raise_signal(signal.SIGINT))
    >>> _ = model.learn(1_000_000, callback=[press, stop])  # and Ctrl-C, which `press` stands for here
    SIGINT after 1,000 transitions: model saved to interrupted.zip
    >>> stop.signal, PPO.load("interrupted.zip", device="cpu").num_timesteps
    ('SIGINT', 1000)

    To go on: ``PPO.load("interrupted.zip", env).learn(n, reset_num_timesteps=False)``.

    While ``learn`` runs, signals are held back; if it ends by an exception, the first one after that still is.

    :param path: where the model goes; a file there is replaced.
    :raises ConfigError: where the model is saved, a folder that cannot be written.
    """

    def __init__(self, path: str | Path, verbose: int = 1) -> None:
        super().__init__(verbose)
        self._path = Path(path)
        self._signals = StopSignals()

    @property
    def signal(self) -> str:
        """The name of the signal that ended the training, empty if none did."""
        return self._signals.name

    @property
    def exit_code(self) -> int:
        """For ``sys.exit``, as a shell expects it: 130 after SIGINT, 143 after SIGTERM; 0 if none came."""
        return self._signals.exit_code

    def _on_training_start(self) -> None:
        self._signals = StopSignals()
        self._signals.__enter__()

    def _on_step(self) -> bool:
        return self._signals.received is None

    def _on_training_end(self) -> None:
        try:
            if self.signal:
                save_model(self.model, self._path)
                if self.verbose:
                    print(f"{self.signal} after {self.num_timesteps:,} transitions: model saved to {self._path}")
        finally:
            self._signals.__exit__(None, None, None)
