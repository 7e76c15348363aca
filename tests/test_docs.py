"""The Python code of README and docs/ runs unchanged; the fast tests shorten its trainings."""

import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_quad.evaluation.offset_correction
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.cli import main
from sb3_quad.evaluation.flights import fly

ROOT = Path(__file__).resolve().parent.parent
# Page and number of blocks that cannot simply be run, and why, or which test runs them.
ELSEWHERE = {
    ("docs/evaluate.md", 0): "reads the folder of a whole evaluation",
    ("docs/export.md", 0): "tests/test_export.py",
    ("docs/export.md", 1): "tests/test_export.py",
    ("docs/export.md", 2): "tests/test_export.py",
    ("docs/export.md", 3): "tests/test_export.py",
    ("docs/research/experts.md", 0): "flies 13,440 episodes",
    ("docs/research/experts.md", 1): "a module, flown below",
}


def python_blocks(page: str) -> list[str]:
    """The code of a page's Python blocks, in order, each on the lines that it has in the page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.finditer(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return ["\n" * text.count("\n", 0, match.start(1)) + match.group(1) for match in blocks]


NAMES = [
    "README.md",
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md")),
]
PAGES = {page: python_blocks(page) for page in NAMES}


TO_RUN = [
    page
    for page, blocks in PAGES.items()
    if any((page, number) not in ELSEWHERE for number in range(len(blocks)))
]


def run(page: str) -> dict[str, object]:
    """Run a page's blocks in order, in the current folder. Returns their namespace."""
    scope: dict[str, object] = {"__name__": page}
    for number, code in enumerate(PAGES[page]):
        if (page, number) not in ELSEWHERE:
            exec(compile(code, str(ROOT / page), "exec"), scope)
    return scope


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The tutorial's reader has made it before.
    shutil.copy(ROOT / "examples/my_quadcopter.yaml", tmp_path / "mine.yaml")
    return tmp_path


def shorten_trainings(monkeypatch, rollouts=1):
    """End each training after some rollouts.

    :returns: a list that gets the intended length and the final weights of each training.
    """
    learn = OnPolicyAlgorithm.learn
    trained = []

    def short(self, total_timesteps, *args, **kwargs):
        size = min(total_timesteps, rollouts * self.n_steps * self.n_envs)
        kwargs.pop("progress_bar", None)
        learn(self, size, *args[:4], **kwargs, progress_bar=False)
        weights = [tensor.tolist() for tensor in self.policy.state_dict().values()]
        trained.append((total_timesteps, weights))
        return self

    monkeypatch.setattr(OnPolicyAlgorithm, "learn", short)
    monkeypatch.setattr(
        sb3_quad.evaluation.offset_correction, "correct_offset", lambda *arguments: None
    )  # which needs an agent that flies
    return trained


def shown_output(page):
    (shown,) = re.findall(
        r"^```text\n(.*?)^```",
        (ROOT / page).read_text(encoding="utf-8"),
        flags=re.DOTALL | re.MULTILINE,
    )
    return shown


def table_row(text, task, name):
    """The first number of each cell of a row in the table of a task, as ``compare`` prints it."""
    table = text.partition(f"{task}: 240 fresh")[2]
    cells = re.search(rf"^│ {name}.*$", table, flags=re.MULTILINE).group().split("│")[2:-1]
    return [float(re.search(r"\d+(\.\d+)?", cell).group()) for cell in cells]


def check_output(output):
    """README shows what its code prints, to within what another seed or machine changes."""
    shown = shown_output("README.md")
    for task, name, tolerance in (
        ("state_recovery", "survival", 5.0),
        ("target_tracking", "final error, median", 0.03),
    ):
        ours = table_row(output, task, name)
        assert ours == pytest.approx(table_row(shown, task, name), abs=tolerance)
    pid, imitation, agent = table_row(output, "state_recovery", "survival")
    assert agent >= 90.0 and agent - 20.0 > max(pid, imitation)


def remarked(page, start):
    """The numbers in the remark behind a line of a page, by how the line begins."""
    text = (ROOT / page).read_text(encoding="utf-8")
    (remark,) = re.findall(rf"^ *{re.escape(start)}.*  # (.*)$", text, flags=re.MULTILINE)
    return [float(number) for number in re.findall(r"-?\d+\.\d+", remark)]


def check_readme(scope):
    assert [scope["mean"]] == pytest.approx(remarked("README.md", 'print(f"mean'), abs=0.1)
    check_output(scope["printed"])
    assert scope["agent"].num_timesteps == 3_000_000


def check_dagger(scope):
    assert scope["agent"] > scope["expert"] - 1.0  # mean rewards of 48 episodes
    assert len(scope["model"].dataset) == scope["model"].num_timesteps


def check_domain_randomization(scope):
    printed = [float(line.removesuffix(" m")) for line in scope["printed"].splitlines()]
    page = "docs/domain_randomization.md"
    assert printed == pytest.approx(remarked(page, "print(f"), abs=6e-4)


