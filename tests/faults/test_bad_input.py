"""Bad input, as data: ``corpus.yaml`` holds what is given and what the one line must say."""

import errno
import shlex
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO

from sb3_quad.cli.app import main
from sb3_quad.cli.commands import plot
from sb3_quad.envs import QuadcopterVecEnv

CORPUS = yaml.safe_load(Path(__file__).with_name("corpus.yaml").read_text(encoding="utf-8"))


def write(path, content):
    """A text, or one of ``{begin, repeat, times, end}``; an .npz of ``{arrays}``; a zip of empty
    files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif "arrays" in content:
        np.savez(path, **content["arrays"])
    elif "zip" in content:
        with zipfile.ZipFile(path, "w") as archive:
            for name in content["zip"]:
                archive.writestr(name, "")
    else:
        text = content["repeat"] * content["times"]
        path.write_text(content.get("begin", "") + text + content.get("end", ""), encoding="utf-8")


def files(folder):
    return {path for path in folder.rglob("*") if "__pycache__" not in path.parts}


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
    case = (
        CORPUS[name]
        if isinstance(CORPUS[name], dict)
        else dict(zip(("command", "says"), CORPUS[name], strict=True))
    )
    for file, content in case.get("files", {}).items():
        write(here / file, content)
    before = files(here)
    code = main([part.format(digits="1" * 5000) for part in shlex.split(case["command"])])
    lines = capsys.readouterr().err.splitlines()
    assert code == case.get("code", 2), lines
    assert (
        lines and lines[-1].startswith(case.get("begins", "error: ")) and case["says"] in lines[-1]
    )
    assert not any(
        "Traceback" in line or "--traceback" in line for line in lines
    )  # a check foresaw it
    assert files(here) - before == set()


@pytest.mark.parametrize(
    ("raised", "says"),
    [
        (SystemExit(0), "SystemExit: 0 ("),
        (
            OSError(errno.ENOSPC, "No space left on device", "run/0.monitor.csv"),
            "run/0.monitor.csv: No space left on device",
        ),
        (
            ZeroDivisionError("in a callback"),
            "ZeroDivisionError: in a callback (test_bad_input.py, line",
        ),
    ],
)
def test_what_no_check_foresees_is_a_line_too(raised, says, monkeypatch, capsys):
    def run(options):
        raise raised

    monkeypatch.setattr(plot, "run", run)
    assert main(["plot", "agent=run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and says in line
    if not isinstance(raised, OSError):
        assert line.endswith("; add --traceback for all of it)")
    assert main(["plot", "agent=run", "--traceback"]) == 2
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("Traceback (most recent call last)") and says in last


def test_an_interrupt_while_modules_are_imported_leaves_at_once():
    code = "\n".join(
        [
            "import os, signal",
            "from sb3_quad.base.process import interrupts_leave",
            "with interrupts_leave():",
            "    try:",
            "        os.kill(os.getpid(), signal.SIGINT)",
            "    except BaseException:",  # as some compiled modules do
            "        pass",
            "print('goes on')",
        ]
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_an_agent_whose_parameters_are_not_finite_is_refused(here, capsys):
    agent = PPO("MlpPolicy", QuadcopterVecEnv(1), device="cpu")
    agent.policy.action_net.bias.data[0] = float(
        "inf"
    )  # SB3 clips the action, so that it looks sound
    agent.save("agent.zip")
    assert main(["enjoy", "agent.zip", "--no-render"]) == 2
    assert "agent.zip: action_net.bias contains NaN or infinity" in capsys.readouterr().err
