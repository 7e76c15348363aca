"""Every command's help shows examples that the command takes, and unknown options raise advice."""

import re
import shlex
from pathlib import Path

import pytest

from sb3_quad.base.errors import did_you_mean
from sb3_quad.cli import main
from sb3_quad.cli.app import COMMANDS, EPILOG, make_parser
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.training.algorithms import ALGORITHMS
from sb3_quad.training.config import SETTINGS

README = (Path(__file__).parent.parent / "README.md").read_text()


def examples(text: str) -> list[list[str]]:
    """The arguments of each example, without the remarks above them."""
    block = text.split("examples:\n")[1].split("\n\n")[0]
    lines = [line.strip() for line in block.replace("\\\n", " ").splitlines()]
    commands = [re.split(r" {2,}[^- ]", line)[0] for line in lines if not line.startswith("# ")]
    assert all(command.startswith("sb3-quad ") for command in commands)
    return [shlex.split(command)[1:] for command in commands]


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_examples_are_taken(name):
    commands = examples(COMMANDS[name].__doc__ if name else EPILOG)
    assert commands
    assert any(arguments[0] == name for arguments in commands) or not name
    for arguments in commands:
        if "--help" in arguments:
            continue
        # Raises on an unknown flag or a bad value.
        options = make_parser().parse_args(arguments)
        assert options.command in COMMANDS
        if getattr(options, "algo", None) is not None:
            assert {*([options.algo] if isinstance(options.algo, str) else options.algo)} <= {
                *ALGORITHMS
            }
        if getattr(options, "env", None) is not None:
            assert options.env in (*ENVIRONMENTS, "Pendulum-v1")
        files = getattr(options, "conf_file", None) or []
        for file in [files] if isinstance(files, str) else files:
            assert file in (*SETTINGS.names(), "my.yml") or file.endswith("/best.yml")


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_fits_a_terminal_of_80_columns(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([name, "--help"] if name else ["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    # argparse does not break a group of flags that exclude each other.
    assert [line for line in lines if len(line) > 80 and " | " not in line] == []
    assert not name or "--traceback" in "\n".join(lines)


@pytest.mark.parametrize("name", list(COMMANDS))
def test_the_readme_lists_every_command(name):
    assert f"`sb3-quad {name}" in README


TASKS = ("far_tracking", "state_recovery", "target_tracking")


@pytest.mark.parametrize(
    ("given", "valid", "meant"),
    [
        ("state_recovry", TASKS, ["state_recovery"]),
        ("tracking", TASKS, ["far_tracking", "target_tracking"]),
        ("hover", TASKS, []),
        ("imt", ("crazyflie", "itm"), ["itm"]),
        ("Learning_Rtae", ("learning_rate",), ["learning_rate"]),
        ("reference.yml", ("thesis/reference.yml", "dagger.yml"), ["thesis/reference.yml"]),
        ("nothere.yml", ("thesis/reference.yml", "dagger.yml"), []),
        ("a2c", ("dagger", "ppo", "sac"), []),
        ("bc_coef", ("ent_coef", "vf_coef"), []),
        ("--learning-rate", ("--eval-freq", "--seed"), []),
        ("-x", ("-f", "-n"), []),
        ("n", ("n_envs", "n_epochs", "n_steps", "n_timesteps"), []),  # too many to help
        ("", TASKS, []),
        ("anything", (), []),
    ],
)
def test_a_misspelt_name_or_a_part_of_names_is_guessed_and_nothing_else(given, valid, meant):
    assert did_you_mean(given, valid) == (
        f"did you mean {' or '.join(map(repr, meant))}? " if meant else ""
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train --n-timestep 5", "argument '--n-timestep': did you mean '--n-timesteps'?"),
        (
            "train --learning-rate 1e-3",
            "hyperparameters are given as --hyperparams KEY:VALUE, keywords of the environment as",
        ),
        ("tune --gamma=0.9 -n 5", "argument '--gamma': hyperparameters are given as"),
        ("train -optimize", "argument '-optimize': the command sb3-quad tune does that"),
        ("train --optimize-hyperparameters", "the command sb3-quad tune does that"),
        ("train --sampler tpe", "argument '--sampler': it belongs to sb3-quad tune"),
        ("demo --nothing", "argument '--nothing': see --help, and docs/zoo.md"),
        ("train 5", "argument '5': see --help"),
        ("train --algo a2c", "algorithm 'a2c' (valid: apg, dagger,"),
        (
            "train --conf-file nothere.yml",
            "settings file 'nothere.yml' (valid: any_quadcopter/apg.yml,",
        ),
        (
            "train --hyperparams bc_coef:1 --algo dagger",
            "key of dagger 'bc_coef' (valid: batch_size,",
        ),
        (
            "enjoy pid --task tracking --no-render",
            "did you mean 'far_tracking' or 'recovery_and_tracking' or 'target_tracking'?",
        ),
        (
            "enjoy --algo ppo -f nowhere --no-render",
            "nowhere/ppo: there is no run of QuadTargetTracking-v0; give another place with --env",
        ),
    ],
)
def test_an_unknown_option_raises_advice(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(arguments)) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1