def check_dynamics(scope):
    assert len(scope["difference"]) == 5 and 0.0 < max(scope["difference"].values()) < 1e-9
    assert scope["observed"] < 1e-6 and scope["fastest"] > 20.0


def check_environments(scope):
    assert scope["difference"] < 1e-9


def check_tutorial(scope):
    assert scope["flights"].survival.all() and np.median(scope["flights"].final_error) < 0.05


def check_vehicles(scope):
    assert abs(scope["flights"].survival.mean() - 0.953) < 0.01


CHECKS = {
    "README.md": check_readme,
    "docs/dagger.md": check_dagger,
    "docs/domain_randomization.md": check_domain_randomization,
    "docs/environments.md": check_environments,
    "docs/research/dynamics.md": check_dynamics,
    "docs/research/vehicles.md": check_vehicles,
    "docs/tutorial.md": check_tutorial,
}


@pytest.mark.parametrize("page", TO_RUN)
def test_a_page_runs_with_trainings_of_one_rollout(page, monkeypatch):
    shorten_trainings(monkeypatch)
    run(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", CHECKS)
def test_a_page_gives_what_it_says(page, capsys):
    scope = run(page)
    scope["printed"] = capsys.readouterr().out
    CHECKS[page](scope)


def test_exceptions_and_checks_belong_to_pages():
    for page, blocks in PAGES.items():
        for code in blocks:
            compile(code, page, "exec")
    assert all(number < len(PAGES.get(page, ())) for page, number in ELSEWHERE)
    assert CHECKS.keys() <= set(TO_RUN)


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    text = re.sub(
        r"^```.*?^```",
        "",
        (ROOT / page).read_text(encoding="utf-8"),
        flags=re.DOTALL | re.MULTILINE,
    )
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", text):
        file, _, heading = target.partition("#")
        path = (ROOT / page).parent / file if file else ROOT / page
        assert path.exists(), target
        if heading:
            titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert heading in {
                re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
            }, target


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_sources_and_not_to_a_package_index(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert not re.findall(r"https?://[^/\s)]+/(?:projects?|packages?)/[^)\s]*", text)


def test_the_readme_begins_with_a_picture_that_loads_fast():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (first, *_) = re.findall(r"!\[[^]]*\]\((?!https:)([^)]+)\)", text)
    assert text.index(first) < 200 and (ROOT / first).stat().st_size <= 2_000_000


@pytest.fixture
def module_folder(folder, monkeypatch):
    (folder / "my_experts.py").write_text(PAGES["docs/research/experts.md"][1])
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    sys.modules.pop("my_experts", None)


def test_the_worked_expert_flies_to_targets(module_folder):
    expert = resolve_expert("my_experts:lqr", "itm")
    flights = fly(expert, "target_tracking", 96, 5)
    assert flights.success.all() and np.isfinite(flights.time_to[0.1]).all()
    assert flights.final_error.max() < 0.02
    noisy = fly(lambda observation: expert.predict(observation)[0], "target_tracking", 16, 5)
    assert noisy.success.all()


# What the walk below adds to lines, so that they are short and need no screen.
SHORTER = {
    "check-vehicle": ["-n", "2"],
    "evaluate": ["-n", "2", "--no-report"],
    "enjoy": ["-n", "20", "--no-render"],
}
INSTALLS = ("make install", ". .venv/bin/activate")


@pytest.mark.slow
def test_readme_and_tutorial_lead_to_an_own_agent_in_the_demo(folder, monkeypatch):
    """Their blocks in order, in one folder, as a reader runs them; trainings have one rollout.

    Lines that train are those of test_documented_lines.py.
    """
    shorten_trainings(monkeypatch)
    (folder / "mine.yaml").unlink()
    (folder / "examples").symlink_to(ROOT / "examples")
    for page in ("README.md", "docs/tutorial.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        scope = {"__name__": page}
        for language, block in re.findall(r"^```(python|bash)\n(.*?)^```", text, flags=re.S | re.M):
            if language == "python":
                exec(compile(block, page, "exec"), scope)
                continue
            for line in block.splitlines():
                if line.startswith("#"):
                    continue
                program, *arguments = shlex.split(line, comments=True)
                if program == "cp":
                    shutil.copy(*arguments)
                elif program == "sb3-quad" and arguments[0] != "train":
                    assert main([*arguments, *SHORTER.get(arguments[0], [])]) == 0, line
                else:
                    assert program == "sb3-quad" or line.startswith(INSTALLS), line
    data = re.search(
        r'<script type="application/json" id="data">(.*?)</script>',
        (folder / "mine.html").read_text(encoding="utf-8"),
    )
    agent, *experts = json.loads(data.group(1))["agents"]
    assert (agent["label"], agent["vehicle"]) == ("mine", "my_quadcopter")
    assert [expert["kind"] for expert in experts] == ["geometric", "pid"]
