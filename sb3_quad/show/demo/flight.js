/**
 * One vehicle under one controller, control step by control step, as QuadcopterVecEnv flies a row; and how its flight goes.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./vehicle.js").World} World
 * @typedef {import("./vehicle.js").Layout} Layout
 * @typedef {import("./dynamics.js").Wrench} Wrench
 * @typedef {import("./observation.js").ObservationSettings} ObservationSettings
 * @typedef {import("./network.js").Layer} Layer
 * @typedef {import("./course.js").Motion} Motion
 *
 * @typedef {object} Agent
 * @property {string} label
 * @property {"pid" | "geometric" | "network"} kind
 * @property {string} [vehicle] that it was trained on; of an agent of any vehicle empty
 * @property {Layout} [layout] the rotors as it knows them
 * @property {"thrusts" | "rates"} [action] what it commands: thrusts, unless it says otherwise
 * @property {ObservationSettings} [observation]
 * @property {number[]} [mean] μ of Eq. 3.16
 * @property {number[]} [std] σ
 * @property {number} [clip] VecNormalize's bound of scaled features; 0: none
 * @property {Layer[]} [layers]
 *
 * @typedef {object} Start
 * @property {number[]} position m
 * @property {number[]} quaternion body to world
 * @property {number[]} velocity world frame, m/s
 * @property {number[]} body_rates body frame, rad/s
 * @property {number[]} target m
 */
import { commandedSpeeds, distanceOf, physicsStep, rotation, tiltOf } from "./dynamics.js";
import { geometric, pid } from "./experts.js";
import { forward } from "./network.js";
import { Observer } from "./observation.js";
import { RateLoop } from "./rates.js";
import { part, STATE_SIZE, X } from "./tables.js";
import { CALM, findTurn, parametersOf } from "./vehicle.js";

export const NEAR = 0.1; // m: arrival
export const MAX_DISTANCE = 30; // m, farther from the target ends a flight
const EXPERTS = { pid, geometric };
const STARTED = /** @type {const} */ (["position", "quaternion", "velocity", "body_rates", "target"]);
/** @type {Wrench} */
export const NO_WRENCH = { force: [0, 0, 0], torque: [0, 0, 0], wind: [0, 0, 0] };

export class Flight {
  /**
   * @param {Vehicle} vehicle
   * @param {Agent} agent
   * @param {() => number} [normal] standard normals of the observation noise
   */
  constructor(vehicle, agent, normal) {
    this.vehicle = vehicle;
    this.agent = agent;
    this.parameters = parametersOf(vehicle);
    this.state = new Float64Array(STATE_SIZE);
    this.world = CALM;
    this.actions = new Float32Array(4); // in the vehicle's own order of the rotors; thrust and body rates in the agent's axes
    /** @type {number[][]} */
    this.queue = []; // rotor speeds, or thrusts and body rates, that have been commanded and are not due yet
    /** @type {RateLoop | null} */
    this.loop = null; // of an agent that commands body rates
    /** @type {Motion | null} */
    this.course = null; // that the target follows; null: it rests
    this.courseTime = 0; // s
    this.noise = 0;
    this.time = 0; // s
    this.lost = ""; // collision, out of range, or not
    this.away = false; // whether it has been farther than NEAR from the target
    this.arrival = NaN; // s: first within NEAR of the target, once it has been away
    this.settled = NaN; // s: within it ever since
    if (agent.kind === "network") {
      const turn = findTurn(vehicle, agent.layout ?? vehicle);
      if (!turn) throw new Error(`${agent.label} knows other rotors than ${vehicle.name} has`);
      this.turn = turn;
      if (agent.action === "rates") this.loop = new RateLoop(vehicle, turn.angle);
      const settings = agent.observation ?? { last_action: false, history: null, position_integral: null };
      this.observer = new Observer(settings, vehicle.control_step, { mean: agent.mean, std: agent.std, clip: agent.clip, turn, normal });
    } else {
      this.law = EXPERTS[agent.kind](vehicle);
    }
    this.begin({ position: [0, 0, 5], quaternion: [1, 0, 0, 0], velocity: [0, 0, 0], body_rates: [0, 0, 0], target: [0, 0, 5] });
  }

  /** Fly in another world from now on. @param {World} world @param {number} noise relative */
  setWorld(world, noise) {
    this.world = world;
    this.parameters = parametersOf(this.vehicle, world);
    this.noise = noise;
    const { delay } = this.parameters;
    while (this.queue.length > delay) this.queue.shift();
    while (this.queue.length < delay) this.queue.unshift(this.queue[0] ?? this.#hover);
  }

  /** The command of a hover. */
  get #hover() {
    return [...(this.loop?.hover(this.world) ?? this.parameters.hoverSpeeds)];
  }

