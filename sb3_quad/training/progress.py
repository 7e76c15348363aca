"""The progress bar of a training."""

from stable_baselines3.common.callbacks import ProgressBarCallback


class ProgressBar(ProgressBarCallback):
    """SB3's progress bar, which says when it stands still because the networks learn rather than fly."""

    def _on_rollout_start(self) -> None:
        self.pbar.set_description("flying")

    def _on_rollout_end(self) -> None:
        self.pbar.set_description("learning")
