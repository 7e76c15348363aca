"""Callbacks: with any algorithm and environment, each does its one thing."""

import random
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.results_plotter import load_results
from stable_baselines3.common.vec_env import VecEnvWrapper
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks import best_model, every
from sb3_quad.callbacks.best_model import BestModel, fly_episodes
from sb3_quad.callbacks.every import Checkpoint, EpisodeLog, ProgressLine
from sb3_quad.callbacks.snapshot import random_state, set_random_state
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly


class Walk(gymnasium.Env):
    """Ten steps; a success when the last action is positive."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observation(), {}

    def step(self, action):
        self.steps += 1
        return (
            self._observation(),
            float(action[0]),
            False,
            self.steps == 10,
            {"is_success": bool(action[0] > 0)},
        )

    def _observation(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


def make_model(**kwargs):
    return PPO(
        "MlpPolicy",
        make_vec_env(Walk, 2),
        n_steps=20,
        batch_size=20,
        policy_kwargs={"net_arch": [4]},
        seed=0,
        device="cpu",
        **kwargs,
    )


def make_best(tmp_path, every=1000, **kwargs):
    return BestModel(
        make_vec_env(Walk, 2),
        every,
        4,
        5,
        tmp_path / "best_model.zip",
        tmp_path / "evaluations.npz",
        **kwargs,
    )


def test_evaluations_are_regular_and_recorded(tmp_path):
    lines = []
    best = make_best(tmp_path, every=60, report=lines.append)
    make_model().learn(160, callback=best)
    best = make_best(tmp_path, every=60, report=lines.append)  # an existing file is continued
    make_model().learn(60, callback=best)
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [60, 120, 160, 60, 80]  # whole rollouts
        assert (
            file["results"].shape == file["successes"].shape == file["ep_lengths"].shape == (5, 4)
        )
        assert (np.diff(file["seconds"]) >= 0).all()
        means = file["results"].mean(axis=1), file["successes"].mean(axis=1)
    assert best.best == (0.0, max(means[0]))
    assert len(lines) == 5
    assert (tmp_path / "best_model.zip").is_file()


def logged(folder, tag):
    """Timesteps and values that TensorBoard shows."""
    events = EventAccumulator(str(folder)).Reload()
    return [(event.step, event.value) for event in events.Scalars(tag)]


def test_tensorboard_shows_every_evaluation_where_it_happened(tmp_path):
    best, model = make_best(tmp_path, every=20), make_model(tensorboard_log=str(tmp_path))
    model.learn(120, callback=best)  # two in each rollout
    with np.load(tmp_path / "evaluations.npz") as file:
        means = file["results"].mean(axis=1)
    steps, shown = zip(*logged(tmp_path / "PPO_1", "eval/mean_reward"), strict=True)
    assert steps == (20, 40, 60, 80, 100, 120) and shown == pytest.approx(means, abs=1e-5)


def test_the_final_error_is_the_median_of_the_flights_that_survive(tmp_path):
    how = {
        "task_kwargs": {"start_position": (0, 0, 0.5), "target_distance": 1.0, "velocity_std": 2.0}
    }
    env = QuadcopterVecEnv(8, max_episode_steps=50, **how)
    model = PPO(
        "MlpPolicy", env, n_steps=10, batch_size=80, device="cpu", tensorboard_log=str(tmp_path)
    )
    lines = []
    best = BestModel(
        env, 1000, 8, 5, tmp_path / "best.zip", tmp_path / "evaluations.npz", lines.append
    )
    model.learn(80, callback=best)
    flown = fly(model, n_episodes=8, seed=5, max_episode_steps=50, **how)
    assert 0 < flown.survival.sum() < 8
    with np.load(tmp_path / "evaluations.npz") as file:
        errors = np.where(flown.survival, flown.final_error, np.nan)  # in the order of the rows
        np.testing.assert_allclose(np.sort(file["final_errors"][0]), np.sort(errors))
    ((steps, median),) = logged(tmp_path / "PPO_1", "eval/final_error")
    assert steps == 80 and median == pytest.approx(np.median(flown.final_error[flown.survival]))
    assert f"survival {100 * flown.survival.mean():.1f} %, mean reward" in lines[0]


@pytest.mark.parametrize(
    ("by", "better"),
    [
        ("success", [(0.5, 10.0), (1.0, -5.0), (1.0, -4.0)]),
        ("reward", [(0.0, 10.0), (0.0, 99.0)]),
    ],
)
def test_reward_decides_or_a_rate_that_comes_before_it(tmp_path, monkeypatch, by, better):
    best = make_best(tmp_path, by=by)
    model = make_model()
    model.set_logger(configure(None, []))
    best.init_callback(model)
    best.on_training_start({}, {})
    kept = []
    monkeypatch.setattr(best_model, "save_model", lambda model, path: kept.append(best.best))
    for success, reward in [(0.5, 10.0), (1.0, -5.0), (0.5, 99.0), (1.0, -5.0), (1.0, -4.0)]:
        flown = {"results": np.full(4, reward), "successes": np.arange(4) < 4 * success}
        monkeypatch.setattr(best_model, "fly_episodes", lambda *given, flown=flown: flown)
        best.evaluate()
    assert kept == better


def test_the_start_is_evaluated_and_kept_until_a_model_is_better(tmp_path):
    lines = []
    best = make_best(tmp_path, with_start=True, report=lines.append)
    model = make_model(learning_rate=0.0)
    model.learn(80, callback=best)
    assert [line.endswith("(best so far)") for line in lines] == [True, False]
    assert PPO.load(tmp_path / "best_model.zip").num_timesteps == 0
    # A training that was killed before its first rollout begins again.
    again = make_best(tmp_path, with_start=True)
    make_model().learn(80, callback=again)
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [80, 0, 80]


class Own(VecEnvWrapper):
    """A reward of the user's own, ten for each step."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, np.full_like(rewards, 10.0), dones, infos