  /** Begin an episode with rotors in hover. @param {Start} start */
  begin(start) {
    const { hoverSpeeds: hover, delay } = this.parameters;
    this.state.fill(0);
    this.course = null;
    for (const name of STARTED) this.state.set(start[name], X[name]);
    this.state.set(hover, X.rotor_speeds);
    this.queue = Array.from({ length: delay }, () => this.#hover);
    this.loop?.begin(this.state);
    this.time = 0;
    this.lost = "";
    this.away = false;
    this.arrival = this.settled = NaN;
    if (this.observer) {
      this.observer.noise = this.noise;
      this.observation = this.observer.begin(this.state);
    }
  }

  /** @param {number[]} target m; arrival counts again from now on */
  setTarget(target) {
    this.course = null;
    this.state.fill(0, X.target);
    this.state.set(target, X.target);
    this.arrival = this.settled = NaN;
  }

  /** Let the target follow a course from one of its times on. @param {Motion} course @param {number} time s */
  follow(course, time = 0) {
    this.course = course;
    this.courseTime = time;
    this.state.set(course.at(time), X.target);
    this.arrival = this.settled = NaN;
    if (this.observer && this.time === 0) this.observation = this.observer.begin(this.state, this.#ahead);
  }

  /** The reference's acceleration in some control steps, m/s². @param {number} steps @returns {ArrayLike<number>} */
  #ahead = (steps) => {
    if (!this.course) return part(this.state, "target_acceleration");
    return Array.from(this.course.at(this.courseTime + steps * this.vehicle.control_step)).slice(6, 9);
  };

  /** The controller's actions for the present state, in the vehicle's order of the rotors. */
  act() {
    if (this.law) this.law(this.state, this.actions, this.#ahead);
    else if (this.observation && this.agent.layers && this.turn) {
      const known = forward(this.agent.layers, this.observation);
      this.#orders.forEach((own, k) => (this.actions[own] = Math.min(1, Math.max(-1, known[k]))));
    }
    return this.actions;
  }

  /** Where each of the agent's four actions stands in the vehicle's. */
  get #orders() {
    return this.loop || !this.turn ? [0, 1, 2, 3] : this.turn.order;
  }

  /** One control step. @param {Wrench} wrench @param {ArrayLike<number>} actions */
  step(wrench = NO_WRENCH, actions = this.act()) {
    const p = this.parameters, { loop } = this;
    this.queue.push(loop ? loop.command(actions, p) : commandedSpeeds(actions, p));
    const due = this.queue.shift() ?? [];
    for (let k = 0; k < p.substeps; k++) {
      const wanted = loop ? loop.hold(this.state, due, p, this.world.thrust) : due;
      physicsStep(this.state, wanted, p, wrench);
    }
    this.time += this.vehicle.control_step;
    if (this.course) {
      this.courseTime += this.vehicle.control_step;
      this.state.set(this.course.at(this.courseTime), X.target);
    }
    if (this.observer && this.turn) {
      this.observer.noise = this.noise;
      this.observation = this.observer.next(this.state, this.#orders.map((own) => actions[own]), this.#ahead);
    }
    this.#judge();
  }

  #judge() {
    const distance = distanceOf(this.state);
    if (this.state[X.position + 2] <= this.parameters.radius) this.lost ||= "collision";
    else if (distance > MAX_DISTANCE) this.lost ||= "out of range";
    if (distance > NEAR) {
      this.away = true;
      this.settled = NaN;
    } else {
      if (this.away && Number.isNaN(this.arrival)) this.arrival = this.time;
      if (Number.isNaN(this.settled)) this.settled = this.time;
    }
  }

  get distance() {
    return distanceOf(this.state);
  }

  get tilt() {
    return tiltOf(this.state);
  }

  /** Thrusts of the rotors, in hover thrusts of the nominal vehicle. */
  get thrusts() {
    const { lift } = this.parameters;
    const hover = (this.vehicle.mass * this.vehicle.gravity) / 4;
    return [...part(this.state, "rotor_speeds")].map((speed) => (lift * speed ** 2) / hover);
  }

  get rotation() {
    return rotation(this.state);
  }
}

/** Standard normals of a seed (mulberry32; Box and Muller). @param {number} seed */
export function normals(seed) {
  const uniform = uniforms(seed);
  return () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform());
}

/** Numbers uniform on [0, 1) of a seed. @param {number} seed */
export function uniforms(seed) {
  let a = seed >>> 0;
  return () => {
    a = (a + 0x6d2b79f5) >>> 0;
    let t = Math.imul(a ^ (a >>> 15), 1 | a);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}
