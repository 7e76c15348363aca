/**
 * The observation of a policy, as envs/simulation/{observation,frames}.py have it, in float32 where they are: features
 * (thesis 3.3.1), relative to a reference that moves, with their noise and scaling (Eq. 3.16), last action, earlier frames, the
 * integral of the position error, and what is seen of the reference's future.
 *
 * @typedef {import("./vehicle.js").Turn} Turn
 *
 * @typedef {object} ObservationSettings
 * @property {boolean} last_action
 * @property {number[] | null} history ages of the observed frames, control steps
 * @property {{gain: number, distance: number, speed: number, limit: number} | null} position_integral
 * @property {number[] | null} [preview] control steps ahead, whose acceleration of the reference is seen
 *
 * @typedef {(steps: number) => ArrayLike<number>} Ahead the reference's acceleration in so many control steps, m/s²
 */
import { errorOf, rotation } from "./dynamics.js";
import { DEFAULT_STD, F, OBSERVATION_SIZE, part, X } from "./tables.js";

const NO_TURN = { angle: 0, order: [0, 1, 2, 3] };
const f32 = Math.fround;

/**
 * The features of a state, without noise, in the axes of a layout, float32 (OBSERVATION_SIZE,).
 * @param {Float64Array} s
 * @param {Turn} turn
 * @param {Float32Array} out
 */
export function features(s, turn, out) {
  const r = rotation(s);
  const cosine = Math.cos(turn.angle), sine = Math.sin(turn.angle);
  /** A vector of the body, as the layout's axes have it. @param {ArrayLike<number>} v @param {number} first @param {number} stride */
  const turned = (v, first, stride = 1) => {
    out[first] = cosine * v[0] - sine * v[1];
    out[first + stride] = sine * v[0] + cosine * v[1];
    out[first + 2 * stride] = v[2];
  };
  const velocity = part(s, "velocity");
  out.set(errorOf(s).map((each) => -each), F.position);
  // World to body, row by row: its columns are the world's axes, seen from the body.
  for (let k = 0; k < 3; k++) turned(r.slice(3 * k, 3 * k + 3), F.rotation + k, 3);
  turned([0, 1, 2].map((k) => r[k] * velocity[0] + r[3 + k] * velocity[1] + r[6 + k] * velocity[2]), F.velocity);
  turned(part(s, "body_rates"), F.body_rates);
  relate(s, out);
}

const ACCELERATION_STD = 5; // m/s², of the preview

/** Cosine and sine of the heading whose frame is observed; the world's if none is asked for. @param {Float64Array} s */
function headingOf(s) {
  const [cosine, sine] = part(s, "target_heading");
  return cosine || sine ? [f32(cosine), f32(sine)] : [1, 0];
}

/** Make features relative to the reference, in place: its velocity, its heading and the rate of that. @param {Float64Array} s @param {Float32Array} out */
function relate(s, out) {
  const [c, d] = headingOf(s);
  const [ux, uy, uz] = part(s, "target_velocity").map(f32), rate = f32(s[X.target_heading_rate]);
  const toHeading = (/** @type {number} */ k) => ([out[k], out[k + 1]] = [c * out[k] + d * out[k + 1], c * out[k + 1] - d * out[k]]);
  for (let row = 0; row < 3; row++) {
    const k = F.rotation + 3 * row;
    out[F.velocity + row] -= ux * out[k] + uy * out[k + 1] + uz * out[k + 2];
    out[F.body_rates + row] -= rate * out[k + 2];
    toHeading(k);
  }
  toHeading(F.position);
}

