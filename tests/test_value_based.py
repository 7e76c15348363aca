"""Value-based stages as runs: from an imitation, resumed, tuned, corrected and exported."""

import signal

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC

from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.zips import load_model, load_zip, saved_algorithm
from sb3_quad.algorithms import transfer
from sb3_quad.algorithms.offset_correction import correct_offset, hover_offset
from sb3_quad.algorithms.transfer import transfer_policy
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.training.config import TrainingJob, build_config, describe, load_config
from sb3_quad.training.pipeline import load_pipeline, run_pipeline
from sb3_quad.training.trainer import resume, train
from sb3_quad.tuning.space import load_space

ENV = "QuadStateRecovery-v0"
TINY = {
    "n_timesteps": 800,
    "n_envs": 8,
    "buffer_size": 256,  # less than the training flies
    "batch_size": 16,
    "train_freq": 5,
    "gradient_steps": 2,
    "learning_starts": 0,
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"max_episode_steps": 12},
}
WITH_EXPERT = {"expert": "pid", "bc_coef": 0.5}
CASES = {"sac": {}, "td3": {"noise_type": "normal"}, "sac_bc": WITH_EXPERT}


def make_job(folder, algo, **changes):
    config = build_config(algo, ENV, {**TINY, **CASES[algo], **changes})
    return TrainingJob(
        config=config, log_folder=str(folder), eval_freq=120, eval_episodes=4, seed=5
    )


@pytest.fixture
def short_clone(monkeypatch):
    """A hand-over to SAC takes no time, and its clone flies badly."""
    for name, value in {
        "CLONE_STEPS": 20,
        "CLONE_BATCH": 32,
        "CLONE_ROWS": 80,
        "CLONE_FLIGHT": 10,
    }.items():
        monkeypatch.setattr(transfer, name, value)


def state(run):
    return load_model(run.model).policy.state_dict()


@pytest.mark.parametrize("algo", CASES)
def test_an_interrupted_run_goes_on_to_the_same_agent(tmp_path, algo):
    """Also with a replay buffer that is full."""
    whole = train(make_job(tmp_path / "whole", algo), print)
    assert whole.model.replay_buffer.full and whole.model._n_updates > 10
    for evaluation in (1, 4):
        count = iter(range(1, 100))
        broken = train(
            make_job(tmp_path / f"broken{evaluation}", algo),
            print,
            should_continue=lambda *_, count=count, at=evaluation: (
                next(count) != at or not signal.raise_signal(signal.SIGINT)
            ),
        )
        assert (
            broken.exit_code == 130 and 0 < int(np.load(broken.run.resume_state)["timesteps"]) < 800
        )
        again = resume(str(broken.run.path), print).run
        mine, theirs = state(again), state(whole.run)
        assert all(th.equal(mine[name], theirs[name]) for name in theirs)
        assert again.episodes.read_text().count("\n") == whole.run.episodes.read_text().count("\n")
    assert saved_algorithm(whole.run.model) == {"sac": "SAC", "td3": "TD3", "sac_bc": "SACBC"}[algo]


@pytest.mark.slow
def test_a_pipeline_goes_on_from_an_imitation_by_values(tmp_path, short_clone):
    one = {
        "name": "one",
        "algo": "dagger",
        "env": ENV,
        "conf_file": "dagger.yml",
        "settings": {"n_steps": 16, "batch_size": 64},
    }
    tiny = {key: TINY[key] for key in ("batch_size", "train_freq", "buffer_size")}
    two = {"name": "two", "algo": "sac_bc", "env": ENV, "pass_on": "last", "settings": tiny}
    path = tmp_path / "stages.yml"
    path.write_text(yaml.safe_dump({"stages": [one, two]}), encoding="utf-8")
    shared = {"n_envs": 8, "n_timesteps": 256, "env_kwargs": {"max_episode_steps": 12}}
    job = {"log_folder": str(tmp_path / "logs"), "eval_episodes": 4, "eval_freq": 0}
    result = run_pipeline(load_pipeline(path, shared), job, "stages", lambda line: None)
    assert result.exit_code == 0 and saved_algorithm(result.stages["two"].agent) == "SACBC"
    assert [stage.algo for stage in load_pipeline("value_based/two_stage.yml").stages] == [
        "dagger",
        "sac_bc",
    ]


