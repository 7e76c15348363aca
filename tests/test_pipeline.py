"""Pipelines: stages pass their agents on, interrupted ones resume where they were, and the offset
correction cancels an offset.
"""

import argparse
import os
import signal
from functools import partial

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.agents.pretrained import load_pretrained
from sb3_quad.algorithms.ppo_bc import PPOBC
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.seeds import LARGEST
from sb3_quad.callbacks.every import ProgressLine
from sb3_quad.cli import main
from sb3_quad.cli.parser import PAIRS
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.offset_correction import (
    Correction,
    correct_offset,
    hover_offset,
    scale_position,
    shift_position,
)
from sb3_quad.training import pipeline as pipeline_module
from sb3_quad.training.pipeline import (
    load_pipeline,
    resume_pipeline,
    run_pipeline,
    stage_jobs,
    with_settings,
)
from sb3_quad.training.trainer import train

TINY = {
    "n_envs": 8,
    "n_steps": 16,
    "batch_size": 64,
    "n_timesteps": 256,
    "env_kwargs": {"max_episode_steps": 12},
}
TINY["policy_kwargs"] = {"net_arch": [8, 8]}
STAGES = [
    {"name": "one", "algo": "dagger", "env": "QuadTargetTracking-v0", "pass_on": "last"},
    {
        "name": "two",
        "algo": "ppo_bc",
        "env": "QuadStateRecovery-v0",
        "pass_on": "last",
        "settings": {"n_epochs": 1},
    },
]


def write(tmp_path, stages):
    path = tmp_path / "stages.yml"
    path.write_text(yaml.safe_dump({"stages": stages}), encoding="utf-8")
    return path


def tiny(tmp_path, stages=STAGES):
    return with_settings(load_pipeline(write(tmp_path, stages)), TINY)


@pytest.fixture
def job(tmp_path):
    return {"log_folder": str(tmp_path / "logs"), "eval_episodes": 4, "eval_freq": 0}


def quiet(line):
    pass


def policy(path):
    return PPO.load(path).policy.state_dict()


def test_lines_say_how_far_the_pipeline_is_unless_a_bar_does(tmp_path, job, monkeypatch):
    monkeypatch.setattr(
        "sb3_quad.training.trainer.ProgressLine", partial(ProgressLine, seconds=0.0)
    )
    lines = []
    result = run_pipeline(tiny(tmp_path), job, "stages", lines.append)
    stages = [line for line in lines if line.startswith("stage ")]
    assert [line.split(" on ")[0] for line in stages] == [
        "stage 1 of 2, one: dagger",
        "stage 2 of 2, two: ppo_bc",
    ]
    assert sum("256 of 256 timesteps (100 %)" in line for line in lines) == 2
    assert result.exit_code == 0
    lines.clear()
    run_pipeline(tiny(tmp_path), {**job, "progress": True}, "stages", lines.append)
    assert lines and not [line for line in lines if "of 256 timesteps (" in line]


def test_each_stage_starts_from_the_agent_of_the_one_before(tmp_path, job):
    stages = [STAGES[0], {**STAGES[1], "settings": {"learning_rate": 0.0, "n_epochs": 1}}]
    result = run_pipeline(tiny(tmp_path, stages), job, "stages", quiet)
    one, two = (policy(entry.agent) for entry in result.stages.values())
    assert result.exit_code == 0 and all(
        np.array_equal(one[key], two[key]) for key in one if key != "log_std"
    )
    status = yaml.safe_load((result.folder / "pipeline.yml").read_text(encoding="utf-8"))
    assert [str(tmp_path / "logs" / run) for run in status["runs"]] == [
        entry.run for entry in result.stages.values()
    ]


