/**
 * The gradient of the model in the page: whole flights of one vehicle are differentiated by the weights of a small network, as
 * sb3_quad/algorithms/apg.py does it. First the network imitates the geometric expert for some updates, since whole flights that
 * nobody controls teach nothing; then it descends along the gradient of the flights' cost (flight_cost.py).
 *
 * Rows are flights. Arrays of a step hold them one after the other, all in double precision.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./flight.js").Agent} Agent
 */
import { cosineOf, drive, groundEffect, moment, momentumOf, physicsStep, rotation, sincOf } from "./dynamics.js";
import { geometric } from "./experts.js";
import { MAX_DISTANCE, normals, NO_WRENCH } from "./flight.js";
import { DEFAULT_STD, F, OBSERVATION_SIZE, STATE_SIZE, X } from "./tables.js";
import { parametersOf } from "./vehicle.js";

const [P, Q, V, W, M] = [X.position, X.quaternion, X.velocity, X.body_rates, X.rotor_speeds];
const MOVED = M + 4; // rows of a state that move: position to rotor speeds
export const WIDTHS = [OBSERVATION_SIZE, 64, 64, 4];
const ROWS = 64, STEPS = 250; // flights in an update, and control steps of each
const EVALUATED = 600; // control steps of a flight that is only evaluated
const SUBSTEPS = 2; // physics steps in a control step of the training, as APG has them
const IMITATION = { updates: 60, steps: 100, rate: 4e-3 };
const DESCENT = { updates: 300, rate: 3e-2 };
const REPORTED = 10; // updates from one report of the worker to the next
const NOISE = 0.05;
const HEIGHT = 15, NEAREST = 1e-8; // m; keeps lengths smooth at zero
const HARDER = 1.15; // factor of the training's velocities and spins
const FAR_SHARE = 0.2; // of the flights begin level, 10 m from their target

/** One dense layer with what Adam remembers of it. */
class Dense {
  /** @param {number} inputs @param {number} outputs @param {() => number} normal @param {number} gain */
  constructor(inputs, outputs, normal, gain) {
    Object.assign(this, { inputs, outputs });
    this.inputs = inputs;
    this.outputs = outputs;
    this.weight = Float64Array.from({ length: inputs * outputs }, () => (gain * normal()) / Math.sqrt(inputs));
    this.transposed = new Float64Array(inputs * outputs);
    this.bias = new Float64Array(outputs);
    this.byWeight = new Float64Array(inputs * outputs);
    this.byBias = new Float64Array(outputs);
    this.moments = [this.byWeight, this.byBias].map((each) => [new Float64Array(each.length), new Float64Array(each.length)]);
  }

  transpose() {
    const { inputs, outputs, weight, transposed } = this;
    for (let o = 0; o < outputs; o++) for (let i = 0; i < inputs; i++) transposed[i * outputs + o] = weight[o * inputs + i];
  }
}

/**
 * y = x Wᵀ for rows of x; the weights row by row.
 * @param {Float64Array} x @param {number} xAt @param {Float64Array} w @param {Float64Array} y @param {number} yAt
 * @param {number} rows @param {number} inputs @param {number} outputs a multiple of two
 */
function product(x, xAt, w, y, yAt, rows, inputs, outputs) {
  for (let r = 0; r < rows; r += 2) {
    const x0 = xAt + r * inputs, x1 = x0 + inputs, y0 = yAt + r * outputs, y1 = y0 + outputs;
    for (let o = 0; o < outputs; o += 2) {
      let a = 0, b = 0, c = 0, d = 0;
      const w0 = o * inputs, w1 = w0 + inputs;
      for (let i = 0; i < inputs; i++) {
        const u = w[w0 + i], v = w[w1 + i], s = x[x0 + i], t = x[x1 + i];
        a += u * s;
        b += v * s;
        c += u * t;
        d += v * t;
      }
      y[y0 + o] = a;
      y[y0 + o + 1] = b;
      y[y1 + o] = c;
      y[y1 + o + 1] = d;
    }
  }
}

/**
 * Add dᵀ x to the gradient of the weights, and the sums of d to that of the bias.
 * @param {Dense} layer @param {Float64Array} x @param {number} xAt @param {Float64Array} d @param {number} rows
 */
