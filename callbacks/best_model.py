"""Evaluation during training, which keeps the best model."""

import time
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_quad.algorithms.chain import refuse_other_wrappers, share_statistics
from sb3_quad.base.errors import ConfigError, TrainingError, refuse_unknown
from sb3_quad.base.files import read_arrays, save_model, write_arrays
from sb3_quad.base.types import Report, StrDict, StrPath
from sb3_quad.callbacks.every import EveryTimesteps, last_timestep

# By logged name: an array of an evaluation, and the statistic that is logged.
LOGGED: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "success_rate": ("successes", np.mean),
    "survival_rate": ("survivals", np.mean),
    "mean_reward": ("results", np.mean),
    "task_reward": ("task_results", np.mean),
    "mean_ep_length": ("ep_lengths", np.mean),
    "final_error": ("final_errors", np.nanmedian),
}
# The array of each rate that can decide, which is logged as "success_rate", for example.
RATES = {"success": "successes", "survival": "survivals"}
# The key in ``info`` of each array that environments may report.
REPORTED = {"successes": "is_success", "survivals": "survival", "final_errors": "distance"}
# Given the rate that decides and the mean reward of an evaluation, whether to continue.
ShouldContinue = Callable[[float, float], bool]
# The rate that decides, 0 where the reward alone does, and the mean reward.
Score = tuple[float, float]


