"""Learning curves: what a run's evaluations hold is what is drawn, and bad input is one line."""

import numpy as np
import pytest
from conftest import legends_cover_nothing

from sb3_quad.cli import main
from sb3_quad.evaluation.learning_curves import read_curve
from sb3_quad.evaluation.plots import plot_curves


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
    np.testing.assert_array_equal(curve.measures["reward"], [-6.0, -2.0])
    np.testing.assert_array_equal(curve.seconds, [120.0, 240.0])


def test_seeds_are_drawn_as_mean_and_range(runs):
    curves = [read_curve(runs / "Env_1"), read_curve(runs / "Env_2")]
    figure = plot_curves({"agent": curves, "one": curves[:1]})
    success, reward = figure.axes
    mean, single = reward.lines
    np.testing.assert_allclose(mean.get_xydata(), [[1e-4, -4.5], [2e-4, -1.5]])
    np.testing.assert_allclose(single.get_ydata(), [-3.0, -1.0])
    np.testing.assert_allclose(success.lines[0].get_ydata(), [0.5, 1.0])
    band = reward.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (-6.0, -1.0)
    legends_cover_nothing(figure)


def test_losses_are_drawn_where_a_run_has_them(runs):
    path = runs / "Env_1" / "evaluations.npz"
    more = {"train/bc_loss": np.array([np.nan, 0.25])}
    np.savez(path, **{**np.load(path), **more})
    curves = [read_curve(runs / f"Env_{number}") for number in (1, 2)]
    figure = plot_curves({"agent": curves[:1], "without": curves[1:]}, ["bc_loss"])
    assert [line.get_ydata().tolist() for line in figure.axes[0].lines] == [[0.25], []]


def test_the_command_writes_a_picture(runs, capsys):
    picture = runs / "curves.svg"
    asked = ["plot", f"agent={runs}/Env_*", f"{runs}/Env_1", "-o", str(picture)]
    assert main(asked) == 0
    assert "<svg" in picture.read_text(encoding="utf-8")
    assert "curves.svg" in capsys.readouterr().out
    assert main(asked) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["agent=nowhere/*"], "agent=nowhere/*"),
        (["agent={runs}/Env_1", "agent={runs}/Env_2"], "'agent'"),
        (["agent={runs}/Env_1", "-o", "curves.gif"], "--output"),
        (["agent={runs}"], "evaluations.npz"),
        (["agent={runs}/Env_1", "--show", "losses"], "losses"),
        (["agent={runs}/Env_1", "--task", "target_tracking"], "target_tracking"),
    ],
)
def test_bad_input_is_one_line(runs, arguments, key, capsys):
    assert main(["plot", *(argument.format(runs=runs) for argument in arguments)]) == 2
    error = capsys.readouterr().err
    assert key in error and error.count("\n") == 1
