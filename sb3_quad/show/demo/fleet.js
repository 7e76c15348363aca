/**
 * Several controllers side by side: the same vehicle from the same start in the same world, and their score.
 *
 * @typedef {import("./flight.js").Agent} Agent
 * @typedef {import("./flight.js").Start} Start
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 *
 * @typedef {object} Entry one controller of the fleet
 * @property {Agent} agent
 * @property {string} colour
 * @property {boolean} active whether it is shown and flies
 * @property {Flight | null} flight null: it cannot fly this vehicle
 * @property {string} why it cannot
 * @property {boolean} judged whether the present attempt is counted
 * @property {number} survived attempts
 * @property {number} attempts
 * @property {number[][]} log of the latest control steps: time, error, tilt, four thrusts
 * @property {number[][]} trail positions of the latest seconds, m
 * @property {Float64Array} before the state one control step earlier
 *
 * @typedef {object} Settings of the sliders
 * @property {number} mass factor
 * @property {number} motors factor
 * @property {number} delay control steps
 * @property {number} force sideways, weights
 * @property {number} gusts standard deviation, weights
 * @property {number} noise relative
 * @property {number} battery factor of the thrust
 * @property {number} pace greatest speed of a path, m/s
 */
import { Course } from "./course.js";
import { Flight, normals, NO_WRENCH, uniforms } from "./flight.js";
import { part, STATE_SIZE } from "./tables.js";
import { hoverShares, thrustRange } from "./vehicle.js";

export const LOG_SECONDS = 8;
const TRAIL_SECONDS = 4;
const GUST_SECONDS = 1; // time constant
const CALM_SECONDS = 2; // within 0.1 m for so long: the attempt is over
const EPISODE_SECONDS = 15;
const HOME = [0, 0, 15];
const PATH_ACCELERATION = 4; // m/s², at most

/** @param {number[]} q */
const unit = (q) => q.map((each) => each / Math.hypot(...q));

/** A vector of the body in the world. @param {number[]} q @param {number[]} v */
function inWorld([w, x, y, z], [a, b, c]) {
  return [
    (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
    2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
    2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
  ];
}

/**
 * Starts by name; "upside down" and "tumbling" are s1 and s2 of the suite `thesis`, random is as in the task state_recovery.
 * @type {Object<string, (uniform: () => number) => Start>}
 */
export const STARTS = {
  "upside down, at rest": () => ({ position: HOME, quaternion: [0, 1, 0, 0], velocity: [0, 0, 0], body_rates: [0, 0, 0], target: HOME }),
  "upside down": () => thesis([0, -1, 0, 0], [2, 2, 0]),
  tumbling: () => thesis([0.42, -0.41, -0.81, 0], [2, 2, -2]),
  random: (uniform) => {
    const normal = () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform());
    const three = (/** @type {number} */ std) => [normal(), normal(), normal()].map((each) => std * each);
    return { position: HOME, quaternion: unit([...three(1), normal()]), velocity: three(2), body_rates: three(4), target: HOME };
  },
  "10 m away": (uniform) => {
    const [up, azimuth] = [2 * uniform() - 1, 2 * Math.PI * uniform()];
    const across = 10 * Math.sqrt(1 - up * up);
    const target = [across * Math.cos(azimuth), across * Math.sin(azimuth), HOME[2] + 10 * up];
    return { position: HOME, quaternion: [1, 0, 0, 0], velocity: [0, 0, 0], body_rates: [0, 0, 0], target };
  },
};

/** @param {number[]} quaternion @param {number[]} velocity body frame @returns {Start} */
function thesis(quaternion, velocity) {
  const q = unit(quaternion);
  return { position: HOME, quaternion: q, velocity: inWorld(q, velocity), body_rates: [4, 4, 4], target: HOME };
}

