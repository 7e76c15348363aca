"""A control step's equations in PyTorch, written to be read: autograd of them is what the compiled
gradients have to be.

Nothing here is shared with the compiled code, except the parameters of a batch, the noise of its
observations, and its gusts. All numbers are float64, and a row is a vehicle.
"""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.random import STEP
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    FORCE_BODY,
    FORCE_WORLD,
    POSITION,
    QUATERNION,
    REFERENCE,
    ROTOR_SPEEDS,
    TORQUE_BODY,
    TORQUE_WORLD,
    VELOCITY,
    P,
)


class State(NamedTuple):
    """What moves. Vectors are in the world frame, body rates in the body frame."""

    position: th.Tensor  # (n, 3), m
    quaternion: th.Tensor  # (n, 4), body to world, (w, x, y, z)
    velocity: th.Tensor  # (n, 3), m/s
    body_rates: th.Tensor  # (n, 3), rad/s
    rotor_speeds: th.Tensor  # (n, 4), rad/s

    @staticmethod
    def of(array):
        """From the rows of the compiled state, (at least 17, n)."""
        parts = (POSITION, QUATERNION, VELOCITY, BODY_RATES, ROTOR_SPEEDS)
        return State(*(array[part].T for part in parts))

    def flat(self):
        """Return (n, 17), in the compiled state's order."""
        return th.cat(self, dim=1)


class Flight(NamedTuple):
    """A flight of some control steps.

    :param states: after each control step, (steps, n, 17).
    :param observations: before each control step, (steps, n, size).
    :param actions: (steps, n, 4).
    """

    states: th.Tensor
    observations: th.Tensor
    actions: th.Tensor


