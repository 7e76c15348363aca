"""The pages' Python code runs unchanged, with short trainings, and their commands are commands."""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_quad.evaluation.offset_correction
from sb3_quad.cli.app import COMMANDS, make_parser
from sb3_quad.envs.simulation.settings import FlightSettings

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md"))]
# Page and number of blocks that cannot simply be run, and why, or which test runs them.
ELSEWHERE = {
    ("docs/evaluate.md", 0): "reads a log that others have published",
    ("docs/evaluate.md", 1): "reads the folder of a whole evaluation",
    ("docs/export.md", 0): "tests/test_export.py",
    ("docs/export.md", 1): "tests/test_export.py",
    ("docs/export.md", 2): "tests/test_export.py",
    ("docs/export.md", 3): "tests/test_export.py",
}

# Pages that fly or train for several seconds even so.
LONG = (
    "docs/agents",
    "docs/any_quadcopter",
    "docs/apg",
    "docs/domain_randomization",
    "docs/environments",
    "docs/evaluate",
    "docs/ppo_bc",
    "docs/research/",
    "docs/value_based",
)


def blocks(page, language):
    """The code of a page's blocks, in order, each on the lines that it has in the page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.finditer(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return ["\n" * text.count("\n", 0, match.start(1)) + match.group(1) for match in found]


def run(page):
    """Run a page's blocks in order, in the current folder. Returns their namespace."""
    scope: dict[str, object] = {"__name__": page}
    for number, code in enumerate(blocks(page, "python")):
        if (page, number) not in ELSEWHERE:
            exec(compile(code, str(ROOT / page), "exec"), scope)
    return scope


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The tutorial's reader has made it before.
    shutil.copy(ROOT / "examples/my_quadcopter.yaml", tmp_path / "mine.yaml")


@pytest.fixture
def short_trainings(monkeypatch):
    """End each training after a rollout and a few minibatches, and each flight after 1 s."""
    learn = OnPolicyAlgorithm.learn

    def short(self, total_timesteps, *args, **kwargs):
        for name in ("n_epochs", "gradient_steps"):
            if hasattr(self, name):
                setattr(self, name, 1)
        kwargs["progress_bar"] = False
        return learn(self, min(total_timesteps, self.n_steps * self.n_envs), *args[:4], **kwargs)

    monkeypatch.setattr(OnPolicyAlgorithm, "learn", short)
    off_policy = OffPolicyAlgorithm.learn

    def short_off_policy(self, total_timesteps, **kwargs):
        # One update follows the first steps after those of chance.
        return off_policy(self, self.learning_starts + self.n_envs, **kwargs)

    monkeypatch.setattr(OffPolicyAlgorithm, "learn", short_off_policy)
    monkeypatch.setattr(FlightSettings, "longest_episode", 100)
    # It needs an agent that flies.
    monkeypatch.setattr(
        sb3_quad.evaluation.offset_correction, "correct_offset", lambda *arguments: None
    )


WITH_CODE = [
    pytest.param(page, marks=[pytest.mark.slow] if page.startswith(LONG) else [])
    for page in PAGES
    if blocks(page, "python") and page != "README.md"
]


@pytest.mark.parametrize("page", WITH_CODE)
def test_a_page_runs_with_trainings_of_one_rollout(page, short_trainings):
    run(page)


@pytest.mark.slow
def test_the_readme_shows_rows_that_its_code_prints(short_trainings, capsys):
    """Its numbers are those of whole trainings."""
    run("README.md")
    printed = capsys.readouterr().out
    # A row in Markdown, with intervals; a task may stand before the name.
    rows = re.findall(r"^\| (?:\w+: )?(\w[^|]*?) \| [^|]* to ", README, flags=re.MULTILINE)
    assert rows and all(f"│ {row} " in printed for row in rows)


def check_dagger(scope):
    assert scope["agent"] > scope["expert"] - 1.0  # mean rewards of 48 episodes
    assert len(scope["model"].dataset) == scope["model"].num_timesteps


def check_environments(scope):
    assert scope["difference"] < 1e-9


def check_tutorial(scope):
    assert scope["flights"].survival.mean() > 0.9 and np.median(scope["flights"].final_error) < 0.1


CHECKS = {
    "docs/dagger.md": check_dagger,
    "docs/environments.md": check_environments,
    "docs/tutorial.md": check_tutorial,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        "docs/dagger.md",
        "docs/environments.md",
        pytest.param("docs/tutorial.md", marks=pytest.mark.campaign),
    ],
)
def test_a_page_gives_what_it_says(page):
    CHECKS[page](run(page))


def command_lines(text):
    """The arguments of each ``sb3-quad`` line, without remarks."""
    text = re.sub(r"\\\n\s*", " ", text)
    for line in re.findall(r"^[ $]*(?:\w+=\S+ +)*sb3-quad (\w.*)$", text, flags=re.MULTILINE):
        line = re.sub(r" {3,}[^ -].*| &$", "", line)
        if "…" not in line and "--help" not in line:
            yield shlex.split(line, comments=True)


@pytest.mark.parametrize("page", [*PAGES, *COMMANDS])
def test_every_command_line_is_one_that_the_parser_takes(page):
    is_command = page in COMMANDS
    parts = [COMMANDS[page].__doc__] if is_command else blocks(page, "bash")
    lines = [line for text in parts for line in command_lines(text)]
    assert not is_command or any(line[0] == page for line in lines)
    for line in lines:
        make_parser().parse_args(line)


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    """Also those to files outside of the site, which Sphinx does not follow."""
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.S | re.M)
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", text):
        file, _, heading = target.partition("#")
        path = (ROOT / page).parent / file if file else ROOT / page
        assert path.exists(), target
        titles = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), flags=re.M) if heading else []
        slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
        assert not heading or heading in slugs, target
