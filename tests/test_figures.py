"""The figures of README's table and of the agents' cards are those that were measured.

docs/research/readme holds the ``results.json`` of the commands in docs/research/results.md, "The
table of the README". After a change of an agent, run these commands and copy their files there.
"""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

import sb3_quad
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import pretrained_names
from sb3_quad.base.seeds import seed_for
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.statistics import share

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs/research/readme"
NOTE = "docs/research/results.md"
# Pages that show the PID's recoveries of other episodes, which they name.
OTHER_EPISODES = (
    "docs/research/experts.md",
    "docs/research/reality.md",
    "docs/research/vehicles.md",
)


def survival(metrics):
    return 100 * metrics["survival"]["value"]


def settling_time(metrics):
    (arrival,) = (a for a in metrics["arrivals"] if a["tolerance"] == 0.1)
    return arrival["settling"]["time"]["value"]


def final_error(metrics):
    return metrics["final_error_median"]


def rms_error(metrics):
    return metrics["rms_error"]["value"]


# A row's heading, the folder of its results, the scenario and the metric.
ROWS = [
    (r"(thrown|recovery).*survival", "thesis", "recovery", survival),
    (r"10 m\b.*(settling|within 0\.1 m after)", "thesis", "tracking", settling_time),
    (r"20 m\b.*(settling|the same)", "thesis", "tracking_20m", settling_time),
    (r"constant force.*error", "thesis", "constant_force", final_error),
    (r"figure eight.*error", "figure_eight", "figure_eight", rms_error),
]
COLUMNS = {"PID": "PID", "geometric expert": "geometric", "`itm-robust`": "itm-robust"}


def results(folder):
    return json.loads((FOLDER / folder / "results.json").read_text(encoding="utf-8"))


def entry_of(folder, scenario, controller):
    (entry,) = (
        entry
        for entry in results(folder)["entries"]
        if (entry["scenario"], entry["controller"]) == (scenario, controller)
    )
    return entry


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def tables(text):
    """The tables of a page, each a list of rows of cells."""
    blocks = re.findall(r"(?:^\|.*\|\n)+", text, flags=re.MULTILINE)
    return [
        [[cell.strip() for cell in line.split("|")[1:-1]] for line in block.splitlines()]
        for block in blocks
    ]


def first_number(cell):
    """The first number of a cell, and how many decimals it has."""
    number = re.search(r"−?-?\d+(?:\.(\d+))?", cell.partition("](")[0].replace("[", ""))
    return float(number.group().replace("−", "-")), len(number.group(1) or "")


def assert_shows(cell, value):
    number, decimals = first_number(cell)
    assert number == pytest.approx(value, abs=0.5001 * 10**-decimals), (cell, value)


def table_of_results(page):
    """The one table of a page that has a column for the PID, the expert and the agent."""
    (table,) = (table for table in tables(read(page)) if set(COLUMNS) <= set(table[0]))
    return table


@pytest.mark.parametrize("page", ["README.md", NOTE])
@pytest.mark.parametrize(("heading", "folder", "scenario", "metric"), ROWS)
def test_the_table_of_the_readme_shows_what_was_measured(page, heading, folder, scenario, metric):
    header, _, *rows = table_of_results(page)
    (row,) = (row for row in rows if re.search(heading, row[0]))
    for title, controller in COLUMNS.items():
        entry = entry_of(folder, scenario, controller)
        assert_shows(row[header.index(title)], metric(entry["metrics"]))
        limit = row[header.index("physical limit")]
        if limit:
            assert_shows(limit, entry["physical_limit"])


@pytest.mark.parametrize("folder", ["thesis", "figure_eight"])
def test_the_agent_of_the_table_is_the_one_that_ships(folder):
    (agent,) = (c for c in results(folder)["controllers"] if c["label"] == "itm-robust")
    content = sb3_quad.pretrained_path("itm-robust").read_bytes()
    assert agent["content"] == hashlib.sha256(content).hexdigest()


def test_all_pages_give_the_pid_one_recovery_figure():
    value = survival(entry_of("thesis", "recovery", "PID")["metrics"])
    shown = []
    for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]:
        page = path.relative_to(ROOT).as_posix()
        for header, *rows in [] if page in OTHER_EPISODES else tables(read(page)):
            columns = [n for n, cell in enumerate(header) if re.search(r"^PID\b|\(PID\)", cell)]
            for row in rows if columns else []:
                if re.search(r"^(thrown|(state )?recover\w*\b(?!.*random)).*surviv", row[0]):
                    assert_shows(row[columns[0]], value)
                    shown.append(page)
    assert {"README.md", "docs/experts.md", NOTE} <= set(shown)


def card(name):
    return sb3_quad.pretrained_path(name).with_suffix(".md").read_text(encoding="utf-8")


def measured(name):
    """The rows of a card's table by their heading, each a cell by its column's."""
    (table,) = (t for t in tables(card(name)) if any("survival" in cell for cell in t[0]))
    header, _, *rows = table
    return {row[0]: dict(zip(header, row, strict=True)) for row in rows}


@pytest.mark.parametrize("name", pretrained_names())
def test_shares_on_a_card_are_of_its_episodes(name):
    """Each is a share of the flights that the card names, with the interval of that share."""
    assert "3,840 fresh recoveries and 960 fresh targets" in card(name)
    for row, cells in measured(name).items():
        n = 3840 if row == "state recovery" else 960
        for column in cells.keys() & {"success, %", "survival, %", "survival"}:
            shown = [float(number) for number in re.findall(r"\d+\.\d+", cells[column])]
            hits = round(shown[0] / 100 * n)
            estimate = share(np.arange(n) < hits)
            exact = [100 * number for number in (estimate.value, estimate.low, estimate.high)]
            decimals = first_number(cells[column])[1]
            assert shown == pytest.approx(exact, abs=0.5001 * 10**-decimals), (row, column)
    limit = "physical limit of the settling time, s"
    for row, cells in measured(name).items():
        if cells.get(limit, "–") != "–":
            vehicle = load_vehicle(name.split("-")[0].replace("thesis", "itm"))
            distance = float(re.search(r"targets (\d+) m", row).group(1))
            assert_shows(cells[limit], vehicle.time_optimal[distance])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["itm-robust", "crazyflie-recovery", "thesis-recovery"])
def test_a_card_shows_the_flights_that_it_names(name):
    """Its targets 10 m away, by the episodes of ``examples/publish.py``."""
    own = agent_settings(sb3_quad.pretrained_path(name))[0].in_any_task()
    own["vehicle"] = name.split("-")[0].replace("thesis", "itm")
    agent, seed = sb3_quad.load_pretrained(name), seed_for("card", 10_000)
    flights = fly(agent, "target_tracking", 960, seed, task_kwargs={"target_distance": 10.0}, **own)
    cells = measured(name)["targets 10 m away"]
    assert_shows(cells["success, %"], 100 * flights.success.mean())
    assert_shows(cells["survival, %"], 100 * flights.survival.mean())
    assert_shows(cells["mean reward"], flights.reward.mean())
    assert_shows(cells["mean time to 0.1 m, s"], np.nanmean(flights.time_to[0.1]))
    assert_shows(cells["final error, median, m"], np.median(flights.final_error))
