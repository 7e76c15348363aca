/**
 * The two experts on the true state, as sb3_quad/experts/{pid,geometric}.py have them, without a heading that is asked for.
 * docs/research/experts.md explains their laws.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {(state: Float64Array, actions: Float32Array, ahead?: import("./observation.js").Ahead) => void} Law writes the four actions for a state
 */
import { errorOf, rotation } from "./dynamics.js";
import { AHEAD, part } from "./tables.js";
import { armsOf, commandLag, factorsOf, hoverShares, hoverThrust, mixerInverse, thrustRange } from "./vehicle.js";

const { sqrt, min, max, abs, atan2, sin, cos } = Math;

/** @param {number} value */
const clipped = (value) => min(1, max(-1, value));

/** The velocity relative to the reference, m/s. @param {Float64Array} s */
function velocityOf(s) {
  const target = part(s, "target_velocity");
  return [...part(s, "velocity")].map((v, k) => v - target[k]);
}

/**
 * The reference's acceleration in AHEAD seconds, m/s²; where nobody knows it, as now.
 * @param {Float64Array} s
 * @param {Vehicle} v
 * @param {import("./observation.js").Ahead} [ahead]
 */
function later(s, v, ahead) {
  return ahead ? ahead(Math.round(AHEAD / v.control_step)) : part(s, "target_acceleration");
}

/** The thesis's PID controller (Table A.1). @param {Vehicle} v @returns {Law} */
export function pid(v, kp = 1.5, ki = 50, kd = 4.1, frequency = 9, damping = 1) {
  const mixer = mixerInverse(v);
  const [low, high] = thrustRange(v);
  const [middle, half] = [(high + low) / 2, (high - low) / 2];
  const stiff = v.inertia.map((i) => i * frequency ** 2), damp = v.inertia.map((i) => i * 2 * damping * frequency);
  const { mass, gravity: g } = v;
  const kiDt = ki * v.control_step;
  return (s, actions, ahead) => {
    const [ex, ey, ez] = errorOf(s);
    const r = rotation(s);
    const roll = atan2(r[7], r[8]), pitch = Math.asin(clipped(-r[6])), yaw = atan2(r[3], r[0]);
    const [vx, vy, vz] = velocityOf(s), [rx, ry, rz] = later(s, v, ahead);
    const rates = part(s, "body_rates");
    const ax = kp * ex - kd * (r[0] * vx + r[3] * vy + r[6] * vz);
    const ay = kp * ey - kd * (r[1] * vx + r[4] * vy + r[7] * vz);
    const az = kp * ez - kd * (r[2] * vx + r[5] * vy + r[8] * vz);
    const rollDes = (0.25 * (ax * sin(yaw) - ay * cos(yaw)) + rx * sin(yaw) - ry * cos(yaw)) / g;
    const pitchDes = (0.25 * (ax * cos(yaw) + ay * sin(yaw)) + rx * cos(yaw) + ry * sin(yaw)) / g;
    const u = [
      mass * (g + az + rz + kiDt * ez),
      stiff[0] * (rollDes - roll) - damp[0] * rates[0],
      stiff[1] * (pitchDes - pitch) - damp[1] * rates[1],
      -stiff[2] * yaw - damp[2] * rates[2],
    ];
    const thrusts = mixer.map((m) => m[0] * u[0] + m[1] * u[1] + m[2] * u[2] + m[3] * u[3]);
    const largest = max(...thrusts);
    const scale = largest > high ? high / largest : 1;
    for (let k = 0; k < 4; k++) actions[k] = clipped((max(low, scale * thrusts[k]) - middle) / half);
  };
}

