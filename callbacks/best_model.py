"""Evaluation along the way, and the best model kept: by success first, then by mean reward."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.training.files import save_model, write_bytes


class BestModel(BaseCallback):
    """Evaluates the deterministic policy every ``every`` transitions, and whenever :meth:`evaluate` is called.

    The same episodes each time (the environments are seeded anew), so that models are compared and not their luck.
    Unlike SB3's EvalCallback, which keeps the highest mean reward, a model that succeeds more often is better; reward
    decides between equals. ``evaluations.npz`` is EvalCallback's, with ``seconds`` of training besides.

    :param env: the environments to evaluate in, not those of the training; closed by whoever made them.
    :param every: transitions between evaluations.
    :param n_episodes: episodes in each.
    :param seed: of the evaluation's episodes.
    :param best_model: where the best model goes.
    :param evaluations: where the figures go; a file that is there already is continued.
    :param report: told of each evaluation in one line.
    """

    def __init__(
        self,
        env: VecEnv,
        every: int,
        n_episodes: int,
        seed: int,
        best_model: Path,
        evaluations: Path,
        report: Callable[[str], None] = lambda line: None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self._env = env
        self._every, self._next = every, every
        self._n_episodes, self._seed = n_episodes, seed
        self._best_model, self._evaluations = best_model, evaluations
        self._report = report
        self._start = 0.0
        self._seconds_before = 0.0
        self._records: dict[str, list[Any]] = {
            key: [] for key in ("timesteps", "results", "ep_lengths", "successes", "seconds")
        }
        self.best: tuple[float, float] = (-np.inf, -np.inf)  # success rate, mean reward

    def _on_training_start(self) -> None:
        self._start = time.perf_counter()
        self._next = (self.num_timesteps // self._every + 1) * self._every
        if self._evaluations.is_file():
            with np.load(self._evaluations) as file:
                self._records = {key: list(file[key]) for key in self._records}
            self._seconds_before = float(self._records["seconds"][-1])
            pairs = zip(self._records["successes"], self._records["results"], strict=True)
            self.best = max((float(np.mean(successes)), float(np.mean(results))) for successes, results in pairs)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self.evaluate()
        return True

    def evaluate(self) -> None:
        """Evaluate the model as it is now, note the figures, and keep it if it is the best so far."""
        successes: list[float] = []

        def note(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
            if local_variables["done"]:  # an environment that knows no success counts as failing: reward decides
                successes.append(float(local_variables["info"].get("is_success", 0.0)))

        self._env.seed(self._seed)
        rewards, lengths = evaluate_policy(
            self.model, self._env, self._n_episodes, deterministic=True, return_episode_rewards=True, callback=note, warn=False
        )
        score = (float(np.mean(successes)), float(np.mean(rewards)))
        seconds = self._seconds_before + time.perf_counter() - self._start
        entry = (self.num_timesteps, rewards, lengths, successes, seconds)
        for records, value in zip(self._records.values(), entry, strict=True):
            records.append(value)
        self._write()
        self.logger.record("eval/success_rate", score[0])
        self.logger.record("eval/mean_reward", score[1])
        self.logger.record("eval/mean_ep_length", float(np.mean(lengths)))
        better = score > self.best
        if better:
            self.best = score
            save_model(self.model, self._best_model)
        self._report(
            f"{self.num_timesteps:>12,} transitions, {seconds:6.1f} s: success {100 * score[0]:.1f} %, "
            f"mean reward {score[1]:.2f}{' (best so far)' if better else ''}"
        )

    def _write(self) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, **{key: np.array(values) for key, values in self._records.items()})  # type: ignore[arg-type]
        write_bytes(self._evaluations, buffer.getvalue())
