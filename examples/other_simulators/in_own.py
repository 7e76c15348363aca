r"""Fly the same exported agents and RAPTOR's policy, on the same starts, in our simulator.

    python examples/other_simulators/in_own.py any-quadcopter@cf2x_L250.onnx \
        --cells cf2x_L250 --delay 0 1

RotorPy's SE3 controller flies RotorPy's vehicles if RotorPy is installed.

A cell is a vehicle file of that name. You give the delay here; the file's own delay is ignored.
"""

from functools import partial
from typing import Any

import numpy as np
from flights import Array, Cell, Policy, Raptor, State, main

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import STATE, row_slices
from sb3_quad.envs.vehicles.vehicle import load_vehicle

NEVER = 10**6  # control steps


class Own:
    """n vehicles of one file, in a constant wind (m/s) along x."""

    def __init__(self, vehicle: str, wind: float, n: int) -> None:
        self.n = n
        self.name = vehicle
        self._vehicle = load_vehicle(vehicle).model_copy(update={"delay": 0})
        self.hover = self._vehicle.hover_thrust
        self.ground = self._vehicle.collision_radius
        positions = self._vehicle.rotor_positions
        self.rotors = np.column_stack([positions, self._vehicle.rotor_directions])
        # The script decides when a flight ends, so no episode of the batch does.
        keywords: dict[str, Any] = {
            "max_episode_steps": NEVER,
            "task_kwargs": {"max_distance": 1e6},
            "noise": 0.0,
        }
        if wind:
            keywords["randomize"] = {"wind": {"magnitude": wind, "direction": [1.0, 0.0, 0.0]}}
        settings = FlightSettings(vehicle=self._vehicle, **keywords)
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
        return np.asarray(self._vehicle.lift * (low + (high - low) * speeds) ** 2)


CELLS = {}
SMOOTH = ("l2f_crazyflie", "itm", "crazyflie", "hummingbird")
for name in ("cf2x_L250", "cf21B_500", *SMOOTH, "rotorpy_crazyflie", "rotorpy_hummingbird"):
    conditions = "no drag" if name in SMOOTH else "drag"
    CELLS[name] = Cell(name, conditions, partial(Own, name, 0.0))
    if name.startswith("rotorpy"):
        CELLS[name + "_wind"] = Cell(name, "drag, wind 4 m/s", partial(Own, name, 4.0))


def se3(simulator: Own) -> Policy | None:
    """RotorPy's controller for RotorPy's vehicles, with its gains for them."""
    brand, _, vehicle = simulator.name.partition("_")
    if brand != "rotorpy":
        return None
    from in_rotorpy import SE3, parameters_of

    return SE3(parameters_of(vehicle, simulator.n))


if __name__ == "__main__":
    main(__doc__ or "", CELLS, {"RAPTOR": Raptor, "SE3 (true state)": se3})