def test_a_requirement_that_is_missed_stops_the_pipeline(tmp_path, job):
    with pytest.raises(TrainingError, match=r"stage 'one'.*success_rate=1.0.*logs/dagger"):
        run_pipeline(
            tiny(tmp_path, [{**STAGES[0], "require": {"success_rate": 1.0}}, STAGES[1]]),
            job,
            "stages",
            quiet,
        )
    assert not (tmp_path / "logs" / "ppo_bc").exists()


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([{**STAGES[0], "algoo": "dagger"}], "did you mean 'algo'"),
        ([{**STAGES[0], "algo": "daggr"}], "did you mean 'dagger'"),
        ([{**STAGES[0], "settings": {"n_stepz": 3}}], "did you mean 'n_steps'"),
        ([{**STAGES[0], "require": {"success": 1}}], "did you mean 'success_rate'"),
        (
            [{**STAGES[0], "correct_offset": 1.0, "conf_file": "robust/dagger.yml"}],
            "see the 18 features alone",
        ),
        ([{**STAGES[0], "correct_offset": "position"}], "correct_offset"),
        ([{**STAGES[0], "correct_offset": 0}], "correct_offset"),
        (
            [
                {
                    **STAGES[0],
                    "env": "Pendulum-v1",
                    "conf_file": "PENDULUM",
                    "correct_offset": 1.0,
                }
            ],
            "Pendulum-v1 is not an environment of this package",
        ),
        ([], "at least 1"),
        ([STAGES[0], STAGES[0]], "one, one: give each a name of its own"),
    ],
)
def test_bad_stages_are_named_before_anything_is_trained(tmp_path, stages, message, capsys):
    pendulum = tmp_path / "pendulum.yml"
    pendulum.write_text("Pendulum-v1: {n_timesteps: 10}")
    for stage in stages:
        if stage.get("conf_file") == "PENDULUM":
            stage["conf_file"] = str(pendulum)
    code = main(
        ["train", "--conf-file", str(write(tmp_path, stages)), "-f", str(tmp_path / "logs")]
    )
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["-n", "100"], "n_timesteps goes with a single run"),
        (["--conf-file", "two_stage.yml", "--algo", "dagger"], "algo goes with a single run"),
        (
            ["--algo", "dagger", "--hyperparams", "n_timesteps:100", "-n", "200"],
            "n_timesteps: given by itself and in hyperparams",
        ),
        (["--thesis", "--conf-file", "two_stage.yml"], "not allowed with argument --thesis"),
        (
            ["--algo", "dagger", "--env-kwargs", "noise:0", "--env-kwargs", "noise:1"],
            "'noise:1': must be key:value, such as n_steps:500, each key once",
        ),
    ],
)
def test_flags_that_would_be_ignored_are_refused(flags, message, capsys):
    assert main(["train", *flags]) == 2 and message in capsys.readouterr().err


def test_flags_of_pairs_add_up():
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", **PAIRS)
    assert parser.parse_args(["--pairs", "a:1", "--pairs", "b:2", "c:3"]).pairs == {
        "a": 1,
        "b": 2,
        "c": 3,
    }


def test_moved_and_scaled_positions_are_part_of_the_actor():
    env = QuadcopterVecEnv(16, task="state_recovery", noise=0.0, seed=1)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    observations, offset, std = env.reset(), np.array([0.3, -0.2, 0.5]), np.full(3, 10 / np.sqrt(3))
    moved, longer = observations.copy(), observations.copy()
    before = model.predict(observations, deterministic=True)[0]
    shift_position(model, offset, std)
    moved[:, :3] -= (offset / std).astype(np.float32)
    np.testing.assert_allclose(model.predict(moved, deterministic=True)[0], before, atol=1e-5)
    longer[:, :3] /= 0.8
    before = model.predict(longer, deterministic=True)[0]
    scale_position(model, 0.8)
    np.testing.assert_allclose(
        model.predict(observations, deterministic=True)[0], before, atol=1e-5
    )


@pytest.mark.parametrize("variance", [0.04, 1.0, 9.0])
def test_the_correction_counts_the_scale_of_vec_normalize(monkeypatch, variance):
    env = VecNormalize(QuadcopterVecEnv(16, noise=0.0, seed=1))
    env.obs_rms.var[:] = variance
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    offsets = iter([np.array([0.3, -0.2, 0.5]), *np.zeros((3, 3))])
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.hover_offset", lambda *_, **__: next(offsets)
    )
    raw = env.venv.reset()
    moved = raw.copy()
    moved[:, :3] += (np.array([0.3, -0.2, 0.5]) / (10 / np.sqrt(3))).astype(np.float32)
    before = model.predict(env.normalize_obs(moved), deterministic=True)[0]
    correct_offset(model)
    after = model.predict(env.normalize_obs(raw), deterministic=True)[0]
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_the_offset_of_an_agent_that_crashes_cannot_be_measured():
    model = PPO(
        "MlpPolicy", QuadcopterVecEnv(4, seed=1), n_steps=8, batch_size=8, seed=0, device="cpu"
    )
    with pytest.raises(ConfigError, match="offset from the target cannot be measured"):
        hover_offset(model, n_episodes=8)


@pytest.mark.parametrize("scale", [-1.0, 0.0, np.nan, 0.5])
def test_a_correction_that_fails_leaves_the_agent_as_it_was(scale, monkeypatch):
    model = PPO("MlpPolicy", QuadcopterVecEnv(4, seed=1), n_steps=8, batch_size=8, device="cpu")
    offsets = iter([np.ones(3)])

    def fail_the_second_time(*_, **__):
        try:
            return next(offsets)
        except StopIteration:
            raise ConfigError("the agent crashes") from None

    monkeypatch.setattr("sb3_quad.evaluation.offset_correction.hover_offset", fail_the_second_time)
    before = {name: values.clone() for name, values in model.policy.state_dict().items()}
    with pytest.raises(
        ConfigError, match="the agent crashes" if scale > 0.0 else "^scale .*above 0"
    ):
        correct_offset(model, scale=scale)
    for name, values in model.policy.state_dict().items():
        assert values.equal(before[name])


