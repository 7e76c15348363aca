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
import roma
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


class Loaded(BatchedMultirotor):
    """Vehicles with payloads: masses (kg, (n,)) at offsets (m, (n, 3)) from the centre of mass.

    Only their weight acts. Mass and inertia of the vehicle do not change.
    """

    payload = torch.zeros(1), torch.zeros(1, 3)

    def _s_dot_fn(
        self, t: float, s: torch.Tensor, speeds: torch.Tensor, rows: torch.Tensor
    ) -> torch.Tensor:
        mass, offset = self.payload
        weight = torch.zeros(len(rows), 3)
        weight[:, 2] = -9.81 * mass
        rotation = roma.unitquat_to_rotmat(s[:, 6:10])
        torque = torch.linalg.cross(
            offset.expand_as(weight), (weight.unsqueeze(1) @ rotation).squeeze(1)
        )
        dot = super()._s_dot_fn(t, s, speeds, rows)
        dot[:, 3:6] += weight / self.params.mass
        dot[:, 10:13] += (self.params.inv_inertia @ torque.unsqueeze(-1)).squeeze(-1)
        return dot


class RotorPy:
    """n vehicles of ``rotorpy.vehicles`` in a wind.

    :param wind: function from the number of vehicles to one of RotorPy's wind profiles.
    :param payload: greatest mass of AdaptiveQuadBench's payload, as a share of the vehicle's mass.
    :param weakness: greatest error of a rotor's thrust in either direction, as a share of the
        thrust.
    """

    def __init__(
        self,
        vehicle: str,
        wind: Callable[[int], Any],
        n: int,
        payload: float = 0.0,
        weakness: float = 0.0,
    ) -> None:
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
        rng = np.random.default_rng(0)
        arm = np.linalg.norm(positions[0])
        efficiency = torch.tensor(1.0 + weakness * rng.uniform(-1.0, 1.0, (n, 4)))
        self.parameters.k_eta = self.parameters.k_eta * efficiency
        self.parameters.k_m = self.parameters.k_m * efficiency
        mass = payload * parameters["mass"] * rng.uniform(0.0, 1.0, n)
        offset = 0.2 * arm * rng.uniform(-1.0, 1.0, (n, 3))
        self._payload = (torch.tensor(mass), torch.tensor(offset))

    def reset(self, start: State) -> None:
        self._time = 0.0
        speeds = np.full((self.n, 4), np.sqrt(self.hover / self._k_eta))
        self.fields = to_fields(start)
        self.fields["rotor_speeds"] = torch.tensor(speeds)
        self.fields["wind"] = torch.zeros(self.n, 3)
        self._vehicles = Loaded(self.parameters, self.n, self.fields, DEVICE, integrator="rk4")
        self._vehicles.payload = self._payload

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
# The ranges of AdaptiveQuadBench's config/randomization_config.py.
BENCH: dict[str, tuple[str, dict[str, Any]]] = {
    "_payload": ("drag, payload up to 0.5 m off centre", {"payload": 0.5}),
    "_rotors": ("drag, each rotor off by up to 30 %", {"weakness": 0.3}),
}
CELLS = {}
for vehicle in ("crazyflie", "hummingbird"):
    for suffix, (conditions, wind) in WINDS.items():
        CELLS[vehicle + suffix] = Cell(
            f"rotorpy_{vehicle}", conditions, partial(RotorPy, vehicle, wind)
        )
    for suffix, (conditions, scenario) in BENCH.items():
        CELLS[vehicle + suffix] = Cell(
            f"rotorpy_{vehicle}", conditions, partial(RotorPy, vehicle, BatchedNoWind, **scenario)
        )

if __name__ == "__main__":
    se3 = {"SE3 (true state)": lambda simulator: SE3(simulator.parameters)}
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor, **se3})
