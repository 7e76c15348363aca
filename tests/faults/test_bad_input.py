"""Bad input, as data: ``corpus.yaml`` holds what is given and what the one line must say."""

import shlex
import time
from pathlib import Path

import pytest
import yaml

from sb3_quad.cli.app import main
from sb3_quad.envs import QuadcopterVecEnv

CORPUS = yaml.safe_load(Path(__file__).with_name("corpus.yaml").read_text(encoding="utf-8"))
SECONDS = 20.0  # at most for any input, imports included


def write(path, content):
    """A text; or one of ``{begin, repeat, times, end}``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    else:
        text = content["repeat"] * content["times"]
        path.write_text(content.get("begin", "") + text + content.get("end", ""), encoding="utf-8")


@pytest.fixture(scope="module", autouse=True)
def compiled():
    QuadcopterVecEnv(1)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CORPUS)
def test_bad_input_is_one_line_and_leaves_nothing_behind(name, here, capsys):
    case = CORPUS[name]
    for file, content in case.get("files", {}).items():
        write(here / file, content)
    before = sorted(here.rglob("[!_]*"))
    start = time.perf_counter()
    code = main([part.format(digits="1" * 5000) for part in shlex.split(case["command"])])
    seconds = time.perf_counter() - start
    lines = capsys.readouterr().err.splitlines()
    assert code == case.get("code", 2), lines
    assert lines and lines[-1].startswith(case.get("begins", "error: ")) and case["says"] in lines[-1]
    assert not any("Traceback" in line or "python -X dev" in line for line in lines)  # somebody foresaw it
    assert [path for path in sorted(here.rglob("[!_]*")) if path not in before] == []
    assert seconds < SECONDS
