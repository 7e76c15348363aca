"""The report: the metrics of the results, every plot in the page and as PNG, and a page that needs
nothing else.
"""

import datetime
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from conftest import legends_cover_nothing
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from sb3_quad.base.templates import render
from sb3_quad.cli import main
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.flightlog import read_tracks
from sb3_quad.evaluation.metric_tables import SUCCESS, mark_best, time_row
from sb3_quad.evaluation.results import Failure, load_results
from sb3_quad.evaluation.scenarios.load import parse_suite
from sb3_quad.evaluation.tables import Cell, Column, Row, Table
from sb3_quad.report.results_page import facts, sections, write_report

SUITE = """
name: small
source: paper
description: "A <small> suite & its tags"
scenarios:
  - name: tracking
    task_kwargs: {target_distance: 3}
    duration: 6
    tolerances: [0.5, 0.7, 0.8, 0.9, 1.0, 1.5, 2.0]
    n_episodes: 5
    published: {expert: {success: 0.5, time_to: {0.8: 1.25, 1.0: null}, path: [2, 3]}}
  - name: course
    waypoints: [[0, 0, 15.5], [0, 0.5, 15.5]]
    waypoint_radius: 0.4
    duration: 2
    n_episodes: 2
  - name: upside_down
    task_kwargs: {target_distance: 0, start_position: [0, 0, 1.5]}
    start: {quaternion: [0, 1, 0, 0]}
    duration: 2
    n_episodes: 2
  - name: hit
    target: [1, 1, 16]
    wrenches: [{start: 0.5, duration: 0.02, force: [-20, -20, 0], torque: [-5, -5, -5]}]
    duration: 2
    n_episodes: 2
  - name: noise
    task_kwargs: {target_distance: 0}
    vary: {noise: [0, 0.1]}
    duration: 0.5
    n_episodes: 2
  - name: drop
    task_kwargs: {target_distance: 0, start_position: [0, 0, 1.3]}
    start: {velocity: [0, 0, -1.5]}
    vary: {randomize.delay: [0, 90]}
    duration: 3
    n_episodes: 2
  - name: starts
    task: state_recovery
    start: {velocity: {magnitude: 0}, body_rates: {magnitude: 0}}
    vary:
      start.tilt: [0, 90]
      start.body_rates.magnitude: [0, 4]
      start.velocity.magnitude: [0, 3]
    duration: 0.5
    n_episodes: 2
"""
LABEL = '<b>g</b> "2" </script>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results with a scenario of every kind."""
    path = tmp_path_factory.mktemp("results")
    controllers = [ControllerSpec("pid", "pid"), ControllerSpec(LABEL, "geometric")]
    evaluate(parse_suite(SUITE, "small"), controllers, str(path))
    return path


@pytest.fixture(scope="module")
def page(folder):
    return write_report(folder)


@pytest.fixture(scope="module")
def parts(folder):
    """The sections of the report by their anchors."""
    return {section.anchor: section for section in sections(load_results(folder), folder)}


def plot_of(parts, anchor, kind):
    """A plot by its section and the end of its name."""
    (plot,) = (plot for plot in parts[anchor].plots if plot.name == f"{anchor}_{kind}")
    return plot


