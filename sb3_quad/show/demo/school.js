/**
 * An agent that is trained while one looks on: a worker runs gradient.js, and its network flies on the page as it learns.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./controls.js").Controls} Controls
 * @typedef {import("./flight.js").Agent} Agent
 */
import { $ } from "./board.js";
import { WIDTHS } from "./gradient.js";
import { layersOf } from "./network.js";
import { Plot } from "./plots.js";

const LABEL = "your agent";
const SHAPES = [0, 1, 2].map((k) => ({ inputs: WIDTHS[k], outputs: WIDTHS[k + 1], activation: k < 2 ? "tanh" : "none" }));
const PLAIN = { last_action: false, history: null, position_integral: null };

export class School {
  /** @param {Controls} controls @param {number} seed */
  constructor(controls, seed) {
    this.controls = controls;
    this.seed = seed;
    /** @type {Worker | null} */
    this.worker = null;
    /** @type {number[][]} seconds and recoveries, % */
    this.curve = [];
    this.plot = new Plot($("plot-school"), { low: 0, high: 100, ticks: [0, 50, 100] });
    $("train").addEventListener("click", () => (this.worker ? this.stop("stopped") : this.begin()));
  }

  /** Train a new network for the vehicle that is flown now. */
  begin() {
    const { fleet } = this.controls;
    const { vehicle } = fleet;
    const source = `${$("model").textContent}\nonmessage = ({ data }) => train(data, postMessage);`;
    const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(address);
    URL.revokeObjectURL(address);
    this.curve = [];
    const begun = performance.now();
    this.worker.onerror = ({ message }) => this.stop(`failed: ${message}`);
    this.worker.onmessage = ({ data: { numbers, share, progress } }) => {
      const seconds = (performance.now() - begun) / 1000;
      this.curve.push([seconds, 100 * share]);
      this.#show(vehicle, numbers);
      const text = `${Math.round(100 * share)} % of fresh throws survived, ${Math.round(seconds)} s`;
      if (progress < 1) this.#say(text, progress);
      else this.stop(text);
    };
    this.worker.postMessage({ vehicle, seed: this.seed++ });
    $("train").textContent = "Stop";
    $("school").hidden = false;
    this.#say("imitates the geometric expert at first", 0);
  }

  /** @param {string} text why */
  stop(text) {
    this.worker?.terminate();
    this.worker = null;
    $("train").textContent = "Train again";
    this.#say(text, 1);
  }

  /** @param {string} text @param {number} progress */
  #say(text, progress) {
    $("lesson").textContent = text;
    /** @type {HTMLProgressElement} */ ($("progress")).value = progress;
  }

  /** Let the network fly; the first one joins the fleet. @param {Vehicle} vehicle @param {Float32Array} numbers */
  #show(vehicle, numbers) {
    const layers = layersOf(numbers, SHAPES);
    const { fleet } = this.controls;
    const known = fleet.entries.find(({ agent }) => agent.label === LABEL)?.agent;
    if (known?.vehicle === vehicle.name) {
      known.layers = layers;
      // It tries again with what it has learned.
      if (fleet.done) this.controls.player.again();
    }
    else if (known) this.#replace(known, vehicle, layers);
    else this.controls.join({ label: LABEL, kind: "network", vehicle: vehicle.name, layout: vehicle, observation: PLAIN, layers });
  }

  /** The agent of another vehicle makes room. @param {Agent} agent @param {Vehicle} vehicle @param {import("./network.js").Layer[]} layers */
  #replace(agent, vehicle, layers) {
    Object.assign(agent, { vehicle: vehicle.name, layout: vehicle, layers });
    this.controls.fleet.setVehicle(this.controls.fleet.vehicle);
    this.controls.board.build();
  }

  /** @param {Object<string, string>} palette */
  draw(palette) {
    if (!this.curve.length) return;
    const seconds = Math.max(30, this.curve[this.curve.length - 1][0]);
    this.plot.draw([{ colour: palette.target, width: 2, points: this.curve }], seconds, palette, [95]);
  }
}
