"""Fly the same exported agents and RAPTOR's policy, on the same starts, in the simulator of this
package.

    python examples/other_simulators/in_own.py any-quadcopter@cf2x_L250.onnx --cells cf2x_L250
    --delay 0 1

A cell is a vehicle file of that name; the delay is given here and not by the file.
"""

from functools import partial
from typing import Any

import numpy as np
from flights import Array, Cell, Raptor, State, main

from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import STATE, row_slices
from sb3_quad.vehicles.vehicle import load_vehicle

NEVER = 10**6  # control steps


class Own:
    """n vehicles of one file, in a constant wind (m/s) along x."""

    def __init__(self, vehicle: str, wind: float, n: int) -> None:
        self.n, self._vehicle = n, load_vehicle(vehicle).model_copy(update={"delay": 0})
        self.hover, self.ground = self._vehicle.hover_thrust, self._vehicle.collision_radius
        self.rotors = np.column_stack(
            [self._vehicle.rotor_positions, self._vehicle.rotor_directions]
        )
        randomize = {"wind": {"magnitude": wind, "direction": [1.0, 0.0, 0.0]}} if wind else None
        endless: dict[str, Any] = {"max_episode_steps": NEVER, "task_kwargs": {"max_distance": 1e6}}
        settings = FlightSettings(vehicle=self._vehicle, randomize=randomize, noise=0.0, **endless)
        self._batch = QuadcopterBatch(n, settings, seed=0, autoreset=False)

    def reset(self, start: State) -> None:
        self._batch.reset()
        for name, values in vars(start).items():
            self._batch.state[row_slices(STATE)[name]] = values.T

    def step(self, thrusts: Array) -> None:
        self._batch.step(self._vehicle.thrust_to_action(thrusts).astype(np.float32))

    def state(self) -> State:
        true = self._batch.true_state()
        return State(true.position, true.quaternion, true.velocity, true.body_rates)

    def thrusts(self, speeds: Array) -> Array:
        low, high = self._vehicle.rotor_speed_range
        return np.asarray(self._vehicle.thrust_coefficient * (low + (high - low) * speeds) ** 2)


CELLS = {name: Cell(name, "drag", partial(Own, name, 0.0)) for name in ("cf2x_L250", "cf21B_500")}
CELLS["l2f_crazyflie"] = Cell("l2f_crazyflie", "no drag", partial(Own, "l2f_crazyflie", 0.0))
for name in ("rotorpy_crazyflie", "rotorpy_hummingbird"):
    CELLS[name] = Cell(name, "drag", partial(Own, name, 0.0))
    CELLS[name + "_wind"] = Cell(name, "drag, wind 4 m/s", partial(Own, name, 4.0))

if __name__ == "__main__":
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor})
