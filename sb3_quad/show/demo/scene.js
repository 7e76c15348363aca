/**
 * The picture: sky, ground, vehicles, targets, trails and arrows, drawn on a plain 2D canvas.
 *
 * @typedef {import("./camera.js").Camera} Camera
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {Object<string, string>} Palette
 *
 * @typedef {object} Body what is drawn of one flight
 * @property {string} label
 * @property {string} colour
 * @property {number[]} position m, its lane included
 * @property {number[]} rotation body to world, row by row
 * @property {number[]} thrusts in hover thrusts
 * @property {number[]} angles of the rotors, rad
 * @property {number[]} target m
 * @property {number[][]} trail m
 * @property {number[]} lane that was added to positions
 * @property {string} lost
 * @property {number[]} force N, in weights
 * @property {boolean} near whether it is within 0.1 m
 */
import { Airframe, CIRCLE, faded, trace } from "./airframe.js";

const GRID = 120; // m, how far the lines on the ground reach

const FORCE = 3; // m of an arrow, per weight

export class Scene {
  /** @param {CanvasRenderingContext2D} context @param {Camera} camera */
  constructor(context, camera) {
    this.g = context;
    this.camera = camera;
    /** @type {Palette} */
    this.palette = {};
  }

  /**
   * @param {Body[]} bodies
   * @param {Vehicle} vehicle
   * @param {boolean} trails whether they are drawn
   * @param {number[][]} path that is followed, m
   */
  draw(bodies, vehicle, trails, path) {
    this.camera.prepare();
    this.#ground();
    const lanes = new Map(bodies.map((body) => [body.lane.join(), body]));
    for (const body of bodies) this.#shadow(body);
    for (const body of lanes.values()) {
      this.#path(path, body.lane);
      this.#target(body);
    }
    if (trails) for (const body of bodies) this.#trail(body);
    const far = (/** @type {Body} */ body) => this.camera.project(body.position)[2];
    for (const body of [...bodies].sort((a, b) => far(b) - far(a))) {
      new Airframe(this.g, this.camera, this.palette, body, vehicle).draw();
      this.#force(body);
    }
    this.#labels(bodies, lanes.size === bodies.length);
  }