function collect(layer, x, xAt, d, rows) {
  const { inputs, outputs, byWeight, byBias } = layer;
  for (let r = 0; r < rows; r += 4) {
    const x0 = xAt + r * inputs, x1 = x0 + inputs, x2 = x1 + inputs, x3 = x2 + inputs;
    for (let o = 0; o < outputs; o++) {
      const at = r * outputs + o, d0 = d[at], d1 = d[at + outputs], d2 = d[at + 2 * outputs], d3 = d[at + 3 * outputs];
      byBias[o] += d0 + d1 + d2 + d3;
      const first = o * inputs;
      for (let i = 0; i < inputs; i++) byWeight[first + i] += d0 * x[x0 + i] + d1 * x[x1 + i] + d2 * x[x2 + i] + d3 * x[x3 + i];
    }
  }
}

/** A network that is trained for a vehicle, an update at a time. */
export class Training {
  /** @param {Vehicle} vehicle @param {number} seed */
  constructor(vehicle, seed = 0) {
    this.vehicle = vehicle;
    this.normal = normals(seed);
    const p = parametersOf({ ...vehicle, physics_step: vehicle.control_step / SUBSTEPS });
    this.p = p;
    this.law = geometric(vehicle);
    this.layers = [0, 1, 2].map((k) => new Dense(WIDTHS[k], WIDTHS[k + 1], this.normal, k === 2 ? 0.01 : 1));
    this.updates = 0;
    this.inverse = DEFAULT_STD.map((each) => 1 / each);
    const array = (/** @type {number} */ width, count = EVALUATED) => new Float64Array(count * ROWS * width);
    this.states = array(STATE_SIZE, EVALUATED + 1);
    this.units = [...WIDTHS.slice(0, 3).map((size) => array(size)), array(4)]; // inputs, both hidden layers, actions
    this.factors = array(OBSERVATION_SIZE); // of the features: noise and scaling
    this.alive = new Uint8Array((EVALUATED + 1) * ROWS);
    this.wanted = array(4, EVALUATED + p.delay);
    this.byWanted = array(4, EVALUATED + p.delay);
    this.byState = array(MOVED, 1);
    this.errors = WIDTHS.map((size) => new Float64Array(ROWS * size));
    this.inner = new Float64Array((SUBSTEPS + 1) * MOVED);
    this.g = new Float64Array(MOVED);
    this.label = new Float32Array(4);
  }

  /** Updates in all. */
  get length() {
    return IMITATION.updates + DESCENT.updates;
  }

  /** One update; control steps flown. */
  update() {
    const imitates = this.updates < IMITATION.updates;
    const steps = imitates ? IMITATION.steps : STEPS;
    const left = 1 - (this.updates - IMITATION.updates) / DESCENT.updates;
    this.fly(steps, NOISE, HARDER, FAR_SHARE);
    for (const layer of this.layers) {
      layer.transpose();
      layer.byWeight.fill(0);
      layer.byBias.fill(0);
    }
    if (imitates) this.#imitate(steps);
    else this.#differentiate(steps);
    this.updates += 1;
    this.#descend(imitates ? IMITATION.rate : DESCENT.rate * left);
    return steps * ROWS;
  }

