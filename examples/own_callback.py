"""Your own callback: it lets the expert fly less as crashes get rare, and logs their share.

    python examples/own_callback.py

The callbacks that come with sb3_quad: docs/callbacks.md.
"""

import argparse

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger, GeometricExpert, QuadcopterVecEnv, fly


class FewerCrashes(BaseCallback):
    """Log the share of the episodes that ended on the ground, and let the expert fly that share."""

    def _on_training_start(self) -> None:
        self.episodes = 0
        self.crashes = 0

    def _on_step(self) -> bool:
        # Infos are empty, except where an episode ends.
        for info in self.locals["infos"]:
            if "collision" in info:
                self.episodes += 1
                self.crashes += info["collision"]
        return True  # False would end the training

    def _on_rollout_end(self) -> None:
        # A share of fewer episodes would be noise.
        if self.episodes >= 100:
            rate = self.crashes / self.episodes
            self.logger.record("my/crash_rate", rate)
            assert isinstance(self.model, DAgger)
            # It counts from the next rollout on.
            self.model.set_beta(rate)
            print(f"{self.num_timesteps:>9,} timesteps: {rate:.0%} of {self.episodes} crashed")
            self._on_training_start()


parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=600_000,
    help="transitions, over all environments (%(default)s)",
)
arguments = parser.parse_args()

env = QuadcopterVecEnv(240, task="state_recovery", max_episode_steps=300, seed=0)
model = DAgger(
    "MlpPolicy",
    env,
    expert=GeometricExpert(),
    n_steps=125,
    batch_size=2048,
    gradient_steps=100,
    n_epochs=1,
    gamma=0.99,
    learning_rate=LinearSchedule(5e-3, 2.5e-4, 1.0),
    dataset_capacity=1_500_000,
    seed=0,
    device="cpu",
)
model.learn(arguments.timesteps, callback=FewerCrashes())
flights = fly(model, "state_recovery", n_episodes=480, seed=1_000_000)
print(f"agent: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}")
