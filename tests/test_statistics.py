"""Agents that learn behind VecNormalize or other wrappers: evaluated, kept and read as trained."""

import pickle
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from sb3_quad import DAgger
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.transfer import transfer_policy
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.labelling import Labeller
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.callbacks import BestModel
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.flights import fly_settings
from sb3_quad.export.policy import export_policy
from sb3_quad.fast.policy import Perceptrons
from sb3_quad.show.demo import page
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.pipeline import Pipeline, stage_jobs
from sb3_quad.training.trainer import build_model, resume, train

ENV = "QuadTargetTracking-v0"
SETTINGS = {
    "n_timesteps": 800,
    "n_envs": 8,
    "expert": "pid",
    "n_steps": 50,
    "batch_size": 100,
    "gradient_steps": 4,
    "policy_kwargs": {"net_arch": [16]},
    "env_kwargs": {"max_episode_steps": 60, "noise": 0.0},
    "normalize": True,
}
EPISODES = 6


def quiet(line):
    pass


def job(folder, algo="dagger", settings=SETTINGS, **options):
    options = {"eval_episodes": EPISODES, "eval_freq": 400, "save_freq": 400} | options
    config = build_config(algo, ENV, settings)
    return TrainingJob(config=config, log_folder=str(folder), device="cpu", **options)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("normalised")), quiet).run


def statistics(path):
    model: Any = load_model(path)
    return model.vec_normalize.obs_rms


def test_evaluations_are_those_of_the_saved_agent(run):
    """Each zip holds the statistics of its time, and flies as the training has evaluated it."""
    settings, _ = agent_settings(run.model)
    seeds = row_seeds(seed_for("evaluation", 0), EPISODES)
    evaluated = np.load(run.evaluations)["results"]
    for path, row in ((run.checkpoint(400), evaluated[0]), (run.model, evaluated[1])):
        flown = fly_settings(load_model(path), settings, seeds).reward
        np.testing.assert_allclose(np.sort(flown), np.sort(row), rtol=1e-5)
    # The evaluations themselves count for nothing: two resets and 100 steps of 8 environments do.
    assert round(statistics(run.model).count) == 816
    assert round(statistics(run.checkpoint(400)).count) < 816
    best = run.model if evaluated[1].mean() > evaluated[0].mean() else run.checkpoint(400)
    np.testing.assert_array_equal(statistics(run.best_model).mean, statistics(best).mean)


def test_stock_sb3_reads_what_rl_zoo3_would_have_left(run):
    file = run.config.with_name("vecnormalize.pkl")
    plain = QuadcopterVecEnv(EPISODES, max_episode_steps=60, noise=0.0)
    env: Any = VecNormalize.load(str(file), plain)
    env.training = False
    env.norm_reward = False
    env.seed(seed_for("evaluation", 0))
    model = PPO.load(run.model, device="cpu")
    rewards, _ = evaluate_policy(model, env, EPISODES, return_episode_rewards=True)
    evaluated = np.load(run.evaluations)["results"]
    np.testing.assert_allclose(np.sort(rewards), np.sort(evaluated[1]), rtol=1e-5)
    np.testing.assert_array_equal(env.obs_rms.mean, statistics(run.model).mean)


@pytest.mark.parametrize("algo", ["dagger", "ppo"])
def test_statistics_go_on_where_an_interrupted_run_left_them(tmp_path, algo, monkeypatch):
    settings = dict(SETTINGS)
    if algo == "ppo":
        for name in ("expert", "gradient_steps"):
            del settings[name]
    begun = []

    def stop(success, reward):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(job(tmp_path, algo, settings), quiet, begun.append, stop)
    resumed = resume(str(begun[0].path), quiet)
    # DAgger's expert is asked once before the training; the resumed one begins with a reset, too.
    seen = 800 + 8 * {"dagger": 3, "ppo": 2}[algo]
    assert round(resumed.model.get_vec_normalize_env().obs_rms.count) == seen
    assert round(statistics(resumed.run.model).count) == seen


