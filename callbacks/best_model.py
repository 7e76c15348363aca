"""Evaluation along the way, and the best model kept: by success or survival first, then by mean
reward.
"""

import time
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError, TrainingError, unknown
from sb3_quad.base.files import read_arrays, save_model, write_arrays
from sb3_quad.callbacks.every import EveryTimesteps

LIVES = (
    20  # ends that SB3's Monitor does not count, as Atari's wrappers report, in one episode at most
)
Score = tuple[float, float]  # share of successes or survivals, mean reward
LOGGED: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "success_rate": ("successes", np.mean),
    "survival_rate": ("survivals", np.mean),
    "mean_reward": ("results", np.mean),
    "mean_ep_length": ("ep_lengths", np.mean),
    "final_error": ("final_errors", np.nanmedian),
}
"""By the name in the log: an array of an evaluation, and its statistic."""
RATES = {"success": "success_rate", "survival": "survival_rate"}
SHARES = {name: LOGGED[rate][0] for name, rate in RATES.items()}  # their arrays


class BestModel(EveryTimesteps):
    """Evaluates the deterministic policy every ``every`` timesteps, and after the last update.

    Every evaluation flies the same episodes, so that models are compared and not their luck. SB3's
    EvalCallback keeps the model of the highest mean reward; here a model that succeeds more often
    is better, and reward decides between equals. ``evaluations.npz`` is EvalCallback's, with
    ``seconds`` of training, ``survivals`` and ``final_errors`` (m, NaN where the flight was lost)
    where environments report them, and the losses of the latest update, by their names in the log
    such as ``train/value_loss``. It logs ``eval/mean_reward`` and ``eval/mean_ep_length``, where
    they are reported ``eval/success_rate``, ``eval/survival_rate`` and ``eval/final_error``, the
    median, for ``others`` under ``eval_<name>/``, where the evaluation happens. An evaluation that
    is due with the last timestep is the one after the last update.

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

    :param env: the environments to evaluate in, not those of the training; whoever made them closes
        them.
    :param every: timesteps between evaluations.
    :param n_episodes: episodes in each.
    :param seed: of the evaluation's episodes.
    :param best_model: where the best model goes; an existing file is replaced by a model that is
        better than all in ``evaluations``.
    :param evaluations: where the results go; an existing file is continued.
    :param report: called with one line for each evaluation.
    :param others: further environments by name, such as those of another task, which are evaluated
        at the same times. They do not decide which model is best; their results go to
        ``evaluations_<name>.npz`` beside ``evaluations``.
    :param should_continue: called after each evaluation with that share and mean reward; False ends
        the training.
    :param by: ``success`` or ``survival``: the share of episodes that makes a model the best;
        reward decides between equals.
    :raises ConfigError: ``every`` or ``n_episodes`` below 1; when training begins, ``evaluations``
        that cannot be read or flew another number of episodes.
    :raises TrainingError: at an evaluation, a wrapper that drops ``info["episode"]`` of SB3's
        Monitor.
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
        by: str = "success",
        verbose: int = 0,
    ) -> None:
        super().__init__(every, verbose)
        if by not in SHARES:
            raise ConfigError(unknown("share", by, SHARES))
        if n_episodes < 1:
            raise ConfigError(f"BestModel: n_episodes is {n_episodes}, must be at least 1")
        self._n_episodes, self._seed = n_episodes, seed
        self._best_model, self._report, self._should_continue = best_model, report, should_continue
        path, others = Path(evaluations), others or {}
        # By the group of the log: the environments, the file, and its rows; the first group
        # decides.
        self._envs = {"eval": env} | {f"eval_{name}": other for name, other in others.items()}
        self._paths = {"eval": path} | {
            f"eval_{name}": path.with_name(f"{path.stem}_{name}.npz") for name in others
        }
        self._by = SHARES[by]
        self._rows: dict[str, dict[str, Any]] = {group: {} for group in self._envs}
        self._start, self._last = 0.0, 0
        self.stopped = False  # by ``should_continue``
        self.best: Score = (-np.inf, -np.inf)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        for group, path in self._paths.items():
            if path.is_file():
                self._rows[group] = {name: list(array) for name, array in read_arrays(path).items()}
                if not self._rows[group].get("results"):
                    raise ConfigError(
                        f"{path}: cannot be read (results: no such array, or an empty one)"
                    )
                flown = len(self._rows[group]["results"][-1])
                if flown != self._n_episodes:
                    raise ConfigError(
                        f"{path}: evaluations of {flown} episodes; n_episodes (--eval-episodes) must be {flown}"
                    )
        rows = self._rows["eval"]
        self._start = time.perf_counter() - rows.get("seconds", [0.0])[-1]
        none: list[list[float]] = [[]] * len(rows.get("results", []))
        self.best = max(
            map(_score, rows.get(self._by, none), rows.get("results", [])), default=self.best
        )
        self._last = last_timestep(self.model)

    def _on_event(self) -> bool:
        if self.num_timesteps < self._last:
            self.evaluate()
        return not self.stopped

    def _on_training_end(self) -> None:
        if self.num_timesteps >= self._last and not self.stopped:
            self.evaluate()

    @property
    def latest(self) -> int:
        """Timesteps of the latest evaluation; 0: there was none."""
        return int(self._rows["eval"].get("timesteps", [0])[-1])

    def evaluate(self) -> None:
        """Evaluate the model as it is now, note the results, and keep it if it is the best so far."""
        seconds = time.perf_counter() - self._start
        scores = {group: self._fly(group, seconds) for group in self._envs}
        words = [
            f"{group.removeprefix('eval_')}: {self._in_words(group, reward)}"
            for group, (_, reward) in scores.items()
        ]
        line = f"{self.num_timesteps:>12,} timesteps, {seconds:6.1f} s: " + "; ".join(
            words
        ).removeprefix("eval: ")
        if getattr(self.model, "policy_is_idle", False):
            line += " (critic warm-up: the policy does not learn yet)"
        score = scores["eval"]
        if score > self.best:
            self.best = score
            save_model(self.model, self._best_model)
            line += " (best so far)"
        self._report(line)
        self.logger.dump(
            self.num_timesteps
        )  # as EvalCallback does: a later evaluation of the rollout would replace it
        self.stopped = not self._should_continue(*score)

    def _fly(self, group: str, seconds: float) -> Score:
        """Evaluate in one group's environments; write and log the results."""
        env, unreported = self._envs[group], 0  # ends in a row
        successes, survivals, errors = list[float](), list[float](), list[float]()

        def note(local_variables: dict[str, Any], global_variables: dict[str, Any]) -> None:
            nonlocal unreported
            info = local_variables["info"]
            if not local_variables["done"]:
                return
            if (
                local_variables.get("is_monitor_wrapped") and "episode" not in info
            ):  # evaluate_policy does not count it
                unreported += 1
                if unreported > LIVES * env.num_envs:
                    raise TrainingError(
                        "evaluation: a wrapper drops info['episode'], by which SB3 counts episodes"
                    )
                return
            unreported = 0
            successes.append(float(info.get("is_success", np.nan)))
            survivals.append(float(info.get("survival", np.nan)))
            errors.append(float(info.get("distance", np.nan) if info.get("survival") else np.nan))

        env.seed(self._seed)
        flown = evaluate_policy(
            self.model,
            env,
            self._n_episodes,
            callback=note,
            return_episode_rewards=True,
            warn=False,
        )
        rewards, lengths = flown
        values: dict[str, Any] = {
            "timesteps": self.num_timesteps,
            "results": rewards,
            "ep_lengths": lengths,
            "seconds": seconds,
        }
        reported = {"successes": successes, "survivals": survivals, "final_errors": errors}
        values |= {name: each for name, each in reported.items() if not np.isnan(each).all()}
        if "successes" in values:
            values["successes"] = np.nan_to_num(successes)  # some environments report no failures
        if group == "eval":  # of the latest update, which the log still holds
            logged = self.logger.name_to_value
            values |= {
                name: float(logged[name]) for name in logged if fnmatchcase(name, "train/*loss")
            }
        _append(self._rows[group], values)
        write_arrays(self._paths[group], **self._rows[group])
        for name, value in self._latest(group).items():
            self.logger.record(f"{group}/{name}", value)
        return _score(values.get(self._by, []), rewards)

    def _latest(self, group: str) -> dict[str, float]:
        """What the latest evaluation says, by its names in the log."""
        found = {}
        for name, (array, statistic) in LOGGED.items():
            values = np.asarray(self._rows[group].get(array, [np.nan])[-1], dtype=np.float64)
            if not np.isnan(values).all():
                found[name] = float(statistic(values))
        return found

    def _in_words(self, group: str, reward: float) -> str:
        latest = self._latest(group)
        rates = [
            f"{name} {100 * latest[key]:.1f} %, " for name, key in RATES.items() if key in latest
        ]
        return f"{''.join(rates)}mean reward {reward:.2f}"


def last_timestep(model: BaseAlgorithm) -> int:
    """The number of timesteps at which ``model.learn``, which has begun, ends: whole rollouts."""
    steps = 1
    if isinstance(model, OnPolicyAlgorithm):
        steps = model.n_steps
    elif isinstance(model, OffPolicyAlgorithm):
        frequency: Any = model.train_freq
        steps = frequency.frequency if frequency.unit == TrainFrequencyUnit.STEP else 1
    size = steps * model.n_envs
    return model.num_timesteps - (model.num_timesteps - model._total_timesteps) // size * size


def _append(rows: dict[str, Any], values: dict[str, Any]) -> None:
    """Add an evaluation to those before it; NaN stands for what one of them does not have, such as
    losses before the first.
    """
    before = len(rows.get("timesteps", []))
    for name in {**rows, **values}:
        example = values[name] if name in values else rows[name][-1]
        nothing = np.full(np.shape(example), np.nan)
        rows.setdefault(name, [nothing] * before).append(values.get(name, nothing))


def _score(successes: Any, rewards: Any) -> Score:
    """Where there are no successes, reward decides."""
    return float(np.mean(successes)) if len(successes) else 0.0, float(np.mean(rewards))
