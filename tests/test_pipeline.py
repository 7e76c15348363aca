"""Pipelines: stages pass their agents on, and interrupted ones resume where they were."""

import os
import signal

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.algorithms import apg
from sb3_quad.algorithms.ppo_bc import PPOBC
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.seeds import LARGEST
from sb3_quad.cli import main
from sb3_quad.evaluation.offset_correction import Correction
from sb3_quad.training import pipeline as pipeline_module
from sb3_quad.training import rivals
from sb3_quad.training.pipeline import load_pipeline, resume_pipeline, run_pipeline, stage_jobs
from sb3_quad.training.runs import open_run
from sb3_quad.training.trainer import train

TINY = {
    "n_envs": 8,
    "n_steps": 16,
    "batch_size": 64,
    "n_timesteps": 256,
    "env_kwargs": {"max_episode_steps": 12},
    "policy_kwargs": {"net_arch": [8, 8]},
}
ONE = {
    "name": "one",
    "algo": "dagger",
    "env": "QuadTargetTracking-v0",
    "pass_on": "last",
    "require": {},  # agents that have hardly learnt crash
}
TWO = {
    "name": "two",
    "algo": "ppo_bc",
    "env": "QuadStateRecovery-v0",
    "pass_on": "last",
    "require": {},
    "settings": {"n_epochs": 1, "learning_rate": 0.0},
}


def write(tmp_path, *stages):
    path = tmp_path / "stages.yml"
    path.write_text(yaml.safe_dump({"stages": stages}), encoding="utf-8")
    return path


def tiny(tmp_path, *stages):
    return load_pipeline(write(tmp_path, *stages), TINY)


@pytest.fixture
def job(tmp_path):
    return {"log_folder": str(tmp_path / "logs"), "eval_episodes": 4, "eval_freq": 0}


def quiet(line):
    pass


def policy(path):
    return PPO.load(path).policy.state_dict()


def killed(*args, **kwargs):
    raise SystemExit


def test_each_stage_starts_from_the_corrected_agent_of_the_one_before(tmp_path, job, monkeypatch):
    given = []

    def noted(model, seed, settings, scale):
        given.append((settings.noise, scale))
        return Correction(1.0, 0.5)

    monkeypatch.setattr(pipeline_module, "correct_offset", noted)
    first = {**ONE, "correct_offset": 0.7, "settings": {"env_kwargs": {"noise": 0.1}}}
    lines = []
    result = run_pipeline(tiny(tmp_path, first, TWO), job, "stages", lines.append)
    one, two = (policy(entry.agent) for entry in result.stages.values())
    # The second stage has a learning rate of 0.
    assert result.exit_code == 0
    assert all(np.array_equal(one[key], two[key]) for key in one if key != "log_std")
    assert given == [(0.1, 0.7)]
    assert result.stages["one"].agent.endswith("corrected_model.zip")
    assert [line.split(",")[0] for line in lines if line.startswith("stage")] == [
        "stage 1 of 2",
        "stage 2 of 2",
    ]
    status = yaml.safe_load((result.folder / "pipeline.yml").read_text(encoding="utf-8"))
    runs = [str(tmp_path / "logs" / run) for run in status["runs"]]
    assert runs == [entry.run for entry in result.stages.values()]


@pytest.mark.parametrize("require", [{"success_rate": 1.0}, None])
def test_a_requirement_that_is_missed_stops_the_pipeline(tmp_path, job, require):
    """By default, half of the flights have to survive."""
    one = {**ONE, "require": require, "settings": {"eval_env_kwargs": {"max_episode_steps": 1500}}}
    if require is None:
        del one["require"]
    stages = tiny(tmp_path, one, TWO)
    with pytest.raises(TrainingError, match="'one'"):
        run_pipeline(stages, job, "stages", quiet)
    assert not (tmp_path / "logs" / "ppo_bc").exists()