@pytest.fixture
def zoo_agent(tmp_path):
    """A zip with its statistics next to it, as rl_zoo3 leaves them; and its labels."""
    env = VecNormalize(make_vec_env("UnitPendulum-v0", 4, seed=0), clip_obs=1.0)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(256)
    folder = tmp_path / "ppo" / "Pendulum-v1_1"
    (folder / "Pendulum-v1").mkdir(parents=True)
    model.save(folder / "Pendulum-v1.zip")
    env.save(str(folder / "Pendulum-v1" / "vecnormalize.pkl"))
    (folder / "Pendulum-v1" / "config.yml").write_text("normalize: true\n")

    def labels(observation):
        return model.predict(env.normalize_obs(observation), deterministic=True)[0].clip(-1, 1)

    return folder / "Pendulum-v1.zip", labels


def test_statistics_are_found_where_others_keep_them(zoo_agent):
    path, _ = zoo_agent
    file = path.parent / "Pendulum-v1" / "vecnormalize.pkl"
    wanted = statistics(path).mean
    own = file.rename(path.with_name("vec_normalize.pkl"))
    np.testing.assert_array_equal(statistics(path).mean, wanted)
    # Those of a checkpoint belong to that of the same step.
    checkpoint = path.rename(path.with_name("rl_model_600_steps.zip"))
    own.rename(path.with_name("rl_model_vecnormalize_600_steps.pkl"))
    other = path.with_name("rl_model_vecnormalize_800_steps.pkl")
    other.write_bytes(b"of another step")
    np.testing.assert_array_equal(statistics(checkpoint).mean, wanted)
    path.with_name("rl_model_vecnormalize_600_steps.pkl").unlink()
    with pytest.raises(ConfigError, match=r"which statistics are its own.*800_steps\.pkl"):
        load_model(checkpoint)
    other.write_bytes(pickle.dumps(VecNormalize(QuadcopterVecEnv(1))))
    other.rename(path.with_name("vec_normalize.pkl"))
    with pytest.raises(ConfigError, match=r"is of observations \(18,\)"):
        load_model(checkpoint)


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize])
def test_an_agent_with_statistics_labels_as_it_flies(zoo_agent, wrap):
    path, labels = zoo_agent
    plain = make_vec_env("UnitPendulum-v0", 3, seed=1)
    env = wrap(plain)
    labeller = Labeller(str(path), env)
    observation = env.reset()
    for _ in range(5):
        raw = env.get_original_obs() if isinstance(env, VecNormalize) else observation
        np.testing.assert_array_equal(labeller.labels(observation), labels(raw))
        observation, *_ = env.step(np.ones((3, 1), np.float32))


def test_an_agent_without_statistics_sees_raw_observations_behind_them(tmp_path):
    PPO("MlpPolicy", "UnitPendulum-v0", seed=0, device="cpu").save(tmp_path / "raw.zip")
    env = VecNormalize(make_vec_env("UnitPendulum-v0", 3, seed=1))
    labeller = Labeller(tmp_path / "raw.zip", env)
    observation = env.reset()
    raw = env.get_original_obs()
    expected, _ = load_model(tmp_path / "raw.zip").predict(raw, deterministic=True)
    np.testing.assert_array_equal(labeller.labels(observation), expected.clip(-1, 1))


def test_statistics_that_are_missing_or_no_statistics_are_refused(zoo_agent, tmp_path, monkeypatch):
    path, _ = zoo_agent
    file = path.parent / "Pendulum-v1" / "vecnormalize.pkl"
    file.write_bytes(pickle.dumps(np.zeros(3)))
    with pytest.raises(ConfigError, match=r"vecnormalize\.pkl: holds no VecNormalize"):
        DAgger("MlpPolicy", "UnitPendulum-v0", expert=str(path)).learn(1)
    file.write_bytes(pickle.dumps(Path(tmp_path)))
    with pytest.raises(ConfigError, match=r"pathlib.*may run anything"):
        resolve_expert(path)
    file.write_bytes(b"none")
    monkeypatch.setenv("SB3_QUAD_TRUST", "1")
    with pytest.raises(ConfigError, match=r"vecnormalize\.pkl cannot be read"):
        resolve_expert(path)
    monkeypatch.undo()
    file.unlink()
    with pytest.raises(ConfigError, match=r"was trained with normalize \(see .*config\.yml\)"):
        resolve_expert(path)
    (path.parent / "Pendulum-v1" / "config.yml").write_text("env_wrapper: [some.Wrapper]\n")
    with pytest.raises(ConfigError, match=r"was trained with env_wrapper"):
        resolve_expert(path)


