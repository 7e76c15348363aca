/**
 * What a policy sees, as sb3_quad/simulation/{observation,frames}.py have it, in float32 where they are: 18 features
 * (thesis 3.3.1) with their noise and scaling (Eq. 3.16), last action, earlier frames and the integral of the position error.
 *
 * @typedef {import("./vehicle.js").Turn} Turn
 *
 * @typedef {object} ObservationSettings
 * @property {boolean} last_action
 * @property {number[] | null} history ages of the observed frames, control steps
 * @property {{gain: number, distance: number, speed: number, limit: number} | null} position_integral
 */
import { rotation } from "./dynamics.js";

export const OBSERVATION_SIZE = 18;
const NO_TURN = { angle: 0, order: [0, 1, 2, 3] };
const f32 = Math.fround;
const third = Math.sqrt(3);
/** σ of Eq. 3.16 (Table A.2). */
export const DEFAULT_STD = [...Array(3).fill(10 / third), ...Array(9).fill(third), ...Array(6).fill(5)];

/**
 * The features of a state, without noise, in the axes of a layout, float32 (18,).
 * @param {Float64Array} s
 * @param {Turn} turn
 * @param {Float32Array} out
 */
export function features(s, turn, out) {
  const r = rotation(s);
  const cosine = Math.cos(turn.angle), sine = Math.sin(turn.angle);
  const v = [0, 1, 2].map((k) => r[k] * s[7] + r[3 + k] * s[8] + r[6 + k] * s[9]);
  const rows = [[r[0], r[3], r[6]], [r[1], r[4], r[7]], [r[2], r[5], r[8]], v, [s[10], s[11], s[12]]];
  for (let k = 0; k < 3; k++) out[k] = s[k] - s[17 + k];
  for (let k = 0; k < 3; k++) {
    out[3 + k] = cosine * rows[0][k] - sine * rows[1][k];
    out[6 + k] = sine * rows[0][k] + cosine * rows[1][k];
    out[9 + k] = rows[2][k];
  }
  rows.slice(3).forEach(([x, y, z], j) => {
    out[12 + 3 * j] = cosine * x - sine * y;
    out[13 + 3 * j] = sine * x + cosine * y;
    out[14 + 3 * j] = z;
  });
}

/** Observations of one flight, with what they remember. */
export class Observer {
  /**
   * @param {ObservationSettings} settings
   * @param {number} controlStep s
   * @param {object} how the scaling, the turn to the layout that the policy knows, and standard normals for the noise
   * @param {number[]} [how.mean]
   * @param {number[]} [how.std]
   * @param {Turn} [how.turn]
   * @param {() => number} [how.normal]
   */
  constructor(settings, controlStep, { mean = Array(18).fill(0), std = DEFAULT_STD, turn = NO_TURN, normal = () => 0 } = {}) {
    this.ages = settings.history ?? [0];
    this.size = OBSERVATION_SIZE + (settings.last_action ? 4 : 0);
    this.depth = this.ages[this.ages.length - 1] + 1;
    this.integral = settings.position_integral;
    this.controlStep = controlStep;
    this.mean = Float32Array.from(mean);
    this.inverse = Float32Array.from(std, (each) => 1 / f32(each));
    this.turn = turn;
    this.normal = normal;
    this.noise = 0; // relative
    this.feature = new Float32Array(OBSERVATION_SIZE);
    this.sum = [0, 0, 0]; // of the position integral, m
    this.frames = new Float32Array(this.depth * this.size);
    this.out = new Float32Array(this.ages.length * this.size);
    this.step = 0;
  }

  /** The observation as an episode begins. @param {Float64Array} s */
  begin(s) {
    this.step = 0;
    this.frames.fill(0);
    this.sum = [0, 0, 0];
    this.#look(s);
    return this.#observe();
  }

  /**
   * The observation one control step later.
   * @param {Float64Array} s
   * @param {ArrayLike<number>} action that led there, in the layout's order
   */
  next(s, action) {
    this.step += 1;
    const at = (this.step % this.depth) * this.size;
    for (let k = OBSERVATION_SIZE; k < this.size; k++) {
      this.frames[at + k] = Math.min(Math.max(action[k - OBSERVATION_SIZE], -1), 1);
    }
    this.#look(s);
    if (this.integral) this.#integrate(this.integral);
    return this.#observe();
  }

  /** @param {Float64Array} s */
  #look(s) {
    const x = this.feature;
    features(s, this.turn, x);
    for (let k = 0; k < OBSERVATION_SIZE; k++) {
      if (this.noise > 0) x[k] *= f32(1 + this.noise * this.normal());
      x[k] = f32(x[k] - this.mean[k]) * this.inverse[k];
    }
  }

  /** @param {{gain: number, distance: number, speed: number, limit: number}} how */
  #integrate({ gain, distance, speed, limit }) {
    const value = (/** @type {number} */ k) => f32(f32(this.feature[k] / this.inverse[k]) + this.mean[k]);
    const square = (/** @type {number} */ k) => value(k) ** 2 + value(k + 1) ** 2 + value(k + 2) ** 2;
    if (square(0) >= distance ** 2 || square(12) >= speed ** 2) return;
    this.sum = this.sum.map((s, k) => Math.min(Math.max(s + gain * this.controlStep * value(k), -limit), limit));
  }

  #observe() {
    const { step, depth, size, frames, out } = this;
    const now = (step % depth) * size;
    frames.set(this.feature, now);
    if (this.integral) for (let k = 0; k < 3; k++) frames[now + k] += f32(f32(this.sum[k]) * this.inverse[k]);
    this.ages.forEach((age, k) => {
      const then = ((step - age + depth * 2) % depth) * size;
      if (age <= step) out.set(frames.subarray(then, then + size), k * size);
      else out.fill(0, k * size, (k + 1) * size);
    });
    return out;
  }
}
