"""RAPTOR's published policy, one recurrent network of 2,084 parameters for many quadcopters, as a controller.

Source: J. Eschmann, D. Albani, G. Loianno, *RAPTOR: A Foundation Policy for Quadrotor Control* (arXiv 2509.11481). The package
``foundation_policy`` holds the weights and computes the layers. Observation, motor order and normalised speeds are as its
README says (:mod:`.raptor_frame`). Far from the target, position and velocity error are clipped as in PX4's ``mc_raptor``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.imports import require
from sb3_quad.experts.raptor_frame import idle_share, motor_order, rotor_shares, seen
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

foundation_policy = require("foundation_policy", "raptor", "raptor")

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
        self.vehicle, self._idle = vehicles[0], np.array([[idle_share(each)] for each in vehicles])
        self._mean = np.array(DEFAULT_MEAN if observation_mean is None else observation_mean, dtype=np.float32)
        self._std = np.array(DEFAULT_STD if observation_std is None else observation_std, dtype=np.float32)
        self._order = motor_order(self.vehicle)
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
        features = np.asarray(observation[:, :OBSERVATION_SIZE] * self._std + self._mean, dtype=np.float32)
        last = self._policy.evaluate_step(np.hstack([seen(th.from_numpy(features)).numpy(), last])).astype(np.float32)
        return self._actions(last).astype(np.float32), (self._gru.state, last)

    def _actions(self, commands: Float32Array) -> FloatArray:
        """Actions (n, 4) of motor commands."""
        idle = self._idle[np.arange(len(commands)) % len(self._idle)]
        shares = rotor_shares(idle, commands[:, self._order].astype(np.float64))
        return np.asarray(2.0 * (shares - idle**2) / (1.0 - idle**2) - 1.0)
