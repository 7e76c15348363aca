"""The folder of an evaluation's results, as ``records.py`` lays it out; every file appears whole or not at all."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_arrays, write_text
from sb3_quad.evaluation.controllers import file_name
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.records import Entry, Results

RESULTS, EPISODES, FLIGHTS = "results.json", "episodes.csv", "flights"
_START = (
    *("start_x", "start_y", "start_z", "start_qw", "start_qx", "start_qy", "start_qz"),
    *("start_vx", "start_vy", "start_vz", "start_rate_x", "start_rate_y", "start_rate_z"),
)


class ResultFolder:
    """Reading and writing one folder of results.

    :param path: made when something is written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def flights_path(self, controller: str, scenario: str) -> str:
        """Where the flights of a controller's label and a scenario's name lie, relative to the folder."""
        return f"{FLIGHTS}/{file_name(controller)}/{scenario}.npz"

    def read_entry(self, controller: str, scenario: str) -> Entry | None:
        """What is there of a controller in a scenario; None if nothing is.

        :raises ConfigError: a damaged file, or one of another version.
        """
        path = (self.path / self.flights_path(controller, scenario)).with_suffix(".json")
        if not path.is_file() or not path.with_suffix(".npz").is_file():
            return None
        return _parse_entry(path)

    def entries(self) -> Iterator[Entry]:
        """Everything that is there.

        :raises ConfigError: a damaged file, or one of another version.
        """
        for path in sorted((self.path / FLIGHTS).glob("*/*.json")):
            if path.with_suffix(".npz").is_file():
                yield _parse_entry(path)

    def write_entry(self, entry: Entry, arrays: Arrays) -> None:
        """Keep the flights of a controller in a scenario.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        path = self.path / entry.flights
        path.with_suffix(".json").unlink(missing_ok=True)  # an entry is there once its last file is
        write_arrays(path, compressed=True, **arrays)
        write_text(path.with_suffix(".json"), entry.model_dump_json(indent=2) + "\n")

    def read_results(self) -> Results | None:
        """``results.json``, None if there is none.

        :raises ConfigError: a damaged file, or one of another version.
        """
        path = self.path / RESULTS
        return load_results(self.path) if path.is_file() else None

    def write_results(self, results: Results) -> None:
        """Write ``results.json`` and ``episodes.csv``.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        write_text(self.path / EPISODES, self._table(results.entries))
        write_text(self.path / RESULTS, results.model_dump_json(indent=2) + "\n")

    def _table(self, entries: Iterable[Entry]) -> str:
        flights = [(entry, read_flights(self.path / entry.flights, "episode_")) for entry in entries]
        tolerances = sorted({float(value) for _, arrays in flights for value in arrays["episode_tolerances"]})
        waypoints = max((arrays["episode_waypoints"].shape[1] for _, arrays in flights), default=0)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        times = [f"time_to_{value:g}" for value in tolerances]
        writer.writerow(
            [
                *("controller", "scenario", "episode", "seed", "outcome", "flown", "reward", "path", "final_error"),
                *(*times, "waypoints_reached", *(f"waypoint_{number + 1}" for number in range(waypoints))),
                *("target_x", "target_y", "target_z", *_START),
            ]
        )
        for entry, arrays in flights:
            columns = [np.full(len(arrays["episode_seed"]), np.nan) for _ in tolerances]
            for number, value in enumerate(arrays["episode_tolerances"]):
                columns[tolerances.index(float(value))] = arrays["episode_time_to"][:, number]
            reached = arrays["episode_waypoints"]
            for row in range(len(arrays["episode_seed"])):
                figures = [arrays[f"episode_{name}"][row] for name in ("flown", "reward", "path", "final_error")]
                later = [_number(value) for value in reached[row]] + [""] * (waypoints - reached.shape[1])
                writer.writerow(
                    [
                        *(entry.controller, entry.scenario, row, arrays["episode_seed"][row], arrays["episode_outcome"][row]),
                        *(_number(value) for value in (*figures, *(column[row] for column in columns))),
                        *(int(np.isfinite(reached[row]).sum()), *later),
                        *(_number(value) for value in (*arrays["episode_target"][row], *arrays["episode_start"][row])),
                    ]
                )
        return text.getvalue()


def load_results(folder: str | Path) -> Results:
    """The ``results.json`` of a folder.

    :raises ConfigError: no such file, a damaged one, or one of another version.
    """
    path = Path(folder) / RESULTS
    try:
        return Results.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; evaluate writes it") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {_damage(error)}") from None


def _parse_entry(path: Path) -> Entry:
    try:
        return Entry.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {_damage(error)}; give another folder with -o, or remove it") from None


def _damage(error: ValidationError) -> str:
    first = error.errors()[0]
    return f"damaged, or of another version ({'.'.join(map(str, first['loc']))}: {first['msg']})"


def _number(value: float) -> str:
    return f"{value:.9g}" if np.isfinite(value) else ""