class Page(HTMLParser):
    """Tags, attributes that lead somewhere, and text outside of scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.text, self._inside = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self._inside = tag if tag in ("script", "style") else ""
        self.links += [
            value
            for name, value in attributes
            if name in ("src", "href", "srcset", "action", "data")
        ]

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if not self._inside:
            self.text.append(data)


def test_the_page_holds_the_results(folder, page):
    text = " ".join("".join(Page(page.read_text(encoding="utf-8")).text).split())
    results = load_results(folder)
    for scenario in results.scenarios:
        assert scenario.heading.split(":")[0].lower() in text.lower()
    assert LABEL in text and results.description in text
    metrics = results.entry("pid", "tracking").metrics
    assert f"{metrics.reward.value:.2f}".replace("-", "−") in text
    assert (
        f"{metrics.arrivals[0].time.value:.2f}" in text
        and f"{metrics.final_error_95.value:.3f}" in text
    )
    low, high = metrics.success.low, metrics.success.high
    assert f"{100 * low:.1f} to {100 * high:.1f}" in text
    for number in ("1.25", "never", "2 to 3", "paper"):  # the published ones
        assert number in text


def test_the_overview_shows_published_shares_and_what_varies_has_a_table_of_success(parts):
    table = parts["overview"].tables[0]
    assert table.columns[-1].heading == "paper: expert" and table.rows[0].cells[-1].text == "50"
    (table,) = parts["noise"].tables
    assert table.corner == "noise (relative std): success (%)"
    assert [row.name for row in table.rows] == ["0", "0.1"]


def test_small_print_of_cells_holds_what_they_share(parts):
    cells = "2 flights of each controller in each of 2 cells"
    assert parts["noise"].facts == f"{cells}, 0.5 s; seed 0."
    assert parts["drop"].facts == f"{cells}, 3 s; observation noise 5 %; seed 0."


def test_nothing_in_the_page_leads_outside(page):
    parsed = Page(page.read_text(encoding="utf-8"))
    assert {"table", "figure", "svg"} <= set(parsed.tags)
    assert not {"b", "small", "iframe", "img", "script"} & set(parsed.tags)
    for link in parsed.links:
        assert link.startswith(("#", "data:")) or (page.parent / link).is_file(), link


def test_every_plot_is_in_the_page_and_beside_it(folder, parts, page):
    plots = [plot.name for section in parts.values() for plot in section.plots]
    assert {name.rpartition("_")[2] for name in plots} == {"times", "paths", "error", "success"}
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == len({*plots}) == len(plots) and all(
        f'data-plot="{name}"' in text for name in plots
    )
    assert {path.name for path in (folder / "figures").iterdir()} == {
        f"{name}.png" for name in plots
    }
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (folder / "figures").iterdir())


def test_legends_cover_nothing_and_axes_have_units(parts):
    for plot in (plot for section in parts.values() for plot in section.plots):
        legends_cover_nothing(plot.figure)
        titles = [
            name
            for axes in plot.figure.axes
            for name in (axes.get_xlabel(), axes.get_ylabel())
            if name
        ]
        assert len(titles) >= 2 and all("(" in title for title in titles), titles


def test_the_page_is_small_and_says_what_was_flown_when_and_by_which_version(folder, page):
    assert page.stat().st_size < 1_000_000
    results = load_results(folder)
    agent = results.controllers[0].model_copy(
        update={"algorithm": "PPO", "content": "0123456789abcdef"}
    )
    failure = Failure(controller="x<y", scenario="hit", message="no & no")
    flown = results.model_copy(
        update={"controllers": [agent, *results.controllers[1:]], "failures": [failure]}
    )
    content = {"title": "title", "facts": facts(flown), "sections": sections(flown, folder)}
    text = render("sb3_quad.report.templates", "page.html.j2", **content, pictures="figures")
    (day,) = {datetime.date.fromisoformat(entry.date) for entry in results.entries}
    assert (
        f"flown {day} by sb3_quad {results.package_version}" in text and agent.content[:12] in text
    )
    assert "x&lt;y" in text and "no &amp; no" in text


def test_the_tables_as_markdown_hold_no_html(folder, page):
    lines = (folder / "report.md").read_text().splitlines()
    assert any('&lt;b&gt;g&lt;/b&gt; "2" &lt;/script&gt;' in line for line in lines)
    assert "<" not in "".join(lines)


def test_what_varies_alone_is_success_and_final_error_over_it(folder, parts):
    results = load_results(folder)
    for label in ("pid", LABEL):
        plots = [plot_of(parts, "drop", kind).figure.axes[0] for kind in ("success", "error")]
        success, error = ({line.get_label(): line for line in axes.lines}[label] for axes in plots)
        metrics = [results.entry(label, f"drop.{delay}").metrics for delay in (0, 90)]
        np.testing.assert_allclose(
            success.get_ydata(), [100 * each.success.value for each in metrics]
        )
        assert (
            metrics[1].survival.value == 0.0 and len(error.get_ydata()) == 1
        )  # where most are lost, there is no error
        assert error.get_ydata()[0] == max(metrics[0].final_error_median, 1e-3)
        assert plots[1].get_xlabel() == "delay (control steps)"


def test_of_several_quantities_each_has_the_mean_over_the_others(folder, parts):
    results = load_results(folder)
    cells = [entry.metrics for entry in results.entries if entry.scenario.startswith("starts.")]
    assert any(cell.success.value != cell.survival.value for cell in cells)  # success is drawn
    axes = plot_of(parts, "starts", "0_success").figure.axes[0]
    assert [plot.name for plot in parts["starts"].plots] == [
        f"starts_{number}_success" for number in range(3)
    ]
    for line in axes.lines:
        for tilt, mean in zip(*line.get_data(), strict=True):
            cells = [
                each.name
                for each in results.scenarios
                if each.group == "starts" and each.cell["start.tilt"] == tilt
            ]
            metrics = [results.entry(line.get_label(), name).metrics for name in cells]
            shares = [each.success.value for each in metrics]
            assert len(cells) == 4 and mean == pytest.approx(100 * np.mean(shares))


def test_paths_and_distances_are_the_flights(folder, parts):
    results = load_results(folder)
    above, side = plot_of(parts, "hit", "paths").figure.axes
    for label in ("pid", LABEL):
        track = read_tracks(folder / results.entry(label, "hit").flights)[0]
        for axes, columns in ((above, [0, 1]), (side, [0, 2])):
            line = next(line for line in axes.lines if line.get_label() == label)
            np.testing.assert_array_equal(line.get_xydata()[0], track.position[0, columns])
            (force,) = {
                tuple(np.round([u, v], 6))
                for each in axes.collections
                for u, v in zip(each.U, each.V, strict=True)
            }
            assert force == pytest.approx(np.array([-1.0, -1.0, 0.0])[columns] / 2**0.5, abs=1e-6)
    assert results.entry("pid", "upside_down").metrics.collisions == 2
    (line,) = (
        line
        for line in plot_of(parts, "upside_down", "error").figure.axes[0].lines
        if line.get_label() == "pid"
    )
    assert line.get_xdata()[-1] < 2.0  # a lost flight counts as far away, and ends in a cross
    assert "X" in [
        line.get_marker() for line in plot_of(parts, "upside_down", "paths").figure.axes[0].lines
    ]


def test_a_table_reads_the_same_everywhere():
    cells = [
        Cell(-1.234, (-1.5, -1.0), best=True),
        Cell(2.0, (2.0, 2.0)),
        Cell(words="never"),
        Cell(3.0, note="a | b"),
    ]
    columns = [Column("a"), Column("b"), Column("c", source="paper"), Column("d", source="paper")]
    rows = [
        Row("time", "s", cells),
        Row("share", "%", [Cell(99.96875, (99.8, 100.0)), *[Cell()] * 3]),
    ]
    table = Table(columns, rows, corner="what", title="[title]", caption="caption")
    assert table.markdown().splitlines() == [
        "| what | a | b | paper: c | paper: d |",
        "| --- | --- | --- | --- | --- |",
        "| time, s | **−1.23 (−1.50 to −1.00)** | 2.00 | never | 3.00, a / b |",
        "| share, % | 99.97 (99.80 to 100.00) |  |  |  |",
    ]
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    text = console.file.getvalue()
    for part in (
        "[title]",
        "caption",
        "time, s",
        "−1.23 (−1.50 to −1.00)",
        "2.00",
        "never",
        "3.00, a | b",
        "99.97 (99.80 to 100.00)",
    ):
        assert part in text
    assert "paper: c" in text and "**" not in text


@given(value=st.floats(-1e4, 1e4), decimals=st.integers(0, 4))
def test_numbers_are_rounded_and_zero_has_no_sign(value, decimals):
    text = Cell(value, decimals=decimals).number.replace("−", "-")
    assert (float(text) == float(f"{value:.{decimals}f}") and not text.startswith("-0")) or float(
        text
    ) != 0
    assert len(text.partition(".")[2]) == decimals


values = st.floats(-10, 10, allow_nan=False)


@given(
    cells=st.lists(st.tuples(values, values, values), min_size=2, max_size=5),
    row=st.sampled_from([SUCCESS, time_row(1)]),
    some=st.booleans(),
)
def test_the_best_is_better_than_all_others_for_certain(cells, row, some):
    made = [Cell(middle, (low, high)) for low, middle, high in map(sorted, cells)]
    if some:
        # A mean time of the few flights that arrive is comparable with no other.
        made[-1] = made[-1]._replace(note="3 % arrive")
    marked = mark_best(row, made)
    for cell in marked:
        others = [other for other in marked if other is not cell]
        (low, high), ends = cell.ends, [other.ends for other in others]
        apart = all(low > other[1] if row == SUCCESS else high < other[0] for other in ends)
        assert cell.best == (apart and (row == SUCCESS or not some))


def test_a_report_is_not_replaced_silently(folder, page, capsys):
    before = page.stat().st_mtime_ns
    assert main(["report", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err and page.stat().st_mtime_ns == before
    assert main(["report", str(folder), "--overwrite"]) == 0
    assert str(page) in capsys.readouterr().out and page.stat().st_mtime_ns != before
