"""RAPTOR's published policy, one recurrent network of 2,084 parameters for many quadcopters, as a controller.

Source: J. Eschmann, D. Albani, G. Loianno, *RAPTOR: A Foundation Policy for Quadrotor Control* (arXiv 2509.11481). The package
``foundation_policy`` holds the weights and computes the layers. Observation, motor order and normalised speeds are as its
README says: world frame, x forward, y left, z up; the target's heading is x. Far from the target, position and velocity error
are clipped as in PX4's ``mc_raptor``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

foundation_policy = require("foundation_policy", "raptor", "raptor")

MAX_POSITION, MAX_VELOCITY = 0.5, 1.0  # m and m/s, each component
PLACES = {(1, -1): 0, (-1, -1): 1, (-1, 1): 2, (1, 1): 3}  # its motor, by the signs of x and y: FR, BR, BL, FL
DIRECTIONS = (-1, 1, -1, 1)  # signs of its motors' yaw moments
Memory = tuple[Float32Array, Float32Array]  # the GRU's hidden state, (n, 16), and its last action, (n, 4)


class Raptor:
    """The policy as SB3's recurrent ones are asked: ``predict`` gives actions and what it remembers, and is given that again.

    It sees the 18 features as an agent does, noise and all, and is not told the vehicle: of that it needs only the order of
    the rotors and the range of their speeds.

    :param vehicle: name, YAML path or :class:`~sb3_quad.vehicles.vehicle.Vehicle` that it flies; or a sequence of them, of
        which row i flies number i, counted round.
    :param observation_mean: μ of Eq. 3.16, shape (18,), that is undone; None for the environment's default.
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
        self.vehicle, limits = vehicles[0], np.array([each.thrust_limits for each in vehicles])
        self._least_speed = np.sqrt(limits[:, :1] / limits[:, 1:])  # of a rotor, by its greatest; (1 or n, 1)
        self._mean = np.array(DEFAULT_MEAN if observation_mean is None else observation_mean, dtype=np.float32)
        self._std = np.array(DEFAULT_STD if observation_std is None else observation_std, dtype=np.float32)
        signs = [(int(np.sign(x)), int(np.sign(y))) for x, y in self.vehicle.rotor_positions]
        self._order = [PLACES.get(sign, -1) for sign in signs]
        turning = tuple(DIRECTIONS[place] for place in self._order)
        if sorted(self._order) != [0, 1, 2, 3] or turning != self.vehicle.rotor_directions:
            raise ConfigError(
                f"raptor: flies an X whose front right rotor turns anticlockwise, which {self.vehicle.name} has not"
            )
        self._policy = foundation_policy.Raptor()
        (self._gru,) = (layer for layer in self._policy.layers if hasattr(layer, "initial_hidden_state"))

    def predict(
        self,
        observation: npt.NDArray[Any],
        state: Memory | None = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Memory]:
        """Actions (n, 4) for observations (n, 18), or longer ones, of which it sees the present 18 features.

        :param state: what it remembers; None: all rows begin an episode.
        :param episode_start: (n,), the rows that begin one; None: none do.
        """
        n = len(observation)
        new = np.tile(self._gru.initial_hidden_state, (n, 1)), np.zeros((n, 4), dtype=np.float32)
        hidden, last = new if state is None else state
        if episode_start is not None:
            hidden, last = (np.where(episode_start[:, None], *each) for each in zip(new, (hidden, last), strict=True))
        self._gru.state = hidden
        last = self._policy.evaluate_step(np.hstack([self._seen(observation), last])).astype(np.float32)
        return self._actions(last).astype(np.float32), (self._gru.state, last)

    def _seen(self, observation: npt.NDArray[Any]) -> Float32Array:
        """What it sees beside its last action, (n, 18): position, rotation row by row, velocity, body rates."""
        features = observation[:, :OBSERVATION_SIZE] * self._std + self._mean
        part = {name: features[:, columns] for name, columns in GROUPS.items()}
        rotation = part["rotation"].reshape(-1, 3, 3).transpose(0, 2, 1)  # body to world
        position = np.clip(part["position"], -MAX_POSITION, MAX_POSITION)
        velocity = np.clip(np.einsum("nij,nj->ni", rotation, part["velocity"]), -MAX_VELOCITY, MAX_VELOCITY)
        return np.hstack([position, rotation.reshape(-1, 9), velocity, part["body_rates"]]).astype(np.float32)

    def _actions(self, motors: Float32Array) -> FloatArray:
        """Actions from its own, which are linear in the rotors' speeds."""
        least = self._least_speed[np.arange(len(motors)) % len(self._least_speed)]
        speeds = least + (1.0 - least) * (motors[:, self._order].astype(np.float64) + 1.0) / 2.0
        return 2.0 * (speeds**2 - least**2) / (1.0 - least**2) - 1.0
