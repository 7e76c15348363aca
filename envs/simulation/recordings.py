"""Recorded worlds: the force, torque or wind of a log acts again, row by row.

In flight, a table has a row for each control step. ``begins``, int64 (2, n), says at which row of
the wrench's table, and of the wind's, each vehicle's episode began; (2, 0) if nothing is replayed.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sb3_quad.base.compiled import called, inner
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, IntArray
from sb3_quad.base.validate import Frozen
from sb3_quad.envs.simulation.motions import MAX_SECONDS, read_series
from sb3_quad.envs.simulation.random import RECORDING, STEP, uniforms
from sb3_quad.envs.simulation.state import W

# The columns of a file besides t, by the rows of a table that they become
WRENCH_COLUMNS = {
    "fx": W.force_world,
    "fy": W.force_world + 1,
    "fz": W.force_world + 2,
    "tx": W.torque_body,
    "ty": W.torque_body + 1,
    "tz": W.torque_body + 2,
}
WIND_COLUMNS = {"vx": 0, "vy": 1, "vz": 2}
GREATEST = 1e4  # N, N m or m/s
Seconds = Annotated[float, Field(ge=0, le=MAX_SECONDS)]


class Recording(Frozen):
    """A log that is replayed. It comes on top of what was set or sampled. You may write its path.

    Between its rows it is interpolated linearly. After its last row it begins again at its first.
    """

    file: str | Path
    """path of a CSV file with the column t, s, and others that its keyword names"""
    start: Literal["random"] | Seconds | Annotated[tuple[Seconds, ...], Field(min_length=1)] = (
        "random"
    )
    """when in the log an episode begins, s after its first row; each episode samples one of several
    times, or any. Two logs of the same length begin at the same time
    """

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, data: Any) -> Any:
        return {"file": data} if isinstance(data, (str, Path)) else data

    def table(self, columns: dict[str, int], size: int, dt: float) -> tuple[FloatArray, IntArray]:
        """Return what acts in each control step, (rows, size), and where episodes may begin,
        (starts,).

        :param columns: the columns of the file, three or all, and their places.
        :param dt: control step, s.
        :raises ConfigError: a file that cannot be read, has other columns, is longer than 600 s or
            holds a number above 10,000.
        """
        names = ["t", *columns]
        times, numbers = read_series(Path(self.file), names[:4], names)
        if times[-1] > MAX_SECONDS or np.abs(numbers).max() > GREATEST:
            raise ConfigError(
                f"{self.file}: takes {times[-1]:g} s, with numbers up to"
                f" {np.abs(numbers).max():g}; at most {MAX_SECONDS:g} s and {GREATEST:g} are"
                " possible: shorten it, or change its units"
            )
        # Rounding errors must not take a row.
        steps = dt * np.arange(int(times[-1] / dt + 1e-6) + 1)
        table = np.zeros((len(steps), size))
        for place, column in zip(columns.values(), numbers.T, strict=False):
            table[:, place] = np.interp(steps, times, column)
        if self.start == "random":
            return table, np.arange(len(table))
        starts = np.round(np.atleast_1d(self.start) / dt).astype(np.int64)
        if starts.max() >= len(table):
            raise ConfigError(
                f"{self.file}: start {np.max(self.start):g} is after its end, {times[-1]:g} s"
            )
        return table, starts


NO_STARTS = np.zeros(1, np.int64)


@called
def begin_recordings(i, streams, wrench_starts, wind_starts, begins):
    """Sample where the recordings of row i's episode begin, in place."""
    if begins.shape[1] > 0:
        u = uniforms(streams, i, RECORDING)[0]
        begins[0, i] = wrench_starts[np.int64(u * wrench_starts.size)]
        begins[1, i] = wind_starts[np.int64(u * wind_starts.size)]


@inner
def add_recording(to, record, begins, streams, first, count):
    """Add what acted in the log to that of a block, (size, LANES).

    :param record: (rows, size); ``begins`` (0 or n,).
    """
    if record.shape[0] == 0:
        return
    for lane in range(count):
        # With an unsigned index, numba does not check whether it counts from the end.
        row = np.uint64((begins[first + lane] + streams[STEP, first + lane]) % record.shape[0])
        for k in range(to.shape[0]):
            to[k, lane] += record[row, np.uint64(k)]
