"""What every test starts from (the CPU, one thread of torch, fixed seeds, no display), and small
agents to fly and read.
"""

import importlib.abc
import importlib.util
import os
import random
import shutil
import signal
import sys
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = (
    ""  # read when torch is imported; the tests are the same on every machine
)
os.environ["MPLBACKEND"] = "Agg"

import numpy as np
import pytest
import torch
from hypothesis import settings

# The first example of a test may compile, so no deadline. The same examples every time, except in
# `make fuzz`.
settings.register_profile(
    "fuzz", deadline=None, derandomize=False, max_examples=1000, print_blob=True
)
settings.register_profile(
    "default", deadline=None, derandomize=True, database=None, max_examples=20, print_blob=True
)
settings.load_profile("default")

TINY = [
    "--n-envs",
    "16",
    "-n",
    "1600",
    "--eval-episodes",
    "2",
    "--eval-freq",
    "800",
    "--no-progress",
    "--num-threads",
    "1",
]
HYPERPARAMS = {  # by algorithm, what makes a rollout of it a matter of a second
    "dagger": ["n_steps:50", "gradient_steps:2", "batch_size:64"],
    "ppo_bc": ["n_steps:50", "n_epochs:2", "batch_size:400", "critic_warmup:0"],
    "sac_bc": ["learning_starts:100", "buffer_size:2000", "batch_size:64", "gradient_steps:2"],
}


class WithoutPyBullet(importlib.abc.MetaPathFinder):
    """Where there is no PyBullet, skips what imports it: a test, or a file of them.
    test_without_pybullet.py has the rest.
    """

    def find_spec(self, name, path=None, target=None):
        if name in ("pybullet", "sb3_quad.base.bullet"):
            pytest.skip("needs PyBullet, the extra [pybullet]", allow_module_level=True)


if importlib.util.find_spec("pybullet") is None:
    sys.meta_path.insert(0, WithoutPyBullet())


def pytest_configure():
    """Under nohup, or in a shell's background, signals are ignored, also by the programs that are
    started from here.
    """
    for number in (signal.SIGINT, getattr(signal, "SIGHUP", signal.SIGINT)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            )


@pytest.fixture(autouse=True)
def same_start(monkeypatch):
    """Sums come out the same on any number of cores, global generators start from the same seed,
    closing tables are small.
    """
    torch.set_num_threads(1)
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - SB3's buffers draw from it
    torch.manual_seed(0)
    monkeypatch.setattr("sb3_quad.cli.closing.FRESH_EPISODES", 4)
    monkeypatch.setattr("sb3_quad.cli.closing.PIPELINE_EPISODES", 4)


def _trained(algo: str, folder: Path) -> Path:
    from sb3_quad.cli import main

    command = [
        "train",
        "--algo",
        algo,
        "--env",
        "QuadStateRecovery-v0",
        "--conf-file",
        f"nominal/{algo}.yml",
        "--seed",
        "3",
    ]
    assert main([*command, "-f", str(folder), *TINY, "--hyperparams", *HYPERPARAMS[algo]]) == 0
    return folder / algo / "QuadStateRecovery-v0_1"


@pytest.fixture(scope="session")
def trained_runs(tmp_path_factory):
    """By an algorithm's name, the folder of a tiny run of it, trained when it is first asked for;
    to be read, not written.
    """
    folder, found = tmp_path_factory.mktemp("logs"), {}

    def run(algo: str) -> Path:
        if algo not in found:
            found[algo] = _trained(algo, folder)
        return found[algo]

    return run


@pytest.fixture
def dagger_run(trained_runs, tmp_path):
    """A copy of a tiny run of DAgger, in a log folder of its own."""
    folder = tmp_path / "logs" / "dagger" / "QuadStateRecovery-v0_1"
    shutil.copytree(trained_runs("dagger"), folder)
    return folder


@pytest.fixture(scope="session")
def results_folder(tmp_path_factory):
    """The results of evaluating two experts on a suite of two short scenarios; to be read, not
    written.
    """
    from sb3_quad.cli import main

    folder = tmp_path_factory.mktemp("results")
    suite = folder / "small.yaml"
    hover = "{name: hover, duration: 0.5, episodes: 3}"
    far = "{name: far, target: [1, 0, 15], duration: 1, episodes: 2}"
    suite.write_text(f"{{name: small, scenarios: [{hover}, {far}]}}")
    out = folder / "out"
    assert (
        main(["evaluate", "pid", "geometric", "--suite", str(suite), "-o", str(out), "--no-report"])
        == 0
    )
    return out


def legends_cover_nothing(figure):
    """Assert that a figure's legends lie within it and outside of its axes."""
    figure.draw_without_rendering()
    assert not any(axes.get_legend() for axes in figure.axes)
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert box.x0 >= -1 and box.x1 <= figure.bbox.width + 1, box
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
