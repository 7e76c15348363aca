"""An exported file against the policy it came from, in flights of the policy: the largest
difference.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.errors import ExportError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, StrDict
from sb3_quad.evaluation.flights import Hook, fly_settings
from sb3_quad.export.load import Call
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.observation import (
    GROUPS,
    OBSERVATION_SIZE,
    turn_features,
)
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.simulation.tasks import Task
from sb3_quad.vehicles.vehicle import Vehicle

N_OBSERVATIONS = 10_000
# Control steps of a flight: of a policy that sees the present features only, of one with a state.
SHORT, LONG = 2, 1000
# Of the range between least and greatest output: far above rounding, far below any mistake.
TOLERANCE = 1e-4
WIDE = {"target_distance": 30.0, "nearest_target": 0.0, "velocity_std": 4.0, "body_rates_std": 8.0}
# Here the position integral is at work from the first step on.
NEAR = Task(name="near", target_distance=1.0, nearest_target=0.0)
ROUNDING = 2e-6  # relative, of the limits within which the position integral is at work


class Reference:
    """A trained policy in its own environment: an exported file must agree with it.

    :ivar vehicle: in the layout that the policy knows.
    :ivar mean: μ of Eq. 3.16, (OBSERVATION_SIZE,), as in training; ``std`` σ, likewise.
    :ivar observation: the frames that the policy sees.
    :ivar turn: from the vehicle's own axes and rotors, which are the file's, to that layout.

    :param settings: how the policy flies.
    :param vehicle: that it flies; its layout may be another.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s).
    :raises ConfigError: settings that the environment refuses, a layout that does not fit.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        settings: FlightSettings,
        vehicle: Vehicle,
        output: str = "thrusts",
    ) -> None:
        layout = settings.layout
        # A batch of one row checks the settings and resolves vehicle and scaling.
        settings = settings.with_changes(vehicle=vehicle, rotor_layout=layout)
        row = QuadcopterBatch(1, settings, n_threads=1)
        self.model = model
        self.output = output
        self.vehicle = row.vehicle_list[0]
        self.mean = row.mean[:, 0]
        self.std = row.std[:, 0]
        self.observation = row.observation
        self.turn = vehicle.turn_to(layout)

    @property
    def own_mean(self) -> FloatArray:
        """μ in the vehicle's own body frame, (OBSERVATION_SIZE,)."""
        return self.mean @ turn_features(self.turn)

    def results(self, actions: Any) -> FloatArray:
        """Return rotor thrusts, N (Eq. 3.18), or speeds, rad/s (Eq. 2.4), of actions of any shape,
        in float64.
        """
        thrusts = self.vehicle.action_to_thrust(np.asarray(actions, dtype=np.float64))
        if self.output == "thrusts":
            return thrusts
        return np.sqrt(thrusts / self.vehicle.thrust_coefficient)


class Comparison(Hook):
    """Runs a file at each control step of the policy's flights. It keeps the file's state from a
    flight's start to its end.

    :ivar error: the largest difference of any rotor so far, N or rad/s.
    :ivar count: how many observations the file has seen.
    """

    def __init__(self, reference: Reference, call: Call) -> None:
        self._reference = reference
        self._call = call
        self._turned = turn_features(reference.turn).astype(np.float32)
        self._state = None
        self._sure = np.True_
        self.count = 0
        self.error = 0.0

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        # The present frame comes first in an observation. Unscaled, it is the file's input.
        scaled = observation[:, :OBSERVATION_SIZE]
        features = (scaled * self._reference.std + self._reference.mean).astype(np.float32)
        integral = self._reference.observation.position_integral
        if integral is not None:
            # The position integral is a part of the observed position, and the file has its own.
            features[:, GROUPS["position"]] = state.position - state.target
            # So close to a limit, rounding may begin to integrate one step earlier or later.
            for group, limit in (("position", integral.distance), ("velocity", integral.speed)):
                norm = np.linalg.norm(features[:, GROUPS[group]], axis=1)
                self._sure = self._sure & (np.abs(norm / limit - 1.0) > ROUNDING)
        # The file flies the vehicle in its own axes and order of rotors.
        results, self._state = self._call(features @ self._turned, self._state)
        self._results = results[:, self._reference.turn.order]
        self._compared = flying & self._sure

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        difference = np.abs(self._results - self._reference.results(actions))[self._compared]
        self.error = float(np.max(difference, initial=self.error))  # NaN stays
        self.count += len(difference)


def compare(reference: Reference, call: Call, by: str, n: int = N_OBSERVATIONS) -> Comparison:
    """Compare a file with the policy that it came from, in the policy's flights.

    The flights start at any attitude, up to 30 m from the target, with velocities of N(0, 4 m/s)
    and body rates of N(0, 8 rad/s) per axis, twice what an episode starts with. A policy of the
    present features flies two steps each time, so that half of the observations are such starts,
    and both see noise. The flights of a policy with a state are longer, without noise, and half of
    them start within 1 m.

    :param by: the program that runs the file, for the message.
    :param n: observations, at most: a flight may end early.
    :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not
        finite.
    """
    # Far and fast starts, or long flights for a policy with a state.
    changes: StrDict = {"task": "recovery_and_tracking", "task_kwargs": WIDE, "noise": 0.05}
    steps = SHORT
    if reference.observation.is_extended:
        changes = {"task": {"recovery_and_tracking": 1.0, NEAR: 1.0}, "noise": 0.0}
        steps = LONG
    settings = FlightSettings().with_changes(
        **changes,
        **dict(reference.observation),
        observation_mean=reference.mean,
        observation_std=reference.std,
        vehicle=reference.vehicle,
        max_episode_steps=steps,
    )
    comparison = Comparison(reference, call)
    fly_settings(reference.model, settings, row_seeds(0, max(n // steps, 1)), hooks=[comparison])
    allowed = TOLERANCE * float(np.ptp(reference.results([-1.0, 1.0])))
    # Negated, so that NaN fails as well.
    if not comparison.error <= allowed:
        raise ExportError(
            f"the exported policy differs from the trained one by {comparison.error:.3g}, "
            f"{allowed:.3g} is allowed ({by}); nothing was written"
        )
    return comparison