  /**
   * Begin flights: most in any attitude, velocity and spin, as the task state_recovery has them; the rest 10 m from their target.
   * @param {number} harder factor of the velocities and spins
   * @param {number} share of the flights that begin 10 m away
   */
  #begin(harder, share) {
    const { states, normal, p } = this;
    states.fill(0, 0, ROWS * STATE_SIZE);
    for (let r = 0; r < ROWS; r++) {
      const at = r * STATE_SIZE, far = r < share * ROWS;
      const direction = [normal(), normal(), normal()], size = Math.hypot(...direction);
      const q = [normal(), normal(), normal(), normal()], length = Math.hypot(...q);
      for (let k = 0; k < 4; k++) states[at + Q + k] = far ? Number(k === 0) : q[k] / length;
      for (let k = 0; k < 3; k++) {
        states[at + V + k] = far ? 0 : 2 * harder * normal();
        states[at + W + k] = far ? 0 : 4 * harder * normal();
        states[at + X.target + k] = far ? (10 * direction[k]) / size : 0;
      }
      states[at + P + 2] = HEIGHT;
      states[at + X.target + 2] += HEIGHT;
      for (let k = 0; k < 4; k++) states[at + M + k] = p.hoverSpeeds[k];
    }
    this.alive.fill(1, 0, ROWS);
    for (let k = 0; k < this.wanted.length; k++) this.wanted[k] = p.hoverSpeeds[k % 4];
  }

  /**
   * Fly all rows for so many control steps.
   * @param {number} steps @param {number} noise relative @param {number} harder @param {number} share
   */
  fly(steps, noise, harder, share) {
    const { states, alive, wanted, p } = this;
    this.#begin(harder, share);
    for (let t = 0; t < steps; t++) {
      this.#observe(t, noise);
      this.#act(t);
      const actions = this.units[3];
      for (let k = 0; k < 4 * ROWS; k++) {
        const action = Math.min(Math.max(actions[t * 4 * ROWS + k], -1), 1);
        wanted[(t + p.delay) * 4 * ROWS + k] = Math.sqrt((p.middle + p.half * action) / p.lift);
      }
      const now = t * ROWS * STATE_SIZE, next = now + ROWS * STATE_SIZE;
      states.copyWithin(next, now, next);
      for (let r = 0; r < ROWS; r++) {
        const at = next + r * STATE_SIZE, before = alive[t * ROWS + r];
        if (before) for (let k = 0; k < SUBSTEPS; k++) physicsStep(states, wanted, p, NO_WRENCH, at, (t * ROWS + r) * 4);
        alive[(t + 1) * ROWS + r] = before && states[at + P + 2] > p.radius ? 1 : 0;
      }
    }
  }

  /** The share of fresh throws that survive for 6 s, with noise as in the training. */
  evaluate() {
    const steps = EVALUATED;
    this.fly(steps, NOISE, 1, 0);
    let good = 0;
    for (let r = 0; r < ROWS; r++) {
      const at = (steps * ROWS + r) * STATE_SIZE;
      const away = Math.hypot(...[0, 1, 2].map((k) => this.states[at + P + k] - this.states[at + X.target + k]));
      good += this.alive[steps * ROWS + r] && away < MAX_DISTANCE ? 1 : 0;
    }
    return good / ROWS;
  }

  /** Features of step t, with noise and scaling (Eq. 3.16). @param {number} t @param {number} noise */
  #observe(t, noise) {
    const { states, factors, inverse, normal } = this, x = this.units[0];
    for (let r = 0; r < ROWS; r++) {
      const s = (t * ROWS + r) * STATE_SIZE, o = (t * ROWS + r) * OBSERVATION_SIZE;
      look(states, s, x, o);
      for (let k = 0; k < OBSERVATION_SIZE; k++) {
        const factor = inverse[k] * (noise ? 1 + noise * normal() : 1);
        factors[o + k] = factor;
        x[o + k] *= factor;
      }
    }
  }

  /** The network's actions of step t. @param {number} t */
  #act(t) {
    for (let k = 0; k < 3; k++) {
      const { inputs, outputs, weight, bias } = this.layers[k];
      const y = this.units[k + 1], first = t * ROWS * outputs, end = first + ROWS * outputs;
      product(this.units[k], t * ROWS * inputs, weight, y, first, ROWS, inputs, outputs);
      for (let at = first, o = 0; at < end; at++, o = o + 1 === outputs ? 0 : o + 1) {
        const sum = y[at] + bias[o];
        y[at] = k < 2 ? Math.tanh(sum) : sum;
      }
    }
  }

  /** Carry the gradient by the actions of step t (errors[3]) back through the network, to errors[0]. @param {number} t @param {boolean} further */
  #backward(t, further) {
    const { errors, layers, units } = this;
    for (let k = 2; k >= 0; k--) {
      const { inputs, outputs, transposed } = layers[k];
      const first = t * ROWS * inputs;
      collect(layers[k], units[k], first, errors[k + 1], ROWS);
      if (k === 0 && !further) return;
      product(errors[k + 1], 0, transposed, errors[k], 0, ROWS, outputs, inputs);
      if (k > 0) for (let j = 0; j < ROWS * inputs; j++) errors[k][j] *= 1 - units[k][first + j] ** 2;
    }
  }

  /** Gradient of the squared distance from the geometric expert's actions. @param {number} steps */
  #imitate(steps) {
    const { states, units, errors, alive, label } = this, scale = 1 / (steps * ROWS);
    for (let t = 0; t < steps; t++) {
      for (let r = 0; r < ROWS; r++) {
        const at = (t * ROWS + r) * STATE_SIZE;
        this.law(states.subarray(at, at + STATE_SIZE), label);
        for (let k = 0; k < 4; k++) {
          errors[3][4 * r + k] = alive[t * ROWS + r] * scale * (units[3][(t * ROWS + r) * 4 + k] - label[k]);
        }
      }
      this.#backward(t, false);
    }
  }

  /** Gradient of the mean cost of whole flights. @param {number} steps */
  #differentiate(steps) {
    const { states, units, errors, alive, wanted, byWanted, byState, p, g, inner } = this;
    const scale = 1 / (steps * ROWS);
    byState.fill(0);
    byWanted.fill(0);
    for (let t = steps - 1; t >= 0; t--) {
      for (let r = 0; r < ROWS; r++) {
        const before = (t * ROWS + r) * STATE_SIZE, after = before + ROWS * STATE_SIZE, to = r * MOVED;
        if (!alive[(t + 1) * ROWS + r]) continue;
        for (let k = 0; k < MOVED; k++) g[k] = byState[to + k];
        addCost(states, after, g, scale);
        // The substeps once more, then backwards.
        for (let k = 0; k < MOVED; k++) inner[k] = states[before + k];
        for (let k = 1; k < SUBSTEPS; k++) {
          inner.copyWithin(k * MOVED, (k - 1) * MOVED, k * MOVED);
          physicsStep(inner, wanted, p, NO_WRENCH, k * MOVED, (t * ROWS + r) * 4);
        }
        for (let k = SUBSTEPS - 1; k >= 0; k--) undo(inner, k * MOVED, wanted, byWanted, (t * ROWS + r) * 4, g, p);
        for (let k = 0; k < MOVED; k++) byState[to + k] = g[k];
      }
      for (let k = 0; k < 4 * ROWS; k++) {
        const action = units[3][t * 4 * ROWS + k], bounded = Math.min(Math.max(action, -1), 1);
        const at = (t + p.delay) * 4 * ROWS + k;
        const slope = action === bounded ? p.half / (2 * p.lift * wanted[at]) : 0;
        const counts = alive[(t + 1) * ROWS + (k >> 2)];
        errors[3][k] = counts * (byWanted[at] * slope + 0.02 * scale * (action - bounded));
      }
      this.#backward(t, true);
      for (let r = 0; r < ROWS; r++) {
        if (!alive[(t + 1) * ROWS + r]) continue;
        lookBack(states, (t * ROWS + r) * STATE_SIZE, this.factors, (t * ROWS + r) * OBSERVATION_SIZE, errors[0], r * OBSERVATION_SIZE, byState, r * MOVED);
      }
    }
  }

  /** One step of Adam along a gradient of length at most one. @param {number} rate */
  #descend(rate) {
    let square = 0;
    for (const { byWeight, byBias } of this.layers) for (const each of [byWeight, byBias]) for (const value of each) square += value * value;
    const scale = 1 / Math.max(1, Math.sqrt(square));
    if (!Number.isFinite(square)) return;
    const n = this.updates, unbias = Math.sqrt(1 - 0.99 ** n) / (1 - 0.9 ** n);
    for (const { weight, bias, byWeight, byBias, moments } of this.layers) {
      [weight, bias].forEach((values, which) => {
        const gradient = which ? byBias : byWeight, [mean, size] = moments[which];
        for (let k = 0; k < values.length; k++) {
          const value = scale * gradient[k];
          mean[k] = 0.9 * mean[k] + 0.1 * value;
          size[k] = 0.99 * size[k] + 0.01 * value * value;
          values[k] -= (rate * unbias * mean[k]) / (Math.sqrt(size[k]) + 1e-5);
        }
      });
    }
  }

  /** The weights and biases, layer by layer, as layersOf reads them. */
  get numbers() {
    return Float32Array.from(this.layers.flatMap(({ weight, bias }) => [...weight, ...bias]));
  }
}