export class Fleet {
  /**
   * @param {Agent[]} agents
   * @param {string[]} colours
   * @param {Vehicle} vehicle
   * @param {number} seed of noise, gusts and random starts
   */
  constructor(agents, colours, vehicle, seed = 1) {
    /** @type {Settings} */
    this.settings = { mass: 1, motors: 1, delay: vehicle.delay, force: 0, gusts: 0, noise: 0, battery: 1, pace: 2 };
    this.uniform = uniforms(seed);
    this.normal = normals(seed + 1);
    /** @type {Entry[]} */
    this.entries = [];
    this.vehicle = vehicle;
    this.held = false;
    this.gust = [0, 0, 0];
    this.push = [0, 0, 0]; // by hand, N
    this.rounds = 0; // attempts begun
    /** @type {{points: number[][], course: Course, time: number} | null} */
    this.path = null; // that all follow
    this.start = STARTS["upside down"](this.uniform);
    agents.forEach((agent, k) => this.add(agent, colours[k % colours.length]));
  }

  /** @param {Agent} agent @param {string} colour @returns {Entry} */
  add(agent, colour) {
    /** @type {Entry} */
    const entry = {
      ...{ agent, colour, active: true, flight: null, why: "", judged: true, survived: 0, attempts: 0 },
      ...{ log: [], trail: [], before: new Float64Array(STATE_SIZE) },
    };
    this.entries.push(entry);
    this.#equip(entry);
    return entry;
  }

