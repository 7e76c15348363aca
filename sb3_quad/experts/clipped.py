"""An expert that is shown errors as PX4's ``mc_raptor`` shows them to its policy: no larger than 0.5 m and 1 m/s."""

import numpy as np

from sb3_quad.experts.geometric import told_geometric
from sb3_quad.experts.protocol import Actions, Expert
from sb3_quad.experts.raptor_frame import MAX_POSITION, MAX_VELOCITY
from sb3_quad.simulation.state import POSITION, TARGET, VELOCITY, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle


class ClippedExpert(Expert):
    """Another expert's actions for the state whose target is no farther and whose velocity is no greater than the limits.

    A policy that sees clipped errors cannot know how far its target is and how fast it flies. This expert does what is right
    as far as both can be seen: from afar it approaches at walking pace.

    :param expert: that is asked.
    """

    def __init__(self, expert: Expert) -> None:
        super().__init__(expert.vehicle, expert.observation_mean, expert.observation_std)
        self.expert = expert

    def actions(self, state: QuadcopterState) -> Actions:
        """Actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        array = state.array.copy()
        array[TARGET] = array[POSITION] + np.clip(array[TARGET] - array[POSITION], -MAX_POSITION, MAX_POSITION)
        np.clip(array[VELOCITY], -MAX_VELOCITY, MAX_VELOCITY, out=array[VELOCITY])
        return self.expert.actions(QuadcopterState(array, state.vehicles, state.wrench))


def told_clipped(vehicle: str | Vehicle = "itm") -> ClippedExpert:
    """The geometric expert that is told the true vehicle and wrench, with clipped errors."""
    return ClippedExpert(told_geometric(vehicle))
