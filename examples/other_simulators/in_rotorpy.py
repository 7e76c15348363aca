r"""Fly exported agents in RotorPy (University of Pennsylvania).

Its SE3 controller and RAPTOR's policy fly there, too, for comparison.

    sb3-quad export any-quadcopter --format onnx --vehicle rotorpy_crazyflie \
        -o any-quadcopter@rotorpy_crazyflie.onnx
    python examples/other_simulators/in_rotorpy.py any-quadcopter@rotorpy_crazyflie.onnx \
        --cells crazyflie crazyflie_wind

RotorPy: rotors front left, front right, back right, back left; quaternions x, y, z, w. Its drag of
rotors and body and its translational lift are on. SE3 sees the true state, the others observations
with noise.
"""

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from flights import CONTROL_STEP, Array, Cell, Raptor, Setpoint, State, main
from rotorpy.controllers.quadrotor_control import BatchedSE3Control
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams
from rotorpy.wind.default_winds import BatchedConstantWind, BatchedNoWind, BatchedSinusoidWind

DEVICE = torch.device("cpu")
torch.set_default_dtype(torch.float64)
torch.set_num_threads(1)


def to_fields(state: State) -> dict[str, torch.Tensor]:
    """A state in RotorPy's form."""
    fields = {
        "x": state.position,
        "v": state.velocity,
        "q": np.roll(state.quaternion, -1, axis=1),
        "w": state.body_rates,
    }
    return {name: torch.tensor(values) for name, values in fields.items()}


def parameters_of(vehicle: str, n: int) -> BatchedMultirotorParams:
    """The parameters of n vehicles of ``rotorpy.vehicles``."""
    module = importlib.import_module(f"rotorpy.vehicles.{vehicle}_params")
    return BatchedMultirotorParams([module.quad_params] * n, n, DEVICE)


class RotorPy:
    """n vehicles of ``rotorpy.vehicles`` in a wind.

    :param wind: function from the number of vehicles to one of RotorPy's wind profiles.
    """

    def __init__(self, vehicle: str, wind: Callable[[int], Any], n: int) -> None:
        parameters = importlib.import_module(f"rotorpy.vehicles.{vehicle}_params").quad_params
        # Runge-Kutta steps in a control step: two in each time constant of the motors.
        self._substeps = max(2, round(2 * CONTROL_STEP / parameters["tau_m"]))
        self.n = n
        self._rows = torch.arange(n)
        self._wind = wind(n)
        self._k_eta = parameters["k_eta"]
        self._speeds = (parameters["rotor_speed_min"], parameters["rotor_speed_max"])
        self.hover = parameters["mass"] * 9.81 / 4.0
        # m, as in our vehicle files.
        self.ground = {"crazyflie": 0.0145, "hummingbird": 0.06}[vehicle]
        positions = np.stack([*parameters["rotor_pos"].values()])
        self.rotors = np.column_stack([positions[:, :2], parameters["rotor_directions"]])
        self.parameters = parameters_of(vehicle, n)

    def reset(self, start: State) -> None:
        self._time = 0.0
        speeds = np.full((self.n, 4), np.sqrt(self.hover / self._k_eta))
        self.fields = to_fields(start)
        self.fields["rotor_speeds"] = torch.tensor(speeds)
        self.fields["wind"] = torch.zeros(self.n, 3)
        self._vehicles = BatchedMultirotor(
            self.parameters, self.n, self.fields, DEVICE, integrator="rk4"
        )

    def step(self, thrusts: Array) -> None:
        command = {"cmd_motor_speeds": torch.tensor(np.sqrt(thrusts.clip(0.0) / self._k_eta))}
        duration = CONTROL_STEP / self._substeps
        for _ in range(self._substeps):
            self.fields["wind"] = self._wind.update(self._time, self.fields["x"]).double()
            self.fields = self._vehicles.step(self.fields, command, duration, self._rows)
            self._time += duration

    def state(self) -> State:
        quaternion = np.roll(self.fields["q"].numpy(), 1, axis=1)
        return State(
            self.fields["x"].numpy(),
            quaternion,
            self.fields["v"].numpy(),
            self.fields["w"].numpy(),
        )

    def thrusts(self, speeds: Array) -> Array:
        low, high = self._speeds
        return self._k_eta * (low + (high - low) * speeds) ** 2


class SE3:
    """RotorPy's own geometric controller, on the true state.

    Its gains come from RotorPy's vehicle file.
    """

    def __init__(self, parameters: BatchedMultirotorParams) -> None:
        self._control = BatchedSE3Control(parameters, parameters.num_drones, DEVICE)

    def reset(self, n: int) -> None:
        pass

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
        n = len(state.position)
        wanted = {
            "x": setpoint.position,
            "x_dot": np.tile(setpoint.velocity, (n, 1)),
            "x_ddot": np.tile(setpoint.accelerations[0], (n, 1)),
            "yaw": np.zeros(n),
            "yaw_dot": np.zeros(n),
        }
        flat = {name: torch.tensor(values) for name, values in wanted.items()}
        commands = self._control.update(0.0, to_fields(state), flat)
        return np.asarray(commands["cmd_motor_thrusts"].numpy())


def gusts(n: int) -> BatchedSinusoidWind:
    """Sines of 2 m/s and 0.3 Hz along each axis, each with its own phase."""
    phase = torch.tensor(np.random.default_rng(0).uniform(0.0, 1.0 / 0.3, (n, 3)))
    return BatchedSinusoidWind(torch.full((n, 3), 2.0), torch.full((n, 3), 0.3), phase)


WINDS = {
    "": ("drag", BatchedNoWind),
    "_wind": ("drag, wind 4 m/s", partial(BatchedConstantWind, wx=4.0, wy=0.0, wz=0.0)),
    "_gusts": ("drag, sine gusts 2 m/s", gusts),
}
CELLS = {}
for vehicle in ("crazyflie", "hummingbird"):
    for suffix, (conditions, wind) in WINDS.items():
        CELLS[vehicle + suffix] = Cell(
            f"rotorpy_{vehicle}", conditions, partial(RotorPy, vehicle, wind)
        )

if __name__ == "__main__":
    se3 = {"SE3 (true state)": lambda simulator: SE3(simulator.parameters)}
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor, **se3})
