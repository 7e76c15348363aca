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

/** Where the parts of a state begin; the attitude is a quaternion (w, x, y, z), body to world. */
export const X = { position: 0, quaternion: 3, velocity: 7, rates: 10, rotors: 13, target: 17 };
export const STATE_SIZE = 20;
const MAX_VELOCITY = 100; // PyBullet's cut of each world component, m/s and rad/s

/** The rotation matrix of a state, body to world, row by row. @param {Float64Array} s */
export function rotation(s) {
  const w = s[3], x = s[4], y = s[5], z = s[6];
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
    const old = s[13 + k], missing = wanted[k] - old;
    const speed = old + missing * (missing > 0 ? p.up : p.down);
    s[13 + k] = speed;
    thrusts[k] = p.lift * speed * (speed + p.exact * (old - speed));
  }
  const r = rotation(s);
  const [cx, cy, cz] = p.drag;
  const ux = s[7] - wrench.wind[0], uy = s[8] - wrench.wind[1], uz = s[9] - wrench.wind[2];
  const fx = -cx * (r[0] * ux + r[3] * uy + r[6] * uz);
  const fy = -cy * (r[1] * ux + r[4] * uy + r[7] * uz);
  const fz = thrusts[0] + thrusts[1] + (thrusts[2] + thrusts[3]) - cz * (r[2] * ux + r[5] * uy + r[8] * uz);
  const push = dt / p.mass;
  s[7] += push * (wrench.force[0] + r[0] * fx + r[1] * fy + r[2] * fz);
  s[8] += push * (wrench.force[1] + r[3] * fx + r[4] * fy + r[5] * fz);
  s[9] += push * (wrench.force[2] + r[6] * fx + r[7] * fy + r[8] * fz) - p.gravity * dt;

  const [ixx, iyy, izz] = p.inertia;
  const wx = s[10], wy = s[11], wz = s[12];
  const moment = p.arms.map((arm) => arm[0] * thrusts[0] + arm[1] * thrusts[1] + (arm[2] * thrusts[2] + arm[3] * thrusts[3]));
  s[10] += (dt / ixx) * (wrench.torque[0] - (izz - iyy) * wy * wz + moment[0]);
  s[11] += (dt / iyy) * (wrench.torque[1] - (ixx - izz) * wz * wx + moment[1]);
  s[12] += (dt / izz) * (wrench.torque[2] - (iyy - ixx) * wx * wy + moment[2]);
  limitVelocities(s, r);
  move(s, dt);
}

/** PyBullet's cut of v and ω, in the world frame. @param {Float64Array} s @param {number[]} r */
function limitVelocities(s, r) {
  for (let k = 7; k < 10; k++) s[k] = cut(s[k]);
  const [x, y, z] = [s[10], s[11], s[12]];
  if (x * x + y * y + z * z <= MAX_VELOCITY * MAX_VELOCITY) return;
  const w = [0, 3, 6].map((k) => cut(r[k] * x + r[k + 1] * y + r[k + 2] * z));
  for (let k = 0; k < 3; k++) s[10 + k] = r[k] * w[0] + r[3 + k] * w[1] + r[6 + k] * w[2];
}

/**
 * Position and attitude by the new velocities; the rotation is exact to double precision.
 * @param {Float64Array} s
 * @param {number} dt
 */
function move(s, dt) {
  for (let k = 0; k < 3; k++) s[k] += dt * s[7 + k];
  const half = 0.5 * dt;
  const x = half * s[10], y = half * s[11], z = half * s[12];
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
  const qw = s[3], qx = s[4], qy = s[5], qz = s[6];
  const w = qw * aw - qx * ax - qy * ay - qz * az;
  const x = qw * ax + qx * aw + qy * az - qz * ay;
  const y = qw * ay - qx * az + qy * aw + qz * ax;
  const z = qw * az + qx * ay - qy * ax + qz * aw;
  const scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z); // one step of Newton's method
  s[3] = w * scale;
  s[4] = x * scale;
  s[5] = y * scale;
  s[6] = z * scale;
}

/** |r - r_T|, m. @param {Float64Array} s */
export const distanceOf = (s) => Math.hypot(s[0] - s[17], s[1] - s[18], s[2] - s[19]);

/** The angle between thrust and vertical, rad. @param {Float64Array} s */
export function tiltOf(s) {
  return 2 * Math.atan2(Math.hypot(s[4], s[5]), Math.hypot(s[3], s[6]));
}
