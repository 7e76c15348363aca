"""One control step of n quadcopters: the rotors (Eq. 4.1), the external wrench, and PyBullet's integrator.

Per physics step, as PyBullet does it for the floating base of a multibody: v += dt F/m and ω += dt I⁻¹(τ - ω×Iω), explicit;
world components of v and ω cut at 100; then position and attitude by the new velocities, the attitude by the exact
exponential of ω dt with dt |ω| cut at π/4. Against PyBullet the difference is rounding (1e-12 over 400 control steps).

The body rates stay in the body frame: a rotation about ω leaves ω as it is, so that PyBullet's world-frame sum is the same.
"""

from __future__ import annotations

import math

import numpy as np

from sb3_quad.simulation.engine.blocks import (
    ARM,
    AW,
    AX,
    AY,
    AZ,
    FALL,
    GYRO_X,
    GYRO_Y,
    GYRO_Z,
    LIFT,
    MOTOR,
    PUSH,
    PX,
    PY,
    PZ,
    QW,
    QX,
    QY,
    QZ,
    S0,
    S1,
    S2,
    S3,
    TWIST_X,
    TWIST_Y,
    TWIST_Z,
    VX,
    VY,
    VZ,
    WANTED,
    WRENCH,
    WX,
    WY,
    WZ,
    load_columns,
    load_commands,
    load_state,
    load_vehicles,
    store_state,
)
from sb3_quad.simulation.engine.lowlevel import LANES, SCRATCH_SIZE, compiled, float64_rows, scratch_pointer

MAX_COORDINATE_VELOCITY = 100.0  # btMultiBody's m_maxCoordinateVelocity, m/s and rad/s
MAX_HALF_ANGLE = math.pi / 8.0  # btMultiBody's ANGULAR_MOTION_THRESHOLD, halved
SMALL_STEP = 0.0025  # s; up to here half of dt |ω| stays below 0.2166, whatever ω the cut at 100 lets through


@compiled(fastmath=True)
def accelerate(scratch):
    """Rotor speeds, velocities and body rates after one physics step; whether some may exceed PyBullet's cut."""
    b = float64_rows(scratch)
    for lane in range(LANES):
        s0 = b[S0, lane] + b[MOTOR, lane] * (b[WANTED, lane] - b[S0, lane])
        s1 = b[S1, lane] + b[MOTOR, lane] * (b[WANTED + 1, lane] - b[S1, lane])
        s2 = b[S2, lane] + b[MOTOR, lane] * (b[WANTED + 2, lane] - b[S2, lane])
        s3 = b[S3, lane] + b[MOTOR, lane] * (b[WANTED + 3, lane] - b[S3, lane])
        b[S0, lane], b[S1, lane], b[S2, lane], b[S3, lane] = s0, s1, s2, s3
        lift = b[LIFT, lane]
        f0, f1, f2, f3 = lift * s0 * s0, lift * s1 * s1, lift * s2 * s2, lift * s3 * s3

        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
        r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
        r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)

        fx, fy, fz = b[WRENCH + 3, lane], b[WRENCH + 4, lane], b[WRENCH + 5, lane] + ((f0 + f1) + (f2 + f3))
        push = b[PUSH, lane]
        vx = b[VX, lane] + push * (b[WRENCH, lane] + r00 * fx + r01 * fy + r02 * fz)
        vy = b[VY, lane] + push * (b[WRENCH + 1, lane] + r10 * fx + r11 * fy + r12 * fz)
        vz = b[VZ, lane] + push * (b[WRENCH + 2, lane] + r20 * fx + r21 * fy + r22 * fz) - b[FALL, lane]
        b[VX, lane], b[VY, lane], b[VZ, lane] = vx, vy, vz

        gx, gy, gz = b[WRENCH + 6, lane], b[WRENCH + 7, lane], b[WRENCH + 8, lane]
        wx, wy, wz = b[WX, lane], b[WY, lane], b[WZ, lane]
        tx = b[WRENCH + 9, lane] + r00 * gx + r10 * gy + r20 * gz - b[GYRO_X, lane] * wy * wz
        ty = b[WRENCH + 10, lane] + r01 * gx + r11 * gy + r21 * gz - b[GYRO_Y, lane] * wz * wx
        tz = b[WRENCH + 11, lane] + r02 * gx + r12 * gy + r22 * gz - b[GYRO_Z, lane] * wx * wy
        tx += (b[ARM, lane] * f0 + b[ARM + 1, lane] * f1) + (b[ARM + 2, lane] * f2 + b[ARM + 3, lane] * f3)
        ty += (b[ARM + 4, lane] * f0 + b[ARM + 5, lane] * f1) + (b[ARM + 6, lane] * f2 + b[ARM + 7, lane] * f3)
        tz += (b[ARM + 8, lane] * f0 + b[ARM + 9, lane] * f1) + (b[ARM + 10, lane] * f2 + b[ARM + 11, lane] * f3)
        wx += b[TWIST_X, lane] * tx
        wy += b[TWIST_Y, lane] * ty
        wz += b[TWIST_Z, lane] * tz
        b[WX, lane], b[WY, lane], b[WZ, lane] = wx, wy, wz
        b[AX, lane] = max(wx * wx + wy * wy + wz * wz, vx * vx + vy * vy + vz * vz)
    over = 0
    for lane in range(LANES):
        over += b[AX, lane] > MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY
    return over > 0


@compiled
def _cut(value):
    return min(max(value, -MAX_COORDINATE_VELOCITY), MAX_COORDINATE_VELOCITY)