@pytest.mark.slow
def test_the_correction_cancels_the_offset_of_a_trained_agent(monkeypatch):
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.fly", partial(fly, max_episode_steps=700)
    )  # 7 s are enough to arrive
    model = load_pretrained("itm-imitation")
    shift_position(model, np.array([0.5, 0.0, -0.5]), np.full(3, 10 / np.sqrt(3)))
    assert np.linalg.norm(hover_offset(model, 40)) > 0.4
    result = correct_offset(model)
    assert result.before > 0.4 and result.after < 0.05


def test_a_stage_gives_the_alpha_of_its_correction(tmp_path, job, monkeypatch):
    given = []

    def noted(model, seed, settings, scale):
        given.append((settings.noise, scale))
        return Correction(1.0, 0.5)

    monkeypatch.setattr(pipeline_module, "correct_offset", noted)
    settings = {"env_kwargs": {"noise": 0.1}}
    stages = [
        {**STAGES[0], "name": name, "correct_offset": scale, "settings": settings}
        for name, scale in (("one", 0.7), ("two", None), ("three", 1))
    ]
    lines = []
    run_pipeline(tiny(tmp_path, stages), job, "stages", lines.append)
    assert given == [(0.1, 0.7), (0.1, 1.0)]
    assert [line for line in lines if "steady offset 1.000 m, now 0.500 m" in line]


def small_file(tmp_path, **changes):
    """Write a pipeline whose stages have their settings from a file."""
    settings = tmp_path / "small.yml"
    settings.write_text(yaml.safe_dump({stage["env"]: {**TINY, **changes} for stage in STAGES}))
    return write(tmp_path, [{**stage, "conf_file": str(settings)} for stage in STAGES])


