"""What RAPTOR's policy and PX4's ``mc_raptor`` see and command: their inputs, their motors, their speeds.

Source: the README of the package ``foundation_policy``; PX4-Autopilot, ``src/modules/mc_raptor/mc_raptor.cpp``. World frame, x
forward, y left, z up, the target's heading is x. A motor command is linear in the rotor's speed, -1 its least and 1 its
greatest.
"""

import numpy as np
import torch as th

from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.observation import GROUPS
from sb3_quad.vehicles.vehicle import Vehicle

MAX_POSITION, MAX_VELOCITY = 0.5, 1.0  # m and m/s, each component
PLACES = {(1, -1): 0, (-1, -1): 1, (-1, 1): 2, (1, 1): 3}  # its motor, by the signs of x and y: FR, BR, BL, FL
DIRECTIONS = (-1, 1, -1, 1)  # signs of its motors' yaw moments


def motor_order(vehicle: Vehicle, who: str = "raptor") -> list[int]:
    """For each rotor of a vehicle, which motor of the policy it is: 0 front right, 1 back right, 2 back left, 3 front left.

    :param who: what messages call the policy.
    :raises ConfigError: rotors that are no X, or turn the other way.
    """
    signs = [(int(np.sign(x)), int(np.sign(y))) for x, y in vehicle.rotor_positions]
    order = [PLACES.get(sign, -1) for sign in signs]
    if sorted(order) != [0, 1, 2, 3] or tuple(DIRECTIONS[place] for place in order) != vehicle.rotor_directions:
        raise ConfigError(f"{who}: flies an X whose front right rotor turns anticlockwise, which {vehicle.name} has not")
    return order


def idle_share(vehicle: Vehicle) -> float:
    """The least speed of a rotor over its greatest; 0 where rotors can stand still."""
    low, high = vehicle.rotor_speed_range
    return low / high


def rotor_shares(idle: FloatArray | float, commands: FloatArray) -> FloatArray:
    """Shares of the rotors' greatest thrusts, of motor commands, any shape, not clipped; ``idle``: see :func:`idle_share`."""
    return np.asarray((idle + (1.0 - idle) * (commands + 1.0) / 2.0) ** 2)


def rotor_thrusts(vehicle: Vehicle, order: list[int], commands: Float32Array) -> FloatArray:
    """Thrusts of the vehicle's rotors, (n, 4), N, from motor commands, (n, 4), in the policy's order; not clipped."""
    return vehicle.thrust_range[1] * rotor_shares(idle_share(vehicle), commands[:, order].astype(np.float64))


def seen(features: th.Tensor) -> th.Tensor:
    """What it sees beside its last command, (n, 18), of the 18 features in physical units, (n, 18).

    Position relative to the target, clipped, m; rotation body to world, row by row; velocity, world frame, clipped, m/s; body
    rates, rad/s.
    """
    part = {name: features[:, columns] for name, columns in GROUPS.items()}
    rotation = part["rotation"].reshape(-1, 3, 3).transpose(1, 2)  # body to world
    position = part["position"].clamp(-MAX_POSITION, MAX_POSITION)
    velocity = th.einsum("nij,nj->ni", rotation, part["velocity"]).clamp(-MAX_VELOCITY, MAX_VELOCITY)
    return th.hstack([position, rotation.reshape(-1, 9), velocity, part["body_rates"]])
