"""Learning curves: what a run's evaluations hold is what is drawn, and bad input is one line."""

import numpy as np
import pytest
from conftest import legends_cover_nothing

from sb3_quad.cli import main
from sb3_quad.evaluation.learning_curves import Curve, read_curve
from sb3_quad.report import curves
from sb3_quad.report.curves import plot_curves

EXPERT = {"expert": {"success": 0.3, "reward": -5.0}}


@pytest.fixture
def runs(tmp_path):
    for number in (1, 2):
        folder = tmp_path / f"Env_{number}"
        folder.mkdir()
        np.savez(
            folder / "evaluations.npz",
            timesteps=np.array([100, 200]),
            seconds=np.array([60.0, 120.0]) * number,
            successes=np.array([[0.0, 1.0], [1.0, 1.0]]),
            results=np.array([[-4.0, -2.0], [-1.0, -1.0]]) * number,
        )
    return tmp_path


def test_a_curve_holds_the_means_of_the_evaluations(runs):
    curve = read_curve(runs / "Env_2")
    np.testing.assert_array_equal(curve.values("success"), [0.5, 1.0])
    np.testing.assert_array_equal(curve.reward, [-6.0, -2.0])
    np.testing.assert_array_equal(curve.seconds, [120.0, 240.0])


def test_seeds_are_drawn_as_mean_and_range(runs):
    figure = plot_curves(
        {"agent": [read_curve(runs / "Env_1"), read_curve(runs / "Env_2")]}, EXPERT
    )
    reward = figure.axes[2].lines[0]
    assert reward.get_ydata()[0] == pytest.approx(-4.5) and reward.get_ydata()[-1] == pytest.approx(
        -1.5
    )
    np.testing.assert_array_equal(figure.axes[0].lines[1].get_ydata(), [30.0, 30.0])


def test_every_evaluation_is_marked_and_the_legend_covers_nothing(runs):
    long = read_curve(runs / "Env_1")
    once = {"success": np.array([0.5]), "reward": np.array([-2.0])}
    short = Curve(np.array([150.0]), np.array([30.0]), once)
    figure = plot_curves(
        {"agent": [long], "a run with a single evaluation": [short]}, EXPERT, "title"
    )
    for axes, times in zip(figure.axes, ([1e-4, 2e-4], [1.0, 2.0]) * 2, strict=True):
        several, single, _ = axes.lines
        np.testing.assert_allclose(several.get_xdata(), times)
        assert several.get_marker() == single.get_marker() == "o" and len(single.get_xdata()) == 1
    legends_cover_nothing(figure)


def test_the_command_writes_a_picture(runs, capsys):
    picture = runs / "curves.svg"
    assert main(["plot", f"agent={runs}/Env_*", "--line", "expert:30:-5", "-o", str(picture)]) == 0
    assert (
        picture.read_text(encoding="utf-8").count("<svg") == 1
        and "curves.svg" in capsys.readouterr().out
    )


def test_a_run_folder_alone_is_called_by_its_path(runs, monkeypatch):
    named = {}
    monkeypatch.setattr(
        curves,
        "plot_curves",
        lambda groups, *rest: named.update(groups) or plot_curves(groups, *rest),
    )
    assert main(["plot", f"{runs}/Env_1", f"{runs}/Env_2/", "-o", str(runs / "curves.svg")]) == 0
    assert {name: len(found) for name, found in named.items()} == {
        f"{runs.name}/Env_1": 1,
        f"{runs.name}/Env_2": 1,
    }


def test_losses_and_survival_are_drawn_where_a_run_has_them(runs):
    path = runs / "Env_1" / "evaluations.npz"
    more = {"survivals": np.ones((2, 2)), "train/bc_loss": np.array([np.nan, 0.25])}
    np.savez(path, **{**np.load(path), **more})
    groups = {"agent": [read_curve(runs / "Env_1")]}
    figure = plot_curves(groups, {"thesis": {"survival": 0.88}}, show=["survival", "losses"])
    survival, _, loss, _ = figure.axes
    np.testing.assert_array_equal(survival.lines[0].get_ydata(), [100.0, 100.0])
    np.testing.assert_array_equal(survival.lines[1].get_ydata(), [88.0, 88.0])
    assert loss.get_ylabel() == "cloning loss" and loss.lines[0].get_ydata().tolist() == [0.25]


def test_the_thesis_is_drawn_by_the_name_of_the_task(runs):
    path = runs / "Env_1" / "evaluations.npz"
    np.savez(path, **{**np.load(path), "survivals": np.ones((2, 2))})
    picture = runs / "curves.svg"
    assert (
        main(["plot", f"agent={runs}/Env_1", "--thesis", "state_recovery", "-o", str(picture)]) == 0
    )
    text = picture.read_text(encoding="utf-8")
    assert all(f"thesis: {name}" in text for name in ("expert", "RL-agent", "PPO only"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["agent=nowhere/*"], "'agent=nowhere/*': no such folder"),
        (["agent"], "or NAME=PATTERN"),
        (["agent={runs}/Env_1", "agent={runs}/Env_2"], "'agent': two groups have this name"),
        (["agent={runs}/Env_1", "-o", "curves.gif"], "ending of --output 'gif' (valid: pdf,"),
        (["agent={runs}/Env_1", "-o", "{runs}/mine.svg"], "exists already"),
        (["agent={runs}/Env_1", "--line", "expert"], "NAME:SUCCESS:REWARD"),
        (["agent={runs}"], "no such file"),
        (
            ["agent={runs}/Env_1", "--thesis", "state_recovery"],
            "survival: the runs' evaluations hold none",
        ),
        (["agent={runs}/Env_1", "--show", "losses"], "losses: the runs' evaluations hold none"),
        (
            ["agent={runs}/Env_1", "--task", "target_tracking"],
            "one for each of its eval_tasks",
        ),
    ],
)
def test_bad_input_is_one_line(runs, arguments, message, capsys):
    (runs / "mine.svg").touch()
    assert main(["plot", *(argument.format(runs=runs) for argument in arguments)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