def test_the_reward_that_is_trained_decides_and_the_tasks_own_stands_beside_it(tmp_path):
    lines = []
    env = Own(make_vec_env(Walk, 2))
    files = tmp_path / "best_model.zip", tmp_path / "evaluations.npz"
    best = BestModel(env, 1000, 4, 5, *files, lines.append)
    model = make_model()
    # Evaluated behind a wrapper that training lacks, it would be refused.
    model.set_env(Own(model.get_env()))
    model.learn(80, callback=best)
    own, _ = evaluate_policy(model, env, 4)
    with np.load(files[1]) as file:
        assert file["results"].tolist() == [[100.0] * 4]
        assert file["task_results"].mean() == pytest.approx(own, abs=0.5)
    assert best.best == (0.0, 100.0)
    assert "mean reward 100.00 (the task's own: " in lines[0]


def test_the_same_episodes_stand_side_by_side_whichever_ends_first():
    env = QuadcopterVecEnv(3, max_episode_steps=[20, 10, 5])
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=30, device="cpu")
    assert fly_episodes(model, env, 6, 0)["ep_lengths"].tolist() == [20, 20, 10, 10, 5, 5]


def test_other_environments_are_evaluated_at_the_same_times_and_decide_nothing(tmp_path):
    alone = make_best(tmp_path / "alone", every=40)
    make_model().learn(80, callback=alone)
    # An environment that is not vectorised is one that is.
    best = make_best(tmp_path / "both", every=40, others={"far": Walk()})
    make_model().learn(80, callback=best)
    assert best.best == alone.best
    with (
        np.load(tmp_path / "both" / "evaluations.npz") as own,
        np.load(tmp_path / "both" / "evaluations_far.npz") as far,
    ):
        assert own["timesteps"].tolist() == far["timesteps"].tolist() == [40, 80]
        assert own["results"].shape == far["results"].shape == (2, 4)


def test_a_resumed_training_keeps_to_the_multiples(tmp_path):
    model = make_model()
    model.learn(80)
    best = make_best(tmp_path, every=60)
    checkpoints = Checkpoint(60, str(tmp_path / "model_{steps}.zip"))
    model.learn(80, callback=[best, checkpoints], reset_num_timesteps=False)
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [120, 160]
    assert [entry.name for entry in tmp_path.glob("model_*")] == ["model_120.zip"]


