/**
 * The clock of the flights, and what the visitor does: throw, push, draw a path, move the target.
 *
 * @typedef {import("./fleet.js").Entry} Entry
 * @typedef {import("./camera.js").Camera} Camera
 * @typedef {import("./scene.js").Body} Body
 * @typedef {import("./flight.js").Start} Start
 */
import { lengthOf } from "./course.js";
import { rotation, turnBody } from "./dynamics.js";
import { Fleet, STARTS } from "./fleet.js";
import { part, STATE_SIZE, X } from "./tables.js";

const LANE = 2.4; // m between vehicles
const FASTEST = 14; // m/s of a throw
const TUMBLE = 1.1; // rad/s of a throw, per m/s
const SPIN = 12; // rad/s at which a dragged vehicle turns at most
const STRONGEST = 1.2; // of a push, weights
const FARTHEST = 20; // m of a path from the reference
const SHORTEST = 1; // m, below which a path is a slip of the hand
const KICK_SECONDS = 0.15;
const PAUSE = 1.4; // s between attempts of the automatic flight
const CYCLE = ["random", "10 m away", "upside down, at rest", "random", "tumbling", "upside down"];

export class Player {
  /** @param {Fleet} fleet @param {Camera} camera */
  constructor(fleet, camera) {
    this.fleet = fleet;
    this.camera = camera;
    this.paused = false;
    this.speed = 1;
    this.auto = true; // starts again by itself
    this.apart = true; // each vehicle in a lane of its own
    this.trails = true;
    this.touched = false;
    this.startName = "upside down"; // of the present attempt; empty after a throw
    /** @type {"throw" | "push" | "draw"} */
    this.tool = "throw";
    /** @type {number[][]} */
    this.drawing = []; // the path under the hand, m
    this.carried = 0; // s of flight that are due
    this.idle = 0; // s since all were done
    this.round = 0;
    this.kickLeft = 0; // s
    this.grabbed = { position: [0, 0, 0], quaternion: [1, 0, 0, 0] };
    /** @type {number[]} */
    this.dragged = [0, 0, 0]; // the target, as its drag began
    /** @type {WeakMap<Entry, number[]>} */
    this.angles = new WeakMap(); // of the rotors, as they are drawn
    this.onChange = () => {};
    this.onEnd = () => {};
  }

  /** @param {Partial<Pick<Player, "paused" | "speed" | "auto" | "apart" | "trails" | "tool">>} changes */
  set(changes) {
    if (changes.tool && (changes.tool === "draw") !== (this.tool === "draw")) {
      // A path is drawn from above, and all follow it in one place.
      if (changes.tool === "draw") this.camera.lookDown();
      else this.camera.reset();
      Object.assign(this, { apart: changes.tool !== "draw", auto: false, touched: true });
    }
    Object.assign(this, changes);
    this.onChange();
  }

  /** @param {string} name */
  start(name) {
    this.startName = name;
    this.#begin(STARTS[name](this.fleet.uniform));
  }

  /** The same start again. */
  again() {
    this.#begin(this.fleet.start, true);
  }

