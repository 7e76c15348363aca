"""Snapshots, of a batch and of a run: what does not fit is refused, in one line, and nothing is
lost.
"""

import re

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks.snapshot import random_state
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.runs import open_run
from sb3_quad.training.snapshots import load_snapshot
from sb3_quad.training.trainer import train

TASK = {"target_tracking": 1.0, "state_recovery": 1.0}


def test_numbers_of_tasks_that_are_not_there_are_refused():
    batch = QuadcopterBatch(3, FlightSettings(task=TASK), seed=0)
    batch.reset()
    before = batch.snapshot()
    with pytest.raises(ConfigError, match="task_index"):
        batch.restore({**before, "state": 0.0 * batch.state, "task_index": np.full(3, 7)})
    for key, array in batch.snapshot().items():
        np.testing.assert_array_equal(array, before[key])


@pytest.mark.parametrize("level", [[0.5, 0.0, 0.1], {"relative": 0.2, "additive": 0.1}])
def test_a_snapshot_keeps_the_level_of_the_noise(level):
    batch = QuadcopterBatch(3, FlightSettings(), seed=0)
    other = QuadcopterBatch(3, FlightSettings(), seed=1)
    batch.reset()
    batch.set_noise(level)
    other.restore(batch.snapshot())
    np.testing.assert_array_equal(other.noise_level, batch.noise_level)
    np.testing.assert_array_equal(other.additive_level, batch.additive_level)
    actions = np.zeros((3, 4))
    np.testing.assert_array_equal(other.step(actions)[0], batch.step(actions)[0])


SETTINGS = {
    "n_timesteps": 600,
    "n_envs": 4,
    "n_steps": 25,
    "batch_size": 50,
    "dataset_capacity": 150,
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"max_episode_steps": 20},
}


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A run that an error ended, with a snapshot, evaluations, a best model and episodes; and its
    settings.
    """
    config = build_config("dagger", "QuadTargetTracking-v0", SETTINGS)
    folder, calls = tmp_path_factory.mktemp("logs"), []
    job = TrainingJob(
        config=config, log_folder=str(folder), eval_freq=100, eval_episodes=2, snapshot_every=1e-9
    )

    def fail_the_third_time(success, reward):
        calls.append(success)
        if len(calls) == 3:
            raise RuntimeError("failed")
        return True

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_quad.callbacks.snapshot.SHARE", np.inf)  # each rollout has one
        with pytest.raises(RuntimeError, match="failed"):
            train(job, lambda line: None, should_continue=fail_the_third_time)
    return open_run(folder / "dagger" / "QuadTargetTracking-v0_1"), config


@pytest.fixture
def resuming(broken):
    """Writes arrays as the run's snapshot, and says what loading that raises; no other file may
    have changed.
    """
    run, config = broken
    env = make_environments(config, config.n_envs, 0)
    whole = run.resume_state.read_bytes()
    files = {
        path: path.read_bytes()
        for path in run.path.rglob("*")
        if path.is_file() and path != run.resume_state
    }

    def load(state):
        np.savez(run.resume_state, **state)
        with pytest.raises(ConfigError) as raised:
            load_snapshot(run, TrainingJob(config=config), env, expert=None)
        assert {path: path.read_bytes() for path in files} == files
        return str(raised.value)

    yield load
    run.resume_state.write_bytes(whole)
    load_snapshot(run, TrainingJob(config=config), env, expert=None)


WRONG = {
    "missing": lambda name, array: None,
    "of another type": lambda name, array: np.zeros(array.shape, np.complex64),
    "of another shape": lambda name, array: np.stack([array, array]),
    "shorter": lambda name, array: (
        array[:-1] if array.size and array.ndim and name != "best_model" else array[None]
    ),
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG)
def test_each_entry_of_a_snapshot_must_fit(change, broken, resuming):
    state = dict(np.load(broken[0].resume_state))
    assert {
        "environment.state",
        "best_model",
        "episodes",
        "timesteps",
        "torch",
        "random",
    } < state.keys()
    assert any(name.startswith("dataset.") for name in state)
    assert state["best_model"].size and state["timesteps"] > 0
    for name, array in state.items():
        if array.size == 0:
            continue
        changed = change(name, array)
        message = resuming(
            {key: each for key, each in state.items() if key != name}
            | ({} if changed is None else {name: changed})
        )
        assert re.match(rf"{re.escape(str(broken[0].resume_state))}: {name}\b", message), message
        assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("random", np.array("[]")),
        ("random", np.array("no JSON")),
        ("torch", np.zeros_like(random_state()["torch"])),
        ("timesteps", np.array(7)),
        ("episodes", np.array(-1)),
        ("dataset.added", np.array(-1)),
        ("environment.task_index", np.full(4, -1)),
        ("model", np.frombuffer(b"no zip", np.uint8)),
    ],
)
def test_values_that_mean_nothing_are_refused(name, value, broken, resuming):
    state = dict(np.load(broken[0].resume_state))
    message = resuming({**state, name: value})
    assert message.startswith(f"{broken[0].resume_state}: ") and name.split(".")[-1] in message


def test_rows_that_a_buffer_had_more_when_it_was_written_are_left_out(broken):
    run, config = broken
    whole = run.resume_state.read_bytes()
    state = dict(np.load(run.resume_state))
    more = {
        name: np.concatenate([array, array[:1]])
        for name, array in state.items()
        if name.startswith("dataset.") and array.ndim
    }
    np.savez(run.resume_state, **{**state, **more})
    env = make_environments(config, config.n_envs, 0)
    model = load_snapshot(run, TrainingJob(config=config), env, expert=None)
    for name in more:
        rows = model.dataset.filled[name.partition(".")[2]]
        np.testing.assert_array_equal(rows, state[name])
    run.resume_state.write_bytes(whole)
