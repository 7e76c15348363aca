/**
 * The physics of one control step, as sb3_quad/simulation/physics.py has them: rotors (Eqs. 2.4 and 4.1), external wrench,
 * drag, and PyBullet's integrator. All of it in double precision.
 *
 * @typedef {import("./vehicle.js").Parameters} Parameters
 *
 * @typedef {object} Wrench
 * @property {number[]} force world frame, N
 * @property {number[]} torque body frame, N m
 * @property {number[]} wind world frame, m/s
 */
import { part, X } from "./tables.js";

const MAX_VELOCITY = 100; // PyBullet's cut of each world component, m/s and rad/s

/** The rotation matrix of a state, body to world, row by row. @param {Float64Array} s */
export function rotation(s) {
  const [w, x, y, z] = part(s, "quaternion");
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/**
 * Rotor speeds that actions command (Eqs. 3.18 and 2.4), rad/s.
 * @param {ArrayLike<number>} actions
 * @param {Parameters} p
 */
export function commandedSpeeds(actions, p) {
  return [0, 1, 2, 3].map((k) => Math.sqrt((p.middle + p.half * Math.min(Math.max(actions[k], -1), 1)) / p.lift));
}

/** @param {number} value */
const cut = (value) => Math.min(Math.max(value, -MAX_VELOCITY), MAX_VELOCITY);

/**
 * One physics step of a state, in place.
 * @param {Float64Array} s
 * @param {number[]} wanted rotor speeds, rad/s
 * @param {Parameters} p
 * @param {Wrench} wrench
 */
export function physicsStep(s, wanted, p, wrench) {
  const dt = p.dt;
  const thrusts = [0, 0, 0, 0];
  for (let k = 0; k < 4; k++) {
    const old = s[X.rotor_speeds + k], missing = wanted[k] - old;
    const speed = old + missing * (missing > 0 ? p.up : p.down);
    s[X.rotor_speeds + k] = speed;
    thrusts[k] = p.lift * speed * (speed + p.exact * (old - speed));
  }
  const r = rotation(s);
  const velocity = part(s, "velocity"), rates = part(s, "body_rates"); // views, changed in place
  const [cx, cy, cz] = p.drag;
  const [ux, uy, uz] = velocity.map((v, k) => v - wrench.wind[k]);
  const fx = -cx * (r[0] * ux + r[3] * uy + r[6] * uz);
  const fy = -cy * (r[1] * ux + r[4] * uy + r[7] * uz);
  const fz = thrusts[0] + thrusts[1] + (thrusts[2] + thrusts[3]) - cz * (r[2] * ux + r[5] * uy + r[8] * uz);
  const perForce = dt / p.mass;
  velocity[0] += perForce * (wrench.force[0] + r[0] * fx + r[1] * fy + r[2] * fz);
  velocity[1] += perForce * (wrench.force[1] + r[3] * fx + r[4] * fy + r[5] * fz);
  velocity[2] += perForce * (wrench.force[2] + r[6] * fx + r[7] * fy + r[8] * fz) - p.gravity * dt;

  const [ixx, iyy, izz] = p.inertia;
  const [wx, wy, wz] = rates;
  const moment = p.arms.map((arm) => arm[0] * thrusts[0] + arm[1] * thrusts[1] + (arm[2] * thrusts[2] + arm[3] * thrusts[3]));
  rates[0] += (dt / ixx) * (wrench.torque[0] - (izz - iyy) * wy * wz + moment[0]);
  rates[1] += (dt / iyy) * (wrench.torque[1] - (ixx - izz) * wz * wx + moment[1]);
  rates[2] += (dt / izz) * (wrench.torque[2] - (iyy - ixx) * wx * wy + moment[2]);
  limitVelocities(velocity, rates, r);
  move(s, dt);
}

/**
 * PyBullet's cut of v and ω, in the world frame, in place.
 * @param {Float64Array} velocity
 * @param {Float64Array} rates
 * @param {number[]} r
 */
function limitVelocities(velocity, rates, r) {
  for (let k = 0; k < 3; k++) velocity[k] = cut(velocity[k]);
  const [x, y, z] = rates;
  if (x * x + y * y + z * z <= MAX_VELOCITY * MAX_VELOCITY) return;
  const w = [0, 3, 6].map((k) => cut(r[k] * x + r[k + 1] * y + r[k + 2] * z));
  for (let k = 0; k < 3; k++) rates[k] = r[k] * w[0] + r[3 + k] * w[1] + r[6 + k] * w[2];
}

/**
 * Position and attitude by the new velocities; the rotation is exact to double precision.
 * @param {Float64Array} s
 * @param {number} dt
 */
function move(s, dt) {
  for (let k = 0; k < 3; k++) s[X.position + k] += dt * s[X.velocity + k];
  const [x, y, z] = part(s, "body_rates").map((rate) => 0.5 * dt * rate);
  const h2 = x * x + y * y + z * z;
  const sinc = 1 - (h2 / 6) * (1 - (h2 / 20) * (1 - (h2 / 42) * (1 - (h2 / 72) * (1 - h2 / 110))));
  const aw = 1 - (h2 / 2) * (1 - (h2 / 12) * (1 - (h2 / 30) * (1 - (h2 / 56) * (1 - (h2 / 90) * (1 - h2 / 132)))));
  turnBody(s, aw, x * sinc, y * sinc, z * sinc);
}

/**
 * Turn the body of a state by a quaternion in its own axes.
 * @param {Float64Array} s
 * @param {number} aw
 * @param {number} ax
 * @param {number} ay
 * @param {number} az
 */
export function turnBody(s, aw, ax, ay, az) {
  const [qw, qx, qy, qz] = part(s, "quaternion");
  const w = qw * aw - qx * ax - qy * ay - qz * az;
  const x = qw * ax + qx * aw + qy * az - qz * ay;
  const y = qw * ay - qx * az + qy * aw + qz * ax;
  const z = qw * az + qx * ay - qy * ax + qz * aw;
  const scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z); // one step of Newton's method
  s.set([w * scale, x * scale, y * scale, z * scale], X.quaternion);
}

/** |r - r_T|, m. @param {Float64Array} s */
export function distanceOf(s) {
  const [x, y, z] = errorOf(s);
  return Math.hypot(x, y, z);
}

/** r_T - r, (3,), m. @param {Float64Array} s */
export function errorOf(s) {
  const position = part(s, "position");
  return part(s, "target").map((target, k) => target - position[k]);
}

/** The angle between thrust and vertical, rad. @param {Float64Array} s */
export function tiltOf(s) {
  const [w, x, y, z] = part(s, "quaternion");
  return 2 * Math.atan2(Math.hypot(x, y), Math.hypot(w, z));
}