/** Gains for a vehicle whose file has none. @param {Vehicle} v @returns {Object<string, number>} */
export function derivedGains(v) {
  const [low, high] = thrustRange(v);
  const factors = factorsOf(v);
  const moment = armsOf(v).map((arm) => (arm.reduce((sum, each, k) => sum + abs(each * factors[k]), 0) * (high - low)) / 2);
  const turn = min(moment[0] / v.inertia[0], moment[1] / v.inertia[1]), lag = commandLag(v), g = v.gravity;
  const hovers = hoverShares(v).map((share) => share * hoverThrust(v));
  const least = low / min(...hovers), most = max(high / max(...hovers), 1.01);
  const rate = min(1 / (lag + 1 / sqrt(turn)), 0.438 / lag);
  const sideways = sqrt(most ** 2 - 1), upwards = g * (most - 1);
  return {
    position: 0.285 * rate,
    velocity: 0.607 * rate,
    height_position: 0.407 * rate,
    height_velocity: 0.937 * rate,
    deceleration: 1.07 * g * sideways,
    height_deceleration: 1.63 * g * (1 - least),
    descent: g * min(0.9, 1.56 * (1 - least)),
    tilt: 1.9 * sideways,
    attitude: 1.53 * rate,
    angular_deceleration: 1.17 * turn,
    body_rates: 0.587 / lag,
    yaw_rate: 0.132 / lag,
    descent_deceleration: 0.612 * upwards,
  };
}

/**
 * Speed per distance from which one can brake.
 * @param {number} gain
 * @param {number} distanceByDeceleration
 */
function brakingProfile(gain, distanceByDeceleration) {
  return (2 * gain) / (1 + sqrt(1 + 2 * gain * gain * distanceByDeceleration));
}

/** The geometric controller for large angles. @param {Vehicle} v @returns {Law} */
export function geometric(v) {
  /** @type {any} */
  const gains = v.geometric_gains ?? derivedGains(v);
  const mixer = mixerInverse(v);
  const [low, high] = thrustRange(v);
  const [ixx, iyy, izz] = v.inertia;
  const lag = commandLag(v);
  // A command acts after the lag; sideways, the vehicle must turn to it first. In terms of AHEAD
  const upwards = lag / AHEAD, sideways = upwards + 1 / (gains.attitude * AHEAD);
  const shares = [sideways, sideways, upwards];
  return (s, actions, ahead) => {
    const r = rotation(s);
    const [p, q, w] = part(s, "body_rates");
    const now = part(s, "target_acceleration"), then = later(s, v, ahead);
    const acceleration = shares.map((share, k) => now[k] + share * (then[k] - now[k]));
    const [fx, fy, fz] = desiredForce([...errorOf(s)], velocityOf(s), acceleration, gains, v.gravity);
    const size = sqrt(fx * fx + fy * fy + fz * fz);
    const body = [0, 1, 2].map((k) => (r[k] * fx + r[3 + k] * fy + r[6 + k] * fz) / size);
    const [b1, b2, b3] = rotated(body, p, q, w, lag);
    const [nx, ny, rate] = wantedTurn(b1, b2, b3, p, q, gains);
    const mx = ixx * (gains.body_rates * (rate * nx - p) + w * rate * ny) + (izz - iyy) * q * w;
    const my = iyy * (gains.body_rates * (rate * ny - q) - w * rate * nx) + (ixx - izz) * w * p;
    allocate(v.mass * size * b3, mx, my, -gains.yaw_rate * izz * w, mixer, low, high, actions);
  };
}

/**
 * Desired force of the rotors per mass, world frame, m/s².
 * @param {number[]} e
 * @param {number[]} v
 * @param {ArrayLike<number>} a acceleration of the reference
 * @param {any} gains
 * @param {number} g
 */
function desiredForce([ex, ey, ez], [vx, vy, vz], a, gains, g) {
  // Seen from the reference, its acceleration acts on the vehicle the other way round.
  const [ax, ay, az] = [0, 1, 2].map((k) => -a[k]), across = sqrt(ex * ex + ey * ey);
  const left = (/** @type {number} */ brake, /** @type {number} */ along) => max(0.1 * brake, brake - max(0, along));
  const brake = left(gains.deceleration, across > 0 ? (ax * ex + ay * ey) / across : 0);
  const heightBrake = ez > 0 ? left(gains.height_deceleration, az) : left(gains.descent_deceleration, -az);
  const way = sqrt((across / brake) ** 2 + (ez / heightBrake) ** 2);
  const speed = brakingProfile(gains.position, way);
  const fx = gains.velocity * (speed * ex - vx), fy = gains.velocity * (speed * ey - vy);
  const climb = max(-gains.descent, gains.height_velocity * (brakingProfile(gains.height_position, way) * ez - vz));
  const weight = g - az, square = fx * fx + fy * fy + climb * climb, along = climb * weight - fx * ax - fy * ay;
  const room = g * g * (1 + gains.tilt ** 2) - (weight * weight + ax * ax + ay * ay);
  const root = sqrt(max(0, along * along + square * max(0, room)));
  const scale = square + 2 * along > room ? max(0, root - along) / square : 1;
  return [scale * fx - ax, scale * fy - ay, max(0.1 * g, weight + scale * climb)];
}

