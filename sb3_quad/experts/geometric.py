"""A geometric controller for large angles: it recovers from nearly every attitude, spin and fall,
and flies to targets.
"""

import math

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.experts.protocol import Actions, Expert
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.physics import rotation_rows
from sb3_quad.simulation.state import (
    FORCE_WORLD,
    STATE,
    WRENCH_SIZE,
    P,
    QuadcopterState,
    W,
    drag_forces,
    first_rows,
    row_slices,
)
from sb3_quad.vehicles.gains import GAIN_NAMES, GeometricGains
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

G = first_rows(dict.fromkeys(GAIN_NAMES, 1))
_ROWS = [
    row_slices(STATE)[name]
    for name in ("position", "quaternion", "velocity", "body_rates", "target")
]
_NO_WRENCH = np.zeros((WRENCH_SIZE, 1))
_DRAG_LEFT = 0.5  # of the drag of its own motion, uncompensated: it damps
_SLOWER = dict.fromkeys(
    ("position", "velocity", "height_position", "height_velocity", "attitude"), 0.85
)
_LATE = {
    **_SLOWER,
    "descent": 0.5,
    "body_rates": 1.25,
}  # what privileged_derived multiplies where commands act late
_LATE_FROM, _LATE_TO = 0.085, 0.125  # s of command lag: not yet, fully
# Times the yaw gain: an error in the moment set against a known torque becomes a yaw rate / gain
_PRIVILEGED_YAW = 4.0


def derived_gains(vehicle: Vehicle) -> GeometricGains:
    """Gains for a vehicle whose YAML has none, in proportion to its control authority, by search.

    Found together for ITM, Crazyflie, Hummingbird, one with slow motors, and vehicles of the
    distribution ``raptor``, told. The scales are the lag τ from a command to its thrust
    (``Vehicle.command_lag``); the greatest angular acceleration a_φ about the weaker of roll and
    pitch; the time to turn, τ + 1/√a_φ; and the greatest accelerations: upwards, g (c - 1),
    sideways at constant height, g √(c² - 1), and downwards, g (1 - l), with thrust limits l and c
    in hover thrusts.
    """
    derived = _derived_gains(vehicle.parameters()[:, None], vehicle.control_step)
    return GeometricGains.model_validate({name: float(value[0]) for name, value in derived.items()})


def _command_lag(v: FloatArray, control_step: float) -> FloatArray:
    return np.asarray(
        (v[P.delay] + 0.5) * control_step + 0.5 / v[P.motor_gain_up] + 0.5 / v[P.motor_gain_down]
    )


def _derived_gains(v: FloatArray, control_step: float) -> dict[str, FloatArray]:
    """The gains of :func:`derived_gains` by name, (n,) each, for the parameters of n vehicles."""
    moments = (
        np.abs(v[P.roll_arm_0 : P.yaw_arm_0].reshape(2, 4, -1)).sum(axis=1) * v[P.thrust_half_range]
    )
    turn, lag, gravity = (
        (moments / v[[P.ixx, P.iyy]]).min(axis=0),
        _command_lag(v, control_step),
        v[P.gravity],
    )
    least, most = (
        (v[P.thrust_middle] + sign * v[P.thrust_half_range]) / v[P.hover_thrust]
        for sign in (-1.0, 1.0)
    )
    rate = np.minimum(1.0 / (lag + 1.0 / np.sqrt(turn)), 0.438 / lag)
    sideways = np.sqrt(np.maximum(most, 1.01) ** 2 - 1.0)  # a tired vehicle may not even hover
    upwards = gravity * (np.maximum(most, 1.01) - 1.0)
    return {
        "position": 0.285 * rate,
        "velocity": 0.607 * rate,
        "height_position": 0.407 * rate,
        "height_velocity": 0.937 * rate,
        "deceleration": 1.07 * gravity * sideways,
        "height_deceleration": 1.63 * gravity * (1.0 - least),
        "descent": gravity * np.minimum(0.9, 1.56 * (1.0 - least)),
        "tilt": 1.90 * sideways,
        "attitude": 1.53 * rate,
        "angular_deceleration": 1.17 * turn,
        "body_rates": 0.587 / lag,
        "yaw_rate": 0.132 / lag,
        "descent_deceleration": 0.612 * upwards,
    }


