"""Evaluation along the way, and the best model kept: by success first, then by mean reward."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import read_arrays, save_model, write_arrays
from sb3_quad.callbacks.every import EveryTimesteps

LIVES = 20  # ends that SB3's Monitor does not count, as Atari's wrappers report, in one episode at most
Score = tuple[float, float]  # success rate, mean reward


class BestModel(EveryTimesteps):
    """Evaluates the deterministic policy every ``every`` timesteps, and whenever :meth:`evaluate` is called.

    Every evaluation flies the same episodes, so that models are compared and not their luck. SB3's EvalCallback keeps the
    model of the highest mean reward; here a model that succeeds more often is better, and reward decides between equals.
    ``evaluations.npz`` is EvalCallback's, with ``seconds`` of training, ``survivals`` where environments report them, and the
    losses of the latest update, by their names in the log such as ``train/value_loss``. It logs ``eval/success_rate``,
    ``eval/survival_rate``, ``eval/mean_reward`` and ``eval/mean_ep_length``, for ``others`` under ``eval_<name>/``, where the
    evaluation happens.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> tasks = ("state_recovery", "target_tracking")
    >>> recovery, tracking = (QuadcopterVecEnv(4, task, max_episode_steps=50) for task in tasks)
    >>> best = BestModel(recovery, every=800, n_episodes=4, seed=9, others={"tracking": tracking})
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, "state_recovery"), n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=best)
    >>> import numpy as np
    >>> np.load("evaluations.npz")["timesteps"].tolist(), np.load("evaluations_tracking.npz")["results"].shape
    ([800, 1600], (2, 4))
    >>> PPO.load("best_model.zip", device="cpu").num_timesteps in (800, 1600)
    True

    :param env: the environments to evaluate in, not those of the training; whoever made them closes them.
    :param every: timesteps between evaluations.
    :param n_episodes: episodes in each.
    :param seed: of the evaluation's episodes.
    :param best_model: where the best model goes; an existing file is replaced by a model that is better than all in
        ``evaluations``.
    :param evaluations: where the results go; an existing file is continued.
    :param report: called with one line for each evaluation.
    :param others: further environments by name, such as those of another task, which are evaluated at the same times. They do
        not decide which model is best; their results go to ``evaluations_<name>.npz`` beside ``evaluations``.
    :param should_continue: called after each evaluation with its success rate and mean reward; False ends the training.
    :raises ConfigError: ``every`` or ``n_episodes`` below 1; when training begins, ``evaluations`` that cannot be read or
        flew another number of episodes.
    :raises TrainingError: at an evaluation, a wrapper that drops ``info["episode"]`` of SB3's Monitor.
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
        should_continue: Callable[[float, float], bool] = lambda success, reward: True,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, verbose)
        if n_episodes < 1:
            raise ConfigError(f"BestModel: n_episodes is {n_episodes}, must be at least 1")
        self._n_episodes, self._seed = n_episodes, seed
        self._best_model, self._report, self._should_continue = best_model, report, should_continue
        path, others = Path(evaluations), others or {}
        # By the group of the log: the environments, the file, and its rows; the first group decides.
        self._envs = {"eval": env} | {f"eval_{name}": other for name, other in others.items()}
        self._paths = {"eval": path} | {f"eval_{name}": path.with_name(f"{path.stem}_{name}.npz") for name in others}
        self._rows: dict[str, dict[str, Any]] = {group: {} for group in self._envs}
        self._start = 0.0
        self.stopped = False  # by ``should_continue``
        self.best: Score = (-np.inf, -np.inf)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        for group, path in self._paths.items():
            if path.is_file():
                self._rows[group] = {name: list(array) for name, array in read_arrays(path).items()}
                flown = len(self._rows[group]["results"][-1])
                if flown != self._n_episodes:
                    raise ConfigError(f"{path}: evaluations of {flown} episodes; n_episodes (--eval-episodes) must be {flown}")
        rows = self._rows["eval"]
        self._start = time.perf_counter() - rows.get("seconds", [0.0])[-1]
        self.best = max(map(_score, rows.get("successes", []), rows.get("results", [])), default=self.best)

    def _on_event(self) -> bool:
        self.evaluate()
        return not self.stopped

    def evaluate(self) -> None:
        """Evaluate the model as it is now, note the results, and keep it if it is the best so far."""
        seconds = time.perf_counter() - self._start
        scores = {group: self._fly(group, seconds) for group in self._envs}
        words = [
            f"{group.removeprefix('eval_')}: success {100 * success:.1f} %, mean reward {reward:.2f}"
            for group, (success, reward) in scores.items()
        ]
        line = f"{self.num_timesteps:>12,} timesteps, {seconds:6.1f} s: " + "; ".join(words).removeprefix("eval: ")
        if getattr(self.model, "policy_is_idle", False):
            line += " (critic warm-up: the policy does not learn yet)"
        score = scores["eval"]
        if score > self.best:
            self.best = score
            save_model(self.model, self._best_model)
            line += " (best so far)"
        self._report(line)
        self.logger.dump(self.num_timesteps)  # as EvalCallback does: a later evaluation of the rollout would replace it
        self.stopped = not self._should_continue(*score)

    def _fly(self, group: str, seconds: float) -> Score:
        """Evaluate in one group's environments; write and log the results."""
        env, successes, survivals = self._envs[group], [], []
        unreported = 0  # ends in a row

        def note(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
            nonlocal unreported
            info = local_variables["info"]
            if not local_variables["done"]:
                return
            if local_variables.get("is_monitor_wrapped") and "episode" not in info:  # evaluate_policy does not count it
                unreported += 1
                if unreported > LIVES * env.num_envs:
                    raise TrainingError("evaluation: a wrapper drops info['episode'], by which SB3 counts episodes")
                return
            unreported = 0
            successes.append(float(info.get("is_success", 0.0)))  # without reports all fail, and reward decides
            survivals.append(float(info.get("survival", np.nan)))

        env.seed(self._seed)
        flown = evaluate_policy(self.model, env, self._n_episodes, callback=note, return_episode_rewards=True, warn=False)
        rewards, lengths = flown
        values = {"timesteps": self.num_timesteps, "results": rewards, "ep_lengths": lengths, "successes": successes}
        values["seconds"] = seconds
        if not np.isnan(survivals).any():
            values["survivals"] = survivals
        if group == "eval":  # of the latest update, which the log still holds
            values |= {name: float(value) for name, value in self.logger.name_to_value.items() if _is_loss(name)}
        _append(self._rows[group], values)
        write_arrays(self._paths[group], **self._rows[group])
        success, reward = score = _score(successes, rewards)
        logged = {"success_rate": success, "mean_reward": reward, "mean_ep_length": float(np.mean(lengths))}
        if "survivals" in values:
            logged["survival_rate"] = float(np.mean(survivals))
        for name, value in logged.items():
            self.logger.record(f"{group}/{name}", value)
        return score


def _append(rows: dict[str, Any], values: dict[str, Any]) -> None:
    """Add an evaluation to those before it; NaN stands for what one of them does not have, such as losses before the first."""
    before = len(rows.get("timesteps", []))
    for name in {**rows, **values}:
        example = values[name] if name in values else rows[name][-1]
        nothing = np.full(np.shape(example), np.nan)
        rows.setdefault(name, [nothing] * before).append(values.get(name, nothing))


def _is_loss(name: str) -> bool:
    return name.startswith("train/") and name.endswith("loss")


def _score(successes: Any, rewards: Any) -> Score:
    return float(np.mean(successes)), float(np.mean(rewards))
