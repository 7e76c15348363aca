"""An exported file against the policy it came from, in flights of the policy: the largest
difference.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.errors import ExportError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.evaluation.flights import Hook, fly_settings
from sb3_quad.export.load import Call
from sb3_quad.simulation.frames import ObservationSettings
from sb3_quad.simulation.kernel import physical_features
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, turn_features
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.simulation.tasks import Task
from sb3_quad.vehicles.layout import Turn
from sb3_quad.vehicles.vehicle import Vehicle

N_OBSERVATIONS = 10_000
SHORT, LONG = (
    2,
    1000,
)  # control steps of the flights of a policy of the present features, and of one with a state
# Of the range between least and greatest output: far above rounding, far below any mistake
TOLERANCE = 1e-4
_WIDE = {"target_distance": 30.0, "nearest_target": 0.0, "velocity_std": 4.0, "body_rates_std": 8.0}
_NEAR = Task(
    name="near", target_distance=1.0, nearest_target=0.0
)  # where a position integral is at work at once
_ROUNDING = 2e-6  # relative, of what decides whether the position integral is at work


class Reference(NamedTuple):
    """A trained policy in its own environment: what an exported file must agree with.

    :param mean: μ of Eq. 3.16, (18,), as in training; ``std`` σ, likewise.
    :param vehicle: in the layout that the policy knows.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s).
    :param observation: the frames that the policy sees.
    :param turn: from the vehicle's own axes and rotors, which are the file's, to that layout.
    """

    model: BaseAlgorithm
    vehicle: Vehicle
    mean: FloatArray = DEFAULT_MEAN
    std: FloatArray = DEFAULT_STD
    output: str = "thrusts"
    observation: ObservationSettings = ObservationSettings()
    turn: Turn = Turn()

    @property
    def turned_features(self) -> FloatArray:
        """(18, 18), from features in the vehicle's own body frame to those that the policy knows."""
        return turn_features(self.turn)

    @property
    def own_mean(self) -> FloatArray:
        """μ in the vehicle's own body frame, (18,)."""
        return self.mean @ self.turned_features

    def results(self, actions: npt.ArrayLike) -> FloatArray:
        """Rotor thrusts, N (Eq. 3.18), or speeds, rad/s (Eq. 2.4), of actions of any shape; in
        float64.
        """
        thrusts = self.vehicle.action_to_thrust(np.asarray(actions, dtype=np.float64))
        return (
            thrusts
            if self.output == "thrusts"
            else np.sqrt(thrusts / self.vehicle.thrust_coefficient)
        )


class Comparison(Hook):
    """Asks a file at each control step of the policy's flights; it keeps its own state from a
    flight's start to its end.

    :ivar error: the largest difference of any rotor so far, N or rad/s.
    :ivar count: how many observations the file has been asked about.
    """

    def __init__(self, reference: Reference, call: Call) -> None:
        self._reference, self._call, seen = reference, call, reference.observation
        integral = seen.position_integral
        self._limits = (
            {"position": integral.distance, "velocity": integral.speed} if integral else {}
        )
        self._state, self._sure, self.count, self.error = None, np.True_, 0, 0.0
        self._turned, self._order = (
            reference.turned_features.astype(np.float32),
            [*reference.turn.order],
        )

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        if self._reference.observation.is_extended:
            features = physical_features(state)
        else:
            features = (observation * self._reference.std + self._reference.mean).astype(np.float32)
        for (
            group,
            limit,
        ) in (
            self._limits.items()
        ):  # so close to one, rounding may begin to integrate a step later, or earlier
            self._sure = self._sure & (
                np.abs(np.linalg.norm(features[:, GROUPS[group]], axis=1) / limit - 1.0) > _ROUNDING
            )
        results, self._state = self._call(features @ self._turned, self._state)
        self._results = results[:, self._order]
        self._compared = flying & self._sure

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        difference = np.abs(self._results - self._reference.results(actions))[self._compared]
        self.error = float(np.max(difference, initial=self.error))  # NaN stays
        self.count += len(difference)


def compare(reference: Reference, call: Call, by: str, n: int = N_OBSERVATIONS) -> Comparison:
    """Compare a file with the policy that it came from, in its flights.

    They start at any attitude, up to 30 m from the target, with velocities of N(0, 4 m/s) and body
    rates of N(0, 8 rad/s) per axis, twice what an episode starts with. A policy of the present
    features flies two steps each time, so that half of the observations are such starts, and both
    see noise. The flights of one with a state are longer, without noise, and half of them start
    within 1 m.

    :param by: what runs the file.
    :param n: observations, at most: a flight may end early.
    :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not
        finite.
    """
    has_state = reference.observation.is_extended
    steps = LONG if has_state else SHORT
    task: dict[str, Any] = {"task": "recovery_and_tracking", "task_kwargs": _WIDE}
    seen = {
        "observation_mean": reference.mean,
        "observation_std": reference.std,
        **dict(reference.observation),
    }
    settings = FlightSettings().with_changes(
        **({"task": {"recovery_and_tracking": 1.0, _NEAR: 1.0}} if has_state else task),
        **seen,
        vehicle=reference.vehicle,
        noise=0.0 if has_state else 0.05,
        max_episode_steps=steps,
    )
    comparison = Comparison(reference, call)
    fly_settings(reference.model, settings, row_seeds(0, max(n // steps, 1)), hooks=[comparison])
    allowed = TOLERANCE * float(np.ptp(reference.results([-1.0, 1.0])))
    if not comparison.error <= allowed:  # also where it is NaN
        difference = f"differs from the trained one by {comparison.error:.3g}, {allowed:.3g} is allowed ({by})"
        raise ExportError(f"the exported policy {difference}; nothing was written")
    return comparison