class _TrueConstants:
    """The law's constants for n vehicles of known parameters, computed anew only for vehicles that
    have changed.
    """

    def __init__(self, vehicle: Vehicle, gains: GeometricGains, late: dict[str, float]) -> None:
        self._control_step, self._seen = vehicle.control_step, np.empty(0)
        self._scale = gains.values()[:, None] / self._gains(vehicle.parameters()[:, None])
        self._scale[G.yaw_rate] *= _PRIVILEGED_YAW
        self._late = np.array([[late.get(name, 1.0)] for name in GAIN_NAMES])

    def _gains(self, v: FloatArray) -> FloatArray:
        return np.stack([*_derived_gains(v, self._control_step).values()])

    def constants(self, vehicles: FloatArray) -> tuple[FloatArray, ...]:
        """Gains (gains, n), body (6, n), inverses of mixers (n, 4, 4) and thrust ranges (2, n)."""
        if self._seen.shape != vehicles.shape:
            self._seen = np.full_like(vehicles, np.nan)
            n = vehicles.shape[1]
            self._all = (
                np.empty((len(self._scale), n)),
                np.empty((6, n)),
                np.empty((n, 4, 4)),
                np.empty((2, n)),
            )
        new = np.flatnonzero((self._seen != vehicles).any(axis=0))
        if new.size:
            v = self._seen[:, new] = vehicles[:, new]
            gains, body, inverses, ranges = self._all
            body[:, new] = (
                *v[[P.mass, P.gravity, P.ixx, P.iyy, P.izz]],
                _command_lag(v, self._control_step),
            )
            late = np.clip((body[-1, new] - _LATE_FROM) / (_LATE_TO - _LATE_FROM), 0.0, 1.0)
            gains[:, new] = self._scale * self._gains(v) * (1.0 + (self._late - 1.0) * late)
            arms = v[P.roll_arm_0 : P.roll_arm_0 + 12].reshape(3, 4, -1)
            inverses[new] = np.linalg.inv(
                np.concatenate([np.ones((1, *arms.shape[1:])), arms]).transpose(2, 0, 1)
            )
            ranges[:, new] = (
                v[P.thrust_middle] - v[P.thrust_half_range],
                v[P.thrust_middle] + v[P.thrust_half_range],
            )
        return self._all