@compiled
def limit_velocities(scratch):
    """PyBullet's cut of each world component of v and ω, in the rare lanes that exceed it."""
    b = float64_rows(scratch)
    for lane in range(LANES):
        for k in range(3):
            b[VX + k, lane] = _cut(b[VX + k, lane])
        x, y, z = b[WX, lane], b[WY, lane], b[WZ, lane]
        if x * x + y * y + z * z <= MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY:
            continue
        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
        r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
        r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        wx = _cut(r00 * x + r01 * y + r02 * z)
        wy = _cut(r10 * x + r11 * y + r12 * z)
        wz = _cut(r20 * x + r21 * y + r22 * z)
        b[WX, lane] = r00 * wx + r10 * wy + r20 * wz
        b[WY, lane] = r01 * wx + r11 * wy + r21 * wz
        b[WZ, lane] = r02 * wx + r12 * wy + r22 * wz


@compiled(fastmath=True)
def move(scratch, dt):
    """Position and attitude by the new velocities, for steps up to ``SMALL_STEP``.

    With h = dt |ω| / 2 below 0.2166, sin(h)/h to h¹⁰ and cos(h) to h¹² are exact to double precision, and the new
    quaternion is off unit norm by rounding only, which one step of Newton's method takes back.
    """
    b = float64_rows(scratch)
    half_step = 0.5 * dt
    for lane in range(LANES):
        b[PX, lane] += dt * b[VX, lane]
        b[PY, lane] += dt * b[VY, lane]
        b[PZ, lane] += dt * b[VZ, lane]
        ax, ay, az = half_step * b[WX, lane], half_step * b[WY, lane], half_step * b[WZ, lane]
        h2 = ax * ax + ay * ay + az * az
        sinc = 1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0 * (1.0 - h2 / 110.0))))
        aw = 1.0 - h2 / 2.0 * (
            1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0 * (1.0 - h2 / 90.0 * (1.0 - h2 / 132.0))))
        )
        ax *= sinc
        ay *= sinc
        az *= sinc
        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        nw = qw * aw - qx * ax - qy * ay - qz * az
        nx = qw * ax + qx * aw + qy * az - qz * ay
        ny = qw * ay - qx * az + qy * aw + qz * ax
        nz = qw * az + qx * ay - qy * ax + qz * aw
        scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz)
        b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane] = nw * scale, nx * scale, ny * scale, nz * scale


@compiled(fastmath=True)
def move_far(scratch, dt):
    """As :func:`move`, for steps of any length: PyBullet's cut of the angle, longer series, full normalisation."""
    b = float64_rows(scratch)
    half_step = 0.5 * dt
    for lane in range(LANES):
        b[PX, lane] += dt * b[VX, lane]
        b[PY, lane] += dt * b[VY, lane]
        b[PZ, lane] += dt * b[VZ, lane]
        ax, ay, az = half_step * b[WX, lane], half_step * b[WY, lane], half_step * b[WZ, lane]
        h2 = min(ax * ax + ay * ay + az * az, MAX_HALF_ANGLE * MAX_HALF_ANGLE)
        sinc = 1.0 - h2 / 156.0 * (1.0 - h2 / 210.0)
        sinc = 1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0 * (1.0 - h2 / 110.0 * sinc))))
        aw = 1.0 - h2 / 132.0 * (1.0 - h2 / 182.0)
        aw = 1.0 - h2 / 2.0 * (1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0 * (1.0 - h2 / 90.0 * aw))))
        b[AX, lane], b[AY, lane], b[AZ, lane], b[AW, lane] = ax * sinc, ay * sinc, az * sinc, aw
    for lane in range(LANES):
        ax, ay, az, aw = b[AX, lane], b[AY, lane], b[AZ, lane], b[AW, lane]
        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        nw = qw * aw - qx * ax - qy * ay - qz * az
        nx = qw * ax + qx * aw + qy * az - qz * ay
        ny = qw * ay - qx * az + qy * aw + qz * ax
        nz = qw * az + qx * ay - qy * ax + qz * aw
        scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
        b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane] = nw * scale, nx * scale, ny * scale, nz * scale


@compiled(inline="always")
def fly_block(scratch, physics_step, substeps):
    """The physics steps of one control step of a loaded block, in place."""
    for _ in range(substeps):
        if accelerate(scratch):
            limit_velocities(scratch)
        if physics_step <= SMALL_STEP:
            move(scratch, physics_step)
        else:
            move_far(scratch, physics_step)


@compiled
def control_step(state, queue, actions, wrench, vehicles, physics_step, substeps):
    """Fly one control step, in place: delay, then ``substeps`` times motor, wrench and integration.

    :param state: float64 (STATE_SIZE, n), see dynamics/state.py.
    :param queue: float64 (delay, 4, n), commanded rotor speeds on their way, the next to act first.
    :param actions: (n, 4), clipped to [-1, 1] (Eq. 3.18); finite.
    :param wrench: float64 (12, n): force world, force body (N), torque world, torque body (N m) at the centre of mass.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) for all rows.
    :param physics_step: s.
    :param substeps: physics steps in one control step.
    """
    memory = np.empty(SCRATCH_SIZE + 8)
    n = state.shape[1]
    for first in range(0, n, LANES):
        scratch = scratch_pointer(memory)  # in the loop: numba frees what is not used again
        count = min(LANES, n - first)
        load_state(scratch, state, first, count)
        load_columns(wrench, first, count, float64_rows(scratch), WRENCH)
        load_vehicles(scratch, vehicles, first, count, physics_step)
        load_commands(scratch, actions, queue, first, count)
        fly_block(scratch, physics_step, substeps)
        store_state(scratch, state, first, count)