/**
 * What the page's worker does: train a network for a vehicle, and report it every so often.
 * @param {{vehicle: Vehicle, seed: number}} job
 * @param {(report: {numbers: Float32Array, share: number, progress: number}) => void} report
 */
export function train({ vehicle, seed }, report) {
  const training = new Training(vehicle, seed);
  while (training.updates < training.length) {
    training.update();
    if (training.updates % REPORTED) continue;
    report({ numbers: training.numbers, share: training.evaluate(), progress: training.updates / training.length });
  }
}

/** The derivative of sin(h) / h by h². @param {number} h2 */
const sincSlope = (h2) => -(1 / 6) * (1 - (h2 / 10) * (1 - (h2 / 28) * (1 - h2 / 54)));

// Of the row that is carried back: a rotation matrix, the gradient by it, and thrusts and speeds of the rotors
const R = new Float64Array(9), byR = new Float64Array(9), driven = new Float64Array(8);

/**
 * Add byR, the gradient by the rotation matrix of a state, to that by its quaternion.
 * @param {Float64Array} s @param {number} at @param {Float64Array} g @param {number} to
 */
function addByRotation(s, at, g, to) {
  const w = s[at + Q], x = s[at + Q + 1], y = s[at + Q + 2], z = s[at + Q + 3];
  const [e0, e1, e2, e3, e4, e5, e6, e7, e8] = byR;
  g[to + Q] += 2 * (-z * e1 + y * e2 + z * e3 - x * e5 - y * e6 + x * e7);
  g[to + Q + 1] += 2 * (y * e1 + z * e2 + y * e3 - 2 * x * e4 - w * e5 + z * e6 + w * e7 - 2 * x * e8);
  g[to + Q + 2] += 2 * (-2 * y * e0 + x * e1 + w * e2 + x * e3 + z * e5 - w * e6 + z * e7 - 2 * y * e8);
  g[to + Q + 3] += 2 * (-2 * z * e0 - w * e1 + x * e2 + w * e3 - 2 * z * e4 + y * e5 + x * e6 + y * e7);
}

