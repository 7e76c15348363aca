"""The package as others get it: built, installed into an empty environment, used from anywhere."""

import ast
import configparser
import json
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
# Extras in the environments of make test-zoo and make docs, and one that most have anyway.
APART = {"zoo", "ray", "track", "docs", "pybullet"}
HEAVY = ("torch", "pybullet", "numba", "stable_baselines3", "matplotlib")


def run(*command, cwd):
    """Standard output of a command that must succeed; nothing of this process's own import path
    reaches it.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def module_name(path):
    """The name under which a folder of the checkout is imported."""
    parts = path.relative_to(ROOT).parts
    return ".".join(parts if parts[0] == "sb3_quad" else ("sb3_quad", *parts))


def package_folders():
    """Every folder of code in the checkout, by the name it is imported under."""
    return {
        module_name(init.parent): init.parent
        for name in CODE
        for init in (ROOT / name).rglob("__init__.py")
    }


def requirements(text):
    """The names in lines such as ``rl_zoo3[plots]>=2.9``, without this package's own."""
    lines = [line for line in text.splitlines() if line.strip()]
    names = {re.split(r"[\[>=;]", line)[0].strip().lower() for line in lines}
    return names - {"sb3_quad"}


def extra_requirements(options, extra):
    """The names that an extra installs, those of the extras that it names included."""
    text = options["options.extras_require"][extra]
    names = requirements(text)
    for listed in re.findall(r"sb3_quad\[([\w,]+)\]", text):
        for other in listed.split(","):
            names |= extra_requirements(options, other)
    return names


@pytest.fixture(scope="module")
def options():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel made from a source distribution, made from a copy, so that nothing built earlier can
    slip in.
    """
    folder = tmp_path_factory.mktemp("build")
    source = folder / "source"
    source.mkdir()
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, source)
    for name in (*CODE, "tests"):
        shutil.copytree(
            ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    run(
        sys.executable,
        "-c",
        f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})",
        cwd=source,
    )
    (archive,) = folder.glob("*.tar.gz")
    pip = (
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
    )
    run(*pip, "--wheel-dir", folder, archive, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder of commands of a new environment that holds the wheel, and uses what it depends on
    from ours.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    paths = {
        name: Path(path) for name, path in sysconfig.get_paths("venv", {"base": folder}).items()
    }
    # A line in a .pth file lends the packages there, but not the link to this checkout, which is a
    # .pth file itself.
    lent = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (paths["purelib"] / "lent.pth").write_text("\n".join(lent))
    pip = (
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "--python",
        paths["scripts"] / "python",
    )
    run(*pip, "install", "--no-deps", "--no-index", "--ignore-installed", wheel, cwd=folder)
    _lend_compiled_code(paths["purelib"])
    return paths["scripts"]


def _lend_compiled_code(purelib):
    """Numba takes what it has compiled for the checkout, if there is any, where the files' times
    are the same.
    """
    for name, source in package_folders().items():
        target = purelib.joinpath(*name.split("."))
        for path in source.glob("*.py"):
            shutil.copystat(path, target / path.name)
        for path in source.glob("__pycache__/*.nb[ic]"):
            (target / "__pycache__").mkdir(exist_ok=True)
            shutil.copy(path, target / "__pycache__")


def test_every_code_folder_is_a_package_and_listed(options):
    """Without an ``__init__.py``, a folder works in a checkout and is missing from the wheel."""
    folders = {path.parent for name in CODE for path in (ROOT / name).rglob("*.py")}
    assert folders == set(package_folders().values())
    assert set(options["options"]["packages"].split()) == set(package_folders())


def test_package_dir_leads_to_the_package(options):
    mapping = dict(
        line.split(" = ") for line in options["options"]["package_dir"].strip().splitlines()
    )
    for name, folder in package_folders().items():
        prefix = max((key for key in mapping if f"{name}.".startswith(f"{key}.")), key=len)
        assert (ROOT / mapping[prefix]).joinpath(*name.removeprefix(prefix).split(".")) == folder


def test_each_dependency_is_pinned(options):
    wanted = "".join(
        [options["options"]["install_requires"], *options["options.extras_require"].values()]
    )
    pins = [
        line.split("==")[0]
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    ]
    assert requirements(wanted) <= set(pins)
    assert len(pins) == len(set(pins))


def test_the_extra_for_developers_holds_all_but_those_apart(options):
    extras = {name: extra_requirements(options, name) for name in options["options.extras_require"]}
    for name in extras.keys() - APART:
        assert extras["dev"] >= extras[name], name
    assert "moviepy" in extras["video"]  # Gymnasium's RecordVideo imports it
    page, tried = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("docs/installation.md", ".ci/extras")
    )
    assert all(
        f"| `[{name}]` |" in page and re.search(rf"^ +{name}\)", tried, re.MULTILINE)
        for name in extras
    )


def test_extras_are_installed_from_a_clone(options):
    """The package is on no index, and zsh wants the brackets quoted."""
    code = [path for name in CODE for path in (ROOT / name).rglob("*.py")]
    for path in [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *code]:
        for written in re.findall(
            r"pip install (?!\"gymnasium)[^`\n]*\[[^`\n]*", path.read_text(encoding="utf-8")
        ):
            named = re.match(
                r"pip install (?:-c constraints.txt )?'\.\[(\w+|\{extra\})\]'", written
            )
            assert named, f"{path}: {written}"
            assert named[1] in (*options["options.extras_require"], "{extra}"), f"{path}: {written}"


def test_the_version_stands_in_one_place(options):
    assert options["metadata"]["version"] == "attr: sb3_quad.base.__version__"
    assert f"\nversion: {sb3_quad.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_what_the_code_imports_is_declared(options):
    distributions = {
        "yaml": "pyyaml",
        "stable_baselines3": "stable-baselines3",
        "PIL": "pillow",
    }
    brought = {"llvmlite": "numba", "pybullet_data": "pybullet", "typing_extensions": "torch"}
    declared = requirements(options["options"]["install_requires"])
    for name in options["options.extras_require"].keys() - {"tests", "docs", "dev"}:
        declared |= extra_requirements(options, name)
    for path in (path for name in CODE for path in (ROOT / name).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in (
                {name.split(".")[0] for name in names} - {"sb3_quad"} - set(sys.stdlib_module_names)
            ):
                assert brought.get(name, distributions.get(name, name)) in declared, (
                    f"{path} imports {name}"
                )


@pytest.mark.slow
def test_importing_waits_for_nothing_heavy():
    imports = "import sys, sb3_quad, sb3_quad.envs, sb3_quad.cli, sb3_quad.zoo_configs"
    code = f"{imports}; print(*sorted(set({HEAVY!r}) & set(sys.modules)))"
    assert run(sys.executable, "-c", code, cwd=ROOT).split() == []


@pytest.mark.slow
def test_the_wheel_holds_all_code_and_data(wheel):
    assert wheel.name.split("-")[1] == sb3_quad.__version__
    kept = {".py", *DATA}
    expected = {
        f"{name.replace('.', '/')}/{path.name}"
        for name, folder in package_folders().items()
        for path in folder.iterdir()
        if path.suffix in kept or path.name == "py.typed"
    }
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == expected


def test_no_data_file_is_outside_a_package():
    """Package data is listed by package: a YAML file in a folder that is none would be missing from
    the wheel.
    """
    folders = set(package_folders().values())
    for path in (path for name in CODE for path in (ROOT / name).rglob("*")):
        assert path.suffix not in DATA or path.parent in folders, path


@pytest.mark.slow
def test_the_wheel_works_from_another_folder(installed, tmp_path):
    code = """