def rotation(quaternion):
    """Return rotation matrices, body to world, (n, 3, 3)."""
    w, x, y, z = quaternion.unbind(1)
    rows = [
        th.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        th.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        th.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return th.stack(rows, dim=1)


def turn(matrix, vectors):
    """Return matrix times vector of each row, (n, 3)."""
    return (matrix @ vectors[:, :, None])[:, :, 0]


def product(p, q):
    """Return products of quaternions, (n, 4)."""
    real = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(dim=1, keepdim=True)
    imaginary = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + th.linalg.cross(p[:, 1:], q[:, 1:])
    return th.cat([real, imaginary], dim=1)


def exponential(half_turn):
    """Return the unit quaternions of half the rotation vectors, (n, 3)."""
    angle = th.linalg.vector_norm(half_turn, dim=1, keepdim=True)
    return th.cat([angle.cos(), th.sinc(angle / np.pi) * half_turn], dim=1)


class Vehicles:
    """The parameters of n vehicles, (n, 1) or (n, axes or rotors) each.

    :param parameters: (parameters, 1 or n), of a batch.
    """

    def __init__(self, parameters, n):
        table = th.tensor(np.broadcast_to(parameters, (len(parameters), n)).T.copy())

        def some(first, count=1):
            return table[:, first : first + count]

        self.mass = some(P.mass)
        self.gravity = some(P.gravity)
        self.inertia = some(P.ixx, 3)
        self.drag = some(P.drag_x, 3)
        self.lift = some(P.thrust_coefficient)
        self.gain_up = some(P.motor_gain_up)
        self.gain_down = some(P.motor_gain_down)
        self.exact = some(P.exact_motors) > 0
        self.thrust_middle = some(P.thrust_middle)
        self.thrust_half_range = some(P.thrust_half_range)
        self.battery = some(P.battery)
        self.shared = some(P.shared_saturation)
        self.arms = some(P.roll_arm_0, 12).reshape(n, 3, 4)
        self.delay = some(P.delay)[:, 0].long()
        self.rotor_drag = some(P.rotor_drag_x, 3)
        self.translational_lift = some(P.translational_lift)
        self.airspeed_moment = some(P.airspeed_moment_roll, 2)
        self.rate_damping = some(P.rate_damping_x, 3)
        self.rotor_inertia = some(P.rotor_inertia)
        self.ground_radius = some(P.ground_effect_radius)
        self.thrust_factors = some(P.thrust_factor_0, 4)
        # The rate loop
        self.shares = some(P.hover_share_0, 4) / 4.0
        self.rate_limits = some(P.rate_limit_x, 3)
        self.rate_gains = some(P.rate_gain_x, 3)
        self.rate_lag = some(P.rate_lag)
        self.mix = some(P.roll_mix_0, 12).reshape(n, 3, 4)

    def commanded_speeds(self, actions):
        """Return the rotor speeds that actions command, (n, 4) (Eqs. 3.18 and 2.4)."""
        thrust = self.thrust_middle + self.thrust_half_range * actions.clamp(-1.0, 1.0)
        return self.speeds_of(thrust)

    def speeds_of(self, thrust):
        """Return the rotor speeds that are commanded for thrusts, (n, 4)."""
        speeds = (thrust / self.lift).sqrt()
        most = (self.thrust_middle + self.thrust_half_range) * self.battery
        greatest = (most / self.lift).sqrt()
        excess = (speeds.amax(dim=1, keepdim=True) - greatest).clamp(min=0.0)
        return th.minimum(speeds - self.shared * excess, greatest).clamp(min=0.0)

    def commanded_rates(self, actions):
        """Return the collective thrusts and body rates that actions command, (n, 4)."""
        actions = actions.clamp(-1.0, 1.0)
        thrust = 4.0 * (self.thrust_middle + self.thrust_half_range * actions[:, :1])
        return th.cat([thrust, self.rate_limits * actions[:, 1:]], dim=1)

    def held_rates(self, rates, command):
        """Return the rotor speeds with which the rate loop holds a command, (n, 4), for filtered
        body rates (n, 3).
        """
        torque = self.rate_gains * (command[:, 1:] - rates)
        torque = torque + th.linalg.cross(rates, self.inertia * rates)
        high = self.thrust_middle + self.thrust_half_range
        low = th.maximum(self.thrust_middle - self.thrust_half_range, 0.001 * high)
        # Roll and pitch first: scaled until they fit, then the thrust makes room.
        highest = (high / self.shares).amin(dim=1, keepdim=True)
        lowest = (low / self.shares).amax(dim=1, keepdim=True)
        tilts = (self.mix[:, :2] * torque[:, :2, None]).sum(dim=1) / self.shares
        spread = tilts.amax(dim=1, keepdim=True) - tilts.amin(dim=1, keepdim=True)
        tilts = tilts * (highest - lowest) / th.maximum(spread, highest - lowest)
        total = th.maximum(command[:, :1], lowest - tilts.amin(dim=1, keepdim=True))
        total = th.minimum(total, highest - tilts.amax(dim=1, keepdim=True))
        thrust = self.shares * (total + tilts)
        # Yaw takes what is left.
        yaw = self.mix[:, 2]
        room = th.where(yaw * torque[:, 2:] > 0.0, high - thrust, thrust - low) / yaw.abs()
        room = room.amin(dim=1, keepdim=True).clamp(min=0.0)
        moment = th.minimum(torque[:, 2:].abs(), room) * torque[:, 2:].sign()
        thrust = thrust + yaw * moment
        # But for rounding, it is within its limits.
        return self.speeds_of(thrust + (thrust.clamp(low, high) - thrust).detach())

    def physics_step(self, state, wanted_speeds, wrench, wind, dt):
        """Return the state after a physics step.

        :param wrench: (n, 12); ``wind`` (n, 3).
        """
        # Rotors (Eq. 4.1). Exact motors use Padé's approximant of 1 - exp(-x).
        old = state.rotor_speeds
        x = dt * th.where(wanted_speeds > old, self.gain_up, self.gain_down)
        share = th.where(self.exact, x / (1 + x / 2 + x**2 / 12), x)
        speeds = old + share * (wanted_speeds - old)
        thrust = self.lift * speeds * th.where(self.exact, old, speeds)
        # Without a radius a lost row may be at height 0.
        height = th.maximum(state.position[:, 2:], 0.5 * self.ground_radius).clamp_min(1e-9)
        near = self.ground_radius / (4.0 * height)
        thrust = thrust * self.thrust_factors / (1.0 - near.square())

        # Newton, in the world frame
        to_world = rotation(state.quaternion)
        to_body = to_world.transpose(1, 2)
        up = th.tensor([0.0, 0.0, 1.0], dtype=th.float64)
        in_body = wrench[:, FORCE_BODY] + thrust.sum(dim=1, keepdim=True) * up
        air = turn(to_body, state.velocity - wind)
        turning = speeds.sum(dim=1, keepdim=True)
        in_body = in_body - (self.drag + self.rotor_drag * turning) * air
        lift = self.translational_lift * air[:, :2].square().sum(dim=1, keepdim=True)
        in_body = in_body + lift * up
        force = wrench[:, FORCE_WORLD] + turn(to_world, in_body)
        velocity = state.velocity + dt * (force / self.mass - self.gravity * up)

        # Euler, in the body frame
        rates = state.body_rates
        torque = wrench[:, TORQUE_BODY] + turn(to_body, wrench[:, TORQUE_WORLD])
        torque = torque + turn(self.arms, thrust)
        # A rotor turns against the yaw moment of its drag. What rotors and body have turns along.
        spins = -self.rotor_inertia * self.arms[:, 2].sign()
        before, after = ((spins * each).sum(dim=1, keepdim=True) * up for each in (old, speeds))
        torque = torque - th.linalg.cross(rates, self.inertia * rates + after)
        torque = torque + (before - after) / dt - self.rate_damping * rates
        roll, pitch = (turning * self.airspeed_moment).unbind(dim=1)
        by_air = [roll * air[:, 1], -pitch * air[:, 0], th.zeros_like(roll)]
        torque = torque + th.stack(by_air, dim=1)
        rates = rates + dt * torque / self.inertia

        # PyBullet's limits, in the world frame. Their derivative is taken as 1.
        velocity = velocity + (velocity.clamp(-100.0, 100.0) - velocity).detach()
        limited = turn(to_body, turn(to_world, rates).clamp(-100.0, 100.0))
        is_fast = rates.norm(dim=1, keepdim=True) > 100.0
        rates = rates + th.where(is_fast, limited - rates, 0.0).detach()

        attitude = product(state.quaternion, exponential(dt / 2 * rates))
        attitude = attitude / attitude.norm(dim=1, keepdim=True)
        return State(state.position + dt * velocity, attitude, velocity, rates, speeds)


class Observer:
    """What a policy sees of n vehicles: frames of features, with their noise held fixed.

    It goes on from what a batch has seen so far, which counts as constant.
    """

    def __init__(self, batch):
        n = batch.n
        self.settings = batch.observation
        self.numbers = batch.integral_numbers
        self.refer(batch)
        scaling = th.tensor(np.broadcast_to(batch.scaling, (len(batch.scaling), n)).T.copy())
        # The compiled code keeps these in float32.
        scaling = scaling.float()
        self.mean = scaling[:, :OBSERVATION_SIZE].double()
        self.std = 1.0 / (1.0 / scaling[:, OBSERVATION_SIZE : 2 * OBSERVATION_SIZE]).double()
        self.relative = scaling[:, -2:-1].double()
        self.additive = scaling[:, -1:].double()
        self.integral = th.tensor(batch.integral.T)
        self.seen = th.tensor(batch.observe()).double()
        # The latest last. The present frame is the first of an observation.
        self.frames = [self.seen[:, : self.settings.frame_size]]
        began = batch.streams[STEP].astype(np.int64)
        for age in range(1, max(self.settings.ages) + 1):
            frame = batch.frames[np.arange(n), (began - age) % batch.frames.shape[1]]
            frame[age > began] = 0.0
            self.frames.insert(0, th.tensor(frame).double())

    def refer(self, batch):
        """Take over where a batch's references are, and what it sees of their future."""
        reference = th.tensor(batch.state[REFERENCE].T)
        self.target, self.target_velocity = reference[:, 0:3], reference[:, 3:6]
        cosine, sine = reference[:, 9], reference[:, 10]
        cosine = cosine + ((cosine == 0.0) & (sine == 0.0))
        zero = th.zeros_like(sine)
        rows = [th.stack([cosine, -sine, zero], 1), th.stack([sine, cosine, zero], 1)]
        up = th.stack([zero, zero, zero + 1.0], 1)
        self.from_heading = th.stack([*rows, up], 1)
        self.turning = up * reference[:, 11:12]
        size = len(self.settings.ages) * self.settings.frame_size
        self.preview = th.tensor(batch.observe()).double()[:, size:]
        self.error = th.tensor(batch.estimate.T.copy())

    def features(self, state):
        """Return the features without noise, in their units, (n, 18)."""
        if self.error.numel():
            position, velocity, rates, turned = self.error[:, :12].split(3, dim=1)
            state = State(
                state.position + position,
                product(state.quaternion, exponential(turned / 2)),
                state.velocity + velocity,
                state.body_rates + rates,
                state.rotor_speeds,
            )
        to_body = rotation(state.quaternion).transpose(1, 2)
        parts = [
            turn(self.from_heading.transpose(1, 2), state.position - self.target),
            (to_body @ self.from_heading).flatten(1),
            turn(to_body, state.velocity - self.target_velocity),
            state.body_rates - turn(to_body, self.turning),
        ]
        return th.cat(parts, dim=1)

    def disturb(self, features, noise):
        """Return features with noise (Eq. 3.16)."""
        relative = self.relative * features
        fixed = self.additive * self.std
        # Relative noise alone has the feature's sign. The 1 only keeps the root's slope finite.
        both = (relative**2 + fixed**2 + (fixed == 0.0)).sqrt()
        return features + th.where(fixed > 0.0, both, relative) * noise

    def look(self, state, action, noise):
        """Return the observation after a control step, (n, size).

        :param action: that led there, (n, 4); ``noise`` (n, 18), standard normals.
        """
        noisy = self.disturb(self.features(state), noise)
        scaled = (noisy - self.mean) / self.std
        if self.settings.position_integral is not None:
            gain_dt, near2, slow2, limit = self.numbers.tolist()
            error, speed = noisy[:, 0:3], noisy[:, 12:15]
            counts = (error.square().sum(dim=1) < near2) & (speed.square().sum(dim=1) < slow2)
            grown = (self.integral + gain_dt * error).clamp(-limit, limit)
            self.integral = th.where(counts[:, None], grown, self.integral)
            scaled = th.cat([scaled[:, :3] + self.integral / self.std[:, :3], scaled[:, 3:]], dim=1)
        if self.settings.last_action:
            scaled = th.cat([scaled, action.clamp(-1.0, 1.0)], dim=1)
        self.frames.append(scaled)
        frames = [self.frames[-1 - age] for age in self.settings.ages]
        return th.cat([*frames, self.preview], dim=1)


def noise_of(batch):
    """Return the standard normals of a batch's present observation, (n, 18), to 1e-6.

    They are what an additive noise of one σ changes.
    """
    levels = batch.scaling[-2:]
    kept = levels.copy()
    levels[:] = 0.0
    plain = batch.observe()
    levels[1] = 1.0
    noisy = batch.observe()
    levels[:] = kept
    return th.tensor(noisy - plain)[:, :OBSERVATION_SIZE].double()


def fly(batch, act, steps, substeps, start=None):
    """Fly on from the present state of a batch, in PyTorch, and leave the batch as it is.

    :param act: from the number of a control step and the observation, (n, size), to the actions
        (n, 4).
    :param start: the state to begin with, (n, 17); None: that of the batch.
    :return: :class:`Flight`.
    """
    before = batch.snapshot()
    vehicles = Vehicles(batch.vehicles, batch.n)
    observer = Observer(batch)
    dt = batch.physics_step * batch.substeps / substeps
    state = State.of(th.tensor(batch.state) if start is None else start.T)
    # Commands under way, then those of this flight, (commands, n, 4)
    commands = [*th.tensor(batch.queue).transpose(1, 2)]
    delay, longest, rows = vehicles.delay, len(batch.queue), th.arange(batch.n)
    by_rates = batch.filtered_rates.size > 0
    commanded = vehicles.commanded_rates if by_rates else vehicles.commanded_speeds
    filtered = th.tensor(batch.filtered_rates.T)
    states, observations, actions = [], [observer.seen], []
    for step in range(steps):
        action = act(step, observations[-1])
        commands.append(commanded(action))
        due = th.where(delay > step, step, longest + step - delay)
        wanted = th.stack(commands)[due, rows]
        wrench, wind = th.tensor(batch.total_wrench().T), th.tensor(batch.total_wind().T)
        due_now = wanted
        for _ in range(substeps):
            if by_rates:
                # PT1
                filtered = filtered + dt / (dt + vehicles.rate_lag) * (state.body_rates - filtered)
                wanted = vehicles.held_rates(filtered, due_now)
            state = vehicles.physics_step(state, wanted, wrench, wind, dt)
        # The batch flies along for its random numbers.
        batch.step_on(action.detach().numpy(), substeps)
        observer.refer(batch)
        states.append(state.flat())
        actions.append(action)
        observations.append(observer.look(state, action, noise_of(batch)))
    batch.restore(before)
    return Flight(th.stack(states), th.stack(observations[:-1]), th.stack(actions))
