"""Fly the same exported agents and RAPTOR's policy, on the same starts, in the simulator of this package.

    python examples/other_simulators/in_own.py any-quadcopter@cf2x_L250.onnx --cells cf2x_L250 --delay 0 1

A cell is a vehicle file of that name; the delay is given here and not by the file.
"""

from functools import partial

import numpy as np
from flights import Array, Cell, Raptor, State, main

from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import STATE, row_slices
from sb3_quad.vehicles.vehicle import load_vehicle

NEVER = 10**6  # control steps


class Own:
    """n vehicles of one file."""

    def __init__(self, vehicle: str, n: int) -> None:
        self.n, self._vehicle = n, load_vehicle(vehicle).model_copy(update={"delay": 0})
        self.hover, self.ground = self._vehicle.hover_thrust, self._vehicle.collision_radius
        self.rotors = np.column_stack([self._vehicle.rotor_positions, self._vehicle.rotor_directions])
        settings = FlightSettings(vehicle=self._vehicle, max_episode_steps=NEVER, noise=0.0)
        self._batch = QuadcopterBatch(n, settings, seed=0, autoreset=False)

    def reset(self, start: State) -> None:
        from scipy.spatial.transform import Rotation

        self._batch.reset()
        rows = row_slices(STATE)
        x, y, z, w = Rotation.from_matrix(start.rotation).as_quat().T
        fields = {"position": start.position.T, "velocity": start.velocity.T, "body_rates": start.body_rates.T}
        for name, values in (fields | {"quaternion": np.stack([w, x, y, z])}).items():
            self._batch.state[rows[name]] = values

    def step(self, thrusts: Array) -> None:
        self._batch.step(self._vehicle.thrust_to_action(thrusts).astype(np.float32))

    def state(self) -> State:
        true = self._batch.true_state()
        return State(true.position, true.rotation, true.velocity, true.body_rates)

    def thrusts(self, speeds: Array) -> Array:
        low, high = self._vehicle.rotor_speed_range
        return np.asarray(self._vehicle.thrust_coefficient * (low + (high - low) * speeds) ** 2)


VEHICLES = ("cf2x_L250", "cf21B_500", "rotorpy_crazyflie", "rotorpy_hummingbird")
CELLS = {name: Cell(name, "", partial(Own, name)) for name in VEHICLES}

if __name__ == "__main__":
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor})