/**
 * A direction fixed in the world as the body sees it some time later.
 * @param {number[]} b
 * @param {number} p
 * @param {number} q
 * @param {number} r
 * @param {number} time
 */
function rotated([b1, b2, b3], p, q, r, time) {
  const rate = sqrt(p * p + q * q + r * r);
  if (rate < 1e-9) return [b1, b2, b3];
  const n1 = p / rate, n2 = q / rate, n3 = r / rate;
  const cosine = cos(rate * time), sine = -sin(rate * time);
  const along = (n1 * b1 + n2 * b2 + n3 * b3) * (1 - cosine);
  return [
    cosine * b1 + sine * (n2 * b3 - n3 * b2) + along * n1,
    cosine * b2 + sine * (n3 * b1 - n1 * b3) + along * n2,
    cosine * b3 + sine * (n1 * b2 - n2 * b1) + along * n3,
  ];
}

/**
 * Axis and rate that turn the thrust to a direction, the long way round where the spin makes that quicker.
 * @param {number} b1
 * @param {number} b2
 * @param {number} b3
 * @param {number} p
 * @param {number} q
 * @param {any} gains
 */
function wantedTurn(b1, b2, b3, p, q, gains) {
  const braking = gains.angular_deceleration;
  const sine = sqrt(b1 * b1 + b2 * b2);
  let angle = atan2(sine, b3);
  let [nx, ny] = sine > 1e-9 ? [-b2 / sine, b1 / sine] : [1, 0];
  const along = p * nx + q * ny;
  const short = -along + 2 * sqrt(0.5 * along * along + braking * angle);
  const long = along + 2 * sqrt(0.5 * along * along + braking * (2 * Math.PI - angle));
  if (long < short) [nx, ny, angle] = [-nx, -ny, 2 * Math.PI - angle];
  return [nx, ny, angle * brakingProfile(gains.attitude, angle / braking)];
}

/**
 * Roll and pitch before thrust, thrust before yaw, within every rotor's limits.
 * @param {number} thrust
 * @param {number} mx
 * @param {number} my
 * @param {number} mz
 * @param {number[][]} mixer
 * @param {number} low
 * @param {number} high
 * @param {Float32Array} actions
 */
function allocate(thrust, mx, my, mz, mixer, low, high, actions) {
  const middle = (high + low) / 2, half = (high - low) / 2;
  // Rotors give shares of the thrust, and what roll and pitch ask of them, here in terms of the whole thrust.
  const shares = mixer.map(([each]) => each);
  const tilting = mixer.map((m, k) => (m[1] * mx + m[2] * my) / shares[k]);
  const least = min(0, ...tilting), most = max(0, ...tilting);
  const highest = high / max(...shares), lowest = min(highest, low / min(...shares));
  const scale = most - least > highest - lowest ? (highest - lowest) / (most - least) : 1;
  const whole = min(highest - scale * most, max(lowest - scale * least, thrust));
  const parts = shares.map((each, k) => each * (whole + scale * tilting[k]));
  let share = 1;
  for (let k = 0; k < 4; k++) {
    const each = parts[k], yaw = mixer[k][3] * mz;
    const room = yaw > 0 ? high - each : each - low;
    if (abs(yaw) * share > room) share = max(0, room / abs(yaw));
  }
  for (let k = 0; k < 4; k++) {
    actions[k] = clipped((parts[k] + share * mixer[k][3] * mz - middle) / half);
  }
}
