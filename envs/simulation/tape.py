"""Flights of a batch, recorded so that their cost can be differentiated with respect to every
action.
"""

from collections.abc import Callable

import numpy as np
from numba import float32

from sb3_quad.base.compiled import LANES, atomic_add, compiled, inner
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.envs.simulation.adjoint import (
    CARRIED,
    DIFFERENTIATED,
    MOVING,
    features_vjp,
    flight_vjp,
    limits_vjp,
    noise_vjp,
    relation_vjp,
)
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.estimator import displace, turn_attitudes
from sb3_quad.envs.simulation.kernel import (
    CHUNK,
    load_rows,
    load_scaling,
    load_vehicles,
    new_block,
    save_rows,
)
from sb3_quad.envs.simulation.observation import (
    FEATURE_SIZES,
    OBSERVATION_SIZE,
    F,
    features,
    with_noise,
)
from sb3_quad.envs.simulation.physics import limit_speeds, rotor_speed
from sb3_quad.envs.simulation.random import (
    EPISODE,
    OBSERVATION_NOISE,
    STEP,
    random_words,
    standard_normals,
)
from sb3_quad.envs.simulation.rate_loop import rate_command
from sb3_quad.envs.simulation.state import STATE_SIZE, P, X
from sb3_quad.envs.simulation.threads import DONE, LEFT, finish, share_out

FlightCost = Callable[[FloatArray, Float32Array, BoolArray], tuple[float, FloatArray, FloatArray]]
"""A function of the states after each step (steps, STATE_SIZE, n), the actions (steps, n, 4), and
whether each counts (steps, n). It returns the mean cost, its gradient with respect to the first
MOVING rows of the states, or to all, and that with respect to the actions.
"""


