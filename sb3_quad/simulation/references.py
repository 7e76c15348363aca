"""References that move: curves, files and functions as tables of a state for each control step.

A reference is a state: position, velocity, acceleration, heading and its rate. A row of a table is
that state in the order of the last rows of :data:`.state.STATE`. Tables are made once, when an
environment is; in flight, :mod:`.tracks` reads them.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field, PositiveFloat, model_validator

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.state import STATE_SIZE, X

Motion = Callable[[FloatArray], FloatArray]
"""The position at given times (t,), s: (t, 3) or with a heading (t, 4); m and rad."""
Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Point = tuple[Metres, Metres, Metres]
CURVES = (
    *("hover", "circle", "figure_eight", "helix", "lissajous"),
    *("polynomial", "file", "function", "random_smooth"),
)
REFERENCE_SIZE = STATE_SIZE - X.target
_POSITION, _VELOCITY, _ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
_HEADING, _HEADING_RATE = slice(9, 11), 11
# Random motion: so many pieces of so many seconds, each a sum of sines that fit into it.
PIECES = 256
PIECE_SECONDS = 10.0
HARMONICS = np.arange(1, 7)
MAX_SECONDS = 600.0
_COLUMNS = ["t", "x", "y", "z", "heading"]
# Coefficients of a piece of a polynomial with the least snap, and its derivatives that are
# continuous
_COEFFICIENTS = 8
_SMOOTH = 6


class Tracks(NamedTuple):
    """Tables of references, one or several pieces, that the compiled step reads.

    :param table: (pieces * length, REFERENCE_SIZE), positions relative to the start of a piece.
    :param length: control steps of a piece.
    :param loops: whether a piece begins again at its end; otherwise the reference rests there.
    """

    table: FloatArray
    length: int
    loops: bool

    def numbers(self) -> "np.ndarray[Any, np.dtype[np.int64]]":
        """Return length, loops and the number of pieces, for compiled code."""
        pieces = len(self.table) // self.length
        return np.array([self.length, self.loops, pieces], dtype=np.int64)


NO_TRACKS = Tracks(np.zeros((0, REFERENCE_SIZE)), 1, False)


class Reference(Frozen):
    """A reference that moves from the target of an episode on; units m, s, rad.

    The axes of a curve are those of the world. With ω such that the greatest speed is ``speed``:

    | curve | position at the time t, relative to its start |
    |---|---|
    | `hover` | 0 |
    | `circle` | (A cos ωt - A, A sin ωt, 0) |
    | `figure_eight` | (A sin ωt, B sin 2ωt, C sin ωt) |
    | `helix` | the circle, and C upwards in each turn, for ``duration`` |
    | `lissajous` | (A sin ωt, B sin 2ωt, C sin 3ωt) |
    | `polynomial` | least snap through ``waypoints``, from rest to rest, looping where it closes |
    | `file` | cubic Hermite splines through the rows of a CSV file: t, x, y, z, maybe heading |
    | `function` | what ``function`` returns, for ``duration`` |
    | `random_smooth` | one of 256 random sums of sines, which repeat after 10 s |
    """

    curve: Literal[CURVES] = "figure_eight"  # type: ignore[valid-type]
    """which curve"""
    speed: PositiveFloat = Field(default=2.0, le=100)
    """greatest speed, m/s; of random_smooth the limit, below which each piece has its own"""
    size: tuple[Metres, Metres, Metres] | None = None
    """A, B and C, m; None: 2, 1 and 0 (helix: 0.5, lissajous: 0.5)"""
    acceleration: PositiveFloat = Field(default=8.0, le=1e3)
    """random_smooth: limit of the acceleration, m/s²"""
    resting: float = Field(default=0.0, ge=0, le=1)
    """random_smooth: share of pieces that rest"""
    heading: float | Literal["path", "random"] | None = None
    """at the start, rad; path: along the velocity; random: of each piece of random_smooth its own,
    with a rate up to heading_rate; None: nothing is asked of it"""
    heading_rate: float = Field(default=0.0, ge=-20, le=20)
    """rad/s, for a heading that is a number"""
    waypoints: tuple[Point, ...] | None = None
    """polynomial: two or more points, relative to the start, which is added if they do not begin
    there"""
    file: str | Path | None = None
    """file: path of the CSV file"""
    function: Any = Field(default=None, exclude=True)
    """function: times (t,) to positions (t, 3), or (t, 4) with headings; it is not saved"""
    duration: PositiveFloat = Field(default=20.0, le=MAX_SECONDS)
    """helix and function: s"""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, data: Any) -> Any:
        """A string names a curve, or is the path of a CSV file; a function is one."""
        if isinstance(data, (str, Path)):
            is_file = str(data).endswith(".csv")
            return {"curve": "file", "file": data} if is_file else {"curve": data}
        return {"curve": "function", "function": data} if callable(data) else data

    @model_validator(mode="after")
    def _complete(self) -> "Reference":
        for curve, needed in (
            ("polynomial", self.waypoints),
            ("file", self.file),
            ("function", self.function),
        ):
            if self.curve == curve and not needed:
                argument = "waypoints" if curve == "polynomial" else curve
                raise ValueError(f"curve {curve}: needs {argument}")
        if self.heading == "random" and self.curve != "random_smooth":
            raise ValueError("heading 'random': only with curve random_smooth")
        return self

    def tracks(self, dt: float) -> Tracks:
        """Return the tables for control steps of ``dt``, s.

        :raises ConfigError: a file or function that does not give such numbers.
        """
        if self.curve == "random_smooth":
            return self._random_tracks(dt)
        loops = self.curve not in ("helix", "polynomial", "file", "function")
        table = self._curve_table(dt)
        position = table[:, _POSITION]
        if not np.isfinite(table).all():
            raise ConfigError(f"reference {self.curve}: its positions are not all finite")
        position -= position[0].copy()
        heading = self._heading(table, dt)
        if heading is not None:
            _set_heading(table, heading, dt)
        if not loops:
            # It rests where it ends.
            table = np.vstack([table, table[-1]])
            table[-1, _VELOCITY.start : _ACCELERATION.stop] = 0.0
            table[-1, _HEADING_RATE] = 0.0
        return Tracks(table, len(table), loops)

    def _heading(self, table: FloatArray, dt: float) -> FloatArray | None:
        """Return the heading of each row of a table, (t,), rad; None: nothing is asked of it."""
        if isinstance(self.heading, str):
            return np.asarray(np.unwrap(np.arctan2(table[:, 4], table[:, 3])))
        if self.heading is None:
            return None
        times = dt * np.arange(len(table), dtype=np.float64)
        return np.asarray(self.heading + self.heading_rate * times)

    def _curve_table(self, dt: float) -> FloatArray:
        """Return the positions of a curve with their derivatives; their start may be anywhere."""
        if self.curve == "polynomial":
            return self._polynomial(dt)
        if self.curve == "file":
            times, points = read_points(Path(str(self.file)))
            return self._sampled(_interpolated(times, points), times[-1], dt)
        if self.curve == "function":
            return self._sampled(self.function, self.duration, dt)
        return self._sines(dt)

    def _sines(self, dt: float) -> FloatArray:
        """Return one period of a curve that is made of sines."""
        default = {"helix": 0.5, "lissajous": 0.5}.get(self.curve, 0.0)
        a, b, c = self.size or (2.0, 1.0, default)
        # Amplitude, multiple of ω and phase by axis
        waves = {
            "hover": (),
            "circle": ((0, a, 1, 0.5 * math.pi), (1, a, 1, 0.0)),
            "helix": ((0, a, 1, 0.5 * math.pi), (1, a, 1, 0.0)),
            "figure_eight": ((0, a, 1, 0.0), (1, b, 2, 0.0), (2, c, 1, 0.0)),
            "lissajous": ((0, a, 1, 0.0), (1, b, 2, 0.0), (2, c, 3, 0.0)),
        }[self.curve]
        if not waves:
            # A second at rest, which repeats.
            return np.zeros((round(1.0 / dt), REFERENCE_SIZE))
        climb = c / (2.0 * math.pi) if self.curve == "helix" else 0.0
        # The greatest speed per ω, found on a fine grid
        unit = _waves(waves, np.linspace(0.0, 2.0 * math.pi, 7201), 1.0)
        unit[:, 5] += climb
        rate = self.speed / np.linalg.norm(unit[:, _VELOCITY], axis=1).max()
        # A whole number of control steps, so that it loops without a jump.
        period = max(round(2.0 * math.pi / rate / dt), 4)
        rate = 2.0 * math.pi / (period * dt)
        steps = period if self.curve != "helix" else round(self.duration / dt)
        times = dt * np.arange(steps)
        table = _waves(waves, times, rate)
        table[:, 2] += climb * rate * times
        table[:, 5] += climb * rate
        return table

    def _sampled(self, motion: Motion, duration: float, dt: float) -> FloatArray:
        """Return a table of a function, its derivatives by central differences."""
        # Two steps more on each side, so that both differences have their neighbours.
        times = dt * np.arange(-2, round(duration / dt) + 3)
        with raised_as(ConfigError, f"reference {self.curve}"):
            inside = np.clip(times, 0.0, duration)
            values = np.asarray(motion(inside), dtype=np.float64)
        if values.ndim != 2 or values.shape[0] != len(times) or values.shape[1] not in (3, 4):
            raise ConfigError(
                f"reference {self.curve}: gives shape {values.shape} for {len(times)} times; must"
                f" be ({len(times)}, 3) or, with a heading, ({len(times)}, 4)"
            )
        table = np.zeros((len(times), REFERENCE_SIZE))
        table[:, _POSITION] = values[:, :3]
        table[:, _VELOCITY] = np.gradient(values[:, :3], dt, axis=0)
        table[:, _ACCELERATION] = np.gradient(table[:, _VELOCITY], dt, axis=0)
        if values.shape[1] == 4:
            _set_heading(table, values[:, 3], dt)
        return table[2:-2]

    def _polynomial(self, dt: float) -> FloatArray:
        """Return the motion of the least snap through the waypoints (Mellinger and Kumar, "Minimum
        snap trajectory generation and control for quadrotors", ICRA 2011).

        The times between them are such that the mean speed is half of ``speed``, then the whole is
        stretched so that the greatest speed is ``speed``.
        """
        points = np.array(self.waypoints, dtype=np.float64)
        if points[0].any():
            points = np.vstack([np.zeros(3), points])
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not lengths.all():
            raise ConfigError("reference polynomial: two waypoints in a row are the same point")
        seconds = 2.0 * lengths / self.speed
        coefficients = least_snap(points, seconds)
        speeds = _evaluate(coefficients, seconds, 0.01 * seconds.min())[:, _VELOCITY]
        seconds = seconds * np.linalg.norm(speeds, axis=1).max() / self.speed
        return _evaluate(least_snap(points, seconds), seconds, dt)

    def _random_tracks(self, dt: float) -> Tracks:
        """Return random pieces. They are the same in every environment; which of them a row flies
        comes from its own stream.
        """
        length = round(PIECE_SECONDS / dt)
        times = dt * np.arange(length, dtype=np.float64)
        base = 2.0 * math.pi / (length * dt)
        random = np.random.default_rng(0)
        pieces = []
        for number in range(PIECES):
            weights: Any = random.normal(size=(3, len(HARMONICS))) / HARMONICS**1.5
            weights[2] *= 0.5
            phases: Any = random.uniform(0.0, 2.0 * math.pi, size=weights.shape)
            waves = []
            for axis in range(3):
                for harmonic in HARMONICS:
                    at = axis, harmonic - 1
                    waves.append((axis, weights[at], harmonic, phases[at]))
            table = _waves(tuple(waves), times, base)
            greatest = np.linalg.norm(table[:, _VELOCITY], axis=1).max()
            steepest = np.linalg.norm(table[:, _ACCELERATION], axis=1).max()
            scale: Any = min(
                self.speed * random.uniform(0.1, 1.0) / greatest, self.acceleration / steepest
            )
            if number < round(self.resting * PIECES):
                scale = 0.0
            table[:, : _ACCELERATION.stop] *= scale
            table[:, _POSITION] -= table[0, _POSITION].copy()
            turns = round(random.uniform(-1.0, 1.0) * self.heading_rate / base)
            start = random.uniform(-math.pi, math.pi)
            if self.heading == "random":
                # Whole turns in a piece, so that it loops.
                _set_heading(table, start + turns * base * times, dt)
            else:
                heading = self._heading(table, dt)
                if heading is not None:
                    _set_heading(table, heading, dt)
            pieces.append(table)
        return Tracks(np.concatenate(pieces), length, True)


def _set_heading(table: FloatArray, heading: FloatArray, dt: float) -> None:
    """Write the direction and the rate of a heading, (t,), rad, into a table, in place."""
    table[:, _HEADING] = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    table[:, _HEADING_RATE] = np.gradient(heading, dt)


def _waves(waves: tuple[Any, ...], times: FloatArray, rate: float) -> FloatArray:
    """Return a table of sums of sines, (axis, amplitude, multiple of ``rate``, phase) each."""
    table = np.zeros((len(times), REFERENCE_SIZE))
    for axis, amplitude, multiple, phase in waves:
        omega = multiple * rate
        angle = omega * times + phase
        table[:, axis] += amplitude * np.sin(angle)
        table[:, 3 + axis] += amplitude * omega * np.cos(angle)
        table[:, 6 + axis] -= amplitude * omega**2 * np.sin(angle)
    return table


def read_points(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return the times (t,), from 0 on, and positions (t, 3), or (t, 4) with headings, of a CSV
    file.

    Its first line names the columns: t, x, y, z and maybe heading; s, m, rad.

    :raises ConfigError: a file that cannot be read, or whose times do not rise.
    """
    with raised_as(ConfigError, str(path)):
        frame = pd.read_csv(path, dtype=np.float64)
    if [*frame.columns] not in (_COLUMNS[:4], _COLUMNS) or len(frame) < 2:
        raise ConfigError(f"{path}: needs two or more rows with the columns t,x,y,z[,heading]")
    numbers = frame.to_numpy()
    times = numbers[:, 0] - numbers[0, 0]
    if not np.isfinite(numbers).all() or not 0.0 < np.diff(times).min() <= times[-1] <= MAX_SECONDS:
        raise ConfigError(
            f"{path}: every number must be finite, and t rise from row to row, by {MAX_SECONDS:g} s"
            " at most"
        )
    return times, numbers[:, 1:]


def _interpolated(times: FloatArray, points: FloatArray) -> Motion:
    """Return cubic Hermite splines through points, as a function of time."""
    slopes = np.gradient(points, times, axis=0)

    def motion(t: FloatArray) -> FloatArray:
        after = np.clip(np.searchsorted(times, t, side="right"), 1, len(times) - 1)
        before = after - 1
        width = (times[after] - times[before])[:, None]
        u = (t - times[before])[:, None] / width
        mean = points[before] + u * u * (3.0 - 2.0 * u) * (points[after] - points[before])
        bend = u * (1.0 - u) * width * ((1.0 - u) * slopes[before] - u * slopes[after])
        return np.asarray(mean + bend)

    return motion


def least_snap(points: FloatArray, seconds: FloatArray) -> FloatArray:
    """Return the polynomials of degree 7 with the least integral of the squared snap.

    :param points: (m + 1, 3), with rest at both ends.
    :param seconds: (m,), from each point to the next.
    :return: (m, 8, 3), coefficients of rising powers of the time since the segment's start.
    """
    m = len(seconds)
    # In between, the optimum is continuous up to the sixth derivative.
    matrix = np.zeros((m * _COEFFICIENTS, m * _COEFFICIENTS))
    right = np.zeros((m * _COEFFICIENTS, 3))
    row = 0
    for k in range(m):
        own = slice(k * _COEFFICIENTS, (k + 1) * _COEFFICIENTS)
        for time, point in ((0.0, points[k]), (seconds[k], points[k + 1])):
            matrix[row, own] = _powers(time, 0)
            right[row] = point
            row += 1
        for derivative in range(1, _SMOOTH + 1):
            if k > 0:
                before = slice(own.start - _COEFFICIENTS, own.start)
                matrix[row, before] = _powers(seconds[k - 1], derivative)
                matrix[row, own] = -_powers(0.0, derivative)
                row += 1
    for derivative in (1, 2, 3):
        matrix[row, :_COEFFICIENTS] = _powers(0.0, derivative)
        matrix[row + 1, -_COEFFICIENTS:] = _powers(seconds[-1], derivative)
        row += 2
    return np.asarray(np.linalg.solve(matrix, right)).reshape(m, _COEFFICIENTS, 3)


def _powers(time: float, derivative: int) -> FloatArray:
    """Return the derivative of 1, t, t², … at a time."""
    result = np.zeros(_COEFFICIENTS)
    for power in range(derivative, _COEFFICIENTS):
        result[power] = math.perm(power, derivative) * time ** (power - derivative)
    return result


def _evaluate(coefficients: FloatArray, seconds: FloatArray, dt: float) -> FloatArray:
    """Return a table of segments of polynomials."""
    ends = np.cumsum(seconds)
    times = dt * np.arange(math.floor(ends[-1] / dt) + 1)
    table = np.zeros((len(times), REFERENCE_SIZE))
    segment = np.minimum(np.searchsorted(ends, times, side="right"), len(seconds) - 1)
    since = times - np.concatenate([[0.0], ends])[segment]
    for row, (k, time) in enumerate(zip(segment, since, strict=True)):
        for derivative, place in enumerate((_POSITION, _VELOCITY, _ACCELERATION)):
            table[row, place] = _powers(time, derivative) @ coefficients[k]
    return table