  /** @param {Start} start @param {boolean} [stays] whether they still follow the path */
  #begin(start, stays = false) {
    this.fleet.begin(start, stays);
    this.carried = this.idle = 0;
    this.set({ paused: false });
  }

  /** Somebody has done something: the page no longer flies on its own. */
  takeOver() {
    this.touched = true;
    this.set({ auto: false });
  }

  /** @param {number} seconds since the last picture */
  advance(seconds) {
    if (this.paused) return;
    const { fleet } = this;
    const flown = seconds * this.speed;
    if (this.kickLeft > 0) {
      this.kickLeft -= flown;
      fleet.push = this.kickLeft > 0 ? this.camera.axes.right.map((each) => each * fleet.weight) : [0, 0, 0];
    }
    const step = fleet.vehicle.control_step;
    for (this.carried += flown; this.carried >= step; this.carried -= step) fleet.step();
    this.#turnRotors(seconds * Math.max(this.speed, 0.25));
    if (!fleet.done || fleet.held) return;
    if (this.idle === 0) this.onEnd();
    this.idle += seconds;
    if (this.auto && this.idle > PAUSE) this.start(CYCLE[this.round++ % CYCLE.length]);
  }

  /** @param {number} seconds */
  #turnRotors(seconds) {
    for (const entry of this.fleet.flying) {
      const { thrusts, lost, vehicle } = entry.flight;
      const turns = thrusts.map((each, k) => (lost ? 0 : seconds * 26 * Math.sqrt(each) * -vehicle.rotor_directions[k]));
      this.angles.set(entry, (this.angles.get(entry) ?? [0, 0, 0, 0]).map((each, k) => each + turns[k]));
    }
  }

  /** What is drawn of the flights, between their last two states. @returns {Body[]} */
  bodies() {
    const { fleet } = this;
    const flying = fleet.flying;
    return flying.map((entry, place) => {
      const { flight, before } = entry;
      const lane = [0, this.apart ? -(place - (flying.length - 1) / 2) * LANE : 0, 0];
      const share = flight.lost || fleet.held ? 1 : this.carried / fleet.vehicle.control_step;
      const between = flight.state.map((each, k) => before[k] + share * (each - before[k]));
      const attitude = part(between, "quaternion");
      const size = Math.hypot(...attitude) || 1;
      attitude.forEach((each, k) => (attitude[k] = each / size));
      const inLane = (/** @type {ArrayLike<number>} */ v) => lane.map((each, k) => v[k] + each);
      return {
        label: entry.agent.label,
        colour: entry.colour,
        position: inLane(part(between, "position")),
        rotation: rotation(between),
        thrusts: flight.thrusts,
        angles: this.angles.get(entry) ?? [0, 0, 0, 0],
        target: inLane(part(flight.state, "target")),
        trail: entry.trail,
        lane,
        lost: flight.lost,
        force: fleet.force.map((each) => each / fleet.weight),
        near: !flight.lost && flight.settled >= 0,
      };
    });
  }

  // ------------------------------------------------------------ what the visitor drags

  /** What the visitor can drag. @returns {import("./hand.js").Holdable[]} */
  things() {
    return this.bodies().flatMap(({ position, target }, index) => [
      { kind: /** @type {const} */ ("vehicle"), index, position },
      { kind: /** @type {const} */ ("target"), index, position: target },
    ]);
  }

  /** Grab a vehicle, and with it all others. @param {number} index */
  grab(index) {
    const { state } = this.fleet.flying[index].flight;
    this.grabbed = { position: [...part(state, "position")], quaternion: [...part(state, "quaternion")] };
    this.startName = "";
    this.fleet.hold(this.#inHand([0, 0, 0], [0, 0, 0]));
    for (const entry of this.fleet.entries) entry.trail = [];
    this.takeOver();
    this.set({ paused: false });
  }

  /** @param {number[]} way from where it was grabbed, m @param {number[]} velocity m/s */
  carry(way, velocity) {
    this.#tumble(this.#spin(velocity), 1 / 60);
    this.fleet.hold(this.#inHand(way, velocity));
  }

  /** @param {number[]} velocity m/s */
  release(velocity) {
    const { position } = this.fleet.start;
    this.#begin({ ...this.#inHand([0, 0, 0], velocity), position }, true);
  }

  /** @param {number[] | null} way an arrow, m; null: no longer */
  push(way) {
    if (way === null) this.takeOver();
    const size = Math.max(Math.hypot(...(way ?? [0])), 1e-9);
    const force = (Math.min(size / 2, STRONGEST) * this.fleet.weight) / size;
    this.fleet.push = (way ?? [0, 0, 0]).map((each) => each * force);
  }

  /** @param {number} x @param {number} y pixels @param {boolean} begins */
  draw(x, y, begins) {
    if (begins) this.drawing = [];
    const point = this.camera.pointAt(x, y, this.fleet.target[2]);
    if (point && Math.hypot(...point.map((each, k) => each - this.fleet.target[k])) < FARTHEST) this.drawing.push(point);
  }

  /** The path has been drawn: all follow it. */
  drawn() {
    const points = this.drawing;
    this.drawing = [];
    if (lengthOf(points) < SHORTEST) return;
    this.takeOver();
    this.startName = "";
    this.idle = 0;
    this.fleet.follow(points);
    this.set({ paused: false });
  }

  /** The path that is drawn or followed, m. @returns {number[][]} */
  get line() {
    return this.drawing.length ? this.drawing : this.fleet.path?.course.lap ?? [];
  }

  /** A blow to the right. */
  kick() {
    this.takeOver();
    this.kickLeft = KICK_SECONDS;
  }

  /** @param {number[] | null} way from where it was, m; null: the drag begins */
  target(way) {
    if (way) this.moveTarget(this.dragged, way);
    else {
      this.takeOver();
      this.dragged = this.fleet.target;
    }
  }

  /** @param {number[]} from @param {number[]} way m */
  moveTarget(from, way) {
    const target = from.map((each, k) => each + way[k]);
    this.fleet.setTarget([target[0], target[1], Math.max(0.5, target[2])]);
  }

  /** Move the target in the picture. @param {number} x @param {number} y m */
  nudge(x, y) {
    this.takeOver();
    const { right, up } = this.camera.axes;
    this.moveTarget(this.fleet.target, right.map((each, k) => x * each + y * up[k]));
  }

  /** The spin of something thrown, body frame, rad/s. @param {number[]} velocity */
  #spin(velocity) {
    const { forward } = this.camera.axes;
    const world = [0, 1, 2].map((k) => {
      const [i, j] = [(k + 1) % 3, (k + 2) % 3];
      return TUMBLE * (velocity[i] * forward[j] - velocity[j] * forward[i]);
    });
    const r = rotation(this.#grabbedState());
    return [0, 1, 2].map((k) => r[k] * world[0] + r[3 + k] * world[1] + r[6 + k] * world[2]);
  }

  #grabbedState() {
    const state = new Float64Array(STATE_SIZE);
    state.set(this.grabbed.quaternion, X.quaternion);
    return state;
  }

  /** Turn what is held. @param {number[]} rates @param {number} seconds */
  #tumble(rates, seconds) {
    const size = Math.hypot(...rates);
    if (size < 0.2) return;
    const half = (Math.min(size, SPIN) * seconds) / 2;
    const [x, y, z] = rates.map((each) => (each / size) * Math.sin(half));
    const state = this.#grabbedState();
    turnBody(state, Math.cos(half), x, y, z);
    this.grabbed.quaternion = [...part(state, "quaternion")];
  }

  /** @param {number[]} way @param {number[]} velocity @returns {Start} */
  #inHand(way, velocity) {
    const position = this.grabbed.position.map((each, k) => each + way[k]);
    position[2] = Math.max(position[2], this.fleet.vehicle.collision_radius + 0.15);
    const share = Math.min(1, FASTEST / Math.max(Math.hypot(...velocity), 1e-9));
    const held = velocity.map((each) => each * share);
    const { quaternion } = this.grabbed, { target } = this.fleet.start;
    return { position, quaternion, velocity: held, body_rates: this.#spin(held), target };
  }
}
