"""Moving references: curves, files and functions, as tables with a state for each control step.

A reference is a state: position, velocity, acceleration, heading and its rate. A row of a table is
that state in the order of the last rows of :data:`.state.STATE`. Tables are made once, with the
environment; in flight, :mod:`.tracks` reads them.
"""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.base.validate import Frozen, Number
from sb3_quad.envs.simulation.motions import (
    HARMONICS,
    MAX_SECONDS,
    SINES,
    Motion,
    interpolated,
    least_snap,
    read_points,
    sum_of_sines,
)
from sb3_quad.envs.simulation.state import AHEAD, REFERENCE_PARTS, REFERENCE_SIZE, row_slices

Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Point = tuple[Metres, Metres, Metres]
_POSITION, _VELOCITY, _ACCELERATION, _HEADING, _HEADING_RATE, _AHEAD = row_slices(
    REFERENCE_PARTS
).values()
# Random motion: this many pieces of this many seconds, each a sum of sines that fit into it.
PIECES = 256
PIECE_SECONDS = 10.0
# Curves that need a field, and the name of that field
NEEDED = {"polynomial": "waypoints", "file": "file", "function": "function"}
# Curves by the name of what they are for, whose other fields you may replace
PRESETS: dict[str, tuple[str, StrDict]] = {
    "take_off": ("polynomial", {"waypoints": ((0.0, 0.0, 1.5),), "speed": 1.0}),
    "landing": ("helix", {"size": (0.0, 0.0, -1.0), "speed": 0.2}),
}
CURVES = (*SINES, *NEEDED, "random_smooth", *PRESETS)
# Fields that only some curves use, and these curves
USED_BY = {
    "speed": ("circle", "figure_eight", "helix", "lissajous", "polynomial", "random_smooth"),
    "size": ("circle", "figure_eight", "helix", "lissajous"),
    "acceleration": ("random_smooth",),
    "resting": ("random_smooth",),
    "waypoints": ("polynomial",),
    "file": ("file",),
    "function": ("function",),
    "duration": ("helix", "function"),
}


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
    """A reference that starts at the target of an episode and moves; units m, s, rad.

    The axes of a curve are those of the world. With ω such that the greatest speed is ``speed``,
    its position at the time t relative to its start is:

    - ``hover``: it stays.
    - ``circle``: (A cos ωt - A, A sin ωt, 0)
    - ``figure_eight``: (A sin ωt, B sin 2ωt, C sin ωt)
    - ``helix``: the circle, and C upwards in each turn, for ``duration``
    - ``lissajous``: (A sin ωt, B sin 2ωt, C sin 3ωt)
    - ``polynomial``: the least snap through ``waypoints``, from rest to rest
    - ``file``: cubic Hermite splines through the rows of a CSV file: t, x, y, z, maybe heading
    - ``function``: what ``function`` returns, for ``duration``
    - ``random_smooth``: one of 256 random sums of sines, which repeat after 10 s
    - ``take_off``: a polynomial 1.5 m up, at up to 1 m/s
    - ``landing``: straight down at 0.2 m/s, a helix without radius, through the ground
    """

    curve: Literal[CURVES] = "figure_eight"  # type: ignore[valid-type]
    """which curve; not needed with waypoints, a file or a function"""
    speed: PositiveFloat = Field(default=2.0, le=100)
    """greatest speed, m/s; for random_smooth a limit, below which each piece has its own speed"""
    size: Point | None = None
    """A, B and C, m; None: 2, 1 and 0.5 (figure_eight: 0)"""
    acceleration: PositiveFloat = Field(default=8.0, le=1e3)
    """random_smooth: limit of the acceleration, m/s²"""
    resting: float = Field(default=0.0, ge=0, le=1)
    """random_smooth: share of pieces that rest"""
    heading: Literal["path", "random"] | Number | None = None
    """heading at the start, rad; path: along the velocity; random: another one for each piece of
    random_smooth, with a rate up to heading_rate; None: no heading is commanded
    """
    heading_rate: float = Field(default=0.0, ge=-20, le=20)
    """rad/s, for a heading that is a number; rounded to whole turns in 600 s (random_smooth: 10 s),
    so that curves loop
    """
    waypoints: tuple[Point, ...] | None = None
    """polynomial: two or more points, relative to the start, which is added if they do not begin
    there"""
    file: str | Path | None = None
    """file: path of the CSV file; times and positions count from its first row"""
    function: Any = Field(default=None, exclude=True)
    """function: times (t,) to positions (t, 3), or (t, 4) with headings; it is not saved"""
    duration: PositiveFloat = Field(default=20.0, le=MAX_SECONDS)
    """helix and function: time after which they rest, s"""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, data: Any) -> Any:
        """A string is the name of a curve or the path of a CSV file; a function is itself a curve.

        If no curve is named, a field that only one curve needs decides which it is.
        """
        if isinstance(data, (str, Path)):
            field = "file" if str(data).endswith(".csv") else "curve"
            data = {field: data}
        elif callable(data):
            data = {"function": data}
        if isinstance(data, dict):
            if data.get("curve") in [*PRESETS]:
                curve, fields = PRESETS[data["curve"]]
                data = {**fields, **data, "curve": curve}
            for curve, field in NEEDED.items():
                if data.get(field) is not None:
                    return {"curve": curve, **data}
        return data

    @model_validator(mode="after")
    def _check_complete(self) -> "Reference":
        needed = NEEDED.get(self.curve)
        if needed and not getattr(self, needed):
            raise ValueError(f"curve {self.curve}: needs {needed}")
        # Zips contain every field, so only a value other than the default was given on purpose.
        for name, curves in USED_BY.items():
            default = type(self).model_fields[name].default
            if self.curve not in curves and getattr(self, name) != default:
                raise ValueError(
                    f"{name}: curve {self.curve} does not use it, only {', '.join(curves)};"
                    " remove it, or name such a curve"
                )
        if self.heading == "random" and self.curve != "random_smooth":
            raise ValueError("heading 'random': only with curve random_smooth")
        if self.heading_rate and self.heading in (None, "path"):
            raise ValueError("heading_rate: needs a heading that is a number or 'random'")
        return self

    def tracks(self, dt: float) -> Tracks:
        """Return the tables for control steps of ``dt``, s.

        :raises ConfigError: a file or function without valid positions.
        """
        if self.curve == "random_smooth":
            return self._random_tracks(dt)
        with raised_as(ConfigError, f"reference {self.curve}"):
            motion, seconds = self._motion(dt)
        if seconds > MAX_SECONDS:
            raise ConfigError(
                f"reference {self.file or self.curve}: takes {seconds:g} s; at most"
                f" {MAX_SECONDS:g} s are possible: make it shorter or faster"
            )
        # The end may lie within the last control step. Rounding errors must not add a step.
        steps = math.ceil(seconds / dt - 1e-6)
        loops = self.curve in SINES and self.curve != "helix"
        if loops and self.heading_rate:
            # The heading must loop, too; with whole turns in many periods its rate is nearly kept.
            steps *= math.ceil(MAX_SECONDS / dt / steps)
        # One more row if it does not loop: the end, at which it rests.
        with raised_as(ConfigError, f"reference {self.curve}"):
            table = self._table(motion, steps + (not loops), dt, loops, seconds)
        return Tracks(table, len(table), loops)

    def _motion(self, dt: float) -> tuple[Motion, float]:
        """Return a curve as a function of time, and how long it takes, s."""
        if self.curve == "polynomial":
            return self._polynomial()
        if self.curve == "file":
            times, points = read_points(Path(str(self.file)))
            return interpolated(times, points), times[-1]
        if self.curve == "function":
            return self.function, self.duration
        size = self.size or (2.0, 1.0, 0.0 if self.curve == "figure_eight" else 0.5)
        sines = SINES[self.curve]
        # The greatest speed per ω, on a fine grid
        grid = np.linspace(0.0, 2.0 * math.pi, 7201)
        way = np.gradient(np.stack(sines(grid, *size)), grid, axis=1)
        length = 2.0 * math.pi * np.linalg.norm(way, axis=0).max()
        # With fewer than 10 control steps in a round, differences no longer approximate velocities.
        fastest = length / (10 * dt)
        if 0.0 < fastest < self.speed:
            raise ConfigError(
                f"reference {self.curve}: with this size it reaches {fastest:.3g} m/s, less than"
                f" speed {self.speed:g}; lower speed, or enlarge size"
            )
        # A whole number of control steps, so that it loops without a jump.
        seconds = max(round(length / self.speed / dt), 10) * dt
        omega = 2.0 * math.pi / seconds
        if self.curve == "helix":
            seconds = self.duration
        return lambda t: np.stack(sines(omega * t, *size), axis=1), seconds

    def _table(
        self, motion: Motion, steps: int, dt: float, loops: bool, end: float = math.inf
    ) -> FloatArray:
        """Return a table of a function, its derivatives by central differences; if it does not
        loop, it rests in the last row.

        :param end: time after which a motion that does not loop rests, s.
        :raises ValueError: the function returns something other than positions.
        """
        # If it loops, add two steps on each side, so that both differences have their neighbours.
        more = 2 * loops
        times = dt * np.arange(-more, steps + more, dtype=np.float64)
        if not loops:
            times = np.minimum(times, end)
        values = np.asarray(motion(times), dtype=np.float64)
        columns = values.size / len(times)
        if values.ndim != 2 or columns not in (3, 4) or not np.isfinite(values).all():
            raise ValueError(
                f"gives shape {values.shape} for {len(times)} times; must be finite numbers of"
                f" shape ({len(times)}, 3) or, with a heading, ({len(times)}, 4)"
            )
        table = np.zeros((len(times), REFERENCE_SIZE))
        table[:, _POSITION] = values[:, :3] - values[more, :3]
        table[:, _VELOCITY] = np.gradient(table[:, _POSITION], dt, axis=0)
        table[:, _ACCELERATION] = np.gradient(table[:, _VELOCITY], dt, axis=0)
        heading: Any = None
        if columns == 4 and self.heading is not None:
            raise ValueError("gives headings of its own; remove heading")
        if columns == 4:
            heading = np.unwrap(values[:, 3])
        elif self.heading == "path":
            heading = np.unwrap(np.arctan2(table[:, 4], table[:, 3]))
        elif isinstance(self.heading, float):
            turn = 2.0 * math.pi / (steps * dt)
            rate = turn * round(self.heading_rate / turn) if loops else self.heading_rate
            heading = self.heading + rate * times
        if heading is not None:
            _set_heading(table, heading, dt)
        table = table[more : more + steps]
        if not loops:
            table[-1, _VELOCITY.start : _ACCELERATION.stop] = 0.0
            table[-1, _HEADING_RATE] = 0.0
        later = np.arange(steps) + round(AHEAD / dt)
        accelerations = table[:, _ACCELERATION]
        table[:, _AHEAD] = accelerations.take(later, axis=0, mode="wrap" if loops else "clip")
        return table

    def _polynomial(self) -> tuple[Motion, float]:
        """Return the motion of the least snap through the waypoints (Mellinger and Kumar, "Minimum
        snap trajectory generation and control for quadrotors", ICRA 2011), and its duration, s.

        The times between waypoints are proportional to the distances; then the whole motion is
        stretched so that its greatest speed is ``speed``.
        """
        points = np.array(self.waypoints)
        if points[0].any():
            points = np.vstack([np.zeros(3), points])
        seconds = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(points) < 2 or not seconds.all():
            raise ConfigError(
                "reference polynomial: two consecutive waypoints are the same point, or the only"
                " one is the start; give others"
            )
        grid = np.linspace(0.0, seconds.sum(), 5000)
        way = np.gradient(least_snap(points, seconds)(grid), grid, axis=0)
        seconds = seconds * np.linalg.norm(way, axis=1).max() / self.speed
        return least_snap(points, seconds), seconds.sum()

    def _random_tracks(self, dt: float) -> Tracks:
        """Return random pieces. They are the same in every environment; which of them a row flies
        comes from its own stream.
        """
        length = round(PIECE_SECONDS / dt)
        base = 2.0 * math.pi / (length * dt)
        random = np.random.default_rng(0)
        pieces = []
        for number in range(PIECES):
            amplitudes: Any = random.normal(size=(3, len(HARMONICS))) / HARMONICS**1.5
            amplitudes[2] *= 0.5
            phases = random.uniform(0.0, 2.0 * math.pi, size=amplitudes.shape)
            motion = partial(sum_of_sines, base, phases, amplitudes)
            table = self._table(motion, length, dt, True)
            speed = self.speed * random.uniform(0.1, 1.0)
            greatest = np.linalg.norm(table[:, _VELOCITY], axis=1).max()
            steepest = np.linalg.norm(table[:, _ACCELERATION], axis=1).max()
            scale = min(speed / greatest, self.acceleration / steepest)
            if number < self.resting * PIECES:
                scale = 0.0
            table[:, : _ACCELERATION.stop] *= scale
            table[:, _AHEAD] *= scale
            if scale == 0.0 and self.heading == "path":
                # It has no path, so its heading rests, too, as in hover.
                _set_heading(table, np.zeros(length), dt)
            # Whole turns in a piece, so that it loops.
            turns = round(random.uniform(-1.0, 1.0) * self.heading_rate / base)
            start = random.uniform(-math.pi, math.pi)
            if self.heading == "random":
                angle = start + turns * base * dt * np.arange(length, dtype=np.float64)
                _set_heading(table, angle, dt)
            pieces.append(table)
        return Tracks(np.concatenate(pieces), length, True)


def _set_heading(table: FloatArray, heading: FloatArray, dt: float) -> None:
    """Write the direction and the rate of a heading, (t,), rad, into a table, in place."""
    table[:, _HEADING] = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    table[:, _HEADING_RATE] = np.gradient(heading, dt)[:, None]
