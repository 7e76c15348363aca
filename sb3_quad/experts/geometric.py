"""A geometric controller for large angles.

It recovers from nearly every attitude, spin and fall, and flies to targets.
"""

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.settings import Action
from sb3_quad.envs.simulation.state import (
    FELT,
    FORCE_WORLD,
    WRENCH_SIZE,
    QuadcopterState,
    drag_forces,
)
from sb3_quad.envs.vehicles.gains import GeometricGains
from sb3_quad.envs.vehicles.vehicle import VehicleSource, load_vehicle
from sb3_quad.experts.geometric_gains import TrueConstants, constants_of, derived_gains
from sb3_quad.experts.geometric_law import fly_geometric
from sb3_quad.experts.protocol import Actions, Expert

_NO_WRENCH = np.zeros((WRENCH_SIZE, 1))
# Half of the drag from the vehicle's own motion is not compensated, because it damps.
_DRAG_LEFT = 0.5


class GeometricExpert(Expert):
    """Position and attitude control on S² for large angles.

    docs/research/experts.md has its law in formulas. It follows Lee, Leok and McClamroch,
    "Geometric tracking control of a quadrotor UAV on SE(3)" (CDC 2010). The attitude is the reduced
    one of Chaturvedi, Sanyal and McClamroch, "Rigid-body attitude control" (IEEE Control Systems
    31(3), 2011): it turns the thrust direction first and then the yaw, as in Brescianini and
    D'Andrea, "Tilt-prioritized quadrocopter attitude control" (IEEE Trans. Control Systems
    Technology 28(2), 2020): a heading is followed with the remaining thrust.

    It adds: velocities and body rates from which the vehicle can brake; a prediction of the
    attitude for the time when the command acts; the long way round if the spin makes that quicker;
    and an allocation that gives up yaw before thrust, and thrust before tilt. It has no state: its
    actions are a function of the 18 observed features and the reference.

    :param vehicle: name, YAML path or Vehicle that it is designed for.
    :param gains: the :class:`GeometricGains`; None: those in the vehicle's YAML
        (``geometric_gains``), or :func:`derived_gains` if it has none.
    :param privileged: whether it uses each vehicle's true parameters and compensates the external
        wrench, if the state has them (``state.vehicles``, ``state.wrench``). Its gains then scale
        with the vehicle as :func:`derived_gains` do.
    :param action: what its actions command, see :class:`Expert`. As ``rates`` they are the thrust
        along the body's z axis, and the rates at which it wants to turn.
    """

    def __init__(
        self,
        vehicle: VehicleSource = "itm",
        gains: GeometricGains | None = None,
        privileged: bool = False,
        action: Action = "thrusts",
    ) -> None:
        super().__init__(vehicle, action)
        self.gains = gains or self.vehicle.geometric_gains or derived_gains(self.vehicle)
        # The law's constants for the vehicle as designed, and if they are known, for the true ones.
        self._nominal = constants_of(
            self.vehicle.parameters()[:, None],
            self.vehicle.control_step,
            self.gains.values()[:, None],
        )
        self.is_privileged = privileged
        self._true = TrueConstants(self.vehicle, self.gains) if privileged else None

    def actions(self, state: QuadcopterState) -> Actions:
        """Return actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        constants = self._nominal
        wrench = _NO_WRENCH
        if self._true is not None:
            if state.vehicles is not None:
                constants = self._true.of(state.vehicles)
            if state.wrench is not None:
                wrench = self._to_compensate(state, state.wrench)
        actions = np.empty((state.n, 4), dtype=np.float32)
        fly_geometric(state.array, constants, wrench, self.action == "rates", actions)
        return actions

    @staticmethod
    def _to_compensate(state: QuadcopterState, wrench: FloatArray) -> FloatArray:
        """Return the external wrench without a part of the drag from the vehicles' own motion."""
        if state.vehicles is None or not state.vehicles[FELT].any():
            return wrench
        # The drag in air that moves with the reference is caused by velocity errors.
        air = state.target_velocity.T
        wrench = wrench.copy()
        wrench[FORCE_WORLD] -= _DRAG_LEFT * drag_forces(state.array, state.vehicles, air)
        return wrench


def privileged_geometric(
    vehicle: VehicleSource = "itm", action: Action = "thrusts"
) -> GeometricExpert:
    """Return a :class:`GeometricExpert` that knows the true vehicle and wrench."""
    return GeometricExpert(vehicle, privileged=True, action=action)


def privileged_derived(
    vehicle: VehicleSource = "itm", action: Action = "thrusts"
) -> GeometricExpert:
    """Return a privileged expert with the derived gains of each vehicle.

    It is meant for distributions of vehicles unlike this one. If commands act late, its outer loop
    is slower and its inner one faster: agents that learn from it can cope with slow motors.
    """
    gains = derived_gains(load_vehicle(vehicle))
    expert = GeometricExpert(vehicle, gains, privileged=True, action=action)
    expert._true = TrueConstants(expert.vehicle, expert.gains, is_gentle=True)
    return expert