class GeometricExpert(Expert):
    """Position and attitude control on S² for large angles; docs/research/experts.md has its law in
    formulas.

    After Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)" (CDC
    2010), with reduced attitude (Chaturvedi, Sanyal and McClamroch, "Rigid-body attitude control",
    IEEE Control Systems 31(3), 2011): the thrust direction only, before the yaw, as in Brescianini
    and D'Andrea, "Tilt-prioritized quadrocopter attitude control" (IEEE Trans. Control Systems
    Technology 28(2), 2020), since no task here asks for a heading. What it adds to them: velocities
    and body rates that the vehicle can brake from, the attitude as it will be when the command
    acts, the long way round where the spin makes that quicker, and rotor thrusts that give up yaw
    before thrust and thrust before tilt. Its actions are a function of what the 18 observed
    features hold; it has no state.

    :param vehicle: name, YAML path or Vehicle it is designed for.
    :param gains: the :class:`GeometricGains`; None for those in the vehicle's YAML
        (``geometric_gains``), or :func:`derived_gains` where it has none.
    :param privileged: whether it uses each vehicle's true parameters and compensates the external wrench,
        as far as a state holds them (``state.vehicles``, ``state.wrench``). Its gains then scale
        with the vehicle as :func:`derived_gains` do.
    :param reserve: thrust, in weights, that it keeps back when it plans to brake a descent.
    :param late: times the gains of that name, the more the later commands act: fully from a command
        lag of 0.125 s on.
    :raises ConfigError: a negative reserve, an unknown gain, or either parameter without ``privileged``.
    """

    def __init__(
        self,
        vehicle: str | Vehicle = "itm",
        gains: GeometricGains | None = None,
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
        privileged: bool = False,
        reserve: float = 0.0,
        late: dict[str, float] | None = None,
    ) -> None:
        super().__init__(vehicle, observation_mean, observation_std)
        if reserve < 0.0 or (reserve and not privileged):
            raise ConfigError(
                f"reserve {reserve:g}: must not be negative, and needs privileged=True"
            )
        if late and (not privileged or set(late) - set(GAIN_NAMES)):
            raise ConfigError(
                f"late {', '.join(late)}: must be among {', '.join(GAIN_NAMES)}, and needs privileged=True"
            )
        self.reserve = reserve
        v = self.vehicle
        self.gains = gains or v.geometric_gains or derived_gains(v)
        body = np.array([v.mass, v.gravity, *v.inertia, v.command_lag])
        self._constants = (
            self.gains.values()[:, None],
            body[:, None],
            v.mixer_inverse[None],
            np.array(v.thrust_range)[:, None],
        )
        self._privileged = _TrueConstants(v, self.gains, late or {}) if privileged else None

    def actions(self, state: QuadcopterState) -> Actions:
        """Actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        actions = np.empty((state.n, 4), dtype=np.float32)
        moving = [state.array[rows] for rows in _ROWS]
        wrench = _NO_WRENCH if self._privileged is None or state.wrench is None else state.wrench
        constants: tuple[FloatArray, ...] = self._constants
        if self._privileged is not None and state.vehicles is not None:
            constants = self._privileged.constants(state.vehicles)
            if state.wrench is not None and state.vehicles[P.drag_x : P.drag_z + 1].any():
                wrench = state.wrench.copy()
                wrench[FORCE_WORLD] -= _DRAG_LEFT * drag_forces(
                    state.array, state.vehicles, np.zeros((3, 1))
                )
        _geometric(*moving, *constants, wrench, self.reserve, actions)
        return actions


def privileged_geometric(vehicle: str | Vehicle = "itm") -> GeometricExpert:
    """A :class:`GeometricExpert` that knows the true vehicle and wrench."""
    return GeometricExpert(vehicle, privileged=True)


def privileged_derived(vehicle: str | Vehicle = "itm") -> GeometricExpert:
    """As :func:`privileged_geometric`, with the derived gains of each vehicle: for distributions of
    vehicles unlike this one.

    Where commands act late, its outer loop is slower and its inner one faster: agents that learn
    from it bear slow motors.
    """
    return GeometricExpert(
        vehicle, derived_gains(load_vehicle(vehicle)), privileged=True, late=_LATE
    )


def privileged_cautious(vehicle: str | Vehicle = "itm") -> GeometricExpert:
    """As :func:`privileged_geometric`, with 0.7 of the ``descent`` and of the ``tilt``, and 0.05 weights
    of thrust in reserve.

    It teaches agents that must find out what their rotors lift before they fall too fast to stop.
    """
    gains = GeometricExpert(vehicle).gains
    gentle = gains.model_copy(update={"descent": 0.7 * gains.descent, "tilt": 0.7 * gains.tilt})
    return GeometricExpert(vehicle, gentle, privileged=True, reserve=0.05)


@compiled
def _braking_profile(gain, distance_by_deceleration):  # type: ignore[no-untyped-def]
    """Speed per distance from which one can brake: the gain near the target, that of √(2
    deceleration distance) far away.
    """
    return 2.0 * gain / (1.0 + math.sqrt(1.0 + 2.0 * gain * gain * distance_by_deceleration))


@compiled
def _desired_force(ex, ey, ez, vx, vy, vz, ax, ay, az, gains, g, spare):  # type: ignore[no-untyped-def]
    """Desired force of the rotors per mass in the world frame, m/s², where something else
    accelerates by (ax, ay, az).
    """
    distance = math.sqrt(ex * ex + ey * ey)
    along = (ax * ex + ay * ey) / distance if distance > 0.0 else 0.0
    brake = _left_to_brake(gains[G.deceleration], along)
    if ez > 0.0:
        height_brake = _left_to_brake(gains[G.height_deceleration], az)
    else:
        height_brake = _left_to_brake(gains[G.descent_deceleration], spare - az)
    way = math.sqrt(
        (distance / brake) ** 2 + (ez / height_brake) ** 2
    )  # both brake at once, on a straight line
    speed = _braking_profile(gains[G.position], way)
    fx, fy = gains[G.velocity] * (speed * ex - vx), gains[G.velocity] * (speed * ey - vy)
    climb = gains[G.height_velocity] * (_braking_profile(gains[G.height_position], way) * ez - vz)
    climb = max(-gains[G.descent], climb)
    # As much of this acceleration as leaves the force no greater than the one that holds the height
    # at the greatest tilt.
    weight = g - az
    square, across = fx * fx + fy * fy + climb * climb, climb * weight - fx * ax - fy * ay
    room = g * g * (1.0 + gains[G.tilt] * gains[G.tilt]) - (weight * weight + ax * ax + ay * ay)
    scale = 1.0
    if square + 2.0 * across > room:
        scale = (
            max(0.0, math.sqrt(max(0.0, across * across + square * max(0.0, room))) - across)
            / square
        )
    return (
        scale * fx - ax,
        scale * fy - ay,
        max(0.1 * g, weight + scale * climb),
    )  # upwards, so that the force has a tilt


@compiled
def _left_to_brake(deceleration, push):  # type: ignore[no-untyped-def]
    """The deceleration to plan with where something pushes on along the way, m/s²."""
    return max(0.1 * deceleration, deceleration - max(0.0, push))


@compiled
def _rotated(b1, b2, b3, p, q, r, time):  # type: ignore[no-untyped-def]
    """A direction fixed in the world as the body sees it after turning with its present rates for
    some time.
    """
    rate = math.sqrt(p * p + q * q + r * r)
    if rate < 1e-9:
        return b1, b2, b3
    n1, n2, n3 = p / rate, q / rate, r / rate
    cosine, sine = math.cos(rate * time), -math.sin(rate * time)
    along = (n1 * b1 + n2 * b2 + n3 * b3) * (1.0 - cosine)
    return (
        cosine * b1 + sine * (n2 * b3 - n3 * b2) + along * n1,
        cosine * b2 + sine * (n3 * b1 - n1 * b3) + along * n2,
        cosine * b3 + sine * (n1 * b2 - n2 * b1) + along * n3,
    )


@compiled
def _turn_moments(b1, b2, b3, p, q, r, gains, body):  # type: ignore[no-untyped-def]
    """Roll and pitch moments that turn the thrust to the direction (b1, b2, b3), body frame, N m."""
    k_a, a_w, k_w = gains[G.attitude], gains[G.angular_deceleration], gains[G.body_rates]
    sine = math.sqrt(b1 * b1 + b2 * b2)
    angle = math.atan2(sine, b3)
    nx, ny = (-b2 / sine, b1 / sine) if sine > 1e-9 else (1.0, 0.0)
    along = p * nx + q * ny
    short = -along + 2.0 * math.sqrt(0.5 * along * along + a_w * angle)
    long = along + 2.0 * math.sqrt(0.5 * along * along + a_w * (2.0 * math.pi - angle))
    if long < short:
        nx, ny, angle = -nx, -ny, 2.0 * math.pi - angle
    rate = angle * _braking_profile(k_a, angle / a_w)
    # The wanted rates stay in the world while the body yaws; then Euler's gyroscopic moments.
    _, _, ixx, iyy, izz, _ = body
    mx = ixx * (k_w * (rate * nx - p) + r * rate * ny) + (izz - iyy) * q * r
    my = iyy * (k_w * (rate * ny - q) - r * rate * nx) + (ixx - izz) * r * p
    return mx, my


@compiled
def _allocate(thrust, mx, my, mz, mixer_inverse, low, high, actions):  # type: ignore[no-untyped-def]
    """Actions of one vehicle: roll and pitch before thrust, thrust before yaw, all within every
    rotor's limits.
    """
    middle, half = (high + low) / 2, (high - low) / 2
    least, most, largest = 0.0, 0.0, 0.0
    for k in range(4):
        difference = mixer_inverse[k, 1] * mx + mixer_inverse[k, 2] * my
        least, most, largest = (
            min(least, difference),
            max(most, difference),
            max(largest, abs(difference)),
        )
    scale = half / largest if largest > half else 1.0
    common = min(high - scale * most, max(low - scale * least, min(high, max(low, thrust / 4))))
    share = 1.0  # of the yaw moment, as far as there is room
    for k in range(4):
        each = common + scale * (mixer_inverse[k, 1] * mx + mixer_inverse[k, 2] * my)
        yaw = mixer_inverse[k, 3] * mz
        room = high - each if yaw > 0.0 else each - low
        if abs(yaw) * share > room:
            share = max(0.0, room / abs(yaw))
    for k in range(4):
        each = (
            common
            + scale * (mixer_inverse[k, 1] * mx + mixer_inverse[k, 2] * my)
            + share * mixer_inverse[k, 3] * mz
        )
        actions[k] = min(1.0, max(-1.0, (each - middle) / half))


@compiled
def _geometric(
    position,
    quaternion,
    velocity,
    rates,
    target,
    all_gains,
    bodies,
    inverses,
    limits,
    wrench,
    reserve,
    actions,
):  # type: ignore[no-untyped-def]
    gains, body = np.empty(all_gains.shape[0]), np.empty(bodies.shape[0])
    for i in range(actions.shape[0]):
        column, disturbed = min(i, bodies.shape[1] - 1), min(i, wrench.shape[1] - 1)
        gains[:], body[:] = all_gains[:, column], bodies[:, column]
        mixer_inverse, low, high = inverses[column], limits[0, column], limits[1, column]
        mass, g, _, _, izz, lag = body
        p, q, r = rates[0, i], rates[1, i], rates[2, i]
        ex, ey, ez = (
            target[0, i] - position[0, i],
            target[1, i] - position[1, i],
            target[2, i] - position[2, i],
        )
        (r11, r12, r13), (r21, r22, r23), (r31, r32, r33) = rotation_rows(
            quaternion[0, i], quaternion[1, i], quaternion[2, i], quaternion[3, i]
        )
        ux, uy, uz = (
            wrench[W.force_body, disturbed],
            wrench[W.force_body + 1, disturbed],
            wrench[W.force_body + 2, disturbed],
        )
        ax = (wrench[W.force_world, disturbed] + r11 * ux + r12 * uy + r13 * uz) / mass
        ay = (wrench[W.force_world + 1, disturbed] + r21 * ux + r22 * uy + r23 * uz) / mass
        az = (wrench[W.force_world + 2, disturbed] + r31 * ux + r32 * uy + r33 * uz) / mass
        tx, ty, tz = (
            wrench[W.torque_world, disturbed],
            wrench[W.torque_world + 1, disturbed],
            wrench[W.torque_world + 2, disturbed],
        )
        vx, vy, vz = velocity[0, i], velocity[1, i], velocity[2, i]
        fx, fy, fz = _desired_force(ex, ey, ez, vx, vy, vz, ax, ay, az, gains, g, reserve * g)
        size = math.sqrt(fx * fx + fy * fy + fz * fz)
        b1 = (r11 * fx + r21 * fy + r31 * fz) / size
        b2 = (r12 * fx + r22 * fy + r32 * fz) / size
        b3 = (r13 * fx + r23 * fy + r33 * fz) / size
        b1, b2, b3 = _rotated(b1, b2, b3, p, q, r, lag)
        mx, my = _turn_moments(b1, b2, b3, p, q, r, gains, body)
        mx -= wrench[W.torque_body, disturbed] + r11 * tx + r21 * ty + r31 * tz
        my -= wrench[W.torque_body + 1, disturbed] + r12 * tx + r22 * ty + r32 * tz
        mz = -gains[G.yaw_rate] * izz * r - (
            wrench[W.torque_body + 2, disturbed] + r13 * tx + r23 * ty + r33 * tz
        )
        _allocate(mass * size * b3, mx, my, mz, mixer_inverse, low, high, actions[i])