def test_n_step_returns_are_loaded_without_a_warning(tmp_path, recwarn):
    settings = {"n_steps": 3, "gamma": 0.9, "buffer_size": 40, "device": "cpu"}
    SAC("MlpPolicy", QuadcopterVecEnv(4), **settings).save(tmp_path / "sac.zip")
    buffer = load_zip(SAC, tmp_path / "sac.zip", env=QuadcopterVecEnv(4)).replay_buffer
    assert (buffer.n_steps, buffer.gamma) == (3, 0.9) and not recwarn.list


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """An agent of SAC's that flies as one that came with the package."""
    env = QuadcopterVecEnv(240, "recovery_and_tracking", seed=0, max_episode_steps=500)
    policy_kwargs = {"net_arch": {"pi": [64, 64], "qf": [8]}, "activation_fn": th.nn.Tanh}
    model = SAC(
        "MlpPolicy", env, policy_kwargs=policy_kwargs, buffer_size=240, seed=0, device="cpu"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfer, "CLONE_STEPS", 1000)
        patch.setattr(transfer, "CLONE_BATCH", 512)
        transfer_policy(pretrained_path("itm-recovery"), model)
    path = tmp_path_factory.mktemp("clone") / "sac.zip"
    FlightSettings().write_into(model)
    model.save(path)
    return path


@pytest.mark.slow
def test_an_agent_is_handed_over_to_sac_and_flies(clone):
    before, after = (
        fly(load_model(path), "state_recovery", 240, 3)
        for path in (pretrained_path("itm-recovery"), clone)
    )
    assert before.survival.mean() > 0.98 and after.survival.mean() > before.survival.mean() - 0.03
    assert fly(load_model(clone), "target_tracking", 48, 3).survival.all()


@pytest.mark.slow
def test_its_offset_is_trimmed(clone):
    model = load_model(clone)
    with th.no_grad():
        model.actor.latent_pi[0].bias -= (
            0.3 * model.actor.latent_pi[0].weight[:, 0]
        )  # sees itself where it is not
    before = np.linalg.norm(hover_offset(model))
    assert correct_offset(model).after < 0.1 * before > 0.1


@pytest.mark.slow
def test_its_export_flies_where_it_flies(clone, tmp_path):
    """In closed loop: the file's thrusts lead to the same ends."""
    assert (
        main(["export", str(clone), "--format", "torchscript", "-o", str(tmp_path / "agent.pt")])
        == 0
    )
    module = th.jit.load(tmp_path / "agent.pt")
    env = QuadcopterVecEnv(1)
    low, high = env.vehicle.thrust_range
    mean, std = env.batch.mean[:, 0], env.batch.std[:, 0]

    def exported(observation):
        thrusts = module(th.as_tensor(observation * std + mean, dtype=th.float32)).numpy()
        return (2.0 * thrusts - high - low) / (high - low)

    own, theirs = (
        fly(each, "state_recovery", 48, 9, noise=0.0) for each in (load_model(clone), exported)
    )
    assert own.survival.mean() > 0.9 and (own.survival == theirs.survival).mean() > 0.95
    both = own.survival & theirs.survival
    np.testing.assert_allclose(own.final_error[both], theirs.final_error[both], atol=0.01)


@pytest.mark.parametrize("algo", CASES)
def test_settings_of_the_package_describe_a_training_of_rows_with_gradient_steps(algo):
    config = load_config(algo, ENV)
    assert config.is_off_policy and config.rollout_steps * config.n_envs >= 480
    line = describe(TrainingJob(config=config))
    assert f"{algo} on {ENV}: " in line and f"rollouts of {config.rollout_steps} steps" in line
    short = load_config(algo, ENV, overrides={"n_timesteps": config.n_envs})
    assert short.rollout_steps == 1 and short.keyword("n_steps") == config.keyword(
        "n_steps"
    )  # of the returns: it stays
    space = load_space(config)
    assert space.start() is not None and "n_minibatches" not in space.dimensions


@pytest.mark.parametrize(
    ("algo", "changes", "message"),
    [
        ("sac", {"expert": "pid"}, "does not learn from an expert"),
        ("td3", {"noise_type": "pink"}, "noise_type"),
        ("sac_bc", {"buffer_size": 2**39}, "this machine's memory"),
        ("sac_bc", {"train_freq": [2, "episode"]}, "counts episodes"),
        ("sac_bc", {"ent_coef": "much"}, "cannot be made"),
        ("ppo", {"noise_type": "normal"}, "samples its actions"),
    ],
)
def test_bad_settings_are_one_line(tmp_path, algo, changes, message):
    base = {"n_timesteps": 100, "n_envs": 2} if algo == "ppo" else {**TINY, **CASES[algo]}
    with pytest.raises(ConfigError, match=message) as raised:
        train(
            TrainingJob(
                config=build_config(algo, ENV, {**base, **changes}),
                log_folder=str(tmp_path),
                eval_episodes=0,
            )
        )
    assert "\n" not in str(raised.value)