class FlightTape:
    """The flights of a batch for some control steps, and the backward pass through these steps.

    Record with :meth:`reset` and a :meth:`step` for each control step. Then call :meth:`begin`, and
    :meth:`backward` for each step, the last one first.

    A row that crashes or leaves the range costs nothing from there on and has no gradient, unless
    recordings continue below the ground.

    :param batch: the batch that flies. No time limit ends an episode within a recording.
    :param n_steps: control steps of a recording.
    :param substeps: physics steps in a control step; None: those of the batch. Two take half the
        time of four, and differ little.
    :param cost: the cost that :meth:`begin` takes unless it is given another.
    :param end_at_ground: whether a row ends where it crashes. If not, it counts as lost there, but
        flies on below the ground, and only leaving the range ends it.
    """

    def __init__(
        self,
        batch: QuadcopterBatch,
        n_steps: int,
        substeps: int | None = None,
        cost: FlightCost | None = None,
        end_at_ground: bool = True,
    ) -> None:
        if FEATURE_SIZES.keys() != DIFFERENTIATED:
            names = ", ".join(FEATURE_SIZES.keys() - DIFFERENTIATED)
            raise ConfigError(f"features {names}: have no gradient yet; see features_vjp")
        n = batch.n
        self.substeps = batch.substeps if substeps is None else substeps
        self.control_step = batch.physics_step * batch.substeps
        self.physics_step = self.control_step / self.substeps
        self.batch = batch
        self.n_steps = n_steps
        self._cost = cost
        self._end_at_ground = end_at_ground
        # The states before each control step and after the last one
        self.states = np.zeros((n_steps + 1, STATE_SIZE, n))
        self.actions = np.zeros((n_steps, n, 4), np.float32)
        self.rewards = np.zeros((n_steps, n), np.float32)
        # Control steps that each row has flown, and whether it crashed or left the range then
        self.lengths = np.full(n, n_steps)
        self.lost = np.zeros(n, np.bool_)
        # The control step that each row ends with; after the recording: it does not
        self.ends = np.full(n, n_steps + 1)
        self._integrals = np.zeros((n_steps, *batch.integral.shape))
        self._estimates = np.zeros((n_steps, *batch.estimate.shape))
        self._wrenches = np.zeros((n_steps, *batch.wrench.shape))
        self._winds = np.zeros((n_steps, *batch.wind.shape))
        self._filtered = np.zeros((n_steps, *batch.filtered_rates.shape))

    def reset(self, continue_flights: bool = False) -> Float32Array:
        """Begin a recording; return the observations, float32 (n, size).

        :param continue_flights: let the rows that still fly continue their episodes, unless
            these have reached their time limit.
        """
        batch = self.batch
        # Rows that have not flown yet are in no episode.
        ended = (batch.streams[EPISODE] == 0) | (batch.streams[STEP] >= batch.limits)
        observations = batch.reset(np.flatnonzero(ended) if continue_flights else None)
        # A rotor must not overshoot its commanded speed because the physics steps are long.
        vehicles = batch.vehicles
        gains = vehicles[[P.motor_gain_up, P.motor_gain_down]]
        fastest = (gains * (1.0 - vehicles[P.exact_motors])).max()
        if fastest * self.physics_step > 1.0:
            raise ConfigError(
                f"substeps {self.substeps}: too few for motors of gain {fastest:.3g} per second;"
                " give None, for those of the simulation"
            )
        self._at = 0
        self._streams = batch.streams.copy()
        self._queue = batch.queue.copy()
        self.lengths[:] = self.n_steps
        self.lost[:] = False
        self.ends[:] = self.n_steps + 1
        return observations

    def step(self, actions: Float32Array) -> Float32Array:
        """Fly a control step; return the observations after it.

        :param actions: float32 (n, 4); in flight they are clipped to [-1, 1], here they are not.
        """
        batch = self.batch
        t = self._at
        if t == 0:
            self.states[0] = batch.state
        self.actions[t] = actions
        self._integrals[t] = batch.integral
        self._estimates[t] = batch.estimate
        self._wrenches[t] = batch.total_wrench()
        self._winds[t] = batch.total_wind()
        self._filtered[t] = batch.filtered_rates
        observations, self.rewards[t], dones = batch.step_on(actions, self.substeps)
        self._at = t + 1
        self.states[self._at] = batch.state
        done = dones.nonzero()[0]
        if done.size:
            self._note_ends(done)
        return observations

    def _note_ends(self, rows: IntArray) -> None:
        """Note which of these rows the last step has ended; the time limit of others is over."""
        outcome = self.batch.outcome.take(rows)
        is_over = ~outcome["truncated"]
        newly_lost = rows[is_over & ~self.lost[rows]]
        self.lengths[newly_lost] = self._at
        self.lost[newly_lost] = True
        # Their episodes are over for later recordings, too, and for those of a resumed run.
        self.batch.limits[newly_lost] = 0
        if not self._end_at_ground:
            is_over &= outcome["out_of_range"] | ~outcome["collision"]
        over = rows[is_over]
        self.ends[over] = np.minimum(self.ends[over], self._at)

    @property
    def counts(self) -> BoolArray:
        """Whether the state after each control step counts, (n_steps, n).

        The state that a row ends in does not: after a crash it lies outside the model.
        """
        return np.arange(1, self.n_steps + 1)[:, None] < self.ends

    def episodes(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the sum of each row's rewards, its length, and whether it was lost, (n,) each."""
        flown = np.arange(self.n_steps)[:, None] < self.lengths
        return (self.rewards * flown).sum(axis=0), self.lengths, self.lost

    def begin(self, cost: FlightCost | None = None) -> float:
        """Begin the backward pass; return the mean cost of a control step."""
        cost = cost or self._cost
        assert cost is not None
        value, grad_states, grad_actions = cost(self.states[1:], self.actions, self.counts)
        batch = self.batch
        self._grad_states = grad_states
        self._grad_actions = grad_actions
        # The gradient with respect to the state before the step that backward() was last called
        # for, without what comes through the observation of that state
        self.grad_start = np.zeros((MOVING, batch.n))
        self._grad_frames = np.zeros((batch.ages[-1] + 1, batch.n, batch.observation.frame_size))
        self._grad_integral = np.zeros_like(batch.integral)
        self._grad_filtered = np.zeros_like(batch.filtered_rates)
        return value

    def backward(self, step: int, grad_observation: Float32Array) -> FloatArray:
        """Return the gradient with respect to the actions of a control step, (n, 4).

        :param grad_observation: the gradient with respect to the observations after it, float32
            (n, size), which comes from the later actions.
        """
        batch = self.batch
        self.grad_start += self._grad_states[step, :MOVING]
        share_out(
            step_vjp,
            batch.helpers,
            step,
            self.ends,
            self.states,
            self.actions,
            self._queue,
            self._streams,
            self._estimates,
            self._wrenches[step],
            self._winds[step],
            self._filtered[step],
            batch.vehicles,
            batch.scaling,
            batch.moves,
            batch.ages,
            self._integrals,
            batch.integral_numbers,
            grad_observation,
            self._grad_frames,
            self._grad_integral,
            self._grad_filtered,
            self.grad_start,
            self._grad_actions,
            self.physics_step,
            self.substeps,
            batch.in_air,
        )
        result: FloatArray = self._grad_actions[step]
        return result


@compiled
def step_vjp(
    control, leads, step, lengths, states, actions, queue, streams, estimates, wrench, wind,
    filtered_rates, vehicles, scaling, moves, ages, integrals, integral_numbers,
    grad_observation, grad_frames, grad_integral, grad_filtered, gradient, grad_actions,
    physics_step, substeps, in_air,
):  # fmt: skip
    """Vector-Jacobian product of a control step and the observation after it, see FlightTape.

    The arguments are as in :func:`.kernel.step`, with a leading axis for the control steps, and:

    :param grad_frames: (depth, n, frame size), with respect to the frames of the latest control
        steps, step s in slot s % depth.
    :param grad_integral: (0 or 3, n), with respect to the position integral; ``grad_filtered``
        (3, 0 or n), to the filtered body rates.
    :param gradient: (MOVING, n), with respect to the state after the step; becomes that with
        respect to the state before.
    :param grad_actions: (steps, n, 4), is added to where an earlier action acts after a delay or is
        observed.
    """
    n = states.shape[2]
    chunks = (n + CHUNK - 1) // CHUNK
    if leads:
        control[LEFT] = chunks
    blocks = new_block()
    by_rates = filtered_rates.shape[1] > 0
    substep_states = np.empty((substeps + 1, CARRIED, LANES))
    own = np.empty((CARRIED, LANES))
    grad_feature = np.empty((OBSERVATION_SIZE, LANES))
    grad_wanted = np.empty((4, LANES))
    grad_speed = np.empty((4, LANES))
    taken = 0
    while True:
        left = atomic_add(control, LEFT, -1)
        if left <= 0:
            break
        taken += 1
        chunk = (chunks - left) * CHUNK
        for first in range(chunk, min(chunk + CHUNK, n), LANES):
            b = blocks[0]
            count = min(LANES, n - first)
            for lane in range(LANES):
                b.row[lane] = first + min(lane, count - 1)
            load_vehicles(b, vehicles, first, physics_step, in_air, by_rates)
            load_rows(gradient, first, own[:MOVING])
            if by_rates:
                load_rows(grad_filtered, first, own[MOVING:])
                load_rows(filtered_rates, first, b.filtered_rates)
            if step + 1 < len(actions):
                load_scaling(b, scaling)
                load_rows(states[step + 1], first, b.state)
                load_rows(streams, first, b.stream)
                b.stream[STEP] += np.uint32(step + 1)
                is_estimate = estimates.shape[2] > 0
                if is_estimate:
                    displace(b, estimates[step + 1])
                    # While gradients of features are added, all are with respect to the estimate.
                    turn_attitudes(b, own[X.quaternion : X.velocity], estimates[step + 1], 1.0)
                features(b, moves)
                random_words(b, OBSERVATION_NOISE)
                standard_normals(b)
                _frames_vjp(
                    b, first, count, step + 1, lengths, actions, ages, integrals, integral_numbers,
                    grad_observation, grad_frames, grad_integral, grad_feature, grad_actions,
                )  # fmt: skip
                noise_vjp(b, grad_feature)
                if moves:
                    relation_vjp(b, grad_feature)
                features_vjp(b, grad_feature, own)
                if is_estimate:
                    turn_attitudes(b, own[X.quaternion : X.velocity], estimates[step + 1], -1.0)

            load_rows(states[step], first, b.state)
            load_rows(wrench, first, b.wrench)
            load_rows(wind, first, b.wind)
            for lane in range(LANES):
                i = b.row[lane]
                acted = step - np.int64(b.delay[lane])
                for k in range(4):
                    if acted < 0:
                        b.command[k, lane] = queue[step, k, i]
                    elif by_rates:
                        b.command[k, lane] = rate_command(b, lane, k, actions[acted, i, k])
                    else:
                        b.command[k, lane] = rotor_speed(b, lane, actions[acted, i, k])
                    b.wanted_speeds[k, lane] = b.command[k, lane]
                if by_rates:
                    b.rate_command[:, lane] = b.command[:, lane]
                else:
                    limit_speeds(b, b.wanted_speeds, lane)
                if step >= lengths[i]:
                    own[:, lane] = 0.0
            flight_vjp(
                b, substep_states, own, grad_wanted, grad_speed, physics_step, substeps, in_air,
                by_rates,
            )  # fmt: skip
            if by_rates:
                save_rows(own[MOVING:], first, count, grad_filtered)
            else:
                limits_vjp(b, grad_wanted)
            save_rows(own[:MOVING], first, count, gradient)
            for lane in range(count):
                i = first + lane
                acted = step - np.int64(b.delay[lane])
                for k in range(4):
                    if acted >= 0 and abs(actions[acted, i, k]) < float32(1.0):
                        slope = b.square_half_range[lane] / (2.0 * b.command[k, lane])
                        if by_rates:
                            slope = b.command_range[k, lane]
                        grad_actions[acted, i, k] += slope * grad_wanted[k, lane]
    atomic_add(control, DONE, taken)
    if leads:
        finish(control, chunks)
    return True


@inner
def _frames_vjp(
    b, first, count, step, lengths, actions, ages, integrals, numbers, grad_observation,
    grad_frames, grad_integral, grad_feature, grad_actions,
):  # fmt: skip
    """Carry the gradient with respect to an observation to the frames in it, and that with respect
    to the present frame to its features, the last action and the position integral.
    """
    grad_feature[:] = 0.0
    depth, size = grad_frames.shape[0], grad_frames.shape[2]
    for lane in range(count):
        i = first + lane
        if step >= lengths[i]:
            continue
        at = 0
        for age in ages:
            if age <= step:
                grad_frames[(step - age) % depth, i] += grad_observation[i, at : at + size]
            at += size
        frame = grad_frames[step % depth, i]
        for k in range(size - OBSERVATION_SIZE):
            if abs(actions[step - 1, i, k]) < float32(1.0):
                grad_actions[step - 1, i, k] += frame[OBSERVATION_SIZE + k]
        if grad_integral.shape[0] > 0:
            _integral_vjp(b, lane, i, integrals[step], numbers, frame, grad_integral)
        grad_feature[:, lane] = frame[:OBSERVATION_SIZE]
        frame[:] = 0.0


@inner
def _integral_vjp(b, lane, i, integral, numbers, frame, grad_integral):
    """Vector-Jacobian product of :func:`.frames.integrate_position` of a row.

    :param frame: the gradient with respect to its frame.
    """
    error2 = speed2 = 0.0
    for axis in range(3):
        error = with_noise(b, F.position + axis, lane)
        speed = with_noise(b, F.velocity + axis, lane)
        error2 += error * error
        speed2 += speed * speed
    near = error2 < numbers[1] and speed2 < numbers[2]
    for axis in range(3):
        k = F.position + axis
        grad_integral[axis, i] += frame[k] * b.inverse_std[k, lane]
        if abs(integral[axis, i]) >= numbers[3]:
            grad_integral[axis, i] = 0.0
        elif near:
            frame[k] += grad_integral[axis, i] * numbers[0] / b.inverse_std[k, lane]
