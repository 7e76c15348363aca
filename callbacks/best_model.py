"""Evaluation along the way, and the best model kept: by success first, then by mean reward."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import save_model, write_bytes
from sb3_quad.experts.controller import ExpertLabeller

GoesOn = Callable[[float, float], bool]


class BestModel(BaseCallback):
    """Evaluates the deterministic policy every ``every`` transitions, and whenever :meth:`evaluate` is called.

    The same episodes each time (the environments are seeded anew), so that models are compared and not their luck.
    Unlike SB3's EvalCallback, which keeps the highest mean reward, a model that succeeds more often is better; reward
    decides between equals. ``evaluations.npz`` is EvalCallback's, with ``seconds`` of training besides. Logged are
    ``eval/success_rate``, ``eval/mean_reward``, ``eval/mean_ep_length``; of others, the same with ``eval_<name>/``.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad import PIDExpert
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> tasks = ("state_recovery", "target_tracking")
    >>> recovery, tracking = (QuadcopterVecEnv(4, task, max_episode_steps=50) for task in tasks)
    >>> best = BestModel(recovery, every=800, n_episodes=4, seed=9, expert=PIDExpert(), others={"tracking": tracking})
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, "state_recovery"), n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=best)
    >>> import numpy as np
    >>> np.load("evaluations.npz")["timesteps"].tolist(), np.load("evaluations_tracking.npz")["results"].shape
    ([800, 1600], (2, 4))
    >>> PPO.load("best_model.zip", device="cpu").num_timesteps in (800, 1600)
    True

    :param env: the environments to evaluate in, not those of the training; closed by whoever made them.
    :param every: transitions between evaluations.
    :param n_episodes: episodes in each.
    :param seed: of the evaluation's episodes.
    :param best_model: where the best model goes; a file there is replaced, but by none that is worse than those in
        ``evaluations``.
    :param evaluations: where the figures go; a file that is there already is continued.
    :param report: told of each evaluation in one line.
    :param goes_on: asked after each evaluation, with its success rate and mean reward, whether the training goes on.
    :param others: by name: further environments, such as those of another task, to evaluate in at the same times. They have no
        say in which model is best; their figures go to ``evaluations_<name>.npz`` beside ``evaluations``.
    :param expert: as DAgger takes it; flies the same episodes once, at the first evaluation. ``eval/reward_against_expert``
        then tells how much mean reward the model has more than the expert.
    :raises ConfigError: ``every`` or ``n_episodes`` below 1.
    :raises ExpertError: at the first evaluation, an expert that does not fit the environment.
    """

    def __init__(
        self,
        env: VecEnv,
        every: int,
        n_episodes: int,
        seed: int,
        best_model: str | Path = "best_model.zip",
        evaluations: str | Path = "evaluations.npz",
        report: Callable[[str], None] = lambda line: None,
        others: Mapping[str, VecEnv] | None = None,
        expert: Any = None,
        goes_on: GoesOn = lambda success, reward: True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value in (("every", every), ("n_episodes", n_episodes)):
            if value < 1:
                raise ConfigError(f"BestModel: {name} is {value}, must be at least 1")
        best_model, evaluations = Path(best_model), Path(evaluations)
        self._env = env
        self._every, self._next = every, every
        self._n_episodes, self._seed = n_episodes, seed
        self._best_model = best_model
        self._report = report
        self._goes_on = goes_on
        self.stopped = False  # by ``goes_on``
        self._start = 0.0
        self._figures = _Figures(evaluations)
        self._others = {
            name: (other, _Figures(evaluations.with_name(f"{evaluations.stem}_{name}.npz")))
            for name, other in (others or {}).items()
        }
        self._expert = expert
        self._expert_rewards: dict[str, float] = {}  # mean, by group of the log
        self.best: tuple[float, float] = (-np.inf, -np.inf)  # success rate, mean reward

    def _on_training_start(self) -> None:
        self._start = time.perf_counter()
        self._next = (self.num_timesteps // self._every + 1) * self._every
        for figures in (self._figures, *(figures for _, figures in self._others.values())):
            figures.go_on()
        self.best = max(self._figures.scores(), default=self.best)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self.evaluate()
        return not self.stopped

    def evaluate(self) -> None:
        """Evaluate the model as it is now, note the figures, and keep it if it is the best so far."""
        seconds = self._figures.seconds_before + time.perf_counter() - self._start
        score = self._fly(self._env, self._figures, seconds, "eval")
        line = f"{self.num_timesteps:>12,} transitions, {seconds:6.1f} s: {_in_words(score)}"
        for name, (env, figures) in self._others.items():
            line += f"; {name}: {_in_words(self._fly(env, figures, seconds, f'eval_{name}'))}"
        better = score > self.best
        if better:
            self.best = score
            save_model(self.model, self._best_model)
        self._report(line + (" (best so far)" if better else ""))
        self.stopped = not self._goes_on(*score)

    def _fly(self, env: VecEnv, figures: _Figures, seconds: float, group: str) -> tuple[float, float]:
        successes: list[float] = []

        def note(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
            if local_variables["done"]:  # an environment that knows no success counts as failing: reward decides
                successes.append(float(local_variables["info"].get("is_success", 0.0)))

        env.seed(self._seed)
        rewards, lengths = evaluate_policy(
            self.model, env, self._n_episodes, deterministic=True, return_episode_rewards=True, callback=note, warn=False
        )
        figures.add(timesteps=self.num_timesteps, results=rewards, ep_lengths=lengths, successes=successes, seconds=seconds)
        score = (float(np.mean(successes)), float(np.mean(rewards)))
        self.logger.record(f"{group}/success_rate", score[0])
        self.logger.record(f"{group}/mean_reward", score[1])
        self.logger.record(f"{group}/mean_ep_length", float(np.mean(lengths)))
        if self._expert is not None:
            self.logger.record(f"{group}/reward_against_expert", score[1] - self._expert_reward(env, group))
        return score

    def _expert_reward(self, env: VecEnv, group: str) -> float:
        if group not in self._expert_rewards:
            env.seed(self._seed)
            expert: Any = _Predictor(ExpertLabeller(self._expert, env))
            mean, _ = evaluate_policy(expert, env, self._n_episodes, deterministic=True, warn=False)
            self._expert_rewards[group] = float(mean)  # type: ignore[arg-type]
        return self._expert_rewards[group]


class _Predictor:
    """An expert as ``evaluate_policy`` takes a model: asked with the environment's true state where that is what it needs."""

    def __init__(self, labeller: ExpertLabeller) -> None:
        self._labeller = labeller

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> tuple[Any, None]:
        return self._labeller.labels(observation), None