/** Observations of one flight, with what they remember. */
export class Observer {
  /**
   * @param {ObservationSettings} settings
   * @param {number} controlStep s
   * @param {object} how the scaling, the turn to the layout that the policy knows, and standard normals for the noise
   * @param {number[]} [how.mean]
   * @param {number[]} [how.std]
   * @param {number} [how.clip] bound of the scaled features; 0: none
   * @param {Turn} [how.turn]
   * @param {() => number} [how.normal]
   */
  constructor(settings, controlStep, { mean = Array(OBSERVATION_SIZE).fill(0), std = DEFAULT_STD, clip = 0, turn = NO_TURN, normal = () => 0 } = {}) {
    this.ages = settings.history ?? [0];
    this.size = OBSERVATION_SIZE + (settings.last_action ? 4 : 0);
    this.depth = this.ages[this.ages.length - 1] + 1;
    this.integral = settings.position_integral;
    this.preview = settings.preview ?? [];
    this.controlStep = controlStep;
    this.mean = Float32Array.from(mean);
    this.inverse = Float32Array.from(std, (each) => 1 / f32(each));
    this.clip = clip;
    this.turn = turn;
    this.normal = normal;
    this.noise = 0; // relative
    this.feature = new Float32Array(OBSERVATION_SIZE);
    this.sum = [0, 0, 0]; // of the position integral, m
    this.frames = new Float32Array(this.depth * this.size);
    this.out = new Float32Array(this.ages.length * this.size + 3 * this.preview.length);
    this.step = 0;
  }

  /** The observation as an episode begins. @param {Float64Array} s @param {Ahead} [ahead] */
  begin(s, ahead) {
    this.step = 0;
    this.frames.fill(0);
    this.sum = [0, 0, 0];
    this.#look(s);
    return this.#observe(s, ahead);
  }

  /**
   * The observation one control step later.
   * @param {Float64Array} s
   * @param {ArrayLike<number>} action that led there, in the layout's order
   * @param {Ahead} [ahead]
   */
  next(s, action, ahead) {
    this.step += 1;
    const at = (this.step % this.depth) * this.size;
    for (let k = OBSERVATION_SIZE; k < this.size; k++) {
      this.frames[at + k] = Math.min(Math.max(action[k - OBSERVATION_SIZE], -1), 1);
    }
    this.#look(s);
    if (this.integral) this.#integrate(this.integral);
    return this.#observe(s, ahead);
  }

  /** @param {Float64Array} s */
  #look(s) {
    const x = this.feature;
    features(s, this.turn, x);
    for (let k = 0; k < OBSERVATION_SIZE; k++) {
      if (this.noise > 0) x[k] *= f32(1 + this.noise * this.normal());
      x[k] = f32(x[k] - this.mean[k]) * this.inverse[k];
      if (this.clip) x[k] = Math.min(Math.max(x[k], -this.clip), this.clip);
    }
  }

  /** @param {{gain: number, distance: number, speed: number, limit: number}} how */
  #integrate({ gain, distance, speed, limit }) {
    const value = (/** @type {number} */ k) => f32(f32(this.feature[k] / this.inverse[k]) + this.mean[k]);
    const square = (/** @type {number} */ k) => value(k) ** 2 + value(k + 1) ** 2 + value(k + 2) ** 2;
    if (square(F.position) >= distance ** 2 || square(F.velocity) >= speed ** 2) return;
    this.sum = this.sum.map((s, k) => Math.min(Math.max(s + gain * this.controlStep * value(F.position + k), -limit), limit));
  }

  /** @param {Float64Array} s @param {Ahead} [ahead] */
  #observe(s, ahead = () => part(s, "target_acceleration")) {
    const { step, depth, size, frames, out } = this;
    const now = (step % depth) * size;
    frames.set(this.feature, now);
    if (this.integral) {
      const first = F.position;
      this.sum.forEach((s, k) => (frames[now + first + k] += f32(f32(s) * this.inverse[first + k])));
    }
    this.ages.forEach((age, k) => {
      const then = ((step - age + depth * 2) % depth) * size;
      if (age <= step) out.set(frames.subarray(then, then + size), k * size);
      else out.fill(0, k * size, (k + 1) * size);
    });
    const [c, d] = headingOf(s);
    this.preview.forEach((steps, k) => {
      const [x, y, z] = Array.from(ahead(steps));
      out.set([c * x + d * y, c * y - d * x, z].map((each) => each / ACCELERATION_STD), this.ages.length * size + 3 * k);
    });
    return out;
  }
}
