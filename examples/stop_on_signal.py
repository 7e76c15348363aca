"""Ctrl-C in your own training script: the training ends after the current step, and the model is
saved.

    python examples/stop_on_signal.py

``sb3-quad train`` does more: you can resume its runs exactly.
"""

import argparse
from pathlib import Path

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.files import save_model
from sb3_quad.base.process import StopSignals
from sb3_quad.envs import QuadcopterVecEnv


class StopOnSignal(BaseCallback):
    """End ``model.learn`` after the step on Ctrl-C (SIGINT), SIGTERM or SIGHUP, and save the model.

    The file is written whole or not at all. A second signal interrupts at once, without saving.
    ``learn`` returns as usual and the script continues; ``signal`` tells whether one came.

    To continue: ``PPO.load("interrupted.zip", env).learn(n, reset_num_timesteps=False)``. While
    ``learn`` runs, signals are held back. If an exception ends it, the next signal is held back
    too.

    :param path: file for the model; an existing one is replaced.
    :raises ConfigError: when the model is saved, if its folder cannot be written.
    """

    signal = ""
    """The name of the signal that ended the training, empty if none did."""
    exit_code = 0
    """For ``sys.exit``, as a shell expects it.

    130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP; 0 if no signal came.
    """

    def __init__(self, path: str | Path, verbose: int = 1) -> None:
        super().__init__(verbose)
        self._path = Path(path)

    def _on_training_start(self) -> None:
        self.signal = ""
        self.exit_code = 0
        self._signals = StopSignals()
        self._signals.__enter__()

    def _on_step(self) -> bool:
        return self._signals.received is None

    def _on_training_end(self) -> None:
        self._signals.hold()
        self.signal = self._signals.name
        self.exit_code = self._signals.exit_code
        try:
            if self.signal:
                save_model(self.model, self._path)
                if self.verbose:
                    print(
                        f"{self.signal} after {self.num_timesteps:,} timesteps: "
                        f"model saved to {self._path}"
                    )
        finally:
            self._signals.__exit__(None, None, None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--timesteps", type=int, default=1_000_000, help="over all environments (%(default)s)"
    )
    arguments = parser.parse_args()

    model = PPO(
        "MlpPolicy",
        QuadcopterVecEnv(48, seed=0),
        n_steps=250,
        batch_size=3000,
        seed=0,
        device="cpu",
    )
    stop = StopOnSignal("interrupted.zip")
    model.learn(arguments.timesteps, callback=stop)
    print(f"{model.num_timesteps:,} timesteps")
    raise SystemExit(stop.exit_code)