/**
 * Carry a gradient by the state after physicsStep, without wind and wrench, back to the one before, in place, and add that by
 * the wanted speeds.
 * @param {Float64Array} s @param {number} at the state before @param {Float64Array} wanted @param {Float64Array} byWanted @param {number} from
 * @param {Float64Array} g @param {import("./vehicle.js").Parameters} p
 */
export function undo(s, at, wanted, byWanted, from, g, p) {
  const { air, dt, lift, exact, arms, inertia } = p;
  // What the step computed
  drive(s, at, wanted, from, p, driven);
  rotation(s, at, R);
  const w = s[at + Q], x = s[at + Q + 1], y = s[at + Q + 2], z = s[at + Q + 3];
  const vx = s[at + V], vy = s[at + V + 1], vz = s[at + V + 2];
  const sx = R[0] * vx + R[3] * vy + R[6] * vz, sy = R[1] * vx + R[4] * vy + R[7] * vz, sz = R[2] * vx + R[5] * vy + R[8] * vz;
  const total = driven[4] + driven[5] + (driven[6] + driven[7]), momentum = momentumOf(driven, 4, p);
  const drag = p.drag.map((each, k) => each + air.drag[k] * total);
  const thrust = driven[0] + driven[1] + (driven[2] + driven[3]);
  const fx = -drag[0] * sx, fy = -drag[1] * sy, fz = thrust - drag[2] * sz + air.lift * (sx * sx + sy * sy);
  const wx = s[at + W], wy = s[at + W + 1], wz = s[at + W + 2];
  const gx = inertia[2] - inertia[1], gy = inertia[0] - inertia[2], gz = inertia[1] - inertia[0];
  const ix = dt / inertia[0], iy = dt / inertia[1], iz = dt / inertia[2];
  const roll = air.moment[0] * total * sy - momentum * wy - air.damping[0] * wx;
  const pitch = momentum * wx - air.moment[1] * total * sx - air.damping[1] * wy;
  const yaw = (momentumOf(s, at + M, p) - momentum) / dt - air.damping[2] * wz;
  const hx = 0.5 * dt * (wx + ix * (moment(arms[0], driven) - gx * wy * wz + roll));
  const hy = 0.5 * dt * (wy + iy * (moment(arms[1], driven) - gy * wz * wx + pitch));
  const hz = 0.5 * dt * (wz + iz * (moment(arms[2], driven) - gz * wx * wy + yaw)), h2 = hx * hx + hy * hy + hz * hz;
  const sinc = sincOf(h2), aw = cosineOf(h2), ax = hx * sinc, ay = hy * sinc, az = hz * sinc;
  const nw = w * aw - x * ax - y * ay - z * az, nx = w * ax + x * aw + y * az - z * ay;
  const ny = w * ay - x * az + y * aw + z * ax, nz = w * az + x * ay - y * ax + z * aw;
  const scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz);
  // The quaternion: its length, then the product q a.
  const along = nw * g[Q] + nx * g[Q + 1] + ny * g[Q + 2] + nz * g[Q + 3];
  const ew = scale * g[Q] - nw * along, ex = scale * g[Q + 1] - nx * along;
  const ey = scale * g[Q + 2] - ny * along, ez = scale * g[Q + 3] - nz * along;
  g[Q] = ew * aw + ex * ax + ey * ay + ez * az;
  g[Q + 1] = -ew * ax + ex * aw - ey * az + ez * ay;
  g[Q + 2] = -ew * ay + ex * az + ey * aw - ez * ax;
  g[Q + 3] = -ew * az - ex * ay + ey * ax + ez * aw;
  const cw = ew * w + ex * x + ey * y + ez * z, cx = -ew * x + ex * w + ey * z - ez * y;
  const cy = -ew * y - ex * z + ey * w + ez * x, cz = -ew * z + ex * y - ey * x + ez * w;
  // The turn a by half the angle h, and the body rates after the step
  const common = 2 * (cx * hx + cy * hy + cz * hz) * sincSlope(h2) - cw * sinc;
  const bx = g[W] + 0.5 * dt * (cx * sinc + common * hx), by = g[W + 1] + 0.5 * dt * (cy * sinc + common * hy);
  const bz = g[W + 2] + 0.5 * dt * (cz * sinc + common * hz);
  const tx = ix * bx, ty = iy * by, tz = iz * bz; // by the torque
  g[W] = bx - gy * wz * ty - gz * wy * tz + momentum * ty - air.damping[0] * tx;
  g[W + 1] = by - gx * wz * tx - gz * wx * tz - momentum * tx - air.damping[1] * ty;
  g[W + 2] = bz - gx * wy * tx - gy * wx * ty - air.damping[2] * tz;
  // The velocity after the step, which moves the position; force and drag in body axes
  const ux = g[V] + dt * g[P], uy = g[V + 1] + dt * g[P + 1], uz = g[V + 2] + dt * g[P + 2], perForce = dt / p.mass;
  const dx = perForce * ux, dy = perForce * uy, dz = perForce * uz; // by the force in world axes
  const kx = R[0] * dx + R[3] * dy + R[6] * dz, ky = R[1] * dx + R[4] * dy + R[7] * dz, kz = R[2] * dx + R[5] * dy + R[8] * dz;
  // By the velocity in body axes, the sum of the rotor speeds, and the rotors' angular momentum
  const mx = -drag[0] * kx + 2 * air.lift * sx * kz - air.moment[1] * total * ty;
  const my = -drag[1] * ky + 2 * air.lift * sy * kz + air.moment[0] * total * tx, mz = -drag[2] * kz;
  const byDrag = air.drag[0] * sx * kx + air.drag[1] * sy * ky + air.drag[2] * sz * kz;
  const byTotal = air.moment[0] * sy * tx - air.moment[1] * sx * ty - byDrag;
  const byMomentum = wx * ty - wy * tx - tz / dt;
  g[V] = ux + R[0] * mx + R[1] * my + R[2] * mz;
  g[V + 1] = uy + R[3] * mx + R[4] * my + R[5] * mz;
  g[V + 2] = uz + R[6] * mx + R[7] * my + R[8] * mz;
  byR[0] = dx * fx + vx * mx;
  byR[1] = dx * fy + vx * my;
  byR[2] = dx * fz + vx * mz;
  byR[3] = dy * fx + vy * mx;
  byR[4] = dy * fy + vy * my;
  byR[5] = dy * fz + vy * mz;
  byR[6] = dz * fx + vz * mx;
  byR[7] = dz * fy + vz * my;
  byR[8] = dz * fz + vz * mz;
  addByRotation(s, at, g, 0);
  const height = s[at + P + 2], ground = groundEffect(air.radius, height);
  for (let k = 0; k < 4; k++) {
    const byUnscaled = kz + arms[0][k] * tx + arms[1][k] * ty + arms[2][k] * tz;
    const byThrust = byUnscaled * air.factors[k] * ground;
    if (2 * height > air.radius) g[P + 2] -= (2 * (ground - 1) * byUnscaled * driven[k]) / height;
    const old = s[at + M + k], speed = driven[4 + k], share = wanted[from + k] > old ? p.up : p.down;
    const bySpeed =
      g[M + k] + byThrust * lift * (2 * speed + exact * (old - 2 * speed)) + byTotal + air.spins[k] * byMomentum;
    g[M + k] = bySpeed * (1 - share) + byThrust * lift * speed * exact + (air.spins[k] * tz) / dt;
    byWanted[from + k] += bySpeed * share;
  }
}

