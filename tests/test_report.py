"""The report: the metrics of the results as Markdown, and plots of what was flown."""

import numpy as np
import pytest
from conftest import legends_cover_nothing
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.flightlog import read_tracks
from sb3_quad.evaluation.metric_tables import Row
from sb3_quad.evaluation.plots import paths_plot
from sb3_quad.evaluation.report import write_report
from sb3_quad.evaluation.results import load_results
from sb3_quad.evaluation.scenarios.load import parse_suite
from sb3_quad.evaluation.tables import Table

SUITE = """
name: small
source: paper
description: "A <small> suite & its tags"
scenarios:
  - name: tracking
    task_kwargs: {target_distance: 3}
    duration: 4
    tolerances: [0.5, 0.7, 1.0]
    n_episodes: 3
    published: {expert: {success: 0.5, time_to: {1.0: null}}}
  - name: upside_down
    task_kwargs: {target_distance: 0, start_position: [0, 0, 1.5]}
    start: {quaternion: [0, 1, 0, 0]}
    duration: 2
    n_episodes: 2
  - name: drop
    task_kwargs: {target_distance: 0, start_position: [0, 0, 1.3]}
    start: {velocity: [0, 0, -1.5]}
    vary: {randomize.delay: [0, 90]}
    duration: 3
    n_episodes: 2
"""
LABEL = '<b>g</b> "2"'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results with a scenario of every kind, and their report."""
    path = tmp_path_factory.mktemp("results")
    controllers = [ControllerSpec("pid", "pid"), ControllerSpec(LABEL, "geometric")]
    evaluate(parse_suite(SUITE, "small"), controllers, str(path))
    write_report(path)
    return path


def test_the_report_holds_the_results_and_no_html(folder):
    text = (folder / "report.md").read_text(encoding="utf-8")
    results = load_results(folder)
    metrics = results.entry("pid", "tracking").metrics
    assert f"{metrics.reward.value:.2f}".replace("-", "−") in text
    assert f"{metrics.arrivals[0].time.value:.2f}" in text
    assert "Vehicles: itm." in text
    # The published ones, and the cells that vary makes
    for words in ("paper: expert", "never", "A &lt;small&gt; suite &amp; its tags", "90, success"):
        assert words in text
    assert "&lt;b&gt;g&lt;/b&gt;" in text and "<" not in text


def test_every_plot_is_shown_in_the_report(folder):
    text = (folder / "report.md").read_text(encoding="utf-8")
    files = {path.name for path in (folder / "figures").iterdir()}
    names = ("tracking_paths", "upside_down_paths")
    assert files == {f"{name}.png" for name in names}
    for file in files:
        assert f"](figures/{file})" in text
        assert (folder / "figures" / file).read_bytes().startswith(b"\x89PNG")


def test_plots_are_of_the_flights(folder):
    results = load_results(folder)
    entry = results.entry("pid", "upside_down")
    tracks = read_tracks(folder / entry.flights)
    figure = paths_plot({"pid": tracks}, results.colours)
    above, side = figure.axes
    for axes, columns in ((above, [0, 1]), (side, [0, 2])):
        lines = [line for line in axes.lines if line.get_label() == "pid"]
        np.testing.assert_array_equal(lines[0].get_xydata()[0], tracks[0].position[0, columns])
        # It is lost, which a cross marks.
        assert "X" in [line.get_marker() for line in axes.lines]
    legends_cover_nothing(figure)


def test_a_table_reads_the_same_everywhere():
    rows = [("time, s", "−1.23 (−1.50 to −1.00)", "never"), ("share, %", "99.97", "a | b")]
    table = Table(("what", "a", "paper: c"), rows, title="[title]", caption="caption")
    assert table.markdown().splitlines() == [
        "| what | a | paper: c |",
        "| --- | --- | --- |",
        "| time, s | −1.23 (−1.50 to −1.00) | never |",
        "| share, % | 99.97 | a / b |",
    ]
    text = str(table)
    for part in ("[title]", "caption", "paper: c", *rows[0], *rows[1]):
        assert part in text


@given(value=st.floats(-1e4, 1e4), decimals=st.integers(0, 4))
def test_numbers_are_rounded_and_zero_has_no_sign(value, decimals):
    text = Row("name", decimals=decimals).number(value).replace("−", "-")
    assert float(text) == float(f"{value:.{decimals}f}")
    assert len(text.partition(".")[2]) == decimals
    assert not text.startswith("-") or float(text) != 0
