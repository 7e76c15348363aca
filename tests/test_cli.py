"""The command line: light until a command runs, nothing lost on interruption, a run that resumes as
if nothing was.
"""

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.results_plotter import load_results

import sb3_quad
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.cli import closing, main
from sb3_quad.cli.app import COMMANDS
from sb3_quad.envs.simulation.tasks import TASKS
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.compare import compare
from sb3_quad.training import config as config_module
from sb3_quad.training.config import TrainingJob, build_config, load_agent, load_config
from sb3_quad.training.trainer import resume, train

ENV = "QuadTargetTracking-v0"
SMALL = {
    "n_timesteps": 1200,
    "n_envs": 8,
    "n_steps": 50,
    "batch_size": 100,
    "learning_rate": "lin_1e-3",
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"max_episode_steps": 60},
}
SMALL_DAGGER = {**SMALL, "dataset_capacity": 1000}


class Interrupt(BaseCallback):
    """Sends this process a signal, once, after a number of transitions."""

    sent: bool = True

    def __init__(self, number: int = signal.SIGTERM, after: int = 900) -> None:
        super().__init__()
        self.number, self.after = number, after

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.after and not Interrupt.sent:
            Interrupt.sent = True
            os.kill(os.getpid(), self.number)
        return True


class Diverge(BaseCallback):
    """Poisons the policy in its second rollout."""

    def _on_step(self) -> bool:
        if self.num_timesteps > 500:
            with torch.no_grad():
                next(iter(self.model.policy.action_net.parameters())).fill_(torch.nan)
        return True


@pytest.fixture
def settings_file(tmp_path):
    path = tmp_path / "small.yml"
    path.write_text(yaml.safe_dump({ENV: SMALL_DAGGER}))
    return str(path)


def job(tmp_path, algo="dagger", **changes):
    settings = {**(SMALL_DAGGER if algo == "dagger" else SMALL), **changes}
    if algo == "apg":
        settings["continue_flights"] = True
        del settings["batch_size"], settings["env_kwargs"]
    return TrainingJob(
        config=build_config(algo, ENV, settings), log_folder=str(tmp_path / "logs"), eval_episodes=0
    )


def one_line_of_error(capsys) -> str:
    lines = [
        line
        for line in capsys.readouterr().err.splitlines()
        if not line.startswith("sb3_quad: compiling")
    ]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: "), lines
    return lines[0]


def test_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sb3_quad {sb3_quad.__version__}\n"