def test_an_interrupted_pipeline_resumes_from_anywhere_to_the_same_agents(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    arguments = ["train", "--conf-file", str(small_file(tmp_path)), "--eval-episodes", "0"]
    assert main([*arguments, "-f", "whole"]) == 0

    original, rollouts = PPOBC.train, []

    def train(self):
        original(self)
        rollouts.append(None)
        if len(rollouts) == 1:
            os.kill(os.getpid(), signal.SIGINT)  # within the second stage, when the first is done

    monkeypatch.setattr(PPOBC, "train", train)
    assert main([*arguments, "-f", "interrupted"]) == 130
    folder = next((tmp_path / "interrupted" / "stages").iterdir())
    # Neither the settings file, which has changed, nor the working folder is needed any more.
    small_file(tmp_path, n_timesteps=512)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    capsys.readouterr()
    assert main(["train", "--resume", str(folder)]) == 0
    assert capsys.readouterr().out.count("fresh episodes, the same for all") == 2
    for algo in ("dagger", "ppo_bc"):
        one, two = (
            next((tmp_path / name / algo).rglob("Quad*.zip")) for name in ("whole", "interrupted")
        )
        for ours, theirs in zip(policy(one).values(), policy(two).values(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_pipeline_of_an_older_version_keeps_its_finished_stages(tmp_path, job, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stages = load_pipeline(small_file(tmp_path))
    result = run_pipeline(stages, {**job, "log_folder": "logs"}, "stages", quiet)
    # It named the user's files, and the runs' folders from the working folder.
    path = result.folder / "pipeline.yml"
    status = yaml.safe_load(path.read_text(encoding="utf-8"))
    status["stages"] = stages.model_dump(mode="json", exclude_defaults=True)["stages"]
    status["runs"] = [entry.run for entry in result.stages.values()]
    path.write_text(yaml.safe_dump(status), encoding="utf-8")
    small_file(tmp_path, n_timesteps=512)
    monkeypatch.setattr(pipeline_module, "train", None)
    resumed = resume_pipeline(result.folder, quiet)
    assert [entry.run for entry in resumed.stages.values()] == status["runs"]


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--thesis"],
        ["--algo", "dagger"],
    ],
)
def test_files_in_the_working_folder_do_not_replace_the_packages(
    tmp_path, monkeypatch, capsys, flags
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robust").mkdir()
    for name in ("dagger.yml", "two_stage.yml", "thesis.yml", "robust/dagger.yml"):
        (tmp_path / name).write_text("Pendulum-v1: {}")
    assert main(["train", *flags, "--env-kwargs", "noise:-1"]) == 2
    assert "noise" in capsys.readouterr().err
    # A file that the user names is read.
    assert main(["train", "--algo", "dagger", "--conf-file", "dagger.yml"]) == 2
    assert "dagger.yml: unknown environment in this file" in capsys.readouterr().err


def test_a_stage_may_fly_other_episodes_than_the_one_before(tmp_path):
    pipeline = load_pipeline(
        write(tmp_path, [STAGES[0], {**STAGES[0], "name": "two", "seed_offset": 10}])
    )
    assert [job.seed for job in stage_jobs(pipeline, {"seed": 3})] == [3, 13]
    assert all(0 <= job.seed < LARGEST for job in stage_jobs(pipeline, {"seed": LARGEST - 1}))


def test_flags_of_evaluations_hold_for_all_stages(tmp_path):
    own = {**STAGES[0], "eval_episodes": 60}
    pipeline = load_pipeline(write(tmp_path, [own, STAGES[1]]))
    assert [job.eval_episodes for job in stage_jobs(pipeline, {"eval_episodes": 4})] == [4, 4]
    assert stage_jobs(pipeline, {})[0].eval_episodes == 60
    asks = load_pipeline(write(tmp_path, [{**own, "require": {"success_rate": 0.9}}]))
    with pytest.raises(ConfigError, match="require: needs evaluations"):
        stage_jobs(asks, {"eval_episodes": 0})


def test_a_stage_that_a_callback_ended_early_is_not_trained_again(tmp_path, job, monkeypatch):
    stops = "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"
    ends = {"callback": [{stops: {"max_episodes": 1}}]}
    stages = [{**STAGES[0], "settings": ends}, STAGES[1]]
    original = PPOBC.train

    def killed(self):
        raise SystemExit

    monkeypatch.setattr(PPOBC, "train", killed)
    with pytest.raises(SystemExit):
        run_pipeline(tiny(tmp_path, stages), job, "stages", quiet)
    (model,) = (tmp_path / "logs" / "dagger").rglob("Quad*.zip")
    before = model.stat().st_mtime_ns
    monkeypatch.setattr(PPOBC, "train", original)
    folder = tmp_path / "logs" / "stages" / "stages_1"
    result = resume_pipeline(folder, quiet)
    assert [stage.timesteps for stage in result.stages.values()] == [96, 256]
    assert model.stat().st_mtime_ns == before


def two_stages(tmp_path):
    """The offset of the first is to be corrected."""
    first = {**STAGES[0], "conf_file": "nominal/dagger.yml"}
    return tiny(tmp_path, [{**first, "correct_offset": 1.0}, {**first, "name": "two"}])


def no_correction(model, seed, settings, scale):
    return Correction(1.0, 0.0)


def test_a_stage_is_not_trained_again_when_its_correction_was_interrupted(
    tmp_path, job, monkeypatch
):
    def interrupted(model, seed, settings, scale):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(pipeline_module, "correct_offset", interrupted)
    lines = []
    result = run_pipeline(two_stages(tmp_path), job, "stages", lines.append)
    assert result.exit_code == 143 and f"--resume {result.folder}" in lines[-1]

    monkeypatch.setattr(pipeline_module, "correct_offset", no_correction)
    after = resume_pipeline(result.folder, quiet)
    assert after.stages["one"].agent.endswith("corrected_model.zip")
    assert len(list((tmp_path / "logs" / "dagger").iterdir())) == 2
    monkeypatch.setattr(pipeline_module, "correct_offset", interrupted)
    again = resume_pipeline(result.folder, quiet)  # as after a kill in the final tables
    assert [each.agent for each in again.stages.values()] == [
        each.agent for each in after.stages.values()
    ]


def test_a_pipeline_that_was_killed_before_it_noted_its_progress_is_resumed(
    tmp_path, job, monkeypatch
):
    def killed(*args, **kwargs):
        raise SystemExit

    folder = tmp_path / "logs" / "stages" / "stages_1"
    monkeypatch.setattr(pipeline_module, "correct_offset", no_correction)
    monkeypatch.setattr(pipeline_module, "train", killed)  # the first stage has no run folder yet
    with pytest.raises(SystemExit):
        run_pipeline(two_stages(tmp_path), job, "stages", quiet)
    monkeypatch.setattr(pipeline_module, "train", train)
    agent = pipeline_module._agent
    monkeypatch.setattr(pipeline_module, "_agent", killed)  # its model is saved
    with pytest.raises(SystemExit):
        resume_pipeline(folder, quiet)
    monkeypatch.setattr(pipeline_module, "_agent", agent)
    (model,) = (tmp_path / "logs" / "dagger").rglob("Quad*.zip")
    before = model.stat().st_mtime_ns
    result = resume_pipeline(folder, quiet)
    assert result.exit_code == 0 and result.stages["one"].timesteps == 256
    assert model.stat().st_mtime_ns == before
