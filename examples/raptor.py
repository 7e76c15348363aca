"""RAPTOR's published policy, one recurrent network of 2,084 parameters for many quadcopters, as a
controller to compare with.

    pip install foundation-policy        # or pip install '.[raptor]', its extra
    python examples/raptor.py
    PYTHONPATH=examples sb3-quad evaluate geometric RAPTOR=raptor:Raptor --suite robustness -o
    evaluations/raptor

Source: J. Eschmann, D. Albani, G. Loianno, *RAPTOR: A Foundation Policy for Quadrotor Control*
(arXiv 2509.11481). The package ``foundation_policy`` holds the weights and computes the layers.
Observation, motor order and normalised speeds are as its README says: world frame, x forward, y
left, z up; a motor command is linear in the rotor's speed, -1 its least and 1 its greatest. Far
from the target, position and velocity error are clipped as in PX4's ``mc_raptor`` (mc_raptor.cpp).
"""

from collections.abc import Sequence
from typing import Any

import foundation_policy
import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

State = tuple[
    Float32Array, Float32Array
]  # the GRU's hidden state, (n, 16), and the last motor commands, (n, 4)
MAX_POSITION, MAX_VELOCITY = 0.5, 1.0  # m and m/s, each component
MOTORS = {
    (1, -1): 0,
    (-1, -1): 1,
    (-1, 1): 2,
    (1, 1): 3,
}  # its motors by the signs of x and y: FR, BR, BL, FL
DIRECTIONS = (-1, 1, -1, 1)  # signs of its motors' yaw moments


class Raptor:
    """The policy as SB3's recurrent ones are asked: ``predict`` gives actions and a state, and is
    given that state again.

    It sees the 18 features as an agent does, noise and all, and is not told the vehicle: of that it
    needs only the order of the rotors and the range of their speeds.

    :param vehicle: name, YAML path or :class:`~sb3_quad.vehicles.vehicle.Vehicle` that it flies; or
        a sequence of them, of which row i flies number i, counted round.
    :param observation_mean: μ of Eq. 3.16, shape (18,), that is undone; None for the environment's
        default.
    :param observation_std: σ of Eq. 3.16, shape (18,), likewise.
    :raises ConfigError: rotors that are no X, or turn the other way.
    """

    def __init__(
        self,
        vehicle: str | Vehicle | Sequence[Vehicle] = "itm",
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        vehicles = [load_vehicle(vehicle)] if isinstance(vehicle, (str, Vehicle)) else [*vehicle]
        self.vehicle, speeds = vehicles[0], np.array([each.rotor_speed_range for each in vehicles])
        self._idle = (
            speeds[:, :1] / speeds[:, 1:]
        )  # the least speed of a rotor over its greatest, (vehicles, 1)
        self._mean = np.array(
            DEFAULT_MEAN if observation_mean is None else observation_mean, dtype=np.float32
        )
        self._std = np.array(
            DEFAULT_STD if observation_std is None else observation_std, dtype=np.float32
        )
        self._order = motor_order(self.vehicle)
        self._policy = foundation_policy.Raptor()
        (self._gru,) = (
            layer for layer in self._policy.layers if hasattr(layer, "initial_hidden_state")
        )

    def predict(
        self,
        observation: npt.NDArray[Any],
        state: State | None = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, State]:
        """Actions (n, 4) for observations (n, 18), or longer ones, of which it sees the present 18
        features.

        :param state: the one returned before; None: all rows begin an episode.
        :param episode_start: (n,), the rows that begin one; None: none do.
        """
        n = len(observation)
        new = np.tile(self._gru.initial_hidden_state, (n, 1)), np.zeros((n, 4), dtype=np.float32)
        hidden, last = new if state is None else state
        if episode_start is not None:
            hidden, last = (
                np.where(episode_start[:, None], *each)
                for each in zip(new, (hidden, last), strict=True)
            )
        self._gru.state = hidden
        features = np.asarray(
            observation[:, :OBSERVATION_SIZE] * self._std + self._mean, dtype=np.float32
        )
        last = self._policy.evaluate_step(np.hstack([network_inputs(features), last])).astype(
            np.float32
        )
        return self._actions(last[:, self._order]).astype(np.float32), (self._gru.state, last)

    def _actions(self, commands: Float32Array) -> FloatArray:
        """Actions (n, 4) of motor commands: a rotor's thrust is the square of its speed."""
        idle = self._idle[np.arange(len(commands)) % len(self._idle)]
        shares = (
            idle + (1.0 - idle) * (commands.astype(np.float64) + 1.0) / 2.0
        ) ** 2  # of the greatest thrust
        return np.asarray(2.0 * (shares - idle**2) / (1.0 - idle**2) - 1.0)


def motor_order(vehicle: Vehicle) -> list[int]:
    """For each rotor of a vehicle, which motor of the policy it is: 0 front right, 1 back right, 2
    back left, 3 front left.

    :raises ConfigError: rotors that are no X, or turn the other way.
    """
    signs = [(int(np.sign(x)), int(np.sign(y))) for x, y in vehicle.rotor_positions]
    order = [MOTORS.get(sign, -1) for sign in signs]
    if (
        sorted(order) != [0, 1, 2, 3]
        or tuple(DIRECTIONS[motor] for motor in order) != vehicle.rotor_directions
    ):
        raise ConfigError(
            f"RAPTOR flies an X whose front right rotor turns anticlockwise, which {vehicle.name} has not"
        )
    return order


def network_inputs(features: Float32Array) -> Float32Array:
    """What it sees beside its last command, (n, 18), of the 18 features in physical units, (n, 18).

    Position relative to the target, clipped, m; rotation body to world, row by row; velocity, world
    frame, clipped, m/s; body rates, rad/s.
    """
    part = {name: features[:, columns] for name, columns in GROUPS.items()}
    rotation = part["rotation"].reshape(-1, 3, 3).transpose(0, 2, 1)  # body to world
    position = part["position"].clip(-MAX_POSITION, MAX_POSITION)
    velocity = np.einsum("nij,nj->ni", rotation, part["velocity"]).clip(-MAX_VELOCITY, MAX_VELOCITY)
    return np.hstack([position, rotation.reshape(-1, 9), velocity, part["body_rates"]])


if __name__ == "__main__":
    for task in ("target_tracking", "state_recovery"):
        flights = fly(Raptor(), task, n_flights=48, seed=1_000_000)
        print(
            f"{task}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
        )
