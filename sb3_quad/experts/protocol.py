"""What an expert is, and how it answers both with the true state and behind SB3's ``predict``."""

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.base.errors import ExpertError
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    VELOCITY,
    QuadcopterState,
)
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

Actions = Float32Array


class Expert(ABC):
    """A controller of a known vehicle: :meth:`actions` from the true state is all that a subclass
    has to write.

    >>> class Hover(Expert):
    ...     def actions(self, state):
    ...         return np.zeros((state.n, 4), dtype=np.float32)

    Anything with such an ``actions(state)`` method can teach; this class adds ``predict``, so that
    ``evaluate_policy(PIDExpert(), env)`` works as for an SB3 model.

    :param vehicle: name, YAML path or :class:`~sb3_quad.vehicles.vehicle.Vehicle` that the expert
        is designed for.
    :param observation_mean: μ of Eq. 3.16, shape (18,), that :meth:`predict` undoes; None for the
        environment's default.
    :param observation_std: σ of Eq. 3.16, shape (18,), likewise.
    """

    def __init__(
        self,
        vehicle: str | Vehicle = "itm",
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        self.vehicle = load_vehicle(vehicle)
        self.observation_mean = np.array(
            DEFAULT_MEAN if observation_mean is None else observation_mean, dtype=np.float64
        )
        self.observation_std = np.array(
            DEFAULT_STD if observation_std is None else observation_std, dtype=np.float64
        )

    @abstractmethod
    def actions(self, state: QuadcopterState) -> Actions:
        """Actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""

    def predict(
        self,
        observation: npt.NDArray[np.floating] | dict[str, npt.NDArray[np.floating]],
        state: tuple[npt.NDArray[np.floating], ...] | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, tuple[npt.NDArray[np.floating], ...] | None]:
        """SB3's ``predict``: the actions for observations of shape (18,) or (n, 18), noise and all.

        :raises ExpertError: observations of another shape.
        """
        array = np.asarray(observation, dtype=np.float64)
        if array.ndim not in (1, 2) or array.shape[-1] != OBSERVATION_SIZE:
            sizes = f"({OBSERVATION_SIZE},) or (n, {OBSERVATION_SIZE})"
            raise ExpertError(
                f"{type(self).__name__}: observation of shape {array.shape}, expected {sizes}"
            )
        actions = self.actions(
            observed_state(np.atleast_2d(array), self.observation_mean, self.observation_std)
        )
        return (actions[0] if array.ndim == 1 else actions), state


def observed_state(observation: FloatArray, mean: FloatArray, std: FloatArray) -> QuadcopterState:
    """The state that observations of shape (n, 18) describe, with the target as origin (Eq. 3.16
    undone).

    Noise leaves ᴮRᴵ no rotation; the nearest one is taken. Rotor speeds cannot be observed and are
    zero.
    """
    features = observation * std + mean
    part = {name: features[:, columns] for name, columns in GROUPS.items()}
    array = np.zeros((STATE_SIZE, len(features)))
    array[POSITION] = part["position"].T
    array[QUATERNION] = _nearest_quaternion(part["rotation"].reshape(-1, 3, 3).transpose(0, 2, 1)).T
    array[BODY_RATES] = part["body_rates"].T
    state = QuadcopterState(array)
    array[VELOCITY] = np.einsum("nij,nj->in", state.rotation, part["velocity"])
    return state


def _nearest_quaternion(matrices: FloatArray) -> FloatArray:
    """Unit quaternions (w, x, y, z; body to world), (n, 4), of the rotations nearest to matrices
    (n, 3, 3); w is not negative.

    By Davenport's q-method: of all q, the eigenvector to the greatest eigenvalue has the greatest
    trace of R(q)ᵀ M.
    """
    m, transposed = matrices, matrices.transpose(0, 2, 1)
    profile = np.zeros((len(m), 4, 4))
    profile[:, 0, 0] = trace = np.einsum("nii->n", m)
    profile[:, 1:, 1:] = m + transposed - trace[:, None, None] * np.eye(3)
    profile[:, 1:, 0] = profile[:, 0, 1:] = (m - transposed)[:, [2, 0, 1], [1, 2, 0]]
    quaternion = np.linalg.eigh(profile).eigenvectors[:, :, -1]
    return np.asarray(quaternion * np.where(quaternion[:, :1] < 0, -1.0, 1.0))
