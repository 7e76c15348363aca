"""Every `sb3-quad` line of README, docs/ and --help runs, with a small rollout or short flights."""

import re
import shlex
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from stable_baselines3 import PPO

from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.base.yaml_files import YamlFolder, parse_keys
from sb3_quad.cli import main
from sb3_quad.cli.app import COMMANDS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation import evaluate
from sb3_quad.evaluation.scenarios import load
from sb3_quad.training import pipeline

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
PENDULUM = """
Pendulum-v1:
  policy: MlpPolicy
  n_timesteps: 100
  n_steps: 100
  batch_size: 50
  gradient_steps: 2
"""
# Parts of lines that are not run here: which test runs them, or why nothing does.
ELSEWHERE = {
    "--flights": "tests/test_real_flights.py",
    "--resume": "tests/test_runs.py",
    "--track": "tests/test_tracking.py",
    "my_experts:": "tests/test_docs.py",
    "my_package.control:make": "a module of the reader",
    "my_package.rewards:": "tests/test_evaluate.py",
    "my_rewards:": "tests/test_evaluate.py",
    "$RUNS": "agents of a sweep of an hour and a half",
    "…": "an abbreviated line",
}
CONTINUED = re.compile(r"\\\n\s*")
EVALUATED = ["--eval-env-kwargs", "max_episode_steps:100", "--no-progress"]
# Flags that a command gets in addition to its own. Reports are written for the lines of `report`.
SHORTER = {
    "evaluate": ["-n", "2", "--overwrite", "--no-report"],
    "enjoy": ["-n", "20", "--overwrite"],
    "export": ["--overwrite"],
    "sweep": ["--dry-run"],
    "train": ["--eval-episodes", "2", *EVALUATED],
    "tune": ["-n", "960", "--n-trials", "1", *EVALUATED],
    "demo": ["--overwrite"],
    "plot": ["--overwrite"],
    "benchmark": ["--seconds", "0.02", "--sizes", "8", "--n-envs", "1"],
    "check-vehicle": ["-n", "2"],
}
# Upper bounds of settings.
SMALL = {
    "n_timesteps": 960,
    "n_envs": 48,
    "n_steps": 20,
    "batch_size": 240,
    "n_epochs": 2,
    "gradient_steps": 4,
}
NOT_FOR_ONE_ROLLOUT = ("require", "correct_offset")
FLOWN = 100  # control steps, at most
# Flags that are removed: SHORTER gives them, or they need a screen.
WITHOUT = ("-n", "--n-trials", "--max-total-trials", "--sizes", "-P")


def documented() -> list[str]:
    """Collect the lines of shell blocks and of --help, without comments and repetitions."""
    found = []
    for page in PAGES:
        for language, block in re.findall(
            r"^```(\w*)\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.S | re.M
        ):
            if language == "bash":
                found += CONTINUED.sub(" ", block).splitlines()
    for command in COMMANDS.values():
        found += CONTINUED.sub(" ", command.__doc__ or "").splitlines()
    called = [
        re.match(r"(?:\w+=\S+ +)*\s*(?:sb3-quad|python -m sb3_quad\.cli) +(\w.*)", line)
        for line in found
    ]
    lines = [re.sub(r"\s+(#.*|&)$| {3,}[^ -].*", "", match[1]).strip() for match in called if match]
    return [*dict.fromkeys(re.sub(r" +", " ", line) for line in lines)]


