/**
 * A reference along a line that somebody has drawn: smoothed, at a speed and with an acceleration that are limited.
 *
 * @typedef {object} Motion
 * @property {(time: number) => ArrayLike<number>} at position, velocity, acceleration, cosine and sine of the heading, and its rate
 */
const SPACING = 0.05; // m between the points of a smoothed line
const ROUND = 0.3; // m: standard deviation of the smoothing along the line
const BLUR = [8, 8, 8]; // control steps to both sides, over which positions are averaged in turn, so that the jerk is finite
const GAP = 0.12; // of its length, and at least 0.6 m, between the ends of a line that is a loop
const SHARE = Math.SQRT1_2; // of the acceleration that may be along, and across

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @param {number} share */
const between = (a, b, share) => [0, 1, 2].map((k) => a[k] + share * (b[k] - a[k]));

/** The length of a line, m. @param {number[][]} points */
export const lengthOf = (points) => points.reduce((sum, p, k) => sum + (k ? apart(p, points[k - 1]) : 0), 0);

/** Points along a line, evenly spaced. @param {number[][]} points */
function resampled(points) {
  const count = Math.max(2, Math.round(lengthOf(points) / SPACING)), step = lengthOf(points) / count;
  const out = [points[0]];
  let left = step;
  for (let k = 1; k < points.length; k++) {
    const size = apart(points[k - 1], points[k]);
    for (let along = left; along < size + 1e-9 && out.length < count; along += step) out.push(between(points[k - 1], points[k], along / size));
    left = step * out.length - lengthOf(points.slice(0, k + 1));
  }
  return [...out, points[points.length - 1]];
}

/** A line without corners, its ends where they were. @param {number[][]} points */
function rounded(points) {
  let line = points;
  for (let pass = 2 * (ROUND / SPACING) ** 2; pass > 0; pass--) {
    line = line.map((p, k) => (k && k < line.length - 1 ? p.map((x, j) => (line[k - 1][j] + 2 * x + line[k + 1][j]) / 4) : p));
  }
  return line;
}

export class Course {
  /**
   * @param {number[][]} drawn m
   * @param {number[]} from where it begins, at rest: it leads to the line from there, m
   * @param {{speed: number, acceleration: number, dt: number}} limits m/s, m/s²; control step, s
   */
  constructor(drawn, from, { speed, acceleration, dt }) {
    this.dt = dt;
    const first = drawn[0], last = drawn[drawn.length - 1];
    this.loops = apart(first, last) < Math.max(0.6, GAP * lengthOf(drawn));
    const lap = resampled(this.loops ? [...drawn, first] : drawn);
    const lead = apart(from, first) > SPACING ? resampled([from, first]) : [from];
    // Of three laps, the middle one is as every later one.
    const laps = this.loops ? [lap, lap, lap] : [lap];
    this.line = rounded([...lead, ...laps.flatMap((each) => each.slice(1))]);
    const times = this.#times(speed, SHARE * acceleration);
    const begin = lead.length - 1 + (lap.length - 1);
    this.loopFrom = this.loops ? times[begin] : 0;
    this.period = this.loops ? times[begin + lap.length - 1] - times[begin] : 0;
    this.rows = this.#rows(times);
    this.lap = this.line.slice(lead.length - 1, lead.length - 1 + lap.length);
  }

  /** When it is at each point of the line, s. @param {number} speed @param {number} most of the acceleration, in each direction */
  #times(speed, most) {
    const { line, loops } = this;
    const gaps = line.slice(1).map((p, k) => Math.max(apart(p, line[k]), 1e-6));
    const squares = line.map((p, k) => {
      if (!k || k === line.length - 1) return k && loops ? speed ** 2 : 0;
      const bend = Math.hypot(...[0, 1, 2].map((j) => line[k - 1][j] - 2 * p[j] + line[k + 1][j])) / (gaps[k - 1] * gaps[k]);
      return Math.min(speed ** 2, most / Math.max(bend, 1e-6));
    });
    for (let k = 0; k < gaps.length; k++) squares[k + 1] = Math.min(squares[k + 1], squares[k] + 2 * most * gaps[k]);
    for (let k = gaps.length - 1; k >= 0; k--) squares[k] = Math.min(squares[k], squares[k + 1] + 2 * most * gaps[k]);
    const times = [0];
    gaps.forEach((gap, k) => times.push(times[k] + (2 * gap) / (Math.sqrt(squares[k]) + Math.sqrt(squares[k + 1]))));
    return times;
  }

  /** What it does in each control step. @param {number[]} times */
  #rows(times) {
    const { line, dt } = this;
    const rest = Math.ceil(0.5 / dt); // it rests as it begins, and where it ends
    const count = Math.ceil(times[times.length - 1] / dt) + 2 * rest;
    let at = 0;
    let positions = Array.from({ length: count }, (_, k) => {
      const time = Math.min(Math.max((k - rest) * dt, 0), times[times.length - 1]);
      while (at < times.length - 2 && times[at + 1] < time) at++;
      return between(line[at], line[at + 1], (time - times[at]) / (times[at + 1] - times[at]));
    });
    for (const wide of BLUR) positions = blurred(positions, wide);
    const velocities = derivative(positions, dt), accelerations = derivative(velocities, dt);
    this.loopFrom += rest * dt;
    return positions.map((p, k) => [...p, ...velocities[k], ...accelerations[k]]);
  }

  /** @param {number} time s @returns {number[]} */
  at(time) {
    const { rows, dt, loops, loopFrom, period } = this;
    const inside = loops && time > loopFrom ? loopFrom + ((time - loopFrom) % period) : time;
    const place = Math.min(Math.max(inside / dt, 0), rows.length - 1), k = Math.min(Math.floor(place), rows.length - 2);
    return [...rows[k].map((each, j) => each + (place - k) * (rows[k + 1][j] - each)), 0, 0, 0];
  }
}

/** Means over neighbours. @param {number[][]} rows @param {number} wide to both sides */
function blurred(rows, wide) {
  const clamp = (/** @type {number} */ k) => rows[Math.min(Math.max(k, 0), rows.length - 1)];
  const sum = [0, 0, 0];
  for (let k = -wide; k <= wide; k++) clamp(k).forEach((each, j) => (sum[j] += each));
  return rows.map((_, k) => {
    const mean = sum.map((each) => each / (2 * wide + 1));
    clamp(k + wide + 1).forEach((each, j) => (sum[j] += each - clamp(k - wide)[j]));
    return mean;
  });
}

/** Central differences. @param {number[][]} rows @param {number} dt */
function derivative(rows, dt) {
  return rows.map((row, k) => {
    const before = rows[Math.max(k - 1, 0)], after = rows[Math.min(k + 1, rows.length - 1)];
    return row.map((_, j) => (after[j] - before[j]) / (2 * dt));
  });
}