class BestModel(EveryTimesteps):
    """Evaluates the deterministic policy every ``every`` timesteps, and after the last update.

    There is no evaluation at the end if a callback has ended the training earlier.

    Every evaluation flies the same episodes, so that models are compared and not their luck. As in
    SB3's EvalCallback, the best model has the highest mean reward. Rewards are counted as the
    training sees them: if a wrapper changes them, the task's own are shown as well and decide
    nothing. An evaluation that is due at the last timestep is made once, after the last update.

    ``evaluations.npz`` is EvalCallback's with more arrays: ``seconds`` of training; ``survivals``
    and ``final_errors`` (m, NaN where the vehicle crashed or flew out of range), where environments
    report them; ``task_results``, where a wrapper changes rewards; and the losses of the latest
    update, by their names in the log such as ``train/value_loss``.

    Logged at each evaluation are ``eval/mean_reward`` and ``eval/mean_ep_length``, and where they
    are reported ``eval/success_rate``, ``eval/survival_rate``, the median ``eval/final_error`` and
    ``eval/task_reward``; for ``others`` they are under ``eval_<name>/``.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> tasks = ("state_recovery", "target_tracking")
    >>> recovery, tracking = (QuadcopterVecEnv(4, task, max_episode_steps=50) for task in tasks)
    >>> best = BestModel(recovery, every=800, n_episodes=4, seed=9, others={"tracking": tracking})
    >>> env = QuadcopterVecEnv(8, "state_recovery")
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=best)
    >>> import numpy as np
    >>> np.load("evaluations.npz")["timesteps"].tolist()
    [800, 1600]
    >>> np.load("evaluations_tracking.npz")["results"].shape
    (2, 4)
    >>> PPO.load("best_model.zip", device="cpu").num_timesteps in (800, 1600)
    True

    :param env: the environment or environments to evaluate in, not those of the training; you close
        them. A VecNormalize there gets the training's statistics, and neither learns nor scales
        rewards.
    :param every: timesteps between evaluations.
    :param n_episodes: episodes in each.
    :param seed: seed of the evaluation's episodes.
    :param best_model: where the best model goes; an existing file is replaced by a model that is
        better than all in ``evaluations``.
    :param evaluations: where the results go; an existing file is continued.
    :param report: called with one line for each evaluation.
    :param others: further environments by name, such as those of another task, which are evaluated
        at the same times. They do not decide which model is best; their results go to
        ``evaluations_<name>.npz`` next to ``evaluations``.
    :param should_continue: called after each evaluation with the rate and the mean reward that
        decide; False ends the training.
    :param by: what decides which model is best: ``reward``; or ``success`` or ``survival``, a rate
        that comes before the reward.
    :param with_start: whether it also evaluates the model before the first rollout, which then may
        be the best: for a training that starts from an agent.
    :raises ConfigError: ``every`` or ``n_episodes`` below 1; when training begins, ``evaluations``
        that cannot be read or flew another number of episodes.
    :raises TrainingError: at an evaluation, a wrapper that drops ``info["episode"]`` of SB3's
        Monitor.
    """

    def __init__(
        self,
        env: GymEnv,
        every: int,
        n_episodes: int,
        seed: int,
        best_model: StrPath = "best_model.zip",
        evaluations: StrPath = "evaluations.npz",
        report: Report = lambda line: None,
        others: Mapping[str, GymEnv] | None = None,
        should_continue: ShouldContinue = lambda success, reward: True,
        by: str = "reward",
        with_start: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, verbose)
        refuse_unknown("by", [by], ["reward", *RATES])
        if n_episodes < 1:
            raise ConfigError(f"BestModel: n_episodes is {n_episodes}, must be at least 1")
        self._n_episodes = n_episodes
        self._seed = seed
        self._best_model = best_model
        self._report = report
        self._should_continue = should_continue
        self._by = RATES.get(by, "")
        self._with_start = with_start
        path = Path(evaluations)
        self._own = _Evaluations(_vectorised(env), path)
        # By the prefix of their part of a report line.
        self._evaluations = {"": self._own}
        for name, other in (others or {}).items():
            self._evaluations[f"{name}: "] = _Evaluations(
                _vectorised(other), path.with_name(f"{path.stem}_{name}.npz"), f"eval_{name}"
            )
        self.stopped = False  # by ``should_continue``
        self.best: Score = (-np.inf, -np.inf)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.stopped = False
        for evaluations in self._evaluations.values():
            share_statistics(self.model.get_vec_normalize_env(), evaluations.env)
            refuse_other_wrappers(self.model, evaluations.env)
            evaluations.read(self._n_episodes)
        is_new = self._with_start and self.num_timesteps == 0
        if is_new:
            # A kill may have left the row of the start without its model.
            for evaluations in self._evaluations.values():
                evaluations.rows = [row for row in evaluations.rows if row["timesteps"] > 0]
        # A resumed training continues the clock and knows the best model so far.
        self._start = time.perf_counter()
        for row in self._own.rows:
            self.best = max(self.best, score(row, self._by))
        if self._own.rows:
            self._start -= self._own.rows[-1].get("seconds", 0.0)
        self._last = last_timestep(self.model)
        if is_new:
            self.evaluate()

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
        rows = self._own.rows
        return int(rows[-1]["timesteps"]) if rows else 0

    def evaluate(self) -> None:
        """Evaluate the model as it is now, note the results, and keep it if it is the best."""
        seconds = time.perf_counter() - self._start
        values: StrDict = {"timesteps": self.num_timesteps, "seconds": seconds}
        # The log still holds the losses of the latest update.
        for name, value in self.logger.name_to_value.items():
            if fnmatchcase(name, "train/*loss"):
                values[name] = float(value)
        texts = []
        for prefix, evaluations in self._evaluations.items():
            share_statistics(self.model.get_vec_normalize_env(), evaluations.env)
            flown = fly_episodes(self.model, evaluations.env, self._n_episodes, self._seed)
            evaluations.append({**values, **flown})
            text = prefix
            for name, (array, statistic) in LOGGED.items():
                if array in flown:
                    self.logger.record(
                        f"{evaluations.group}/{name}", float(statistic(flown[array]))
                    )
            for name, array in RATES.items():
                if array in flown:
                    text += f"{name} {100 * np.mean(flown[array]):.1f} %, "
            text += f"mean reward {np.mean(flown['results']):.2f}"
            if "task_results" in flown:
                text += f" (the task's own: {np.mean(flown['task_results']):.2f})"
            texts.append(text)
        line = f"{self.num_timesteps:>12,} timesteps, {seconds:6.1f} s: {'; '.join(texts)}"
        if getattr(self.model, "policy_is_idle", False):
            line += " (critic warm-up: the policy does not learn yet)"
        latest = score(self._own.rows[-1], self._by)
        if latest > self.best:
            self.best = latest
            save_model(self.model, self._best_model)
            line += " (best so far)"
        self._report(line)
        # As EvalCallback does; a later evaluation in the same rollout would replace these values.
        self.logger.dump(self.num_timesteps)
        # The start is no result of the training.
        self.stopped = self.num_timesteps > 0 and not self._should_continue(*latest)


