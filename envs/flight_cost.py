"""Costs of flights that :class:`~sb3_quad.algorithms.apg.APG` can differentiate."""

from collections.abc import Callable
from typing import NamedTuple

import torch as th
from torch.nn import functional

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray
from sb3_quad.envs.simulation.reward import CALM_CHANGE, CALM_DISTANCE
from sb3_quad.envs.simulation.state import REFERENCE, REFERENCE_PARTS, REFERENCE_SIZE, STATE

# Distances, m, at which the coarse and the fine term of the position reach half of their limit.
COARSE, FINE = 0.5, 0.05
# Weight of the body rates at the target. Without it an agent oscillates there with delays or motors
# that it has rarely seen.
BODY_RATES_WEIGHT = 0.03
# Weight of the heading error, rad, at the target, if a heading is commanded.
HEADING = 0.1
# Below this height, m, a flight is in danger.
SAFE_HEIGHT = 1.5


class FlownStates(NamedTuple):
    """The states after a number of control steps, and the actions that led to them.

    Shapes begin with (steps, n). Vectors are in the world frame unless noted.
    """

    position: th.Tensor  # (..., 3), m
    quaternion: th.Tensor  # (..., 4), body to world, (w, x, y, z)
    velocity: th.Tensor  # (..., 3), m/s
    body_rates: th.Tensor  # (..., 3), body frame, rad/s
    rotor_speeds: th.Tensor  # (..., 4), rad/s
    target: th.Tensor  # (..., 3), m: the position of the reference
    target_velocity: th.Tensor  # (..., 3), m/s
    target_acceleration: th.Tensor  # (..., 3), m/s²
    target_heading: th.Tensor  # (..., 2), cosine and sine; zeros if none is commanded
    target_heading_rate: th.Tensor  # (..., 1), rad/s
    target_ahead: th.Tensor  # (..., 3), m/s², the acceleration in AHEAD seconds
    actions: th.Tensor  # (..., 4), before they are clipped to [-1, 1]

    @property
    def distance(self) -> th.Tensor:
        """|r - r_T|, m."""
        return length(self.position - self.target)

    @property
    def r33(self) -> th.Tensor:
        """The cosine of the tilt."""
        return 1.0 - 2.0 * self.quaternion[..., 1:3].square().sum(dim=-1)

    @property
    def heading_error(self) -> th.Tensor:
        """2 sin(e / 2), where e is the angle between the heading and the commanded one; 0 if none
        is commanded. The heading is that of the vehicle's nose, projected onto the ground.
        """
        w, x, y, z = self.quaternion.unbind(dim=-1)
        nose = th.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)], dim=-1)
        nose = nose / (nose.square().sum(dim=-1, keepdim=True) + 1e-6).sqrt()
        commanded = self.target_heading
        return length(commanded - nose * commanded.square().sum(dim=-1, keepdim=True))


def cost_and_gradients(
    cost: Callable[[FlownStates], th.Tensor],
    states: FloatArray,
    actions: Float32Array,
    counts: BoolArray,
) -> tuple[float, FloatArray, FloatArray]:
    """Evaluate a cost as :data:`~sb3_quad.envs.simulation.tape.FlightCost` says, by autograd.

    :raises ConfigError: the cost is not a tensor (steps, n) that depends on states or actions.
    """
    # Flights do not change the reference, the last rows.
    flown, reference = th.split(th.from_numpy(states), [REFERENCE.start, REFERENCE_SIZE], dim=1)
    flown.requires_grad_()
    action_tensor = th.from_numpy(actions).double().requires_grad_()
    # Split once: for each slice, autograd would add up an array of all states.
    sizes = [*STATE.values()][: -len(REFERENCE_PARTS)]
    parts = th.split(flown, sizes, dim=1)
    parts += th.split(reference, [*REFERENCE_PARTS.values()], dim=1)
    turned = [part.transpose(1, 2) for part in parts]
    costs = cost(FlownStates._make([*turned, action_tensor]))
    shape = tuple(counts.shape)
    if not isinstance(costs, th.Tensor) or costs.shape != shape or not costs.requires_grad:
        given = getattr(costs, "shape", type(costs).__name__)
        raise ConfigError(
            f"cost: returned {given}; it must return a tensor of shape (steps, n) = {shape} that"
            " depends on the states or the actions"
        )
    mean = th.where(th.from_numpy(counts), costs, 0.0).mean()
    gradients = th.autograd.grad(
        mean, (flown, action_tensor), allow_unused=True, materialize_grads=True
    )
    return mean.item(), gradients[0].numpy(), gradients[1].numpy()


def length(vectors: th.Tensor) -> th.Tensor:
    """Return the length of vectors (..., 3), smooth at zero."""
    return (vectors.square().sum(dim=-1) + 1e-8).sqrt()


def flight_cost(flown: FlownStates) -> th.Tensor:
    """Return the default cost of each control step, (steps, n).

    The distance costs d / (d + 0.5) + d / (d + 0.05), which is steep in the last metre and flat far
    away, but never constant, so that no target is too far to matter. Body rates cost little on the
    way, and more within half a metre of the target. Small terms penalise tilt, actions beyond their
    limits, and a heading other than the commanded one. Below a height of 1.5 m, proximity to the
    ground is penalised, since the crash itself has no gradient.
    """
    d = flown.distance
    cost = d / (d + COARSE) + d / (d + FINE)
    near = 1.0 / _farness(d)
    weight = 0.002 + BODY_RATES_WEIGHT * near
    cost = cost + weight * length(flown.body_rates) + 0.001 * (1.0 - flown.r33)
    if flown.target_heading.any():
        cost = cost + HEADING * near * flown.heading_error
    beyond = functional.softshrink(flown.actions, 1.0)
    cost = cost + 0.01 * beyond.square().sum(dim=-1)
    return cost + 0.5 * (SAFE_HEIGHT - flown.position[..., 2]).relu()


def calm_cost(flown: FlownStates, control_step: float) -> th.Tensor:
    """Return an additional cost of body rates and changing commands at the target, (steps, n).

    It is ``(|ω| + 0.1 c) / (1 + (d / 0.5)²)`` at the distance d, m, with the body rates ω, rad/s.
    The change c of the commands is the root mean square over the rotors, 1/s; that of the first
    control step counts as zero. The reward of a task with a ``calm_cost`` has the same term.

    :param control_step: s.
    """
    # Its derivative takes a quarter of the time of that of clamp.
    commands = functional.hardtanh(flown.actions)
    change = length(commands[1:] - commands[:-1]) / (2.0 * control_step)
    change = functional.pad(change, (0, 0, 1, 0))
    return (length(flown.body_rates) + CALM_CHANGE * change) / _farness(flown.distance)


def _farness(d: th.Tensor) -> th.Tensor:
    """Return the divisor of terms that matter near the target, at distances d, m; 1 at d = 0."""
    return 1.0 + (d / CALM_DISTANCE) ** 2