import importlib, importlib.resources, json, pkgutil, sys, sb3_quad
modules = pkgutil.walk_packages(sb3_quad.__path__, "sb3_quad.")
names = [module.name for module in modules if "__main__" not in module.name]
for name in names: importlib.import_module(name)
configs = importlib.resources.files("sb3_quad.zoo_configs")
files = [sys.modules[name].__file__ for name in names]
print(json.dumps([names, files, configs.joinpath("dagger.yml").read_text()]))
"""
    names, files, config = json.loads(
        run(installed / "python", "-c", code, cwd=tmp_path).splitlines()[-1]
    )
    assert {
        "sb3_quad.envs.quadcopter_env",
        "sb3_quad.callbacks",
        "sb3_quad.zoo_configs.thesis",
    } <= set(names)
    assert not [file for file in files if not Path(file).is_relative_to(installed.parent)]
    assert config == (ROOT / "zoo_configs" / "dagger.yml").read_text()
    assert "train" in run(installed / "sb3-quad", "--help", cwd=tmp_path)
    assert "--algo" in run(
        installed / "python", "-m", "sb3_quad.cli", "train", "--help", cwd=tmp_path
    )


@pytest.mark.slow
def test_the_wheel_trains_exports_and_tunes(installed, tmp_path):
    """From another folder, what a newcomer does after ``pip install``; in one process, which
    compiles once.

    The closing tables are of few episodes, and PyTorch has one thread: its others only wait for
    each other here.
    """
    algo = ["--algo", "dagger", "--num-threads", "1", "-n", "1600", "--n-envs", "16"]
    algo.append("--eval-episodes")
    small = ["--seed", "0", "--hyperparams", "n_steps:50", "gradient_steps:5", "batch_size:256"]
    search = ["--n-trials", "2", "--n-evaluations", "1", "--search-space", "space.yml"]
    zip_file, best = (
        "logs/dagger/QuadTargetTracking-v0_1/QuadTargetTracking-v0.zip",
        "logs/tune/dagger/QuadTargetTracking-v0_1/best.yml",
    )
    commands = [
        ["train", *algo, "0", *small],
        ["export", zip_file, "--format", "onnx"],
        ["export", "itm-recovery", "--format", "onnx", "-o", "pretrained.onnx"],
        ["tune", *algo, "2", *search, *small],
        ["train", *algo, "0", "--conf-file", best],
    ]
    (tmp_path / "space.yml").write_text("learning_rate: {low: 1.0e-3, high: 1.0e-2, log: true}\n")
    code = (
        "from sb3_quad.cli import closing, main; closing.FRESH_EPISODES = 4; "
        f"assert not any(map(main, {commands!r}))"
    )
    run(installed / "python", "-c", code, cwd=tmp_path)
    for path in (Path(Path(zip_file).name).with_suffix(".onnx"), Path("pretrained.onnx")):
        assert (tmp_path / path).stat().st_size > 10_000


@pytest.mark.slow
def test_the_installed_package_works_from_the_checkout(installed):
    """There the checkout's sb3_quad/ comes first, whose envs/ and the like lie beside it."""
    assert "train" in run(installed / "python", "-m", "sb3_quad.cli", "--help", cwd=ROOT)
    code = (
        "import sb3_quad.envs.registration as r, sb3_quad.callbacks, sb3_quad.zoo_configs.thesis; "
        "print(r.__file__)"
    )
    assert run(installed / "python", "-c", code, cwd=ROOT).strip() == str(
        ROOT / "envs" / "registration.py"
    )
    assert "train" in run(installed / "sb3-quad", "--help", cwd=ROOT)
