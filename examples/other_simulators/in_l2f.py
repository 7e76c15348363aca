r"""Fly exported agents in l2f, the simulator of RAPTOR and of Learning to Fly.

RAPTOR's policy flies there, too, for comparison.

    sb3-quad export any-quadcopter --format onnx --vehicle l2f_crazyflie \
        -o any-quadcopter@l2f_crazyflie.onnx
    python examples/other_simulators/in_l2f.py any-quadcopter@l2f_crazyflie.onnx

l2f: its Crazyflie of 30.6 g, whose rotors spin up with 18/s and down with 4/s, numbered as Bitcraze
numbers them; quaternions w, x, y, z; an action is linear in a rotor's speed, -1 its least and 1 its
greatest; its step is the control step.
"""

import json

import l2f
import numpy as np
from flights import Array, Cell, Raptor, State, main

FIELDS = {
    "position": "position",
    "quaternion": "orientation",
    "velocity": "linear_velocity",
    "body_rates": "angular_velocity",
}


class L2F:
    """n vehicles; n is 4, 8, 16 and so on, since l2f has a module for each number."""

    ground = 0.0145  # m, as in l2f_crazyflie.yaml

    def __init__(self, n: int) -> None:
        self.n = n
        self._vector = getattr(l2f, f"vector{n}")
        self._device = l2f.Device()
        self._environment = self._vector.VectorEnvironment()
        self._rng = self._vector.VectorRng()
        self._parameters = self._vector.VectorParameters()
        self._now = self._vector.VectorState()
        self._next = self._vector.VectorState()
        self._vector.initialize_rng(self._device, self._rng, 0)
        self._vector.initialize_environment(self._device, self._environment)
        self._vector.initial_parameters(self._device, self._environment, self._parameters)
        # Mass and rotors of the vehicle can only be read as JSON.
        single = l2f.Environment()
        parameters = self._parameters.parameters[0]
        l2f.initialize_environment(self._device, single)
        dynamics = json.loads(l2f.parameters_to_json(self._device, single, parameters))["dynamics"]
        positions = np.array(dynamics["rotor_positions"])
        torques = np.array(dynamics["rotor_torque_directions"])
        self.rotors = np.column_stack([positions[:, :2], torques[:, 2]])
        self.hover = dynamics["mass"] * 9.81 / 4.0
        # Coefficients of the thrust (N), a polynomial in the share of the greatest speed.
        self._curve = np.array(dynamics["rotor_thrust_coefficients"][0])

    def reset(self, start: State) -> None:
        hover = np.full(4, self._shares(np.array(self.hover)))
        self._vector.initial_state(self._device, self._environment, self._parameters, self._now)
        for row, state in enumerate(self._now.states):
            state.rpm = hover
            for ours, theirs in FIELDS.items():
                setattr(state, theirs, getattr(start, ours)[row])

    def step(self, thrusts: Array) -> None:
        actions = (2.0 * self._shares(thrusts) - 1.0).astype(np.float32)
        self._vector.step(
            self._device,
            self._environment,
            self._parameters,
            self._now,
            actions,
            self._next,
            self._rng,
        )
        self._now.assign(self._next)

    def state(self) -> State:
        fields = {}
        for ours, theirs in FIELDS.items():
            fields[ours] = np.array([getattr(state, theirs) for state in self._now.states])
        return State(**fields)

    def thrusts(self, speeds: Array) -> Array:
        return np.polynomial.polynomial.polyval(speeds, self._curve)

    def _shares(self, thrusts: Array) -> Array:
        c, b, a = self._curve
        root = np.sqrt(np.maximum(b * b - 4.0 * a * (c - thrusts), 0.0))
        return ((-b + root) / (2.0 * a)).clip(0.0, 1.0)


CELLS = {"l2f_crazyflie": Cell("l2f_crazyflie", "no drag", L2F)}

if __name__ == "__main__":
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor})