def test_an_agent_goes_on_with_its_statistics_or_is_refused(run, tmp_path):
    settings = {**SETTINGS, "n_timesteps": 400}
    del settings["gradient_steps"]
    following = job(tmp_path, "ppo_bc", settings, initial_policy=str(run.model))
    made: Any = make_environments(following.config, 8, 0)
    with closing(made) as env:
        build_model(following, env)
        np.testing.assert_array_equal(env.obs_rms.mean, statistics(run.model).mean)
        assert env.training
    raw = job(tmp_path, "ppo_bc", {**settings, "normalize": False}, initial_policy=str(run.model))
    with pytest.raises(ConfigError, match="must both have it, or neither"):
        train(raw, quiet)
    assert not (tmp_path / "ppo_bc").exists()
    model = PPO("MlpPolicy", VecNormalize(QuadcopterVecEnv(2)), policy_kwargs={"net_arch": [16]})
    with pytest.raises(ConfigError, match="must both have it, or neither"):
        transfer_policy(PPO("MlpPolicy", QuadcopterVecEnv(2)), model)


def test_dagger_keeps_raw_rows_and_normalises_them_by_the_present_statistics(monkeypatch, tmp_path):
    env: Any = VecNormalize(make_vec_env("UnitPendulum-v0", 4, seed=0))
    learnt_from = []
    gradients = Perceptrons.gradients

    def spy(self, loss, actor, critic):
        learnt_from.append(actor.observations)
        return gradients(self, loss, actor, critic)

    def expert(observation):
        return -env.get_original_obs()[:, 1:2]

    monkeypatch.setattr(Perceptrons, "gradients", spy)
    settings = {"n_steps": 20, "batch_size": 40, "gradient_steps": 2, "seed": 0, "device": "cpu"}
    model = DAgger("MlpPolicy", env, expert=expert, **settings).learn(240)
    rows = model.dataset.pairs["observations"]
    np.testing.assert_allclose(model.dataset.pairs["actions"], -rows[:, 1:2], atol=1e-6)
    np.testing.assert_array_equal(learnt_from[-1], env.normalize_obs(rows))
    # The rows of a file are raw, too.
    model.dataset.save(tmp_path / "flights.npz")
    given = {"demonstrations": tmp_path / "flights.npz", "beta": 0.0, **settings}
    clone = DAgger("MlpPolicy", env, **given).learn(80)
    np.testing.assert_array_equal(learnt_from[-1], env.normalize_obs(rows))
    assert len(clone.dataset) == len(rows)
    with pytest.raises(ConfigError, match="make VecNormalize the outermost wrapper"):
        DAgger("MlpPolicy", VecFrameStack(env, 2), expert=None, beta=0.0, **settings)


def test_statistics_go_on_in_an_environment_that_is_set_later(run):
    model: Any = DAgger.load(run.model, device="cpu", expert="pid")
    count = model.vec_normalize.obs_rms.count
    with pytest.raises(ConfigError, match="must both have it, or neither"):
        model.set_env(QuadcopterVecEnv(8))
    model.set_env(VecNormalize(QuadcopterVecEnv(8)))
    assert model.get_vec_normalize_env().obs_rms.count == count
    assert model.vec_normalize is model.get_vec_normalize_env()


def test_best_model_freezes_and_synchronises_the_environments_of_a_user(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env: Any = VecNormalize(QuadcopterVecEnv(4, seed=0))
    held: Any = VecNormalize(VecMonitor(QuadcopterVecEnv(4, max_episode_steps=20)))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, device="cpu")
    best = BestModel(held, 64, 4, 0, by="survival")
    model.learn(64, callback=best)
    np.testing.assert_array_equal(held.obs_rms.mean, env.obs_rms.mean)
    assert not held.training and not held.norm_reward
    plain = BestModel(QuadcopterVecEnv(4, max_episode_steps=20), 64, 4, 0)
    with pytest.raises(ConfigError, match="must both have it, or neither"):
        model.learn(64, callback=plain)


