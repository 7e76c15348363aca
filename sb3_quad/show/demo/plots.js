/**
 * Curves of the latest seconds.
 *
 * @typedef {object} Curve
 * @property {string} colour
 * @property {number} width
 * @property {number[][]} points time and value
 */

export class Plot {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{low: number, high: number, ticks: number[], log?: boolean}} axis
   */
  constructor(canvas, axis) {
    this.canvas = canvas;
    this.axis = axis;
    this.g = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  }

  /**
   * @param {Curve[]} curves
   * @param {number} seconds shown
   * @param {Object<string, string>} palette
   * @param {number[]} [limits] drawn as dashed lines
   */
  draw(curves, seconds, palette, limits = []) {
    const { canvas, g, axis } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const ratio = Math.min(devicePixelRatio, 2);
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    const left = 30, right = 4, top = 6, bottom = 6;
    const end = Math.max(seconds, ...curves.map(({ points }) => (points.length ? points[points.length - 1][0] : 0)));
    const scaled = (/** @type {number} */ value) => (axis.log ? Math.log(Math.max(value, axis.low)) : value);
    const [low, high] = [scaled(axis.low), scaled(axis.high)];
    const x = (/** @type {number} */ time) => left + ((time - end + seconds) / seconds) * (width - left - right);
    const y = (/** @type {number} */ value) =>
      height - bottom - ((Math.min(Math.max(scaled(value), low), high) - low) / (high - low)) * (height - top - bottom);
    g.font = "10.5px system-ui, sans-serif";
    g.textAlign = "right";
    g.textBaseline = "middle";
    g.lineWidth = 1;
    for (const tick of axis.ticks) {
      g.strokeStyle = palette.rule;
      g.beginPath();
      g.moveTo(left, y(tick));
      g.lineTo(width - right, y(tick));
      g.stroke();
      g.fillStyle = palette.quiet;
      g.fillText(String(tick), left - 5, y(tick));
    }
    g.setLineDash([4, 4]);
    for (const limit of limits) {
      g.strokeStyle = palette.quiet;
      g.beginPath();
      g.moveTo(left, y(limit));
      g.lineTo(width - right, y(limit));
      g.stroke();
    }
    g.setLineDash([]);
    g.lineJoin = "round";
    for (const { colour, width: thick, points } of curves) {
      g.strokeStyle = colour;
      g.lineWidth = thick;
      g.beginPath();
      for (let k = 0; k < points.length; k++) {
        const [time, value] = points[k];
        if ((k % 4 && k !== points.length - 1) || time < end - seconds) continue;
        g.lineTo(x(time), y(value));
      }
      g.stroke();
    }
  }
}
