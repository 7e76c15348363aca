"""The base class of experts: they act on the true state, or on observations as SB3's models do."""

from abc import ABC, abstractmethod
from typing import get_args

import numpy as np
import numpy.typing as npt

from sb3_quad.base.compiled import inner
from sb3_quad.base.errors import ExpertError, refuse_unknown
from sb3_quad.base.types import Float32Array, FloatArray
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.envs.simulation.settings import Action
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    VELOCITY,
    P,
    QuadcopterState,
)
from sb3_quad.envs.vehicles.vehicle import VehicleSource, load_vehicle

Actions = Float32Array
Floats = npt.NDArray[np.floating]


class Expert(ABC):
    """A controller of a known vehicle. A subclass has to implement only :meth:`actions`.

    >>> class Hover(Expert):
    ...     def actions(self, state):
    ...         return np.zeros((state.n, 4), dtype=np.float32)

    Anything with such an ``actions(state)`` method can teach. This class adds ``predict``, so that
    ``evaluate_policy(PIDExpert(), env)`` works as for an SB3 model.

    :param vehicle: name, YAML path or a :class:`~sb3_quad.envs.vehicles.vehicle.Vehicle` that the
        expert is designed for.
    :param action: what its actions command, ``thrusts`` or ``rates``, as ``action`` of the
        environments.
    :raises ConfigError: another ``action``.
    """

    # μ and σ of Eq. 3.16, shape (18,), which `predict` undoes. They are the environments' defaults;
    # set those of an environment that has others.
    observation_mean: FloatArray = DEFAULT_MEAN
    observation_std: FloatArray = DEFAULT_STD

    # Whether it uses each vehicle's true parameters rather than those of ``vehicle``.
    is_privileged = False
    action: Action = "thrusts"

    def __init__(self, vehicle: VehicleSource = "itm", action: Action = "thrusts") -> None:
        refuse_unknown("action", [action], get_args(Action))
        self.vehicle = load_vehicle(vehicle)
        self.action = action

    @abstractmethod
    def actions(self, state: QuadcopterState) -> Actions:
        """Return actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""

    def predict(
        self,
        observation: Floats | dict[str, Floats],
        state: tuple[Floats, ...] | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, tuple[Floats, ...] | None]:
        """Return the actions for observations of shape (18,) or (n, 18), as SB3's ``predict`` does.

        Noise of the observations is not removed.

        :raises ExpertError: observations of another shape.
        """
        array = np.asarray(observation, dtype=np.float64)
        if array.ndim not in (1, 2) or array.shape[-1] != OBSERVATION_SIZE:
            raise ExpertError(
                f"{type(self).__name__}: observation of shape {array.shape}, "
                f"expected ({OBSERVATION_SIZE},) or (n, {OBSERVATION_SIZE})"
            )
        # One observation is a batch of one.
        rows = np.atleast_2d(array)
        actions = self.actions(observed_state(rows, self.observation_mean, self.observation_std))
        return actions.reshape(*array.shape[:-1], actions.shape[1]), state


@inner
def command_rates(thrust, rates, vehicle, actions):  # type: ignore[no-untyped-def]
    """Write the action (4,) that commands a thrust, N, and body rates (3), rad/s.

    :param vehicle: parameters, (len(PARAMETER_NAMES),).
    """
    own = (thrust / 4.0 - vehicle[P.thrust_middle]) / vehicle[P.thrust_half_range]
    actions[0] = min(1.0, max(-1.0, own))
    for axis in range(3):
        own = rates[axis] / vehicle[P.rate_limit_x + axis]
        actions[1 + axis] = min(1.0, max(-1.0, own))


def observed_state(observation: FloatArray, mean: FloatArray, std: FloatArray) -> QuadcopterState:
    """Return the state that observations of shape (n, 18) describe (Eq. 3.16 undone).

    The target is the origin. With noise, ᴮRᴵ is not a rotation matrix; the nearest one is taken.
    Rotor speeds cannot be observed and are zero.
    """
    features = observation * std + mean
    part = {name: features[:, columns] for name, columns in GROUPS.items()}
    # The feature holds ᴮRᴵ, world to body; the state's rotation is its transpose.
    body_to_world = part["rotation"].reshape(-1, 3, 3).transpose(0, 2, 1)
    array = np.zeros((STATE_SIZE, len(features)))
    array[POSITION] = part["position"].T
    array[QUATERNION] = _nearest_quaternion(body_to_world).T
    array[BODY_RATES] = part["body_rates"].T
    # The feature is in the body frame, the state in the world frame.
    state = QuadcopterState(array)
    array[VELOCITY] = np.einsum("nij,nj->in", state.rotation, part["velocity"])
    return state


def _nearest_quaternion(matrices: FloatArray) -> FloatArray:
    """Return the unit quaternions (n, 4) of the rotations nearest to matrices (n, 3, 3).

    They are (w, x, y, z), body to world, with w at least 0. This is Davenport's q-method: the trace
    of R(q)ᵀ M is qᵀ K q, with a symmetric matrix K built from M. Among unit quaternions, the
    eigenvector of the greatest eigenvalue maximises it.
    """
    trace = np.trace(matrices, axis1=1, axis2=2)[:, None, None]
    transposed = matrices.transpose(0, 2, 1)
    axis = (matrices - transposed)[:, None, [2, 0, 1], [1, 2, 0]]
    inner = matrices + transposed - trace * np.eye(3)
    k = np.block([[trace, axis], [axis.transpose(0, 2, 1), inner]])
    # eigh sorts the eigenvalues in ascending order.
    quaternions = np.linalg.eigh(k).eigenvectors[:, :, -1]
    return np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
