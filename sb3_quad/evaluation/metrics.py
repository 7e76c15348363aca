"""Many flights in a few metrics."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation.flights import Flights, Hook, fly
from sb3_quad.evaluation.scenarios.parts import Vector
from sb3_quad.evaluation.statistics import Estimate, bootstrap, mean, share
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle

NEAR = 0.1  # m


class Moment(Frozen):
    """Something that a flight comes to, or never does."""

    share: Estimate = Field(description="of the flights that came to it")
    time: Estimate | None = Field(description="mean time until then of those flights, s; None: no flight did")


class Arrival(Moment):
    """Arrival within one tolerance."""

    tolerance: float = Field(description="m")


class Course(Frozen):
    """A course of waypoints."""

    reached: Estimate = Field(description="mean number of waypoints reached")
    completed: Estimate = Field(description="share of the flights that reached all")
    time: Estimate | None = Field(description="mean time until the last waypoint of those flights, s")


class Metrics(Frozen):
    """What one controller reached in one scenario; path and errors are of the flights that were not lost."""

    n: int = Field(description="flights")
    success: Estimate = Field(description="share that survived and ended at the target")
    survival: Estimate = Field(description="share that neither touched the ground nor left the range")
    collisions: int = Field(description="flights that touched the ground")
    out_of_range: int = Field(description="flights that left the range")
    reward: Estimate = Field(description="mean sum of rewards (Eqs. 4.5-4.9)")
    flown: Estimate = Field(description="mean time flown, until lost or the end, s")
    arrivals: list[Arrival] = Field(description="by tolerance, the tightest first")
    path: Estimate | None = Field(description="mean length of the path over the whole episode, m")
    final_error: Estimate | None = Field(description="mean |r - r_T| at the end, m")
    final_error_median: float | None = Field(description="m")
    final_error_95: Estimate | None = Field(description="its 95 % quantile, m")
    final_error_max: float | None = Field(description="m")
    final_offset: Vector | None = Field(description="mean r - r_T at the end, world frame, m")
    stabilised: Moment = Field(description="which flights got stable again, and when")
    sideways: Estimate | None = Field(description="mean largest distance from the straight way, m; None: there is none")
    course: Course | None = Field(description="of scenarios with waypoints")


def summarise(flights: Flights) -> Metrics:
    """The metrics of some flights, at least one."""
    done = flights.survival
    error, offset = flights.final_error[done], flights.final_offset[done]
    some, reached = bool(done.any()), np.isfinite(flights.waypoint_times)
    course = None
    if reached.shape[1]:
        count, time = bootstrap(reached.sum(axis=1, dtype=np.float64)), mean(flights.waypoint_times[:, -1])
        course = Course(reached=count, completed=share(reached.all(axis=1)), time=time)
    return Metrics(
        n=flights.n,
        success=share(flights.success),
        survival=share(done),
        collisions=int(flights.collision.sum()),
        out_of_range=int((~done & ~flights.collision).sum()),
        reward=bootstrap(flights.reward),
        flown=bootstrap(flights.flown),
        arrivals=[Arrival(tolerance=each, **_moment(times)) for each, times in sorted(flights.time_to.items())],
        path=mean(flights.path_length[done]),
        final_error=mean(error),
        final_error_median=float(np.median(error)) if some else None,
        final_error_95=bootstrap(error, lambda values, axis: np.quantile(values, 0.95, axis=axis)) if some else None,
        final_error_max=float(error.max()) if some else None,
        final_offset=tuple(offset.mean(axis=0).tolist()) if some else None,
        stabilised=Moment(**_moment(flights.stabilised)),
        sideways=mean(flights.sideways[done]),
        course=course,
    )


def _moment(times: FloatArray) -> dict[str, Any]:
    return {"share": share(np.isfinite(times)), "time": mean(times)}


class Settling(Hook):
    """When each flight came to stay within 0.1 m of its target, s; the whole time if it never did."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.settled, self.period = np.zeros(state.n), vehicle.control_step

    def after_step(self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray) -> None:
        self.settled[flying & (state.distance > NEAR)] = (step + 1) * self.period


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> dict[str, Any]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes, or never stays, within 0.1 m counts as ``time_limit`` control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_steps": time_limit}
    recovery = Flights.concatenate([fly(expert, "state_recovery", episodes, seed, **keywords) for seed in seeds])
    settling = Settling()
    tracking = fly(expert, "target_tracking", episodes, seeds[0], hooks=[settling], **keywords)
    stays = np.where(tracking.survival, settling.settled, time_limit * vehicle.control_step)
    times = np.nan_to_num(tracking.time_to[NEAR], nan=time_limit * vehicle.control_step)
    return {
        "recovery_survival": round(float(recovery.survival.mean()), 5),
        "recovery_episodes": recovery.n,
        "tracking_survival": round(float(tracking.survival.mean()), 5),
        "tracking_episodes": tracking.n,
        "time_to_0_1_m": round(float(times.mean()), 3),  # mean time until 0.1 m from the target, s
        "time_to_stay": round(float(stays.mean()), 3),  # until it stays there, s
        "tracking_reward": round(float(tracking.reward.mean()), 3),  # mean (Eqs. 4.5-4.9)
        "observation_noise": 0.0,
        "seeds": [*seeds],
    }
