"""A policy that sees more than the present features: what it keeps of a flight is a state that goes in and comes out."""

from typing import Any

import torch as th

from sb3_quad.export.check import Reference
from sb3_quad.export.network import EXAMPLE, Network
from sb3_quad.simulation.observation import GROUPS


class StatefulNetwork(Network):
    """A network with the frames of :mod:`sb3_quad.simulation.frames` in a state, float32 (batch, ``state_size``).

    The state is zeros as a flight begins. It holds what the policy sees of these: the last action (4); the integral s (3), m,
    with a 1 once a flight has begun; the earlier frames, scaled, the latest first.

    :param reference: its ``observation`` says what the policy sees.
    """

    def __init__(self, layers: th.nn.Sequential, reference: Reference) -> None:
        super().__init__(layers, reference)
        seen, integral = reference.observation, reference.observation.position_integral
        self.observation, self.integral = seen, integral and integral.numbers(reference.vehicle.control_step)
        self.actions = 4 * seen.last_action  # numbers of the last action in the state
        self.newest = self.actions + 4 * (integral is not None)  # where the latest frame begins in it
        state_size = self.newest + seen.ages[-1] * seen.frame_size
        self.inputs, self.outputs = ["observation", "state"], [self.result, "next_state"]
        self.examples = EXAMPLE, th.zeros(len(EXAMPLE), state_size)
        kept = [f"{name} {value}" for name, value in seen.model_dump(mode="json").items() if value]
        rule = "zeros begin a flight, then it is the next_state of the call before; in C a struct, which NAME_reset begins"
        self.facts = {"state": f"{rule}. It holds what {', '.join(kept)} need", "state_size": f"{state_size}"}

    def forward(self, observation: th.Tensor, state: th.Tensor) -> Any:  # type: ignore[override]
        """Rotor thrusts or speeds, (batch, 4), and the next state, of observations, (batch, 18), and the present state."""
        frame, kept = (observation - self.mean) * self.inverse_std, []
        if self.integral:
            gain, distance2, speed2, limit = self.integral
            e, v = observation[:, GROUPS["position"]], observation[:, GROUPS["velocity"]]
            s, begun = state[:, self.actions : self.newest - 1], state[:, self.newest - 1 : self.newest]
            near = (e.square().sum(1, keepdim=True) < distance2) & (v.square().sum(1, keepdim=True) < speed2)
            s = th.where(near & (begun > 0), s + gain * e, s).clamp(-limit, limit)
            shifted = frame[:, :3] + s * self.inverse_std[:3]  # the position comes first
            frame, kept = th.cat([shifted, frame[:, 3:]], dim=1), [s, begun.clamp(min=1.0)]
        frames = th.cat([frame, state[:, : self.actions], state[:, self.newest :]], dim=1)
        size, ages = self.observation.frame_size, self.observation.ages
        action = self.layers(th.cat([frames[:, age * size : (age + 1) * size] for age in ages], dim=1)).clamp(-1.0, 1.0)
        following = [action[:, : self.actions], *kept, frames[:, : ages[-1] * size]]
        return self.command(action), th.cat(following, dim=1)
