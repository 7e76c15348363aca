"""The package as others get it: built, installed into an empty environment, used from anywhere."""

import configparser
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import sb3_quad

ROOT = Path(__file__).resolve().parent.parent
CODE = ("sb3_quad", "envs", "callbacks", "zoo_configs")
DATA = {".yaml", ".yml", ".typed", ".j2", ".css", ".mplstyle", ".js", ".md", ".zip"}
OPTIONS = configparser.ConfigParser()
OPTIONS.read(ROOT / "setup.cfg")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")


def run(*command, cwd):
    """Standard output of a command that must succeed; nothing of this process's own import path
    reaches it.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    command = [str(part) for part in command]
    result = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def code_folders():
    """Every folder of code in the checkout, and the name that it is imported under."""
    for name in CODE:
        for folder in {path.parent for path in (ROOT / name).rglob("*.py")}:
            parts = folder.relative_to(ROOT).parts
            yield folder, ".".join(parts if parts[0] == "sb3_quad" else ("sb3_quad", *parts))


def test_every_folder_of_code_and_data_is_a_listed_package():
    """Otherwise it works in a checkout, and is missing from the wheel."""
    folders = dict(code_folders())
    assert set(OPTIONS["options"]["packages"].split()) == set(folders.values())
    assert all((folder / "__init__.py").is_file() for folder in folders)
    for name in CODE:
        for path in (ROOT / name).rglob("*"):
            assert path.suffix not in DATA or path.parent in folders, path


def test_each_dependency_is_pinned():
    extras = OPTIONS["options.extras_require"].values()
    wanted = "\n".join([OPTIONS["options"]["install_requires"], *extras])
    lines = [line for line in wanted.splitlines() if line and not line.startswith("sb3_quad[")]
    names = {re.split(r"[\[>=;]", line)[0].strip().lower() for line in lines}
    pins = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)
    assert names <= set(pins) and len(pins) == len(set(pins))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel made from a source distribution, made from a copy, so that nothing built earlier can
    slip in.
    """
    folder = tmp_path_factory.mktemp("build")
    source = folder / "source"
    source.mkdir()
    for path in ROOT.iterdir():
        if path.is_file() and path.name != ".git":
            shutil.copy(path, source)
    for name in (*CODE, "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    run(sys.executable, "-c", build, cwd=source)
    (archive,) = folder.glob("*.tar.gz")
    options = ("--no-deps", "--no-build-isolation", "--wheel-dir", folder)
    run(*PIP, "wheel", *options, archive, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def scripts(wheel, tmp_path_factory):
    """The folder of commands of a new environment that holds the wheel, and uses what it depends on
    from ours.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    paths = sysconfig.get_paths("venv", {"base": folder})
    # A line in a .pth file lends the packages there, but not the link to this checkout, which is a
    # .pth file itself.
    lent = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (Path(paths["purelib"]) / "lent.pth").write_text("\n".join(lent))
    python = Path(paths["scripts"]) / "python"
    options = ("--no-deps", "--no-index", "--ignore-installed")
    run(*PIP, "--python", python, "install", *options, wheel, cwd=folder)
    lend_compiled_code(Path(paths["purelib"]))
    return Path(paths["scripts"])


def lend_compiled_code(purelib):
    """Numba takes what it has compiled for the checkout where the files' times are the same."""
    for folder, name in code_folders():
        target = purelib.joinpath(*name.split("."))
        for path in folder.glob("*.py"):
            shutil.copystat(path, target / path.name)
        if (folder / "__pycache__").is_dir():
            shutil.copytree(folder / "__pycache__", target / "__pycache__", dirs_exist_ok=True)


@pytest.mark.slow
def test_the_wheel_holds_all_code_and_data_and_trains_and_exports(wheel, scripts, tmp_path):
    """From another folder, what a newcomer does after ``pip install``."""
    assert wheel.name.split("-")[1] == sb3_quad.__version__
    expected = {
        f"{name.replace('.', '/')}/{path.name}"
        for folder, name in code_folders()
        for path in folder.iterdir()
        if path.suffix in {".py", *DATA} or path.name == "py.typed"
    }
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == expected

    small = ["--n-envs", "16", "-n", "1600", "--eval-episodes", "0", "--num-threads", "1"]
    hyperparams = ["--hyperparams", "n_steps:50", "gradient_steps:5", "batch_size:256"]
    run(scripts / "sb3-quad", "train", "--algo", "dagger", *small, *hyperparams, cwd=tmp_path)
    (agent,) = tmp_path.glob("logs/dagger/*/QuadTargetTracking-v0.zip")
    run(scripts / "sb3-quad", "export", agent, "--format", "onnx", "-o", "a.onnx", cwd=tmp_path)
    assert (tmp_path / "a.onnx").stat().st_size > 10_000


@pytest.mark.slow
def test_importing_waits_for_nothing_heavy():
    heavy = {"torch", "pybullet", "numba", "stable_baselines3", "matplotlib"}
    imports = "import sys, sb3_quad, sb3_quad.envs, sb3_quad.cli, sb3_quad.zoo_configs"
    code = f"{imports}; print(*({heavy!r} & set(sys.modules)))"
    assert run(sys.executable, "-c", code, cwd=ROOT).split() == []
    code = (
        "import sys, sb3_quad.envs.simulation.batch; print(*({'torch', 'pandas'} & {*sys.modules}))"
    )
    assert run(sys.executable, "-c", code, cwd=ROOT).split() == []