/** Add the gradient of flight_cost.py's cost of one state. @param {Float64Array} s @param {number} at @param {Float64Array} g @param {number} scale */
function addCost(s, at, g, scale) {
  const x = s[at + P] - s[at + X.target], y = s[at + P + 1] - s[at + X.target + 1], z = s[at + P + 2] - s[at + X.target + 2];
  const d = Math.sqrt(x * x + y * y + z * z + NEAREST), near = 1 / (1 + (d / 0.5) ** 2);
  const wx = s[at + W], wy = s[at + W + 1], wz = s[at + W + 2], rate = Math.sqrt(wx * wx + wy * wy + wz * wz + NEAREST);
  const byDistance = 0.5 / (d + 0.5) ** 2 + 0.05 / (d + 0.05) ** 2 - 0.03 * rate * near * near * 8 * d;
  const to = (scale * byDistance) / d, calm = (scale * (0.002 + 0.03 * near)) / rate;
  g[P] += to * x;
  g[P + 1] += to * y;
  g[P + 2] += to * z - (s[at + P + 2] < 1.5 ? 0.5 * scale : 0);
  g[W] += calm * wx;
  g[W + 1] += calm * wy;
  g[W + 2] += calm * wz;
  g[Q + 1] += 0.004 * scale * s[at + Q + 1];
  g[Q + 2] += 0.004 * scale * s[at + Q + 2];
}