def test_an_interrupted_pipeline_resumes_from_anywhere_to_the_same_agents(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    small = {stage["env"]: TINY for stage in (ONE, TWO)}
    (tmp_path / "small.yml").write_text(yaml.safe_dump(small))
    # The seed of the second stage's exploration differs from the first's.
    learning = {**TWO, "settings": {"n_epochs": 1}}
    write(tmp_path, *({**stage, "conf_file": "small.yml"} for stage in (ONE, learning)))
    arguments = ["train", "--conf-file", "stages.yml", "--eval-episodes", "0"]
    assert main([*arguments, "-f", "whole"]) == 0

    original, rollouts = PPOBC.train, []

    def interrupt(self):
        original(self)
        rollouts.append(None)
        if len(rollouts) == 1:
            os.kill(os.getpid(), signal.SIGINT)  # within the second stage, when the first is done

    monkeypatch.setattr(PPOBC, "train", interrupt)
    assert main([*arguments, "-f", "interrupted"]) == 130
    (folder,) = (tmp_path / "interrupted" / "stages").iterdir()
    # Neither the settings file nor the working folder is needed any more.
    (tmp_path / "small.yml").unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["train", "--resume", str(folder)]) == 0
    for algo in ("dagger", "ppo_bc"):
        whole, resumed = (
            policy(next((tmp_path / name / algo).rglob("Quad*.zip")))
            for name in ("whole", "interrupted")
        )
        for ours, theirs in zip(whole.values(), resumed.values(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_stage_that_is_done_is_not_trained_again(tmp_path, job, monkeypatch):
    """Neither after a kill at any moment, nor if a callback ended it early."""
    stops = "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"
    early = {**ONE, "name": "early", "settings": {"callback": [{stops: {"max_episodes": 1}}]}}
    # What it learnt in so short a time could be worse, and then nothing is corrected.
    corrected = {**ONE, "correct_offset": 1.0, "settings": {"learning_rate": 0.0}}
    folder = tmp_path / "logs" / "stages" / "stages_1"

    def corrects(model, seed, settings, scale):
        return Correction(1.0, 0.0)

    def interrupted(model, seed, settings, scale):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(pipeline_module, "correct_offset", corrects)
    monkeypatch.setattr(pipeline_module, "train", killed)  # no stage has a run folder yet
    with pytest.raises(SystemExit):
        run_pipeline(tiny(tmp_path, early, corrected, TWO), job, "stages", quiet)
    monkeypatch.setattr(pipeline_module, "train", train)
    monkeypatch.setattr(pipeline_module, "correct_offset", interrupted)
    lines = []
    assert resume_pipeline(folder, lines.append).exit_code == 143
    assert str(folder) in lines[-1]
    models = sorted((tmp_path / "logs" / "dagger").rglob("Quad*.zip"))
    before = [model.stat().st_mtime_ns for model in models]
    assert len(before) == 2

    monkeypatch.setattr(pipeline_module, "correct_offset", corrects)
    result = resume_pipeline(folder, quiet)
    assert [open_run(stage.run).timesteps for stage in result.stages.values()] == [96, 256, 256]
    monkeypatch.setattr(pipeline_module, "train", None)
    again = resume_pipeline(folder, quiet)
    assert [stage.agent for stage in again.stages.values()] == [
        stage.agent for stage in result.stages.values()
    ]
    assert sorted((tmp_path / "logs" / "dagger").rglob("Quad*.zip")) == models
    assert [model.stat().st_mtime_ns for model in models] == before


@pytest.mark.parametrize("change", ["runs", "link", "tensorboard_log"])
def test_a_strangers_pipeline_writes_nothing_outside_of_its_log_folder(
    tmp_path, job, monkeypatch, change
):
    monkeypatch.setattr(pipeline_module, "train", killed)
    home = tmp_path / "home"
    # Its own user may name any place.
    with pytest.raises(SystemExit):
        run_pipeline(tiny(tmp_path, ONE), {**job, "tensorboard_log": str(home)}, "stages", quiet)
    folder = tmp_path / "logs" / "stages" / "stages_1"
    # A run that has not begun, which resuming would train.
    run = home / "run_1" / ONE["env"]
    run.mkdir(parents=True)
    (run / "config.yml").write_text(yaml.safe_dump(TINY))
    (run / "args.yml").write_text(yaml.safe_dump({"algo": "dagger", "env": ONE["env"]}))
    status = yaml.safe_load((folder / "pipeline.yml").read_text())
    if change != "tensorboard_log":
        del status["job"]["tensorboard_log"]
    if change == "runs":
        status["runs"] = ["../home/run_1"]
    elif change == "link":
        (tmp_path / "logs" / "run_1").symlink_to(home / "run_1")
        status["runs"] = ["run_1"]
    (folder / "pipeline.yml").write_text(yaml.safe_dump(status))
    before = sorted(home.rglob("*"))
    with pytest.raises(ConfigError, match=r"pipeline\.yml"):
        resume_pipeline(folder, quiet)
    assert sorted(home.rglob("*")) == before


@pytest.mark.parametrize("flags", [[], ["--thesis"], ["--algo", "dagger"]])
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
    assert "dagger.yml" in capsys.readouterr().err


def test_a_stage_may_fly_other_episodes_than_the_one_before(tmp_path):
    pipeline = load_pipeline(write(tmp_path, ONE, {**ONE, "name": "two", "seed_offset": 10}))
    assert [job.seed for job in stage_jobs(pipeline, {"seed": 3})] == [3, 13]
    assert all(0 <= job.seed < LARGEST for job in stage_jobs(pipeline, {"seed": LARGEST - 1}))


def test_flags_of_evaluations_hold_for_all_stages(tmp_path):
    own = {**ONE, "eval_episodes": 60}
    pipeline = load_pipeline(write(tmp_path, own, TWO))
    assert [job.eval_episodes for job in stage_jobs(pipeline, {"eval_episodes": 4})] == [4, 4]
    assert stage_jobs(pipeline, {})[0].eval_episodes == 60
    asks = load_pipeline(write(tmp_path, {**own, "require": {"success_rate": 0.9}}))
    with pytest.raises(ConfigError, match="require"):
        stage_jobs(asks, {"eval_episodes": 0})


def test_a_last_stage_below_the_one_before_hands_over_the_earlier_agent(
    tmp_path, monkeypatch, capsys
):
    """Table, commands, files and the exit code say so, also when the pipeline is resumed."""
    monkeypatch.chdir(tmp_path)
    short = {**TINY, "eval_env_kwargs": {"max_episode_steps": 60}}
    ruined = {**short, "learning_rate": 1.0, "n_epochs": 1, "critic_warmup": 0}
    one = {**ONE, "env": TWO["env"], "settings": {**short, "n_timesteps": 2560}}
    write(tmp_path, one, {**TWO, "pass_on": "best", "settings": ruined})
    command = ["train", "--conf-file", "stages.yml", "--eval-episodes", "16", "--no-progress"]
    assert main(command) == 1
    output = capsys.readouterr().out
    earlier = f"logs/dagger/{TWO['env']}_1/{TWO['env']}.zip"
    (folder,) = (tmp_path / "logs" / "stages").iterdir()
    status = yaml.safe_load((folder / "pipeline.yml").read_text())
    assert f"logs/{status['agent']}" == earlier
    assert "one (handed over)" in output and "two: mean reward" in output
    assert all(earlier in line for line in output.split("next:\n")[1].splitlines())
    # The run of the last stage has the earlier agent, too.
    last = tmp_path / "logs" / "ppo_bc" / f"{TWO['env']}_1"
    one, two = policy(earlier), policy(last / "best_model.zip")
    assert all(np.array_equal(one[key], two[key]) for key in one if key != "log_std")
    with np.load(last / "evaluations.npz") as file:
        assert file["timesteps"][0] == 0
        start, *_, end = file["results"].mean(axis=1)
    assert end < start
    assert main(["train", "--resume", str(folder)]) == 1


def test_on_a_vehicle_it_starts_from_the_best_agent_there_and_hands_over_none_below(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rivals, "EPISODES", 4)
    monkeypatch.setattr(pipeline_module, "HEAD_START", 0.0)
    # APG would undo the updates that are to ruin its agent.
    monkeypatch.setattr(apg, "ACTION_CHANGE", np.inf)
    monkeypatch.setattr(apg, "COST_RISE", np.inf)
    short = {**TINY, "eval_env_kwargs": {"max_episode_steps": 100}}
    two = {**ONE, "name": "two", "algo": "apg", "env": TWO["env"], "conf_file": "apg.yml"}
    two["settings"] = {"n_envs": 8, "n_steps": 50, "n_timesteps": 1200}
    two |= {"rivals": ["any-quadcopter", "geometric"], "rival_settings": {"learning_rate": 0.9}}
    two["settings"]["eval_env_kwargs"] = short["eval_env_kwargs"]
    write(tmp_path, {**ONE, "settings": short}, two)
    command = "train --conf-file stages.yml --eval-episodes 4 --no-progress --env-kwargs"
    assert main([*command.split(), "vehicle:crazyflie"]) == 1
    output = capsys.readouterr().out
    (folder,) = (tmp_path / "logs" / "stages").iterdir()
    agent = folder / "any-quadcopter.zip"
    assert f"from {agent.relative_to(tmp_path)}" in output
    for name in ("one", "any-quadcopter", "geometric", "two"):
        assert f"\n{name}: survival 100.0 %, " in output
    assert agent_settings(agent)[0].vehicle.name == "crazyflie"
    status = yaml.safe_load((folder / "pipeline.yml").read_text())
    assert tmp_path / "logs" / status["agent"] == agent
    assert "any-quadcopter (handed over)" in output