def _in_words(score: tuple[float, float]) -> str:
    return f"success {100 * score[0]:.1f} %, mean reward {score[1]:.2f}"


class _Figures:
    """The figures of a file such as EvalCallback's ``evaluations.npz``, a row more with each evaluation."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.records: dict[str, list[Any]] = {
            key: [] for key in ("timesteps", "results", "ep_lengths", "successes", "seconds")
        }
        self.seconds_before = 0.0

    def go_on(self) -> None:
        """Take over what the file holds already."""
        if self.path.is_file():
            with np.load(self.path) as file:
                self.records = {key: list(file[key]) for key in self.records}
            self.seconds_before = float(self.records["seconds"][-1])

    def scores(self) -> list[tuple[float, float]]:
        """Success rate and mean reward of every evaluation."""
        pairs = zip(self.records["successes"], self.records["results"], strict=True)
        return [(float(np.mean(successes)), float(np.mean(results))) for successes, results in pairs]

    def add(self, **row: Any) -> None:
        """Add a row and write the file."""
        for key, records in self.records.items():
            records.append(row[key])
        buffer = io.BytesIO()
        np.savez(buffer, **{key: np.array(values) for key, values in self.records.items()})  # type: ignore[arg-type]
        write_bytes(self.path, buffer.getvalue())