/** The features of a state: features of observation.js without arrays. @param {Float64Array} s @param {number} at @param {Float64Array} x @param {number} o */
function look(s, at, x, o) {
  rotation(s, at, R);
  const vx = s[at + V], vy = s[at + V + 1], vz = s[at + V + 2];
  for (let n = 0; n < 3; n++) {
    x[o + F.position + n] = s[at + P + n] - s[at + X.target + n];
    x[o + F.body_rates + n] = s[at + W + n];
    // World to body, row by row
    for (let k = 0; k < 3; k++) x[o + F.rotation + 3 * n + k] = R[3 * k + n];
    x[o + F.velocity + n] = R[n] * vx + R[3 + n] * vy + R[6 + n] * vz;
  }
}

/**
 * Add the gradient by a state, by way of its observation.
 * @param {Float64Array} s @param {number} at @param {Float64Array} factors @param {number} o @param {Float64Array} by @param {number} from
 * @param {Float64Array} g @param {number} to
 */
function lookBack(s, at, factors, o, by, from, g, to) {
  rotation(s, at, R);
  for (let n = 0; n < 3; n++) {
    g[to + P + n] += factors[o + F.position + n] * by[from + F.position + n];
    g[to + W + n] += factors[o + F.body_rates + n] * by[from + F.body_rates + n];
    // By the velocity in body axes, and by a row of the matrix from world to body
    const k = F.velocity + n, byVelocity = factors[o + k] * by[from + k];
    for (let axis = 0; axis < 3; axis++) {
      const m = F.rotation + 3 * n + axis;
      g[to + V + axis] += R[3 * axis + n] * byVelocity;
      byR[3 * axis + n] = factors[o + m] * by[from + m] + s[at + V + axis] * byVelocity;
    }
  }
  addByRotation(s, at, g, to);
}
