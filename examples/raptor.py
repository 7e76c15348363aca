r"""RAPTOR's published policy, a recurrent network for many quadcopters, for comparison.

    pip install foundation-policy        # or pip install '.[raptor]', its extra
    python examples/raptor.py
    PYTHONPATH=examples sb3-quad evaluate geometric RAPTOR=raptor:Raptor \
        --suite robustness -o evaluations/raptor

Source: J. Eschmann, D. Albani, G. Loianno, *RAPTOR: A Foundation Policy for Quadrotor Control*
(arXiv 2509.11481). It has 2,084 parameters. The package ``foundation_policy`` holds the weights and
computes the layers. Observation, motor order and normalised speeds follow its README: world frame,
x forward, y left, z up; a motor command is linear in the rotor's speed, from -1 at the least to 1
at the greatest speed. Far from the target, position and velocity errors are clipped as in PX4's
``mc_raptor`` (mc_raptor.cpp).
"""

from collections.abc import Sequence
from typing import Any

import foundation_policy
import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.evaluation.flights import fly

# The GRU's hidden state, (n, 16), and the last motor commands, (n, 4).
State = tuple[Float32Array, Float32Array]

# Limits of each component, m and m/s.
MAX_POSITION = 0.5
MAX_VELOCITY = 1.0

# RAPTOR's motors by the signs of x and y: front right, back right, back left, front left.
MOTORS = {(1, -1): 0, (-1, -1): 1, (-1, 1): 2, (1, 1): 3}
# The signs of their yaw moments.
DIRECTIONS = (-1, 1, -1, 1)


class Raptor:
    """The policy, with ``predict`` as in SB3's recurrent policies.

    It sees the 18 features as an agent does, with their noise. Of the vehicle it knows only the
    order of the rotors and the range of their speeds.

    :param vehicle: name, YAML path or :class:`~sb3_quad.envs.vehicles.vehicle.Vehicle` that it
        flies; or a sequence of n of them, and row i flies number i modulo n.
    :param observation_mean: μ of Eq. 3.16, shape (18,), which is undone; None: the environment's
        default.
    :param observation_std: σ of Eq. 3.16, shape (18,), likewise.
    :raises ConfigError: if the rotors do not form an X, or turn the other way.
    """

    def __init__(
        self,
        vehicle: str | Vehicle | Sequence[Vehicle] = "itm",
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        if isinstance(vehicle, (str, Vehicle)):
            vehicles = [load_vehicle(vehicle)]
        else:
            vehicles = list(vehicle)
        self.vehicle = vehicles[0]
        # The least speed of a rotor over its greatest, (vehicles, 1).
        speeds = np.array([flown.rotor_speed_range for flown in vehicles])
        self._idle = speeds[:, :1] / speeds[:, 1:]
        if observation_mean is None:
            observation_mean = DEFAULT_MEAN
        if observation_std is None:
            observation_std = DEFAULT_STD
        self._mean = np.array(observation_mean, dtype=np.float32)
        self._std = np.array(observation_std, dtype=np.float32)
        self._order = motor_order(self.vehicle)
        self._policy = foundation_policy.Raptor()
        # One of its layers is recurrent.
        for layer in self._policy.layers:
            if hasattr(layer, "initial_hidden_state"):
                self._gru = layer

    def predict(
        self,
        observation: npt.NDArray[Any],
        state: State | None = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, State]:
        """Actions (n, 4) for observations (n, 18); of longer ones, it uses the current 18 features.

        :param state: the one returned before; None: all rows begin an episode.
        :param episode_start: (n,), the rows that begin an episode; None: no row does.
        """
        n = len(observation)
        first_hidden = np.tile(self._gru.initial_hidden_state, (n, 1))
        first_commands = np.zeros((n, 4), dtype=np.float32)
        if state is None:
            hidden, commands = first_hidden, first_commands
        else:
            hidden, commands = state
        if episode_start is not None:
            hidden = np.where(episode_start[:, None], first_hidden, hidden)
            commands = np.where(episode_start[:, None], first_commands, commands)

        scaled = observation[:, :OBSERVATION_SIZE]
        features = np.asarray(scaled * self._std + self._mean, dtype=np.float32)
        inputs = np.hstack([network_inputs(features), commands])
        self._gru.state = hidden
        commands = self._policy.evaluate_step(inputs).astype(np.float32)
        actions = self._actions(commands[:, self._order]).astype(np.float32)
        return actions, (self._gru.state, commands)

    def _actions(self, commands: Float32Array) -> FloatArray:
        """Actions (n, 4) for motor commands: a rotor's thrust goes with the square of its speed."""
        idle = self._idle[np.arange(len(commands)) % len(self._idle)]
        # Speed and thrust as shares of their greatest values
        speeds = idle + (1.0 - idle) * (commands.astype(np.float64) + 1.0) / 2.0
        shares = speeds**2
        return np.asarray(2.0 * (shares - idle**2) / (1.0 - idle**2) - 1.0)


def motor_order(vehicle: Vehicle) -> list[int]:
    """Return for each rotor of a vehicle the policy's motor in that place.

    0 is front right, 1 back right, 2 back left, 3 front left.

    :raises ConfigError: if the rotors do not form an X, or turn the other way.
    """
    order = []
    for x, y in vehicle.rotor_positions:
        order.append(MOTORS.get((int(np.sign(x)), int(np.sign(y))), -1))
    directions = tuple(DIRECTIONS[motor] for motor in order)
    if sorted(order) != [0, 1, 2, 3] or directions != vehicle.rotor_directions:
        raise ConfigError(
            "RAPTOR flies an X whose front right rotor turns anticlockwise; "
            f"{vehicle.name} is different"
        )
    return order


def network_inputs(features: Float32Array) -> Float32Array:
    """Convert the 18 features in physical units, (n, 18), to the policy's own, (n, 18).

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
        flights = fly(Raptor(), task, n_episodes=48, seed=1_000_000)
        print(
            f"{task}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
        )