def test_help_has_examples_and_needs_no_torch_nor_does_a_missing_agent():
    code = (
        "import sys\nfrom sb3_quad.cli.app import COMMANDS, main\n"
        "codes = [main(['--help']), *(main([name, '--help']) for name in COMMANDS)]\n"
        "codes.append(main(['train', '-i', 'missing.zip']) != 2)\n"
        "heavy = {'torch', 'numba', 'matplotlib', 'filelock'}\n"
        "sys.exit(any(codes) or bool(heavy & sys.modules.keys()))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("examples:") == 1 + len(COMMANDS) and "exit codes:" in result.stdout


def test_a_run_from_beginning_to_end(tmp_path, settings_file, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    flags = "--eval-freq 400 --eval-episodes 4 --save-freq 800 --seed 3 --env-kwargs noise:0.1"
    command = ["train", "--algo", "dagger", "--conf-file", settings_file, "--no-progress"]
    assert main([*command, *flags.split(), "--hyperparams", "eval_tasks:state_recovery"]) == 0
    output = capsys.readouterr().out
    run = Path("logs", "dagger", f"{ENV}_1")
    for part in ("agent", "expert", "success", f"the last one is {run / ENV}.zip", str(run)):
        assert part in output
    files = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert files == {
        f"{ENV}.zip",
        "best_model.zip",
        "rl_model_800_steps.zip",
        "evaluations.npz",
        "evaluations_state_recovery.npz",
        "0.monitor.csv",
        f"{ENV}/config.yml",
        f"{ENV}/args.yml",
        f"{ENV}/command.txt",
    }
    assert PPO.load(run / f"{ENV}.zip").num_timesteps == 1200
    assert yaml.safe_load((run / ENV / "args.yml").read_text())["seed"] == 3
    used = yaml.safe_load((run / ENV / "config.yml").read_text())["env_kwargs"]
    assert used == {"max_episode_steps": 60, "noise": 0.1}
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [400, 800, 1200]
    # The commands at the end can be pasted.
    lines = output.split("next:\n")[1].splitlines()
    assert len(lines) == 4
    for line, more in zip(lines, ([], [], ["-n", "2", "--no-report"], []), strict=True):
        words = shlex.split(line)
        arguments = words[next(k for k, word in enumerate(words) if word in COMMANDS) :]
        assert main([*arguments, *more]) == 0
    assert Path(f"evaluations/dagger_{ENV}_1/results.json").is_file()


@pytest.mark.parametrize("vec_env", ["batch", pytest.param("dummy", marks=pytest.mark.slow)])
def test_episodes_end_at_all_ages_from_the_first_rollout_on(tmp_path, vec_env):
    result = train(
        job(tmp_path, vec_env=vec_env, n_timesteps=400), report=lambda line: None
    )  # 50 steps of at most 60
    assert load_results(str(result.run.path)).l.tolist() == [8, 15, 23, 30, 38, 45]
    assert [info["l"] for info in result.model.ep_info_buffer] == [8, 15, 23, 30, 38, 45]


@pytest.mark.parametrize(("n_timesteps", "last"), [(400, 1e-3), (1000, 1e-3 / 3)])
def test_the_last_update_learns(tmp_path, n_timesteps, last):
    model = train(job(tmp_path, n_timesteps=n_timesteps), report=lambda line: None).model
    assert model.logger.name_to_value["train/learning_rate"] == pytest.approx(last)
    assert model.lr_schedule(1.0) == 1e-3


@pytest.mark.parametrize("vec_env", ["dummy", pytest.param("subproc", marks=pytest.mark.slow)])
def test_pybullet_gives_the_same_run_as_the_batch(tmp_path, vec_env):
    changes = {"n_timesteps": 200, "n_envs": 2, "env_kwargs": {"noise": 0, "max_episode_steps": 60}}
    models = [
        train(job(tmp_path, vec_env=kind, **changes), report=lambda line: None).model
        for kind in ("batch", vec_env)
    ]
    for ours, theirs in zip(
        models[0].policy.parameters(), models[1].policy.parameters(), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)


def test_other_environments_train_too(tmp_path):
    settings = {"n_timesteps": 128, "n_envs": 2, "n_steps": 32, "batch_size": 32}
    config, lines = build_config("ppo", "Pendulum-v1", settings), []
    result = train(
        TrainingJob(config=config, log_folder=str(tmp_path), eval_episodes=1), report=lines.append
    )
    assert PPO.load(result.run.model).num_timesteps == 128
    assert result.run.best_model.is_file() and "successes" not in np.load(result.run.evaluations)
    (line,) = lines
    assert "mean reward" in line and "success" not in line


@pytest.mark.slow
def test_ctrl_c_saves_the_model_and_says_where(tmp_path, settings_file):
    """In a process of its own, as a shell would send it."""
    command = f"train --algo dagger --conf-file {settings_file} -f {tmp_path} -n 1e9"
    process = subprocess.Popen(
        [sys.executable, "-m", "sb3_quad.cli", *command.split(), "--eval-episodes", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent.parent,
    )
    log = tmp_path / "dagger" / f"{ENV}_1" / "0.monitor.csv"
    while process.poll() is None and (not log.is_file() or log.read_text().count("\n") < 10):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    saved = log.parent / f"{ENV}.zip"
    assert str(saved) in output
    assert PPO.load(saved).num_timesteps > 0


@pytest.mark.parametrize(
    ("algo", "after"),
    [("dagger", 900), ("ppo", 1000), ("ppo_bc", 900), ("apg", 900)],
)
def test_a_resumed_run_equals_one_that_was_not_interrupted(tmp_path, algo, after):
    interruption = {"test_cli.Interrupt": {"after": after}}
    Interrupt.sent = True
    whole = train(job(tmp_path, algo, callback=interruption), report=lambda line: None)
    Interrupt.sent = False
    lines = []
    interrupted = train(job(tmp_path, algo, callback=interruption), report=lines.append)
    assert interrupted.exit_code == 143
    assert f"--resume {interrupted.run.path}" in lines[-1]
    assert PPO.load(interrupted.run.model).num_timesteps == after // 400 * 400
    assert whole.run.path != interrupted.run.path

    again = resume(str(interrupted.run.path), report=lambda line: None)
    assert again.exit_code == 0
    assert again.model.num_timesteps == whole.model.num_timesteps == 1200
    ours, theirs = again.model.get_parameters(), whole.model.get_parameters()
    for name, tensor in theirs["policy"].items():
        assert torch.equal(tensor, ours["policy"][name]), name
    assert str(ours["policy.optimizer"]["param_groups"]) == str(
        theirs["policy.optimizer"]["param_groups"]
    )
    assert not again.run.resume_state.exists()


def test_every_zip_of_a_run_says_how_it_flies_and_its_successor_flies_as_it(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    std = [2.0] * 18
    heavy = load_vehicle("itm").model_copy(update={"mass": 1.6, "name": "heavy"})
    Path("heavy.yaml").write_text(heavy.model_dump_json())
    own = {"vehicle": "heavy.yaml", "observation_std": std, "max_episode_steps": 40}
    evaluated = {"n_timesteps": 800, "env_kwargs": own, "eval_env_kwargs": {"noise": 0}}
    often = {"eval_freq": 400, "eval_episodes": 2, "save_freq": 400}
    config = build_config("ppo", "QuadStateRecovery-v0", {**SMALL, **evaluated})
    run = train(TrainingJob(config=config, **often), report=lambda line: None).run
    Path("heavy.yaml").unlink()
    zips = list(run.path.glob("*.zip"))
    assert len(zips) == 4
    for path in zips:
        mailed = Path(f"mailed_{path.name}")
        mailed.write_bytes(path.read_bytes())
        settings, source = agent_settings(mailed)
        assert source == mailed
        assert settings.vehicle == heavy
        assert settings.task == "state_recovery"
        assert settings.noise == 0
        assert settings.observation_std == std
    capsys.readouterr()

    loaded = []
    original = config_module.load_model
    monkeypatch.setattr(
        config_module, "load_model", lambda path: loaded.append(path) or original(path)
    )
    again = ["train", "--algo", "ppo", "--env", ENV, "-n", "400", "--no-progress"]
    again += ["-i", str(run.path), "--eval-episodes", "0"]
    # Another file has other sizes.
    assert main([*again, "--conf-file", "ppo.yml"]) == 2
    assert "policy_kwargs" in one_line_of_error(capsys)
    loaded.clear()
    assert main(again) == 0
    assert loaded == [str(run.best_model)]
    (successor,) = Path("logs", "ppo").glob(f"{ENV}_*/{ENV}.zip")
    assert agent_settings(successor)[0].observation_std == std


def test_a_run_that_ends_below_its_start_hands_the_start_over(tmp_path, capsys):
    """It says so, the zip that its commands name is the start, and the exit code is 1."""
    command = f"train --algo apg --env QuadStateRecovery-v0 -i itm-recovery -f {tmp_path}"
    command += " --n-envs 8 -n 1600 --eval-episodes 8 --eval-freq 800 --no-progress"
    command += " --eval-env-kwargs max_episode_steps:300 --hyperparams learning_rate:0.5"
    assert main([*command.split(), "n_steps:100"]) == 1
    output = capsys.readouterr().out
    run = tmp_path / "apg" / "QuadStateRecovery-v0_1"
    assert "the agent is the one it started from, " in output and "itm-recovery.zip" in output
    assert all(
        str(run / "best_model.zip") in line for line in output.split("next:\n")[1].splitlines()
    )
    start = sb3_quad.load_pretrained("itm-recovery").policy.action_net.weight
    assert torch.equal(PPO.load(run / "best_model.zip").policy.action_net.weight, start)
    assert not torch.equal(
        PPO.load(run / "QuadStateRecovery-v0.zip").policy.action_net.weight, start
    )


def test_a_diverging_training_leaves_the_last_good_model(tmp_path, capsys):
    path = tmp_path / "diverging.yml"
    path.write_text(yaml.safe_dump({ENV: {**SMALL_DAGGER, "callback": "test_cli.Diverge"}}))
    command = f"train --algo dagger --conf-file {path} -f {tmp_path} --eval-episodes 0"
    assert main(command.split()) == 2
    saved = tmp_path / "dagger" / f"{ENV}_1" / f"{ENV}.zip"
    assert str(saved) in one_line_of_error(capsys)
    model = PPO.load(saved)
    assert model.num_timesteps == 400
    assert all(torch.isfinite(parameter).all() for parameter in model.policy.parameters())


@pytest.mark.parametrize(
    ("agent", "other"), [("crazyflie-recovery", True), ("itm-recovery", False)]
)
def test_an_agent_that_goes_on_with_another_vehicle_is_said(agent, other, capsys):
    load_config("dagger", ENV, agent=load_agent(agent))
    assert ("crazyflie and flies itm" in capsys.readouterr().err) == other


def test_an_agent_that_goes_on_with_a_vehicle_of_another_layout_knows_its_rotors():
    changes = {"env_kwargs": {"vehicle": "crazyflie"}}
    config = load_config("apg", ENV, None, changes, load_agent("any-quadcopter"))
    assert config.flight_settings.rotor_layout.name == "itm"
    # The expert of the closing table flies it in this layout, too.
    config.make_expert()


def test_agents_are_handed_over_with_a_fresh_optimiser(tmp_path):
    quiet = {"report": lambda line: None}
    first = train(job(tmp_path, n_timesteps=400), **quiet)
    start = {"initial_policy": str(first.run.model)}
    small = {"n_timesteps": 400, "learning_rate": 0.0}
    second = train(job(tmp_path, "ppo", **small).model_copy(update=start), **quiet)
    ours, theirs = second.model.policy.state_dict(), first.model.policy.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert second.model.num_timesteps == 400
    fixed = {**small, "policy_kwargs": {"net_arch": [8], "log_std_init": -1.25}}
    third = train(job(tmp_path, "ppo", **fixed).model_copy(update=start), **quiet).model.policy
    assert torch.equal(third.log_std.data, torch.full((4,), -1.25))
    assert torch.equal(third.action_net.weight, first.model.policy.action_net.weight)


def test_the_closing_tables_fly_the_agent_with_the_scaling_that_it_was_trained_with():
    scaling = {"noise": 0.0, "observation_mean": [5.0] * 18, "observation_std": [2.0] * 18}
    config = build_config(
        "ppo", ENV, {"n_timesteps": 1, "env_kwargs": {**scaling, "max_episode_steps": 2}}
    )
    seen = []

    def agent(observation):
        seen.append(observation.copy())
        return np.zeros((len(observation), 4), dtype=np.float32)

    job = TrainingJob(config=config)
    closing.agent_and_expert(job, agent)
    assert np.allclose(seen[0][:, 12:], -2.5)  # an episode begins at rest: (0 - 5) / 2
    seen.clear()
    compare({"agent": agent}, n_episodes=4, seed=0, **job.flight_settings.in_any_task())
    assert np.allclose(seen[0][:, 12:], -2.5)


@pytest.mark.parametrize("task", [*TASKS, {"target_tracking": 3, "far_tracking": 1}])
def test_any_task_has_a_closing_table(task):
    config = build_config(
        "ppo", ENV, {"n_timesteps": 1, "env_kwargs": {"task": task, "max_episode_steps": 2}}
    )
    table = closing.agent_and_expert(
        TrainingJob(config=config), lambda observation: np.zeros((len(observation), 4))
    )
    assert table.title.startswith(
        task if isinstance(task, str) else "75% target_tracking, 25% far_tracking"
    )


@pytest.mark.parametrize("ignored", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_neither_an_import_nor_a_command_changes_what_ctrl_c_does(ignored):
    """Also if it is ignored, as by a shell for what it starts in the background."""
    code = (
        "import signal; before = signal.getsignal(signal.SIGINT);"
        "import sb3_quad, sb3_quad.cli as cli;"
        "assert signal.getsignal(signal.SIGINT) is before;"
        "cli.main(['export', 'none']);"
        "assert signal.getsignal(signal.SIGINT) is before"
    )
    words = [sys.executable, "-c", code]
    if ignored:
        words = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *words]
    subprocess.run(words, capture_output=True, check=True)


def test_a_run_clones_the_flights_of_a_file_and_resumes_with_them(tmp_path):
    flights = tmp_path / "flights.npz"
    sb3_quad.fly(sb3_quad.PIDExpert(), n_episodes=4, max_episode_steps=50, record=flights)
    cloned = {
        "demonstrations": str(flights),
        "beta": 0,
        "callback": {"test_cli.Interrupt": {"after": 900}},
    }
    Interrupt.sent = True
    whole = train(job(tmp_path, **cloned), report=lambda line: None)
    # Demonstrations need no expert.
    assert "expert" not in whole.run.config.read_text()
    Interrupt.sent = False
    interrupted = train(job(tmp_path, **cloned), report=lambda line: None)
    flights.unlink()
    again = resume(str(interrupted.run.path), report=lambda line: None)
    model: Any = again.model
    assert len(model.dataset) == 200
    for ours, theirs in zip(
        model.policy.parameters(), whole.model.policy.parameters(), strict=True
    ):
        assert torch.equal(ours, theirs)
    with pytest.raises(ConfigError, match=r"flights\.npz"):
        train(job(tmp_path, **cloned), report=lambda line: None)


def test_closed_streams_cost_nothing(tmp_path, monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    arguments = "evaluate pid --suite quick --scenario tracking -n 2 --no-report -o"
    assert main([*arguments.split(), str(tmp_path)]) == 0
    assert (tmp_path / "results.json").is_file()


def test_a_training_whose_output_nobody_reads_says_so(tmp_path):
    def report(line):
        raise BrokenPipeError

    config = build_config("dagger", ENV, SMALL_DAGGER)
    job = TrainingJob(config=config, log_folder=str(tmp_path), eval_freq=400, eval_episodes=2)
    with pytest.raises(TrainingError, match="the model after"):
        train(job, report)
