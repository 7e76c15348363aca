"""Recorded worlds: the force, torque or wind of a log acts again, row by row.

In flight, ``record`` (rows, size) has a row for each control step; without rows nothing acts. An
episode begins at one of its rows ``starts`` int64 (starts,), which ``chances`` (n,) choose,
uniform numbers on (0, 1).
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sb3_quad.base.compiled import inner
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, IntArray
from sb3_quad.base.validate import Frozen
from sb3_quad.envs.simulation.motions import MAX_SECONDS, read_series
from sb3_quad.envs.simulation.random import STEP
from sb3_quad.envs.simulation.state import FORCE_WORLD, TORQUE_BODY

# The columns of a file, and the rows of the state or wrench that those after t become
WRENCH_COLUMNS = ["t", "fx", "fy", "fz", "tx", "ty", "tz"]
WRENCH_ROWS = np.r_[FORCE_WORLD, TORQUE_BODY]
WIND_COLUMNS = ["t", "vx", "vy", "vz"]
GREATEST = 1e4  # N, N m or m/s
Seconds = Annotated[float, Field(ge=0, le=MAX_SECONDS)]


class Recording(Frozen):
    """A log that is replayed. It comes on top of what was set or sampled. You may write its path.

    Between its rows it is interpolated linearly. After its last row it begins again at its first.
    """

    file: str | Path
    """path of a CSV file with the column t, s, and others that its keyword names"""
    start: Literal["random"] | Seconds | Annotated[list[Seconds], Field(min_length=1)] = "random"
    """when in the log an episode begins, s after its first row: any time, this one, or one of
    these; two logs of the same length begin at the same random time
    """

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, data: Any) -> Any:
        return {"file": data} if isinstance(data, (str, Path)) else data

    def table(self, columns: list[str], dt: float) -> FloatArray:
        """Return what acts in each control step, (rows, 3 or all columns but t).

        :param columns: t and others; the file has three of these, or all.
        :param dt: control step, s.
        :raises ConfigError: a file that cannot be read, has other columns, is longer than 600 s or
            holds a number above 10,000.
        """
        times, numbers = read_series(Path(self.file), columns[:4], columns)
        seconds, greatest = times[-1], np.abs(numbers).max()
        if seconds > MAX_SECONDS or greatest > GREATEST:
            raise ConfigError(
                f"{self.file}: takes {seconds:g} s, with numbers up to {greatest:g}; at most"
                f" {MAX_SECONDS:g} s and {GREATEST:g} are possible: shorten it, or change its units"
            )
        # Rounding errors must not take a row.
        steps = dt * np.arange(int(seconds / dt + 1e-6) + 1)
        return np.stack([np.interp(steps, times, column) for column in numbers.T], axis=1)


def starts_of(recording: Recording | None, dt: float, record: FloatArray) -> IntArray:
    """Return the rows of a record at which episodes may begin."""
    if recording is None or recording.start == "random":
        return np.arange(len(record))
    return np.round(np.atleast_1d(recording.start) / dt).astype(np.int64)


@inner
def add_recording(to, record, starts, chances, streams, first, count):
    """Add what acted in the log to what acts on a block, (size, LANES)."""
    if record.shape[0] == 0:
        return
    for lane in range(count):
        i = first + lane
        begin = starts[np.int64(chances[i] * starts.size)]
        row = (begin + streams[STEP, i]) % record.shape[0]
        for k in range(to.shape[0]):
            to[k, lane] += record[row, k]
