/**
 * One quadcopter in the picture: arms and rotors from far to near around the hub, legs below it.
 *
 * @typedef {import("./camera.js").Camera} Camera
 * @typedef {import("./scene.js").Body} Body
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 */
import { armLength } from "./vehicle.js";

const SMALLEST = 52; // pixels from rotor to rotor, below which a vehicle is drawn larger than it is
const DISC = 0.62; // radius of a rotor, in arms, as the rest
const TOP = 0.16; // its height above the arms
const HUB = [[0.375, 0.21], [0.375, -0.21], [-0.3, -0.3], [-0.3, 0.3]];
const THICK = 0.1; // half of the hub's height
const LEG = { across: 0.34, along: 0.42, down: -0.36 };
export const CIRCLE = Array.from({ length: 25 }, (_, k) => [Math.cos((k * Math.PI) / 12), Math.sin((k * Math.PI) / 12)]);

/**
 * A colour with some opacity.
 * @param {string} hex #rrggbb
 * @param {number} alpha
 */
export function faded(hex, alpha) {
  const [r, g, b] = [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  return `rgba(${r},${g},${b},${alpha})`;
}

/**
 * A path through points of the picture.
 * @param {CanvasRenderingContext2D} g
 * @param {Camera} camera
 * @param {number[][]} points world frame, m
 */
export function trace(g, camera, points) {
  g.beginPath();
  for (const point of points) {
    const [x, y] = camera.project(point);
    g.lineTo(x, y);
  }
}

export class Airframe {
  /**
   * @param {CanvasRenderingContext2D} g
   * @param {Camera} camera
   * @param {Object<string, string>} palette
   * @param {Body} body
   * @param {Vehicle} vehicle
   */
  constructor(g, camera, palette, body, vehicle) {
    this.g = g;
    this.camera = camera;
    this.palette = palette;
    this.body = body;
    this.arm = armLength(vehicle);
    this.depth = camera.project(body.position)[2];
    this.rotors = vehicle.rotor_positions.map(([x, y]) => [x / this.arm, y / this.arm]);
    this.grown = Math.max(1, SMALLEST / (2 * this.arm * camera.pixels(this.depth)));
    this.pixel = camera.pixels(this.depth) * this.arm * this.grown; // of an arm
    const r = body.rotation, { forward } = camera;
    this.above = r[2] * forward[0] + r[5] * forward[1] + r[8] * forward[2] < 0; // the camera sees its upper side
    this.dark = body.lost ? palette.lost : palette.frame;
  }

  /**
   * A point of the body in the world, m.
   * @param {number} x forward, in arms
   * @param {number} y left
   * @param {number} z up
   */
  at(x, y, z) {
    const { position, rotation: r } = this.body, size = this.arm * this.grown;
    return [0, 1, 2].map((k) => position[k] + size * (r[3 * k] * x + r[3 * k + 1] * y + r[3 * k + 2] * z));
  }

  draw() {
    if (this.depth < 0.3) return;
    const { g } = this;
    g.globalAlpha = this.body.lost ? 0.55 : 1;
    g.lineCap = g.lineJoin = "round";
    if (this.above) this.#legs();
    const rotors = this.rotors.map(([x, y], k) => ({ k, depth: this.camera.project(this.at(x, y, TOP))[2] }));
    rotors.sort((a, b) => b.depth - a.depth);
    for (const { k, depth } of rotors) if (depth >= this.depth) this.#rotor(k);
    this.#hub();
    for (const { k, depth } of rotors) if (depth < this.depth) this.#rotor(k);
    if (!this.above) this.#legs();
    g.globalAlpha = 1;
  }

  /**
   * @param {number[][]} points in the world
   * @param {string} colour
   * @param {number} width in arms
   */
  #line(points, colour, width) {
    trace(this.g, this.camera, points);
    this.g.strokeStyle = colour;
    this.g.lineWidth = Math.max(1.2, width * this.pixel);
    this.g.stroke();
  }

  /** @param {number} k */
  #rotor(k) {
    const { g, body, dark, above, palette } = this;
    const [x, y] = this.rotors[k], tip = this.at(x, y, 0);
    this.#line([body.position, tip], dark, 0.13);
    if (x > 0.2 && !body.lost) this.#line([this.at(0.45 * x, 0.45 * y, 0), tip], body.colour, 0.09); // in front
    this.#line([tip, this.at(x, y, TOP)], dark, 0.16);
    const power = body.lost ? 0 : Math.min(body.thrusts[k] / 2, 1);
    trace(g, this.camera, CIRCLE.map(([c, s]) => this.at(x + DISC * c, y + DISC * s, TOP)));
    g.fillStyle = faded(body.colour, above ? 0.16 + 0.4 * power : 0.1 + 0.25 * power);
    g.fill();
    g.strokeStyle = faded(body.colour, 0.75);
    g.lineWidth = 1;
    g.stroke();
    const c = 0.92 * DISC * Math.cos(body.angles[k]), s = 0.92 * DISC * Math.sin(body.angles[k]);
    this.#line([this.at(x - c, y - s, TOP), this.at(x + c, y + s, TOP)], palette.blade, 0.04);
  }

  #hub() {
    const { g, above, body, dark } = this;
    const near = above ? THICK : -THICK;
    const shown = above && !body.lost ? body.colour : dark;
    for (const height of [-near, near]) {
      trace(g, this.camera, HUB.map(([x, y]) => this.at(x, y, height)));
      g.closePath();
      g.fillStyle = g.strokeStyle = height === near ? shown : dark;
      g.lineWidth = Math.max(1, 0.08 * this.pixel);
      g.fill();
      g.stroke();
    }
  }

  #legs() {
    const { across, along, down } = LEG;
    for (const side of [-across, across]) {
      this.#line([this.at(-along, side, down), this.at(along, side, down)], this.dark, 0.06);
      for (const end of [-0.6 * along, 0.6 * along]) {
        this.#line([this.at(end, 0.5 * side, 0), this.at(end, side, down)], this.dark, 0.06);
      }
    }
  }
}
