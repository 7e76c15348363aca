/** A camera that turns about a point and keeps what matters in its picture. */

const SLOPE = Math.tan((40 * Math.PI) / 360); // half of the field of view
export const STEEPEST = 1.45; // rad, downwards
const LAG = 0.35; // s, after which it has followed to 1/e

export class Camera {
  constructor() {
    this.yaw = 0; // looks along world x, so that world y is to the left
    this.pitch = 0.16;
    this.zoom = 1;
    this.focus = [0, 0, 15];
    this.distance = 14;
    this.width = 1;
    this.height = 1;
    /** What lies over the picture's edges, pixels. */
    this.inset = { top: 0, right: 0, bottom: 0, left: 0 };
    this.free = { width: 1, height: 1 };
    this.middle = [0, 0];
    this.scale = 1; // pixels of a metre one metre away
    this.eye = [0, 0, 0];
    this.right = [0, -1, 0];
    this.up = [0, 0, 1];
    this.forward = [1, 0, 0];
    this.prepare();
  }

  reset() {
    [this.yaw, this.pitch, this.zoom] = [0, 0.16, 1];
  }

  /** Right, up and forward, unit vectors. */
  get axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return { right: [sy, -cy, 0], up: [cy * sp, sy * sp, cp], forward: [cy * cp, sy * cp, -sp] };
  }

  /** Precompute a picture. */
  prepare() {
    const { right, up, forward } = this.axes;
    const { top, right: r, bottom, left } = this.inset;
    this.right = right;
    this.up = up;
    this.forward = forward;
    this.eye = this.focus.map((each, k) => each - forward[k] * this.distance);
    this.free = { width: Math.max(80, this.width - left - r), height: Math.max(80, this.height - top - bottom) };
    this.middle = [left + this.free.width / 2, top + this.free.height / 2];
    this.scale = this.free.height / 2 / SLOPE;
  }

  /**
   * Where a point is in the picture, pixels, and how far away, m; a point behind the camera has no positive distance.
   * @param {ArrayLike<number>} p
   */
  project(p) {
    const { eye, right, up, forward } = this;
    const x = p[0] - eye[0], y = p[1] - eye[1], z = p[2] - eye[2];
    const depth = forward[0] * x + forward[1] * y + forward[2] * z;
    const size = this.scale / Math.max(depth, 0.05);
    const [cx, cy] = this.middle;
    return [cx + size * (right[0] * x + right[1] * y), cy - size * (up[0] * x + up[1] * y + up[2] * z), depth];
  }

  /** Pixels of a metre at a distance. @param {number} depth */
  pixels(depth) {
    return this.scale / Math.max(depth, 0.05);
  }

  /**
   * The way in the world of a way in the picture, in the plane that faces the camera.
   * @param {number} dx
   * @param {number} dy
   * @param {number} depth
   */
  way(dx, dy, depth) {
    const { right, up } = this.axes;
    const size = this.pixels(depth);
    return [0, 1, 2].map((k) => (right[k] * dx - up[k] * dy) / size);
  }

  /** The point at a height that is seen at a place of the picture, m; null: there is none. @param {number} x @param {number} y @param {number} z */
  pointAt(x, y, z) {
    const { right, up, forward } = this.axes;
    const [a, b] = [(x - this.middle[0]) / this.scale, (this.middle[1] - y) / this.scale];
    const ray = [0, 1, 2].map((k) => forward[k] + a * right[k] + b * up[k]);
    const away = (z - this.eye[2]) / ray[2];
    return away > 0 && away < 1000 ? this.eye.map((each, k) => each + away * ray[k]) : null;
  }

  /** Look from above, the world's x upwards. */
  lookDown() {
    [this.yaw, this.pitch, this.zoom] = [0, STEEPEST, 1];
  }

  /**
   * Follow some points.
   * @param {number[][]} points
   * @param {number} margin around them, m
   * @param {number} seconds since the last picture
   */
  follow(points, margin, seconds) {
    if (!points.length) return;
    const { right, up, forward } = this.axes;
    const spans = [right, up, forward].map((axis) => {
      const along = points.map((p) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]);
      return [Math.min(...along), Math.max(...along)];
    });
    const [x, y, z] = spans.map(([low, high]) => (low + high) / 2);
    const focus = [0, 1, 2].map((k) => right[k] * x + up[k] * y + forward[k] * z);
    const aspect = this.free.width / this.free.height;
    const [wide, high, deep] = spans.map(([low, top]) => (top - low) / 2);
    const distance = (Math.max((wide + margin) / aspect, high + margin) / SLOPE + deep) / this.zoom;
    const share = seconds === Infinity ? 1 : 1 - Math.exp(-seconds / LAG);
    this.focus = this.focus.map((each, k) => each + share * (focus[k] - each));
    this.distance += share * (distance - this.distance);
  }
}
