"""Without PyBullet the batch flies and trains, and whatever needs PyBullet says how to get it."""

import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from sb3_quad.base.errors import MissingExtra
from sb3_quad.cli import main

ROOT = Path(__file__).resolve().parent.parent
ON_PYBULLET = ("envs.bullet", "envs.quadcopter_env", "envs.rendering.bullet_client")
NEEDS_PYBULLET = tuple(f"sb3_quad.{name}" for name in ON_PYBULLET)
LINE = "QuadcopterEnv (gymnasium.make, --vec-env dummy or subproc) needs pybullet "


def modules():
    """Every module of the package, by the name it is imported under."""
    for path in (
        path
        for folder in ("sb3_quad", "envs", "callbacks")
        for path in (ROOT / folder).rglob("*.py")
    ):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts if parts[0] == "sb3_quad" else ("sb3_quad", *parts))
        if not name.endswith("__main__"):
            yield name.removesuffix(".__init__")


@pytest.mark.slow
def test_everything_else_can_be_imported_and_a_batch_flies():
    names = [name for name in modules() if not name.startswith(NEEDS_PYBULLET)]
    code = f"""
import importlib, sys
sys.modules["pybullet"] = sys.modules["pybullet_data"] = None
for name in {names}: importlib.import_module(name)
from sb3_quad.evaluation.flights import fly
print(fly(sys.modules["sb3_quad.experts.pid"].PIDExpert(), "target_tracking", 8).survival.sum())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert len(names) > 100 and done.stdout.split() == ["8"], done.stderr


@pytest.fixture
def without_pybullet(monkeypatch):
    """No module of PyBullet can be imported, nor be found as imported before."""
    for name in [name for name in sys.modules if name.startswith(NEEDS_PYBULLET)]:
        monkeypatch.delitem(sys.modules, name)
        # Where its package has it, `from package import module` does not import it again.
        package, _, module = name.rpartition(".")
        if module in vars(sys.modules.get(package, sys)):
            monkeypatch.delattr(sys.modules[package], module)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.setattr(
        sys,
        "meta_path",
        [finder for finder in sys.meta_path if type(finder).__name__ != "WithoutPyBullet"],
    )


def test_a_command_that_needs_it_says_so_in_one_line(
    without_pybullet, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert (
        main(["train", "--algo", "ppo", "--vec-env", "subproc", "-n", "100", "--n-envs", "2"]) == 2
    )
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"error: {LINE}") and said.endswith(
        "pip install '.[pybullet]' from a clone of sb3_quad"
    )
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["QuadTargetTracking-v0", "QuadcopterEnv"])
def test_a_program_that_needs_it_raises_the_same_line(without_pybullet, name):
    import sb3_quad.envs

    with pytest.raises(MissingExtra) as caught:
        gymnasium.make(name) if "-" in name else getattr(sb3_quad.envs, name)
    assert str(caught.value).startswith(LINE)


def test_a_training_evaluates_on_the_batch(without_pybullet, tmp_path, capsys):
    command = (
        "train --algo dagger -n 400 --n-envs 8 --eval-freq 200 --eval-episodes 4 "
        "--n-eval-envs 2 --no-progress"
    )
    hyperparams = ["--hyperparams", "n_steps:25", "gradient_steps:2", "batch_size:64"]
    assert main([*command.split(), "-f", str(tmp_path), *hyperparams]) == 0
    assert capsys.readouterr().out.count("timesteps, ") >= 2