@dataclass
class _Evaluations:
    """The evaluations in some environments: their file, their group in the log, and each of them
    as a row of arrays by name.
    """

    env: VecEnv
    path: Path
    group: str = "eval"
    rows: Sequence[StrDict] = ()

    def read(self, n_episodes: int) -> None:
        """Continue the file, if it exists.

        :raises ConfigError: it cannot be read, or its evaluations have another number of episodes.
        """
        if not self.path.is_file():
            return
        self.rows = read_rows(self.path)
        flown = len(self.rows[-1]["results"])
        if flown != n_episodes:
            raise ConfigError(
                f"{self.path}: evaluations of {flown} episodes; "
                f"n_episodes (--eval-episodes) must be {flown}"
            )

    def append(self, row: StrDict) -> None:
        """Add an evaluation and write the file.

        Values that an evaluation does not have become NaN, such as losses before the first update.
        """
        self.rows = [*self.rows, row]
        arrays: StrDict = {}
        # An example of each array shows its shape.
        for name, value in ChainMap(*self.rows).items():
            nothing = np.full(np.shape(value), np.nan)
            arrays[name] = [row.get(name, nothing) for row in self.rows]
        write_arrays(self.path, **arrays)


def read_rows(path: Path) -> list[StrDict]:
    """Return the evaluations in a file, at least one, each as arrays by name.

    :raises ConfigError: it cannot be read.
    """
    arrays = read_arrays(path)
    rows = [dict(zip(arrays, row, strict=True)) for row in zip(*arrays.values(), strict=False)]
    if not rows or "results" not in rows[0]:
        raise ConfigError(f"{path}: cannot be read (results: no such array, or empty)")
    return rows


def _vectorised(env: GymEnv) -> VecEnv:
    return env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])


def score(row: StrDict, by: str) -> Score:
    """Return the score of an evaluation; without the rate, the reward decides.

    :param by: the array of the rate; empty: none.
    """
    return float(np.nan_to_num(np.mean(row.get(by, 0.0)))), float(np.mean(row["results"]))


def fly_episodes(model: Any, env: VecEnv, n_episodes: int, seed: int) -> StrDict:
    """Return the arrays of an evaluation that the environments report, (n_episodes,) each.

    They are in the order of the rows, so that the same episodes of two models stand side by side,
    whichever ends first.

    :raises TrainingError: a wrapper drops ``info["episode"]`` of SB3's Monitor.
    """
    rows = []
    own = []
    ends = []

    def note(local_variables: StrDict, global_variables: StrDict) -> None:
        if not local_variables["done"]:
            return
        rows.append(local_variables["i"])
        own.append(local_variables["current_rewards"][rows[-1]])
        ends.append(local_variables["info"])
        # evaluate_policy would count no episode and never end.
        if local_variables.get("is_monitor_wrapped") and "episode" not in ends[-1]:
            raise TrainingError(
                "evaluation: a wrapper drops info['episode'], by which SB3 counts episodes"
            )

    env.seed(seed)
    # Monitor, below the wrappers, records the task's own rewards.
    rewards, lengths = evaluate_policy(
        model, env, n_episodes, callback=note, return_episode_rewards=True, warn=False
    )
    values: StrDict = {"results": rewards, "ep_lengths": lengths}
    # It rounds sums, and the rewards of environments are float32.
    if not np.allclose(rewards, own, rtol=1e-4, atol=1e-3):
        values |= {"results": own, "task_results": rewards}
    for name, key in REPORTED.items():
        array = np.array([info.get(key, np.nan) for info in ends], np.float64)
        if key == "distance":
            # There is no final error without a final position.
            array[[not info.get("survival") for info in ends]] = np.nan
        if not np.isnan(array).all():
            values[name] = array
    # Some environments report successes but not failures.
    if "successes" in values:
        values["successes"] = np.nan_to_num(values["successes"])
    order = np.argsort(rows, kind="stable")
    return {name: np.asarray(array)[order] for name, array in values.items()}