  /** @param {Entry} entry */
  #equip(entry) {
    try {
      entry.flight = new Flight(this.vehicle, entry.agent, normals(Math.floor(this.uniform() * 2 ** 32)));
      entry.why = "";
      this.#apply(entry.flight);
      entry.flight.begin(this.start);
    } catch (error) {
      entry.flight = null;
      entry.why = String(error instanceof Error ? error.message : error);
    }
    entry.judged = true;
  }

  /** @param {Flight} flight */
  #apply(flight) {
    const { mass, motors, battery, delay, noise } = this.settings;
    flight.setWorld({ mass, motors, thrust: battery, delay }, noise);
  }

  /** All fly another vehicle from now on; scores begin again. @param {Vehicle} vehicle */
  setVehicle(vehicle) {
    if (this.settings.delay === this.vehicle.delay) this.settings.delay = vehicle.delay;
    this.vehicle = vehicle;
    for (const entry of this.entries) {
      entry.survived = entry.attempts = 0;
      this.#equip(entry);
    }
  }

  /** A controller on or off, from the present start. @param {number} k */
  toggle(k) {
    const entry = this.entries[k];
    Object.assign(entry, { active: !entry.active, log: [], trail: [], judged: true });
    entry.flight?.begin(this.start);
    if (this.path) entry.flight?.follow(this.path.course, this.path.time);
    if (entry.flight) entry.before.set(entry.flight.state);
  }

  /** @param {Partial<Settings>} changes */
  set(changes) {
    Object.assign(this.settings, changes);
    if (changes.pace && this.path) this.follow(this.path.points);
    for (const { flight } of this.flying) this.#apply(flight);
  }

  /** Whether the rotors lift the vehicle in the world of the sliders. */
  get canHover() {
    const most = Math.max(...hoverShares(this.vehicle));
    return thrustRange(this.vehicle)[1] * this.settings.battery * 4 > most * this.weight * this.settings.mass;
  }

  /** Of the nominal vehicle, N. */
  get weight() {
    return this.vehicle.mass * this.vehicle.gravity;
  }

  /** The entries that are shown and can fly. */
  get flying() {
    return /** @type {(Entry & {flight: Flight})[]} */ (this.entries.filter((entry) => entry.active && entry.flight));
  }

  /** Whether the present attempt is over for all. */
  get done() {
    return this.flying.every((entry) => entry.judged);
  }

  /** Where the reference is now, m. */
  get target() {
    const flight = this.flying.find((entry) => !entry.flight.lost)?.flight;
    return flight ? [...part(flight.state, "target")] : this.start.target;
  }

  /** All follow a path from where the reference is; what is lost begins again there. @param {number[][]} points m */
  follow(points) {
    const from = this.target, { pace: speed } = this.settings;
    const course = new Course(points, from, { speed, acceleration: PATH_ACCELERATION, dt: this.vehicle.control_step });
    this.path = { points, course, time: 0 };
    this.start = { position: from, quaternion: [1, 0, 0, 0], velocity: [0, 0, 0], body_rates: [0, 0, 0], target: from };
    for (const { flight } of this.entries) {
      if (flight?.lost) flight.begin(this.start);
      flight?.follow(course);
    }
  }

  /** All begin an attempt. @param {Start} start @param {boolean} [stays] whether they still follow the path */
  begin(start, stays = false) {
    if (!stays) this.path = null;
    this.start = start;
    this.held = false;
    this.rounds += 1;
    this.push = [0, 0, 0];
    const std = this.settings.gusts * this.weight;
    this.gust = this.gust.map(() => std * this.normal());
    for (const entry of this.entries) {
      entry.flight?.begin(start);
      if (this.path) entry.flight?.follow(this.path.course, this.path.time);
      entry.judged = !entry.active;
      entry.log = [];
      entry.trail = [];
      if (entry.flight) entry.before.set(entry.flight.state);
    }
  }

  /** All hang in a state, as in a hand, until the next attempt begins. @param {Start} start */
  hold(start) {
    this.held = true;
    this.start = start;
    for (const entry of this.entries) {
      entry.judged = true;
      entry.flight?.begin(start);
      if (entry.flight) entry.before.set(entry.flight.state);
    }
  }

  /** @param {number[]} target m */
  setTarget(target) {
    this.path = null;
    this.start = { ...this.start, target };
    for (const { flight } of this.entries) flight?.setTarget(target);
  }

  /** The force on all of them, world frame, N. */
  get force() {
    const side = this.settings.force * this.weight;
    return this.push.map((each, k) => each + this.gust[k] + (k === 1 ? -side : 0));
  }

  /** One control step of all. */
  step() {
    if (this.held) return;
    const keeps = Math.exp(-this.vehicle.control_step / GUST_SECONDS);
    const adds = this.settings.gusts * this.weight * Math.sqrt(1 - keeps * keeps);
    this.gust = this.gust.map((each) => keeps * each + adds * this.normal());
    const wrench = { ...NO_WRENCH, force: this.force };
    if (this.path) this.path.time += this.vehicle.control_step;
    for (const entry of this.flying) {
      if (entry.flight.lost) continue;
      entry.before.set(entry.flight.state);
      entry.flight.step(wrench);
      this.#record(entry, entry.flight);
    }
  }

  /** @param {Entry} entry @param {Flight} flight */
  #record(entry, flight) {
    const dt = this.vehicle.control_step;
    entry.log.push([flight.time, flight.distance, flight.tilt, ...flight.thrusts]);
    if (entry.log.length > LOG_SECONDS / dt) entry.log.shift();
    entry.trail.push([...part(flight.state, "position")]);
    if (entry.trail.length > TRAIL_SECONDS / dt) entry.trail.shift();
    const calm = flight.time - flight.settled >= CALM_SECONDS;
    if (!entry.judged && (flight.lost || calm || flight.time >= EPISODE_SECONDS)) {
      entry.judged = true;
      entry.attempts += 1;
      entry.survived += flight.lost ? 0 : 1;
    }
  }
}

/**
 * The least time to within 0.1 m that the vehicle's physics allow from a start, s, where its file holds such times.
 * @param {Pick<Fleet, "vehicle" | "start" | "settings">} fleet
 * @returns {number | null}
 */
export function physicalLimit({ vehicle, start, settings }) {
  // It is known of the nominal vehicle, undisturbed.
  const { mass, motors, battery, delay, force, gusts } = settings;
  if (mass !== 1 || motors !== 1 || battery !== 1 || delay !== vehicle.delay || force || gusts) return null;
  const times = vehicle.time_optimal;
  const level = start.quaternion[0] === 1 && ![...start.velocity, ...start.body_rates].some(Boolean);
  const distance = Math.hypot(...start.target.map((each, k) => each - start.position[k]));
  const known = level ? Object.entries(times ?? {}).find(([metres]) => Math.abs(Number(metres) - distance) < 1e-3) : undefined;
  return known ? known[1] : null;
}
