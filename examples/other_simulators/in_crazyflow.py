r"""Fly exported agents in crazyflow (TU Munich).

Its own controller and RAPTOR's policy fly there, too, for comparison.

    sb3-quad export any-quadcopter --format onnx --vehicle cf2x_L250 \
        -o any-quadcopter@cf2x_L250.onnx
    python examples/other_simulators/in_crazyflow.py any-quadcopter@cf2x_L250.onnx \
        --cells cf2x_L250 --delay 0 1

crazyflow: rotors M1 to M4 as Bitcraze numbers them; quaternions x, y, z, w; commands are rotor
speeds in rpm. Its first principles: rotors that spin up and down at different rates, drag,
gyroscopic propellers; Runge-Kutta with a step of 2 ms. Its controller, Mellinger's as in the
Crazyflie's firmware, sees the true state; the others see observations with noise.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.control.transform import motor_force2rotor_vel
from crazyflow.dynamics import Dynamics, load_params
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator
from flights import CONTROL_STEP, Array, Cell, Policy, Raptor, Setpoint, State, main

FREQUENCY = 500  # Hz, of its physics


class Crazyflow:
    """n vehicles of the type ``drone`` in n of its worlds.

    :param control: the kind of commands: rotor speeds, or crazyflow's setpoints (n, 16).
    """

    ground = 0.02  # m: half the height of its collision box

    def __init__(self, drone: str, n: int, control: Control = Control.rotor_vel) -> None:
        self.n = n
        self.drone = drone
        self._control = control
        parameters = load_params(Dynamics.first_principles, drone)
        # Coefficients of the thrust (N), a polynomial in rpm.
        self._curve = np.asarray(parameters["rpm2thrust"], np.float64).ravel()
        self._limits = float(parameters["thrust_min"]), float(parameters["thrust_max"])
        self.hover = float(parameters["mass"]) * 9.81 / 4.0
        # Signs of the moments of each rotor's thrust about the three axes
        roll, pitch, yaw = np.asarray(parameters["mixing_matrix"])
        arm = float(np.ravel(parameters["L"])[0])
        self.rotors = np.stack([-pitch * arm, roll * arm, yaw], axis=1)
        self._sim = Sim(
            n_worlds=n,
            drone=drone,
            freq=FREQUENCY,
            dynamics=Dynamics.first_principles,
            control=control,
            integrator=Integrator.rk4,
        )

    def reset(self, start: State) -> None:
        self._sim.reset()
        hover = np.full((self.n, 4), self._speeds(np.array(self.hover)))
        fields = {
            "pos": start.position,
            "quat": np.roll(start.quaternion, -1, axis=1),
            "vel": start.velocity,
            "ang_vel": start.body_rates,
            "rotor_vel": hover,
        }
        arrays = {}
        for name, values in fields.items():
            arrays[name] = jnp.asarray(values[:, None], jnp.float32)
        self._sim.data = self._sim.data.replace(states=self._sim.data.states.replace(**arrays))

    def step(self, thrusts: Array) -> None:
        if self._control is Control.state:
            self._sim.state_control(jnp.asarray(thrusts[:, None], jnp.float32))
        else:
            speeds = self._speeds(thrusts.clip(*self._limits))
            self._sim.rotor_vel_control(jnp.asarray(speeds[:, None], jnp.float32))
        self._sim.step(round(FREQUENCY * CONTROL_STEP))

    def state(self) -> State:
        now = self._sim.data.states
        fields = (now.pos, now.quat, now.vel, now.ang_vel)
        position, quaternion, velocity, rates = (np.asarray(x[:, 0], np.float64) for x in fields)
        return State(position, np.roll(quaternion, 1, axis=1), velocity, rates)

    def thrusts(self, speeds: Array) -> Array:
        low, high = self._speeds(np.array(self._limits))
        return np.polynomial.polynomial.polyval(low + (high - low) * speeds, self._curve)

    def _speeds(self, thrusts: Array) -> Array:
        return np.asarray(motor_force2rotor_vel(thrusts, self._curve))


class Mellinger:
    """crazyflow's own controller, with its gains; its commands are setpoints.

    It runs inside crazyflow: position at 100 Hz, attitude at 500 Hz.
    """

    def __init__(self, simulator: Crazyflow) -> None:
        self.simulator = Crazyflow(simulator.drone, simulator.n, Control.state)

    def reset(self, n: int) -> None:
        pass

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
        position = setpoint.position
        # The attitude x, y, z, w, of which it takes the heading, and body rates.
        rest = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        same = np.concatenate([setpoint.velocity, setpoint.accelerations[0], rest])
        return np.hstack([position, np.tile(same, (len(position), 1))])


CELLS = {
    "cf2x_L250": Cell("cf2x_L250", "drag", partial(Crazyflow, "cf2x_L250")),
    "cf21B_500": Cell("cf21B_500", "drag", partial(Crazyflow, "cf21B_500")),
}

if __name__ == "__main__":
    others: dict[str, Callable[[Crazyflow], Policy]] = {
        "RAPTOR": Raptor,
        "Mellinger (true state)": Mellinger,
    }
    main(__doc__ or "", CELLS, others)
