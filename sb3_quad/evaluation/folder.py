"""The folder of an evaluation's results, as ``records.py`` lays it out; every file appears whole or not at all."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_arrays, write_text
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.controllers import file_name
from sb3_quad.evaluation.records import Entry, Results

RESULTS, EPISODES, FLIGHTS = "results.json", "episodes.csv", "flights"
_TARGET = ("target_x", "target_y", "target_z")
_START = (
    *("start_x", "start_y", "start_z", "start_qw", "start_qx", "start_qy", "start_qz"),
    *("start_vx", "start_vy", "start_vz", "start_rate_x", "start_rate_y", "start_rate_z"),
)


def load_results(folder: str | Path) -> Results:
    """The ``results.json`` of a folder.

    :raises ConfigError: no such file, a damaged one, or one of another version.
    """
    path = Path(folder) / RESULTS
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; evaluate writes it")
    return read_record(path, Results)


def read_entries(folder: Path) -> Iterator[Entry]:
    """Everything that was flown into a folder.

    :raises ConfigError: a damaged file, or one of another version.
    """
    for path in sorted((folder / FLIGHTS).glob("*/*.json")):
        if path.with_suffix(".npz").is_file():
            yield read_record(path, Entry)


def flights_path(controller: str, scenario: str) -> str:
    """Where the flights of a controller's label and a scenario's name lie, relative to the folder."""
    return f"{FLIGHTS}/{file_name(controller)}/{scenario}.npz"


def write_entry(folder: Path, entry: Entry, arrays: Arrays) -> None:
    """Keep the flights of a controller in a scenario.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    path = folder / entry.flights
    path.with_suffix(".json").unlink(missing_ok=True)  # an entry is there once its last file is
    write_arrays(path, compressed=True, **arrays)
    _write(path.with_suffix(".json"), entry)


def write_results(folder: Path, results: Results) -> None:
    """Write ``results.json`` and ``episodes.csv``.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    flights = [(entry, read_arrays(folder / entry.flights, "episode_")) for entry in results.entries]
    tolerances = sorted({float(value) for _, arrays in flights for value in arrays["episode_tolerances"]})
    waypoints = max((arrays["episode_waypoints"].shape[1] for _, arrays in flights), default=0)
    columns = [
        *("controller", "scenario", "episode", "seed", "outcome", "flown", "reward", "path", "final_error"),
        *(f"time_to_{value:g}" for value in tolerances),
        *("waypoints_reached", *(f"waypoint_{number + 1}" for number in range(waypoints)), *_TARGET, *_START),
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for entry, arrays in flights:
        writer.writerows(_rows(entry, arrays))
    write_text(folder / EPISODES, text.getvalue())
    _write(folder / RESULTS, results)


def _rows(entry: Entry, arrays: Arrays) -> Iterator[dict[str, Any]]:
    """A line of the table for each flight; empty where there is no number."""
    for episode, reached in enumerate(arrays["episode_waypoints"]):
        numbers = {name: arrays[f"episode_{name}"][episode] for name in ("flown", "reward", "path", "final_error")}
        for tolerance, time in zip(arrays["episode_tolerances"], arrays["episode_time_to"][episode], strict=True):
            numbers[f"time_to_{tolerance:g}"] = time
        numbers |= {f"waypoint_{number + 1}": time for number, time in enumerate(reached)}
        numbers |= zip(_TARGET, arrays["episode_target"][episode], strict=True)
        numbers |= zip(_START, arrays["episode_start"][episode], strict=True)
        yield {
            "controller": entry.controller,
            "scenario": entry.scenario,
            "episode": episode,
            **{name: arrays[f"episode_{name}"][episode] for name in ("seed", "outcome")},
            **{name: f"{value:.9g}" if np.isfinite(value) else "" for name, value in numbers.items()},
            "waypoints_reached": int(np.isfinite(reached).sum()),
        }


def _write(path: Path, record: Frozen) -> None:
    write_text(path, record.model_dump_json(indent=2) + "\n")
