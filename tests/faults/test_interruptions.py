"""Whatever ends a training, it resumes from its snapshot to the same agent, and its files hold
nothing twice.
"""

import shutil
import signal
import sys

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import locked
from sb3_quad.base.process import StopSignals
from sb3_quad.callbacks import snapshot
from sb3_quad.cli import main
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.trainer import resume, train

ENV = "QuadTargetTracking-v0"
SMALL = {
    "n_timesteps": 1600,
    "n_envs": 8,
    "n_steps": 50,
    "batch_size": 100,
    "dataset_capacity": 1000,
    "n_epochs": 1,
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"max_episode_steps": 60},
}


class Trouble(BaseCallback):
    """Does ``what``, once, at a number of timesteps."""

    what = None

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        if self.num_timesteps == self.at and Trouble.what is not None:
            what, Trouble.what = Trouble.what, None
            what()
        return True


def fail():
    raise RuntimeError("the simulation failed")


def job(folder, at=1000, **changes):
    config = build_config(
        "dagger", ENV, {**SMALL, "callback": {"test_interruptions.Trouble": {"at": at}}}
    )
    more = {"eval_freq": 400, "eval_episodes": 4, "snapshot_every": 1e-9, **changes}
    return TrainingJob(config=config, log_folder=str(folder), **more)


@pytest.fixture(autouse=True)
def every_rollout_gets_a_snapshot(monkeypatch):
    monkeypatch.setattr(snapshot, "SHARE", np.inf)  # however long one takes


def quiet(line):
    pass


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    torch.set_num_threads(1)
    return train(job(tmp_path_factory.mktemp("whole")), quiet).run


def the_same(run, whole):
    ours, theirs = (PPO.load(each.model).get_parameters()["policy"] for each in (run, whole))
    same = all(torch.equal(ours[name], theirs[name]) for name in theirs)
    with np.load(run.evaluations) as first, np.load(whole.evaluations) as second:
        same &= {*first} == {*second} and "train/bc_loss" in first
        same &= all(
            np.array_equal(first[name], second[name], equal_nan=True)
            for name in {*first} - {"seconds"}
        )
    episodes = [
        [line.split(",")[:2] for line in each.episodes.read_text().splitlines()[1:]]
        for each in (run, whole)
    ]
    files = [sorted(path.name for path in each.path.rglob("*")) for each in (run, whole)]
    return same and episodes[0] == episodes[1] and files[0] == files[1]


@pytest.fixture
def broken(tmp_path):
    """A run folder in which training raised an error, after evaluations and episodes that its
    snapshot does not know.
    """
    Trouble.what = fail
    with pytest.raises(RuntimeError):
        train(job(tmp_path), quiet)
    return tmp_path / "dagger" / f"{ENV}_1"


def test_an_error_leaves_a_run_that_resumes_to_the_same_agent_also_the_second_time(broken, whole):
    Trouble.what = fail
    with pytest.raises(RuntimeError):
        resume(str(broken), quiet)
    halves = [broken / ".resume.npz.1.tmp", broken / ENV / ".args.yml.1.tmp"]
    for half in halves:
        half.write_bytes(b"half")
    assert the_same(resume(str(broken), quiet).run, whole)
    assert not any(half.exists() for half in halves)