  #ground() {
    const { g, camera, palette } = this;
    const { width, height } = camera;
    const { eye } = camera;
    const horizon = camera.project([eye[0] + 1e4 * Math.cos(camera.yaw), eye[1] + 1e4 * Math.sin(camera.yaw), eye[2]])[1];
    const sky = g.createLinearGradient(0, Math.min(0, horizon - height), 0, horizon);
    sky.addColorStop(0, palette.zenith);
    sky.addColorStop(1, palette.haze);
    g.fillStyle = sky;
    g.fillRect(0, 0, width, height);
    if (horizon < height) {
      const ground = g.createLinearGradient(0, horizon, 0, Math.max(height, horizon + 1));
      ground.addColorStop(0, palette.haze);
      ground.addColorStop(0.25, palette.ground);
      ground.addColorStop(1, palette.ground);
      g.fillStyle = ground;
      g.fillRect(0, horizon, width, height - horizon);
    }
    const cell = 5;
    const [cx, cy] = [0, 1].map((k) => Math.round(camera.focus[k] / cell) * cell);
    g.lineWidth = 1;
    const haze = g.createLinearGradient(0, horizon, 0, horizon + 0.55 * height);
    haze.addColorStop(0.04, palette.gridFar);
    haze.addColorStop(1, palette.grid);
    g.strokeStyle = haze;
    g.beginPath();
    for (let k = -GRID; k <= GRID; k += cell) {
      this.#groundLine([cx + k, cy - GRID, 0], [cx + k, cy + GRID, 0]);
      this.#groundLine([cx - GRID, cy + k, 0], [cx + GRID, cy + k, 0]);
    }
    g.stroke();
  }

  /** A line that may begin behind the camera. @param {number[]} a @param {number[]} b */
  #groundLine(a, b) {
    const near = 0.5;
    const [pa, pb] = [this.camera.project(a), this.camera.project(b)];
    if (pa[2] < near && pb[2] < near) return;
    const cutAt = (/** @type {number[]} */ p, /** @type {number[]} */ q, /** @type {number} */ dp, /** @type {number} */ dq) =>
      this.camera.project(p.map((each, k) => each + ((near - dp) / (dq - dp)) * (q[k] - each)));
    const from = pa[2] < near ? cutAt(a, b, pa[2], pb[2]) : pa;
    const to = pb[2] < near ? cutAt(b, a, pb[2], pa[2]) : pb;
    this.g.moveTo(from[0], from[1]);
    this.g.lineTo(to[0], to[1]);
  }

  /** @param {Body} body */
  #shadow({ position, lost }) {
    const { g, palette } = this;
    const size = 0.3 + 0.02 * position[2];
    if (this.camera.project([position[0], position[1], 0])[2] < 1) return;
    trace(this.g, this.camera, CIRCLE.map(([c, s]) => [position[0] + size * c, position[1] + size * s, 0]));
    g.globalAlpha = lost ? 0.5 : Math.max(0.12, 0.4 - 0.015 * position[2]);
    g.fillStyle = palette.shadow;
    g.fill();
    g.globalAlpha = 1;
  }

  /** @param {Body} body */
  #target({ target, near }) {
    const { g, camera, palette } = this;
    const [x, y, depth] = camera.project(target);
    if (depth < 0.3) return;
    const size = Math.max(camera.pixels(depth) * 0.1, 5);
    trace(this.g, this.camera, [target, [target[0], target[1], 0]]);
    g.strokeStyle = faded(palette.target, 0.28);
    g.lineWidth = 1;
    g.stroke();
    g.lineWidth = 1.5;
    const rings = near ? [[1, 0.9], [2.2, 0.45]] : [[1, 0.8], [2.2, 0.3]];
    for (const [radius, alpha] of rings) {
      g.strokeStyle = faded(palette.target, alpha);
      g.beginPath();
      g.arc(x, y, radius * size, 0, 2 * Math.PI);
      g.stroke();
    }
    g.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      g.moveTo(x + 1.6 * size * dx, y + 1.6 * size * dy);
      g.lineTo(x + 2.8 * size * dx, y + 2.8 * size * dy);
    }
    g.strokeStyle = faded(palette.target, 0.7);
    g.stroke();
    g.fillStyle = palette.target;
    g.beginPath();
    g.arc(x, y, 2, 0, 2 * Math.PI);
    g.fill();
  }

  /** @param {number[][]} path @param {number[]} lane */
  #path(path, lane) {
    if (path.length < 2) return;
    trace(this.g, this.camera, path.map((p) => p.map((each, k) => each + lane[k])));
    this.g.strokeStyle = faded(this.palette.target, 0.7);
    this.g.lineWidth = 2;
    this.g.setLineDash([7, 5]);
    this.g.stroke();
    this.g.setLineDash([]);
  }

  /** @param {Body} body */
  #trail({ trail, colour, lane }) {
    const { g } = this;
    const stride = 3, parts = 12;
    const kept = trail.filter((_, k) => k % stride === 0 || k === trail.length - 1);
    const points = kept.map((p) => p.map((each, k) => each + lane[k]));
    g.lineWidth = 2.5;
    g.lineCap = "butt";
    g.lineJoin = "round";
    for (let part = 0; part < parts; part++) {
      const [from, to] = [part, part + 1].map((each) => Math.floor((each * (points.length - 1)) / parts));
      if (to <= from) continue;
      trace(this.g, this.camera, points.slice(from, to + 1));
      g.strokeStyle = faded(colour, 0.06 + (0.6 * (part + 1)) / parts);
      g.stroke();
    }
  }

  /** @param {Body} body */
  #force({ position, force, lost }) {
    if (lost || Math.hypot(...force) < 0.02) return;
    const tip = position.map((each, k) => each + FORCE * force[k]);
    this.#arrow(this.camera.project(position), this.camera.project(tip), this.palette.force);
  }

  /** @param {number[]} from @param {number[]} to @param {string} colour */
  #arrow(from, to, colour) {
    const { g } = this;
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
    const length = Math.hypot(dx, dy);
    if (length < 4) return;
    const [ux, uy] = [dx / length, dy / length];
    const head = Math.min(11, 0.5 * length);
    g.strokeStyle = g.fillStyle = colour;
    g.lineWidth = 3.5;
    g.lineCap = "round";
    g.beginPath();
    g.moveTo(from[0], from[1]);
    g.lineTo(to[0] - head * ux, to[1] - head * uy);
    g.stroke();
    g.beginPath();
    g.moveTo(to[0], to[1]);
    g.lineTo(to[0] - head * ux - 0.55 * head * uy, to[1] - head * uy + 0.55 * head * ux);
    g.lineTo(to[0] - head * ux + 0.55 * head * uy, to[1] - head * uy - 0.55 * head * ux);
    g.fill();
  }

  /** @param {Body[]} bodies @param {boolean} apart whether each has a lane of its own */
  #labels(bodies, apart) {
    const { g, camera, palette } = this;
    g.font = "600 13px system-ui, sans-serif";
    g.textAlign = "center";
    g.textBaseline = "middle";
    /** @type {number[][]} */
    const taken = [];
    for (const body of bodies) {
      let [x, y, depth] = camera.project(body.position);
      if (depth < 0.3) continue;
      const text = body.lost ? `${body.label}: ${body.lost === "collision" ? "crashed" : "out of range"}` : body.label;
      const width = g.measureText(text).width + 18;
      let top = y - (apart ? 54 : 62);
      if (body.lost) {
        // The camera does not follow what is lost: its label waits at the edge that it left by.
        const { inset } = camera;
        x = Math.min(Math.max(x, inset.left + width / 2), camera.width - inset.right - width / 2);
        top = Math.min(Math.max(top, inset.top), camera.height - inset.bottom - 12);
      }
      while (taken.some(([l, t, w]) => Math.abs(l - x) < (w + width) / 2 && Math.abs(t - top) < 22)) top -= 23;
      taken.push([x, top, width]);
      g.fillStyle = body.lost ? palette.lost : body.colour;
      g.beginPath();
      g.roundRect(x - width / 2, top - 10, width, 21, 10.5);
      g.fill();
      g.fillStyle = "#ffffff";
      g.fillText(text, x, top + 1);
    }
  }
}