def test_checkpoints_are_whole_models_at_their_number_of_steps(tmp_path):
    make_model().learn(160, callback=Checkpoint(50, str(tmp_path / "rl_model_{steps}_steps.zip")))
    names = sorted(entry.name for entry in tmp_path.iterdir())
    assert names == ["rl_model_100_steps.zip", "rl_model_150_steps.zip", "rl_model_50_steps.zip"]
    assert PPO.load(tmp_path / "rl_model_150_steps.zip").num_timesteps == 150
    with pytest.raises(ConfigError, match="steps"):
        Checkpoint(40, "model.zip")


def test_the_episode_log_is_a_monitor_file(tmp_path):
    for _ in range(2):
        make_model().learn(80, callback=EpisodeLog(tmp_path / "0.monitor.csv", "Walk-v0"))
    results = load_results(str(tmp_path))
    assert len(results) == 2 * 80 / 10
    assert (results.l == 10).all()
    assert set(results.is_success) <= {True, False}
    log = tmp_path / "0.monitor.csv"
    assert log.read_text().count("#") == 1
    log.write_text(log.read_text() + "1.0,2")  # as a crash may leave it
    make_model().learn(80, callback=EpisodeLog(log, "Walk-v0"))
    assert len(load_results(str(tmp_path))) == 3 * 80 / 10
    for head in ("", log.read_text().splitlines()[0] + "\n"):
        log.write_text(head)  # as a crash in the first moment may leave it
        make_model().learn(80, callback=EpisodeLog(log, "Walk-v0"))
        assert len(load_results(str(tmp_path))) == 80 / 10


def test_a_line_a_minute_says_how_far_the_training_is(monkeypatch):
    clock = iter(range(0, 10_000, 20))  # each control step of both environments takes 20 s
    monkeypatch.setattr(every, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    lines = []
    model = make_model()
    model.learn(150, callback=ProgressLine(lines.append))
    steps = [int(line.split(" of ")[0]) for line in lines]
    assert steps == [*range(6, 161, 6)]  # whole rollouts: 160 timesteps
    assert lines[0].strip() == "6 of 160 timesteps (4 %), 26 min left"
    rewards = model.ep_info_buffer  # 16 episodes, the last two of them after the last line
    mean = np.mean([episode["r"] for episode in rewards][:14])
    assert lines[-1].strip() == f"156 of 160 timesteps (98 %), mean reward {mean:.2f}, 1 min left"
    lines.clear()
    clock = iter(range(0, 10_000, 10))
    model.learn(80, callback=ProgressLine(lines.append), reset_num_timesteps=False)
    assert lines[0].startswith("         172 of 240 timesteps (72 %), mean reward")
    assert lines[0].endswith(", 6 min left")  # 12 timesteps took a minute, 68 are left


def test_evaluations_without_results_are_refused(tmp_path):
    np.savez(tmp_path / "evaluations.npz", other=np.zeros(2))
    with pytest.raises(ConfigError, match=r"evaluations\.npz"):
        make_model().learn(80, callback=make_best(tmp_path, 40))


def test_random_numbers_can_be_repeated():
    def sample():
        legacy = np.random.normal(size=3).tolist()  # noqa: NPY002
        return torch.rand(3).tolist(), legacy, [random.gauss(0, 1) for _ in range(3)]

    sample()
    state = random_state()
    first = sample()
    set_random_state(state)
    assert sample() == first


def test_a_best_model_that_ended_a_training_does_not_end_the_next(tmp_path):
    verdicts = iter([False, True, True])
    best = make_best(tmp_path, 40, should_continue=lambda success, reward: next(verdicts))
    model = make_model().learn(80, callback=best)
    assert best.stopped and model.num_timesteps == 40
    model.learn(40, callback=best, reset_num_timesteps=False)
    assert not best.stopped and np.load(best._own.path)["timesteps"].tolist() == [40, 80]
