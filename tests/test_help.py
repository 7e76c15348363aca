"""Every command's help shows examples, and these are command lines that the command takes."""

import re
import shlex
from pathlib import Path

import pytest

from sb3_quad.cli.app import COMMANDS, EPILOG, make_parser
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.training.algorithms import ALGORITHMS
from sb3_quad.training.config import SETTINGS

README = (Path(__file__).parent.parent / "README.md").read_text()


def examples(text: str) -> list[list[str]]:
    """The arguments of each example, less the remark behind it."""
    lines = text.split("examples:\n")[1].split("\n\n")[0].splitlines()
    commands = [re.split(r" {2,}", line.strip())[0] for line in lines]
    assert all(command.startswith("sb3-quad ") for command in commands)
    return [shlex.split(command)[1:] for command in commands]


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_examples_are_taken(name):
    found = examples(COMMANDS[name].__doc__ if name else EPILOG)
    assert found
    assert any(arguments[0] == name for arguments in found) or not name
    for arguments in found:
        if "--help" in arguments:
            continue
        options = make_parser().parse_args(arguments)  # raises on a flag that there is not, or a bad value
        assert options.command in COMMANDS
        if getattr(options, "algo", None) is not None:
            assert {*([options.algo] if isinstance(options.algo, str) else options.algo)} <= {*ALGORITHMS}
        if getattr(options, "env", None) is not None:
            assert options.env in (*ENVIRONMENTS, "Pendulum-v1")
        files = getattr(options, "conf_file", None) or []
        for file in [files] if isinstance(files, str) else files:
            assert file in (*SETTINGS.names(), "my.yml") or file.endswith("/best.yml")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_the_readme_lists_every_command(name):
    assert f"`sb3-quad {name}" in README
