"""Common state of all tests (CPU, one PyTorch thread, fixed seeds, no display), and small agents.

``--shuffle SEED`` runs the tests in another order.
"""

import importlib.abc
import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

# PyTorch reads it when it is imported. Without a GPU the tests are the same on every machine.
os.environ["CUDA_VISIBLE_DEVICES"] = ""
os.environ["MPLBACKEND"] = "Agg"
# Also for the programs that tests start: threads of OpenMP and OpenBLAS wait by spinning, which
# costs most where pytest's workers and other programs want the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import settings

import sb3_quad

# The first example of a test may compile, so no deadline. The same examples every time, except in
# `make fuzz`.
settings.register_profile(
    "fuzz", deadline=None, derandomize=False, max_examples=1000, print_blob=True
)
settings.register_profile(
    "default", deadline=None, derandomize=True, database=None, max_examples=20, print_blob=True
)
settings.load_profile("default")

# fmt: off
TINY = [
    "--n-envs", "16", "-n", "1600", "--eval-episodes", "2", "--eval-freq", "800",
    "--no-progress", "--num-threads", "1",
]
# fmt: on

# By algorithm, settings with which a rollout takes about a second.
HYPERPARAMS = {
    "dagger": ["n_steps:50", "gradient_steps:2", "batch_size:64"],
    "ppo_bc": ["n_steps:50", "n_epochs:2", "batch_size:400", "critic_warmup:0"],
}


def unit_pendulum():
    """Return Pendulum-v1 with actions in [-1, 1], as cloning asks for."""
    pendulum = gymnasium.make("Pendulum-v1").unwrapped
    return gymnasium.wrappers.RescaleAction(pendulum, np.float32(-1.0), np.float32(1.0))


gymnasium.register("UnitPendulum-v0", unit_pendulum, max_episode_steps=200)


class WithoutPyBullet(importlib.abc.MetaPathFinder):
    """Skip a test, or a file of tests, that imports PyBullet where there is none.

    test_without_pybullet.py has the rest.
    """

    def find_spec(self, name, path=None, target=None):
        if name in ("pybullet", "sb3_quad.envs.rendering.bullet_client"):
            pytest.skip("needs PyBullet, the extra [pybullet]", allow_module_level=True)


if importlib.util.find_spec("pybullet") is None:
    sys.meta_path.insert(0, WithoutPyBullet())


def pytest_addoption(parser):
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run the tests in another order")


def pytest_configure():
    """Under nohup, or in a shell's background, signals are ignored, also by the programs that the
    tests start. Restore them.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    hangup = getattr(signal, "SIGHUP", None)  # Windows has none
    if hangup is not None and signal.getsignal(hangup) is signal.SIG_IGN:
        signal.signal(hangup, signal.SIG_DFL)


def pytest_sessionstart(session):
    is_worker = hasattr(session.config, "workerinput")
    if not is_worker and not session.config.option.collectonly:
        # Workers would all compile the same code, and on a slow machine the first test of each
        # would take longer than a test may.
        compile_all = (
            "from sb3_quad import APG, PPOBC, DAgger, QuadcopterVecEnv\n"
            "env = QuadcopterVecEnv(1, reference='circle')\n"
            "DAgger('MlpPolicy', env, expert='geometric', n_steps=2).learn(2)\n"
            "PPOBC('MlpPolicy', env, expert='pid', n_steps=2, critic_warmup=0).learn(2)\n"
            "APG('MlpPolicy', env, n_steps=2).learn(2)\n"
        )
        if importlib.util.find_spec("pybullet") is not None:
            compile_all += (
                "from sb3_quad.envs import QuadcopterEnv\n"
                "env = QuadcopterEnv()\n"
                "env.reset()\n"
                "env.step(env.action_space.sample())\n"
            )
        subprocess.run([sys.executable, "-c", compile_all], check=True)


def pytest_collection_modifyitems(config, items):
    """Shuffle the files, and the tests of each file: the tests of a file share its fixtures."""
    seed = config.getoption("--shuffle")
    if seed is None:
        return
    generator = random.Random(seed)
    by_file = {}
    for item in items:
        by_file.setdefault(item.path, []).append(item)
    files = list(by_file.values())
    generator.shuffle(files)
    items.clear()
    for tests in files:
        generator.shuffle(tests)
        items.extend(tests)


@pytest.fixture(autouse=True)
def same_start(monkeypatch):
    """Start each test from the same state.

    With one thread, sums come out the same on any number of cores. Closing tables are small.
    """
    torch.set_num_threads(1)
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - SB3's buffers draw from it
    torch.manual_seed(0)
    monkeypatch.setattr("sb3_quad.cli.closing.FRESH_EPISODES", 4)
    monkeypatch.setattr("sb3_quad.cli.closing.PIPELINE_EPISODES", 4)


def _train(algo: str, folder: Path) -> Path:
    from sb3_quad.cli import main

    command = ["train", "--algo", algo, "--env", "QuadStateRecovery-v0"]
    command += ["--conf-file", f"nominal/{algo}.yml", "--seed", "3", "-f", str(folder)]
    assert main([*command, *TINY, "--hyperparams", *HYPERPARAMS[algo]]) == 0
    return folder / algo / "QuadStateRecovery-v0_1"


@pytest.fixture(scope="session")
def trained_runs(tmp_path_factory):
    """A function from an algorithm's name to the folder of a tiny run, trained on first use.

    The folder is shared: read it, and do not write there.
    """
    folder = tmp_path_factory.mktemp("logs")
    runs = {}

    def run(algo: str) -> Path:
        if algo not in runs:
            runs[algo] = _train(algo, folder)
        return runs[algo]

    return run


@pytest.fixture
def dagger_run(trained_runs, tmp_path):
    """A copy of a tiny run of DAgger, in a log folder of its own."""
    folder = tmp_path / "logs" / "dagger" / "QuadStateRecovery-v0_1"
    shutil.copytree(trained_runs("dagger"), folder)
    return folder


@pytest.fixture
def short_cards(monkeypatch):
    """Let the flights for a card of publish.py end after 0.2 s."""
    import publish

    def fly(*arguments, **settings):
        return sb3_quad.fly(*arguments, **{**settings, "max_episode_steps": 20})

    monkeypatch.setattr(publish, "fly", fly)


def legends_cover_nothing(figure):
    """Assert that a figure's legends lie within it and outside of its axes."""
    figure.draw_without_rendering()
    assert not any(axes.get_legend() for axes in figure.axes)
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert box.x0 >= -1 and box.x1 <= figure.bbox.width + 1, box
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