LINES = [line for line in documented() if not any(part in line for part in ELSEWHERE)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, trained_runs):
    """A folder with what the lines read: runs, agents, files of the reader."""
    place = tmp_path_factory.mktemp("documented")
    for name in ("agent.zip", "path/to/agent.zip", "mine.zip"):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(pretrained_path("thesis-recovery"), place / name)
    shutil.copy(pretrained_path("itm-robust"), place / "itm-old.zip")
    for algo, env in (("dagger", "Tracking"), ("dagger", "Recovery"), ("ppo_bc", "Recovery")):
        for number in (1, 2):
            source = trained_runs("ppo_bc" if algo == "ppo_bc" else "dagger")
            env_id = {"Tracking": "QuadTargetTracking-v0", "Recovery": "QuadStateRecovery-v0"}[env]
            run = shutil.copytree(source, place / "logs" / algo / f"{env_id}_{number}")
            for path in [*run.glob("QuadStateRecovery-v0*")]:
                path.rename(path.with_name(path.name.replace("QuadStateRecovery-v0", env_id)))
            shutil.copy(pretrained_path("thesis-recovery"), run / "corrected_model.zip")
            shutil.copy(pretrained_path("thesis-imitation"), run / "best_model.zip")
    for algo in ("ppo", "logs/ppo"):
        shutil.copytree(
            place / "logs/ppo_bc", place / algo / "ppo_bc" if algo == "ppo" else place / algo
        )
    shutil.copytree(ROOT / "examples", place / "examples")
    for name in ("my.yaml", "my_vehicle.yaml", "mine.yaml", "mine_tuned.yaml"):
        shutil.copy(ROOT / "examples/my_quadcopter.yaml", place / name)
    shutil.copy(ROOT / "zoo_configs/search_spaces/dagger.yml", place / "my_space.yml")
    best = place / "logs/tune/dagger/QuadTargetTracking-v0_1/best.yml"
    best.parent.mkdir(parents=True)
    shutil.copy(ROOT / "zoo_configs/dagger.yml", best)
    for page, key in (
        ("docs/evaluate.md", "my_scenarios.yaml"),
        ("docs/sweeps.md", "my_sweep.yaml"),
    ):
        (block, *_) = re.findall(
            r"^```yaml\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.S | re.M
        )
        (place / key).write_text(block)
    (place / "my.yml").write_text(PENDULUM)
    PPO("MlpPolicy", "Pendulum-v1", device="cpu").save(place / "teacher.zip")
    return place


def shorter(content):
    """Return settings with one small rollout and small grids.

    An agent of one rollout would fail requirements and offset corrections, so there are none.
    """
    if isinstance(content, list):
        return [shorter(entry) for entry in content]
    if not isinstance(content, dict):
        return content
    kept = {}
    for key, value in content.items():
        if key not in NOT_FOR_ONE_ROLLOUT:
            kept[key] = shorter(value)
    if isinstance(kept.get("vary"), dict):
        kept["vary"] = {key: values[:2] for key, values in kept["vary"].items()}
    for key, most in SMALL.items():
        if isinstance(kept.get(key), int):
            kept[key] = min(kept[key], most)
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_a_documented_line_runs(line, folder, monkeypatch, capsys):
    # Each environment may be a process of its own.
    command, *arguments = shlex.split(line.replace("--n-envs 8", "--n-envs 2"))
    read, longest = YamlFolder.read, FlightSettings.longest_episode.fget
    monkeypatch.setattr(
        YamlFolder,
        "read",
        lambda self, source: (shorter(read(self, source)[0]), read(self, source)[1]),
    )
    monkeypatch.setattr(load, "parse_keys", lambda text, where: shorter(parse_keys(text, where)))
    # Worker processes would not see the patches below.
    monkeypatch.setattr(evaluate, "ProcessPoolExecutor", lambda *options: ThreadPoolExecutor(1))
    monkeypatch.setattr(
        FlightSettings, "longest_episode", property(lambda self: min(longest(self), FLOWN))
    )
    monkeypatch.setattr("sb3_quad.show.film.HOLD", 0.1)
    monkeypatch.setattr("sb3_quad.agents.transfer.CLONE_STEPS", 100)
    monkeypatch.setattr(pipeline, "is_pipeline_run", lambda path: False)
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.chdir(folder)
    while any(flag in arguments for flag in WITHOUT):
        first = min(arguments.index(flag) for flag in WITHOUT if flag in arguments)
        del arguments[first : first + 1 + (arguments[first] != "-P")]
        while first < len(arguments) and arguments[first].isdigit():
            del arguments[first]
    screen = []
    if command == "enjoy" and "-o" not in arguments and "--no-render" not in arguments:
        screen = ["--no-render"]
    if command == "report":
        flags = ["--suite", "quick", "-n", "2", "-o", arguments[0], "--overwrite"]
        main(["evaluate", "pid", *flags])
        if "--overwrite" not in arguments:
            arguments.append("--overwrite")
    assert main([command, *arguments, *screen, *SHORTER.get(command, [])]) == 0, (
        capsys.readouterr().err
    )