@pytest.mark.parametrize("file_format", ["onnx", "c"])
def test_files_hold_the_statistics(run, file_format):
    """The check flies beyond the statistics' bound, by which inputs are clipped."""
    exported = export_policy(run.model, file_format, n_observations=2000)
    assert exported.metadata["scaling"].endswith("clipped to 10")
    assert page.describe(ControllerSpec("agent", str(run.model)))["clip"] == 10.0


WRAPPERS = {
    "stacked": {
        "vec_env_wrapper": {"stable_baselines3.common.vec_env.VecFrameStack": {"n_stack": 3}}
    },
    "rescaled": {
        "vec_env": "dummy",
        "env_wrapper": {
            "gymnasium.wrappers.RescaleAction": {"min_action": -2.0, "max_action": 2.0}
        },
    },
}


@pytest.mark.parametrize("wrappers", WRAPPERS)
def test_a_training_behind_wrappers_ends_well_and_its_agent_is_not_flown_without(
    tmp_path, monkeypatch, capsys, wrappers
):
    monkeypatch.chdir(tmp_path)
    settings = {**SETTINGS, **WRAPPERS[wrappers], "n_envs": 2, "normalize": False}
    if wrappers == "rescaled":
        del settings["expert"], settings["gradient_steps"]
    algo = "ppo" if wrappers == "rescaled" else "dagger"
    Path("settings.yml").write_text(yaml.safe_dump({ENV: settings}))
    words = ["train", "--algo", algo, "--env", ENV, "--conf-file", "settings.yml"]
    assert main([*words, "-f", "logs", "--eval-episodes", "2", "--no-progress"]) == 0
    out = capsys.readouterr().out
    folder = Path("logs", algo, f"{ENV}_1")
    assert f"saved in {folder}" in out and "no table: " in out and "mean reward" in out
    for command in (
        ["evaluate", str(folder), "--suite", "quick", "-o", "out"],
        ["export", str(folder), "--format", "onnx"],
        ["enjoy", str(folder), "--no-render"],
        ["train", "--expert", str(folder), "--algo", "dagger", "--env", ENV],
    ):
        assert main(command) != 0
        err = " ".join(capsys.readouterr().err.split())
        assert "was trained with" in err and "wrapper" in err


def test_a_pipeline_whose_stages_do_not_fit_is_refused_before_the_first(tmp_path):
    one = {"name": "one", "algo": "dagger", "env": ENV, "settings": {"normalize": True}}
    two = {"name": "two", "algo": "ppo_bc", "env": ENV}
    with pytest.raises(ConfigError, match="stage 'two': normalize: must be as in"):
        stage_jobs(Pipeline(stages=[one, two]), {})
    settings = {"vec_env_wrapper": "stable_baselines3.common.vec_env.VecCheckNan"}
    with pytest.raises(ConfigError, match=r"stage 'one': correct_offset: .*wrappers"):
        stage_jobs(Pipeline(stages=[{**one, "correct_offset": 1.0, "settings": settings}]), {})
    (job,) = stage_jobs(Pipeline(stages=[{**one, "correct_offset": 1.0}]), {})
    assert job.config.normalize


def test_an_expert_that_is_a_function_sees_raw_observations():
    env = VecNormalize(make_vec_env("UnitPendulum-v0", 3, seed=1))
    seen = []

    def swing_back(observation):
        seen.append(observation.copy())
        return -0.5 * observation[:, 2:3]

    labeller = Labeller(swing_back, env)
    labeller.labels(env.reset())
    np.testing.assert_array_equal(seen[-1], env.get_original_obs())
    with pytest.raises(ConfigError, match="make VecNormalize the outermost wrapper"):
        Labeller(swing_back, VecFrameStack(env, 2))
