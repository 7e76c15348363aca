"""The report: the numbers of the results, every figure as page, PNG and SVG, and a page that a browser shows without help."""

from __future__ import annotations

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.cli import main
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.folder import load_results
from sb3_quad.evaluation.records import Failure
from sb3_quad.report import interactive
from sb3_quad.report.figures import BarFigure, HeatFigure, Line, LineFigure, PathFigure
from sb3_quad.report.page import render, write_report
from sb3_quad.report.sections import sections
from sb3_quad.report.tables import Cell, mark_best
from sb3_quad.report.tracks import read_tracks
from sb3_quad.scenarios.load import parse_suite

SUITE = """
name: small
source: paper
description: "A <small> suite & its tags"
scenarios:
  - name: tracking
    target: {distance: 3}
    duration: 6
    tolerances: [0.5, 1.0, 2.0]
    episodes: 5
    reference: {expert: {success: 0.5, time_to: {0.5: 1.25, 1.0: null}, path: [2, 3]}}
  - name: course
    target: {waypoints: [[0, 0, 15.5], [0, 0.5, 15.5]], radius: 0.4}
    duration: 2
    episodes: 2
  - name: upside_down
    start: {attitude: {quaternion: [0, 1, 0, 0]}, position: [0, 0, 1.5]}
    duration: 2
    episodes: 2
  - name: hit
    target: [1, 1, 16]
    wrenches: [{start: 0.5, duration: 0.02, force: [-20, -20, 0], torque: [-5, -5, -5]}]
    hit_search: {largest: 2, resolution: 0.5, episodes: 2}
    duration: 2
    episodes: 2
  - name: noise
    vary: {noise: [0, 0.1]}
    duration: 0.5
    episodes: 2
  - name: starts
    start: {velocity: {magnitude: 0}, body_rates: {magnitude: 0}}
    vary: {start.attitude.tilt: [0, 90], start.body_rates.magnitude: [0, 4], start.velocity.magnitude: [0, 3]}
    duration: 0.5
    episodes: 2
"""
LABEL = '<b>g</b> "2" </script>'
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


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


