/**
 * The physics of one control step, as envs/simulation/{physics,aerodynamics}.py have them: rotors (Eqs. 2.4 and 4.1), external
 * wrench, air, and PyBullet's integrator. All of it in double precision.
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

/**
 * The rotation matrix of a state, body to world, row by row.
 * @template {number[] | Float64Array} T
 * @param {Float64Array} s states, one after the other
 * @param {number} at where in them the state begins
 * @param {T} out
 */
export function rotation(s, at = 0, out = /** @type {T} */ (Array(9))) {
  const q = at + X.quaternion, w = s[q], x = s[q + 1], y = s[q + 2], z = s[q + 3];
  out[0] = 1 - 2 * (y * y + z * z);
  out[1] = 2 * (x * y - w * z);
  out[2] = 2 * (x * z + w * y);
  out[3] = 2 * (x * y + w * z);
  out[4] = 1 - 2 * (x * x + z * z);
  out[5] = 2 * (y * z - w * x);
  out[6] = 2 * (x * z - w * y);
  out[7] = 2 * (y * z + w * x);
  out[8] = 1 - 2 * (x * x + y * y);
  return out;
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

// Of the step that is computed: no step allocates.
const r = new Float64Array(9);
const rotors = new Float64Array(8);

/** The factor of the thrust at a height, m. @param {number} radius @param {number} height */
export const groundEffect = (radius, height) => 1 / (1 - (radius / (4 * Math.max(height, radius / 2, 1e-9))) ** 2);

/**
 * Thrusts of the rotors in a physics step, N, and behind them their speeds after it, rad/s, (8,).
 * @param {Float64Array} s
 * @param {number} at
 * @param {ArrayLike<number>} wanted rotor speeds, rad/s
 * @param {number} from where in them those of the state begin
 * @param {Parameters} p
 * @param {Float64Array} out
 */
export function drive(s, at, wanted, from, p, out) {
  const ground = groundEffect(p.air.radius, s[at + X.position + 2]);
  for (let k = 0; k < 4; k++) {
    const old = s[at + X.rotor_speeds + k], missing = wanted[from + k] - old;
    const speed = old + missing * (missing > 0 ? p.up : p.down);
    out[k] = p.lift * p.air.factors[k] * ground * speed * (speed + p.exact * (old - speed));
    out[4 + k] = speed;
  }
}

/** The sum of a row of four with what `drive` wrote. @param {ArrayLike<number>} arm @param {Float64Array} driven */
export const moment = (arm, driven) => arm[0] * driven[0] + arm[1] * driven[1] + (arm[2] * driven[2] + arm[3] * driven[3]);

/** The angular momentum of the rotors about z, N m s, at speeds that begin at an index. @param {Float64Array} s @param {number} at @param {Parameters} p */
export const momentumOf = (s, at, { air: { spins } }) => spins[0] * s[at] + spins[1] * s[at + 1] + (spins[2] * s[at + 2] + spins[3] * s[at + 3]);

/**
 * One physics step of a state, in place.
 * @param {Float64Array} s states, one after the other
 * @param {ArrayLike<number>} wanted rotor speeds, rad/s
 * @param {Parameters} p
 * @param {Wrench} wrench
 * @param {number} at where the state begins
 * @param {number} from where its wanted speeds begin
 */
export function physicsStep(s, wanted, p, { force, torque, wind }, at = 0, from = 0) {
  const { air, dt, drag, inertia, arms } = p, v = at + X.velocity, w = at + X.body_rates;
  const before = momentumOf(s, at + X.rotor_speeds, p);
  drive(s, at, wanted, from, p, rotors);
  for (let k = 0; k < 4; k++) s[at + X.rotor_speeds + k] = rotors[4 + k];
  rotation(s, at, r);
  const ux = s[v] - wind[0], uy = s[v + 1] - wind[1], uz = s[v + 2] - wind[2];
  const ax = r[0] * ux + r[3] * uy + r[6] * uz, ay = r[1] * ux + r[4] * uy + r[7] * uz;
  const total = rotors[4] + rotors[5] + (rotors[6] + rotors[7]), momentum = momentumOf(rotors, 4, p);
  const fx = -(drag[0] + air.drag[0] * total) * ax;
  const fy = -(drag[1] + air.drag[1] * total) * ay;
  const thrust = rotors[0] + rotors[1] + (rotors[2] + rotors[3]);
  const fz = thrust - (drag[2] + air.drag[2] * total) * (r[2] * ux + r[5] * uy + r[8] * uz) + air.lift * (ax * ax + ay * ay);
  const perForce = dt / p.mass;
  s[v] += perForce * (force[0] + r[0] * fx + r[1] * fy + r[2] * fz);
  s[v + 1] += perForce * (force[1] + r[3] * fx + r[4] * fy + r[5] * fz);
  s[v + 2] += perForce * (force[2] + r[6] * fx + r[7] * fy + r[8] * fz) - p.gravity * dt;

  const [ixx, iyy, izz] = inertia, wx = s[w], wy = s[w + 1], wz = s[w + 2];
  const roll = air.moment[0] * total * ay - momentum * wy - air.damping[0] * wx;
  const pitch = momentum * wx - air.moment[1] * total * ax - air.damping[1] * wy;
  const yaw = (before - momentum) / dt - air.damping[2] * wz;
  s[w] += (dt / ixx) * (torque[0] - (izz - iyy) * wy * wz + roll + moment(arms[0], rotors));
  s[w + 1] += (dt / iyy) * (torque[1] - (ixx - izz) * wz * wx + pitch + moment(arms[1], rotors));
  s[w + 2] += (dt / izz) * (torque[2] - (iyy - ixx) * wx * wy + yaw + moment(arms[2], rotors));
  limitVelocities(s, at);
  move(s, at, dt);
}

/**
 * PyBullet's cut of v and ω, in the world frame, in place.
 * @param {Float64Array} s
 * @param {number} at
 */
function limitVelocities(s, at) {
  for (let k = 0; k < 3; k++) s[at + X.velocity + k] = cut(s[at + X.velocity + k]);
  const w = at + X.body_rates, x = s[w], y = s[w + 1], z = s[w + 2];
  if (x * x + y * y + z * z <= MAX_VELOCITY * MAX_VELOCITY) return;
  const world = [0, 3, 6].map((k) => cut(r[k] * x + r[k + 1] * y + r[k + 2] * z));
  for (let k = 0; k < 3; k++) s[w + k] = r[k] * world[0] + r[3 + k] * world[1] + r[6 + k] * world[2];
}

/** sin(h) / h by h². @param {number} h2 */
export const sincOf = (h2) => 1 - (h2 / 6) * (1 - (h2 / 20) * (1 - (h2 / 42) * (1 - (h2 / 72) * (1 - h2 / 110))));
/** cos(h) by h². @param {number} h2 */
export const cosineOf = (h2) => 1 - (h2 / 2) * (1 - (h2 / 12) * (1 - (h2 / 30) * (1 - (h2 / 56) * (1 - (h2 / 90) * (1 - h2 / 132)))));

/**
 * Position and attitude by the new velocities; the rotation is exact to double precision.
 * @param {Float64Array} s
 * @param {number} at
 * @param {number} dt
 */
function move(s, at, dt) {
  for (let k = 0; k < 3; k++) s[at + X.position + k] += dt * s[at + X.velocity + k];
  const w = at + X.body_rates, x = 0.5 * dt * s[w], y = 0.5 * dt * s[w + 1], z = 0.5 * dt * s[w + 2];
  const h2 = x * x + y * y + z * z, sinc = sincOf(h2);
  turnBody(s, cosineOf(h2), x * sinc, y * sinc, z * sinc, at);
}

/**
 * Turn the body of a state by a quaternion in its own axes.
 * @param {Float64Array} s
 * @param {number} aw
 * @param {number} ax
 * @param {number} ay
 * @param {number} az
 * @param {number} at where the state begins
 */
export function turnBody(s, aw, ax, ay, az, at = 0) {
  const q = at + X.quaternion, qw = s[q], qx = s[q + 1], qy = s[q + 2], qz = s[q + 3];
  const w = qw * aw - qx * ax - qy * ay - qz * az;
  const x = qw * ax + qx * aw + qy * az - qz * ay;
  const y = qw * ay - qx * az + qy * aw + qz * ax;
  const z = qw * az + qx * ay - qy * ax + qz * aw;
  const scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z); // one step of Newton's method
  s[q] = w * scale;
  s[q + 1] = x * scale;
  s[q + 2] = y * scale;
  s[q + 3] = z * scale;
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
