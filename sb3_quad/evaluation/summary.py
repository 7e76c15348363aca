"""The figures of many flights in a few numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.intervals import mean, share
from sb3_quad.evaluation.records import Arrival, Course, Estimate, Figures


def summarise(flights: Flights) -> Figures:
    """The figures of some flights, at least one."""
    done = flights.success
    error, offset = flights.final_error[done], flights.final_offset[done]
    some = bool(done.any())
    return Figures(
        n=flights.n,
        success=share(done),
        collisions=int(flights.collision.sum()),
        out_of_range=int((~done & ~flights.collision).sum()),
        reward=_present(mean(flights.reward)),
        flown=_present(mean(flights.flown)),
        arrivals=[
            Arrival(tolerance=tolerance, share=share(np.isfinite(times)), time=mean(times))
            for tolerance, times in sorted(flights.time_to.items())
        ],
        path=mean(flights.path_length[done]),
        final_error=mean(error),
        final_error_median=float(np.median(error)) if some else None,
        final_error_max=float(error.max()) if some else None,
        final_offset=tuple(offset.mean(axis=0).tolist()) if some else None,
        course=_course(flights) if flights.waypoint_times.shape[1] else None,
    )


def fly_all(pilots: Mapping[str, Any], task: Any, n_episodes: int, seed: int, **keywords: Any) -> dict[str, Figures]:
    """The figures of several controllers on the same episodes, by name.

    :param keywords: further arguments of :func:`~sb3_quad.evaluation.flights.fly`, such as ``vehicle``.
    """
    return {name: summarise(fly(pilot, task, n_episodes, seed, **keywords)) for name, pilot in pilots.items()}


def _course(flights: Flights) -> Course:
    reached = np.isfinite(flights.waypoint_times)
    return Course(
        reached=_present(mean(reached.sum(axis=1))),
        completed=share(reached.all(axis=1)),
        time=mean(flights.waypoint_times[:, -1]),
    )


def _present(estimate: Estimate | None) -> Estimate:
    if estimate is None:
        raise ValueError("no flight has a finite figure")
    return estimate