class Page(HTMLParser):
    """Tags, attributes that lead somewhere, and text outside of scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.text, self._inside = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self._inside = tag if tag in ("script", "style") else ""
        self.links += [value for name, value in attributes if name in ("src", "href", "srcset", "action", "data")]

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
    figures = results.entry("pid", "tracking").metrics
    assert f"{figures.reward.value:.2f}".replace("-", "−") in text
    assert f"{figures.arrivals[0].time.value:.2f}" in text and f"{figures.final_error_max:.3f}" in text
    low, high = figures.success.low, figures.success.high
    assert f"{100 * low:.1f} to {100 * high:.1f}" in text
    for figure in ("1.25", "never", "2 to 3", "paper"):  # the reference's
        assert figure in text


def test_nothing_in_the_page_leads_outside(page):
    parsed = Page(page.read_text(encoding="utf-8"))
    assert {"table", "figure", "script"} <= set(parsed.tags) and not {"b", "small", "iframe", "img"} & set(parsed.tags)
    assert parsed.tags.count("script") == 3
    for link in parsed.links:
        assert link.startswith("#") or link == "data:," or (page.parent / link).is_file(), link


def test_every_figure_is_in_the_page_and_beside_it(folder, page):
    parts = sections(load_results(folder), folder)
    figures = [figure for section in parts for figure in section.figures]
    names = [figure.name for figure in figures]
    assert len(set(names)) == len(names)
    assert {type(figure) for figure in figures} == {BarFigure, HeatFigure, LineFigure, PathFigure}
    text = page.read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.DOTALL).group(1))
    assert sorted(data) == sorted(names)
    for name in names:
        assert f'data-figure="{name}"' in text
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert ElementTree.parse(folder / "figures" / f"{name}.svg").getroot().tag.endswith("svg")
    assert len(list((folder / "figures").iterdir())) == 2 * len(names)


def test_axes_say_what_and_in_which_unit(folder):
    for section in sections(load_results(folder), folder):
        for figure in section.figures:
            layout = interactive.draw(figure)["layout"]
            axes = [*layout.items(), *layout.get("scene", {}).items()]
            titles = [axis["title"]["text"] for name, axis in axes if "axis" in name and axis["title"]["text"]]
            assert len(titles) >= 2
            if isinstance(figure, PathFigure):
                assert titles == ["x (m)", "y (m)", "z (m)"]
            elif isinstance(figure, (LineFigure, BarFigure)):
                assert all("(" in title or "factor" in title for title in titles), titles


def test_paths_are_the_flights(folder):
    results = load_results(folder)
    (section,) = (section for section in sections(results, folder) if section.anchor == "hit")
    (figure,) = (figure for figure in section.figures if isinstance(figure, PathFigure))
    for path, label in zip(figure.paths, ("pid", LABEL), strict=True):
        track = read_tracks(folder, results.entry(label, "hit"))[0]
        np.testing.assert_array_equal(path.points[[0, -1]], track.position[[0, -1]])
        assert path.name == label
    np.testing.assert_allclose(figure.targets, [[1, 1, 16]])
    directions = [arrow.vector / np.linalg.norm(arrow.vector) for arrow in figure.arrows]
    assert len(directions) == 2 and np.allclose(directions, [-(0.5**0.5), -(0.5**0.5), 0.0], atol=1e-6)


def test_a_lost_flight_counts_as_far_away(folder):
    results = load_results(folder)
    (section,) = (section for section in sections(results, folder) if section.anchor == "upside_down")
    (figure,) = (figure for figure in section.figures if isinstance(figure, LineFigure))
    lost = results.entry("pid", "upside_down").metrics.collisions == 2
    (line,) = (line for line in figure.lines if line.name == "pid" and not line.faint)
    assert lost and line.x[-1] < 2.0
    paths = next(figure for figure in section.figures if isinstance(figure, PathFigure))
    assert paths.paths[0].lost


def test_numbers_that_are_none_leave_gaps():
    line = Line("a", "#123456", np.array([0.0, 1.0]), np.array([np.nan, 2.0]))
    trace = interactive.draw(LineFigure("f", "", "x (s)", "y (m)", [line]))["data"][0]
    assert trace["y"] == [None, 2.0]
    json.dumps(trace, allow_nan=False)


@given(value=st.floats(-1e4, 1e4), decimals=st.integers(0, 4))
def test_cells_split_at_the_decimal_point(value, decimals):
    cell = Cell(value, decimals=decimals)
    text = (cell.whole + cell.fraction).replace("−", "-")
    assert (float(text) == float(f"{value:.{decimals}f}") and not text.startswith("-0")) or float(text) != 0
    assert cell.fraction == "" if decimals == 0 else cell.fraction[0] == "." and len(cell.fraction) == decimals + 1


values = st.floats(-10, 10, allow_nan=False)


@given(
    cells=st.lists(st.tuples(values, values, values), min_size=2, max_size=5),
    row=st.sampled_from(["success", "mean time to 1 m"]),
)
def test_the_best_is_better_than_all_others_for_certain(cells, row):
    made = [Cell(sorted(each)[1], sorted(each)[0], sorted(each)[2]) for each in cells]
    marked = mark_best(row, made)
    for cell in marked:
        others = [other for other in marked if other is not cell]
        apart = all(cell.low > other.high if row == "success" else cell.high < other.low for other in others)
        assert cell.best == apart


def test_failures_are_listed(folder):
    results = load_results(folder)
    failed = results.model_copy(update={"failures": [Failure(controller="x<y", scenario="hit", message="no & no")]})
    text = render(failed, sections(results, folder), with_pictures=False)
    assert "x&lt;y" in text and "no &amp; no" in text and "figures/" not in text.split("<script")[0]


def test_a_report_is_not_replaced_silently(folder, page, capsys):
    before = page.stat().st_mtime_ns
    assert main(["report", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err and page.stat().st_mtime_ns == before
    assert main(["report", str(folder), "--overwrite", "--no-pictures"]) == 0
    assert str(page) in capsys.readouterr().out and page.stat().st_mtime_ns != before


def test_bad_folders_are_one_line(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2
    assert "results.json" in capsys.readouterr().err
    (tmp_path / "results.json").write_text("{}")
    assert main(["report", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "damaged" in error and error.count("\n") == 1


@pytest.mark.slow
def test_a_browser_shows_it_without_errors_or_requests(page):
    browser_path = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser_path is None:
        pytest.skip(f"no browser is installed (none of {', '.join(BROWSERS)})")
    from playwright.sync_api import sync_playwright

    quiet = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    quiet += ["--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path, args=quiet)
        context = browser.new_context(viewport={"width": 1000, "height": 900}, offline=True, color_scheme="light")
        tab = context.new_page()
        errors, requests = [], []
        tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(page.as_uri())
        tab.wait_for_selector("html[data-ready=yes]")
        plots = tab.locator(".plot")
        names = [plots.nth(number).get_attribute("data-figure") for number in range(plots.count())]
        assert len(names) == len(list((page.parent / "figures").glob("*.svg")))
        for number, name in enumerate(names):
            plot = plots.nth(number)
            plot.scroll_into_view_if_needed()
            drawn = "canvas" if plot.get_attribute("data-kind") == "space" else "svg.main-svg"
            plot.locator(drawn).first.wait_for(state="attached", timeout=60_000)
            box = plot.locator(drawn).first.bounding_box()
            assert box is not None and box["width"] > 200 and box["height"] > 100, name
        width = tab.evaluate("document.documentElement.scrollWidth - window.innerWidth")
        colours = "[getComputedStyle(document.body).backgroundColor, document.querySelector('.plot text').style.fill]"
        light = tab.evaluate(colours)
        tab.emulate_media(color_scheme="dark")
        tab.wait_for_timeout(300)
        dark = tab.evaluate(colours)
        browser.close()
    assert errors == []
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [page.as_uri()]
    assert width <= 0  # tables scroll, the page does not
    assert light[0] == "rgb(255, 255, 255)" and all(one != other for one, other in zip(light, dark, strict=True))