def test_the_traceback_of_an_unexpected_error_is_kept_until_the_run_is_resumed(
    broken, whole, capsys
):
    traceback = broken / "error.txt"
    traceback.unlink()
    Trouble.what = fail
    assert main(["train", "--resume", str(broken), "--no-progress"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "800 timesteps" in line
    assert str(traceback) in line
    assert traceback.read_text().endswith("RuntimeError: the simulation failed\n")
    # It has the same files.
    assert the_same(resume(str(broken), quiet).run, whole)


def test_a_callback_that_leaves_python_leaves_the_model_too(tmp_path):
    Trouble.what = sys.exit
    with pytest.raises(SystemExit) as left:
        train(job(tmp_path), quiet)
    assert "the model after 800 timesteps is in" in left.value.__notes__[0]
    assert (tmp_path / "dagger" / f"{ENV}_1" / f"{ENV}.zip").is_file()


def test_a_callback_that_raises_at_the_end_leaves_the_finished_model(tmp_path, monkeypatch, whole):
    monkeypatch.setattr(Trouble, "_on_training_end", lambda self: fail(), raising=False)
    with pytest.raises(RuntimeError) as failed:
        train(job(tmp_path), quiet)
    assert "the model after 1,600 timesteps is in" in failed.value.__notes__[0]
    path = tmp_path / "dagger" / f"{ENV}_1" / f"{ENV}.zip"
    ours, theirs = (PPO.load(file).get_parameters()["policy"] for file in (path, whole.model))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_the_seconds_of_the_episodes_continue(broken):
    seconds = 1000.0
    lines = (broken / "0.monitor.csv").read_text().splitlines()
    state = dict(np.load(broken / "resume.npz"))
    lines[-1] = ",".join([*lines[-1].split(",")[:2], str(seconds), "False"])
    (broken / "0.monitor.csv").write_text("\n".join(lines) + "\n")
    np.savez(
        broken / "resume.npz", **{**state, "episodes": (broken / "0.monitor.csv").stat().st_size}
    )
    run = resume(str(broken), quiet).run
    after = [
        float(line.split(",")[2]) for line in run.episodes.read_text().splitlines()[len(lines) :]
    ]
    assert after and min(after) >= seconds


def test_without_room_for_the_snapshot_the_model_is_saved_and_the_snapshot_before_is_kept(
    tmp_path, whole, monkeypatch
):
    def full(path, **arrays):
        raise ConfigError(f"{path}: cannot be written (No space left on device)")

    def fill_the_disk():
        monkeypatch.setattr(snapshot, "write_arrays", full)
        signal.raise_signal(signal.SIGTERM)

    Trouble.what = fill_the_disk
    with pytest.raises(ConfigError, match=r"resume\.npz.*No space.*800 timesteps"):
        train(job(tmp_path), quiet)
    path = tmp_path / "dagger" / f"{ENV}_1"
    assert PPO.load(path / f"{ENV}.zip").num_timesteps == 800
    lines, Trouble.what = [], monkeypatch.undo  # there is room again, but not at once
    assert the_same(resume(str(path), lines.append).run, whole)
    assert any("no new snapshot" in line for line in lines)


def test_no_further_signal_interrupts_a_save_under_way(tmp_path, whole, monkeypatch):
    write, number = snapshot.write_arrays, signal.SIGHUP

    def interrupted(path, **arrays):
        if pressed:
            signal.raise_signal(number)
        write(path, **arrays)

    pressed = []

    def press_twice():
        pressed.append(number)
        signal.raise_signal(number)
        signal.raise_signal(number)

    monkeypatch.setattr(snapshot, "write_arrays", interrupted)
    Trouble.what = press_twice
    result = train(job(tmp_path), quiet)
    assert result.exit_code == 128 + number and result.run.model.is_file()
    pressed.clear()
    assert the_same(resume(str(result.run.path), quiet).run, whole)


def test_two_signals_within_the_update_leave_the_dataset_of_the_snapshot(
    tmp_path, whole, monkeypatch
):
    update, rollouts = DAgger.train, []

    def interrupted(self):
        rollouts.append(None)
        if len(rollouts) == 3:  # the dataset is full, and has lost its oldest pairs to this rollout
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        update(self)

    monkeypatch.setattr(DAgger, "train", interrupted)
    result = train(job(tmp_path), quiet)
    assert result.exit_code == 130 and the_same(resume(str(result.run.path), quiet).run, whole)


def test_a_complete_run_is_not_resumed_and_stays_as_it_is(whole, capsys):
    before = {path: path.stat().st_mtime_ns for path in whole.path.rglob("*")}
    assert main(["train", "--resume", str(whole.path)]) == 2
    assert f"-i {whole.path}" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in whole.path.rglob("*")} == before


@pytest.mark.parametrize("pressed", [False, True])
def test_a_run_folder_that_is_removed_costs_what_was_in_it_and_no_more(tmp_path, pressed):
    run = tmp_path / "dagger" / f"{ENV}_1"

    def remove():
        shutil.rmtree(tmp_path / "dagger")
        if pressed:
            signal.raise_signal(signal.SIGTERM)

    Trouble.what = remove
    steps = 800 if pressed else 1600
    with pytest.raises(TrainingError, match=run.name):
        train(job(tmp_path), quiet)
    assert PPO.load(run / f"{ENV}.zip").num_timesteps == steps


def test_sighup_stays_ignored_under_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            signal.raise_signal(signal.SIGHUP)
            assert signals.received is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_is_refused_costs_nothing(broken, whole, capsys):
    assert main(["train", "--resume", str(broken), "--eval-episodes", "5"]) == 2
    assert "--eval-episodes" in capsys.readouterr().err
    with locked(broken, "run folder"):
        assert main(["train", "--resume", str(broken)]) == 2
    assert "another process" in capsys.readouterr().err
    assert the_same(resume(str(broken), quiet).run, whole)


def test_a_run_that_was_killed_before_its_first_rollout_is_started(tmp_path, whole, monkeypatch):
    def killed(run):
        raise SystemExit

    with pytest.raises(SystemExit):
        train(job(tmp_path), quiet, on_start=killed)
    assert the_same(resume(str(tmp_path / "dagger" / f"{ENV}_1"), quiet).run, whole)


@pytest.mark.parametrize("name", ["0.monitor.csv", "linked"])
def test_a_strangers_run_is_not_resumed_through_its_links(broken, tmp_path, name):
    outside = tmp_path / "notes"
    outside.write_text("buy milk")
    (broken / name).unlink(missing_ok=True)
    (broken / name).symlink_to(outside)
    with pytest.raises(ConfigError, match=name):
        resume(str(broken), quiet)
    assert outside.read_text() == "buy milk"


def test_a_strangers_run_writes_no_logs_outside_of_its_log_folder(broken, tmp_path):
    arguments = broken / ENV / "args.yml"
    place = tmp_path.parent / "tensorboard"
    text = arguments.read_text().replace("tensorboard_log: null", f"tensorboard_log: {place}")
    arguments.write_text(text)
    with pytest.raises(ConfigError, match="tensorboard"):
        resume(str(broken), quiet)
    assert not place.exists()
