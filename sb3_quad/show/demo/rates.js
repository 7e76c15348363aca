/**
 * The rate loop of agents that command thrust and body rates, as envs/simulation/rate_loop.py has it.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./vehicle.js").Parameters} Parameters
 * @typedef {import("./vehicle.js").World} World
 */
import { part } from "./tables.js";
import { armsOf, hoverShares, hoverThrust, mixerInverse, motorGains, thrustRange } from "./vehicle.js";

const FILTER_LAG = 0.002; // s; this and the next ones are those of envs/vehicles/rates.py
const GAIN_TIMES_LAG = 0.5;
const LEAST_DERIVED_LIMITS = [10, 10, 0]; // rad/s
const LARGEST_DERIVED_LIMIT = 20;
const IDLE = 0.001;
const AXES = [0, 1, 2];
const ROTORS = [0, 1, 2, 3];

/** @param {number} value @param {number} low @param {number} high */
const clip = (value, low, high) => Math.min(Math.max(value, low), high);

export class RateLoop {
  /**
   * @param {Vehicle} vehicle
   * @param {number} angle by which the agent's body axes are turned about z from the vehicle's, rad
   */
  constructor(vehicle, angle) {
    const { limits = null, gains = null, lag = FILTER_LAG } = vehicle.rates ?? {};
    const [up, down] = motorGains(vehicle);
    const gain = GAIN_TIMES_LAG / (lag + 0.5 / up + 0.5 / down);
    const [low, high] = thrustRange(vehicle);
    this.lag = lag;
    this.gains = gains ?? [gain, gain, gain];
    this.inertia = vehicle.inertia;
    this.cosine = Math.cos(angle);
    this.sine = Math.sin(angle);
    // Greatest body rates in the agent's axes
    const axes = [this.#squares(this.inertia), this.#squares(limits ?? [0, 0, 0]), this.#squares(this.gains)];
    const turned = { ...vehicle, rotor_positions: vehicle.rotor_positions.map(([x, y]) => this.#turned(x, y, 1)) };
    const reach = armsOf(turned).map((arms) => arms.reduce((sum, arm) => sum + Math.abs(arm), 0) * ((high - low) / 2));
    const rates = AXES.map((k) => reach[k] / axes[0][k] / axes[2][k]);
    const derived = AXES.map((k) => clip(rates[k], LEAST_DERIVED_LIMITS[k], LARGEST_DERIVED_LIMIT));
    this.limits = limits ? axes[1] : derived;
    this.mix = mixerInverse(vehicle).map((row) => row.slice(1));
    this.shares = hoverShares(vehicle).map((share) => share / 4);
    this.weight = 4 * hoverThrust(vehicle);
    /** @type {number[]} */
    this.filtered = [0, 0, 0];
  }

  /** A diagonal matrix of the vehicle's axes in the agent's. @param {number[]} diagonal */
  #squares([x, y, z]) {
    const c2 = this.cosine ** 2, s2 = this.sine ** 2;
    return [c2 * x + s2 * y, s2 * x + c2 * y, z];
  }

  /** @param {number} x @param {number} y @param {1 | -1} way to the agent's axes, or back @returns {[number, number]} */
  #turned(x, y, way) {
    const sine = way * this.sine;
    return [this.cosine * x - sine * y, sine * x + this.cosine * y];
  }

  /** The command of a hover. @param {World} world */
  hover(world) {
    return [this.weight * world.mass, 0, 0, 0];
  }

  /** Begin an episode. @param {Float64Array} state */
  begin(state) {
    this.filtered = [...part(state, "body_rates")];
  }

  /** The thrust, N, and body rates, rad/s, that actions command. @param {ArrayLike<number>} actions @param {Parameters} p */
  command(actions, p) {
    const [thrust, x, y, z] = ROTORS.map((k) => clip(actions[k], -1, 1));
    const rates = this.#turned(x * this.limits[0], y * this.limits[1], -1);
    return [4 * (p.middle + p.half * thrust), ...rates, z * this.limits[2]];
  }

  /**
   * The rotor speeds, rad/s, that hold a command in the next physics step.
   * @param {Float64Array} state
   * @param {number[]} command
   * @param {Parameters} p
   * @param {number} factor of the thrust that the firmware counts on
   */
  hold(state, command, p, factor) {
    const rates = part(state, "body_rates"), share = p.dt / (p.dt + this.lag);
    this.filtered = this.filtered.map((old, k) => old + share * (rates[k] - old));
    const w = this.filtered, [ixx, iyy, izz] = this.inertia;
    const gyroscopic = [(izz - iyy) * w[1] * w[2], (ixx - izz) * w[2] * w[0], (iyy - ixx) * w[0] * w[1]];
    const torque = AXES.map((k) => factor * this.gains[k] * this.inertia[k] * (command[1 + k] - w[k]) + gyroscopic[k]);

    // Roll and pitch first, scaled until they fit; then the thrust makes room, and yaw gets what is left.
    const most = p.middle + p.half, least = Math.max(p.middle - p.half, IDLE * most);
    const highest = Math.min(...this.shares.map((each) => most / each));
    const lowest = Math.max(...this.shares.map((each) => least / each));
    const tilts = ROTORS.map((k) => (this.mix[k][0] * torque[0] + this.mix[k][1] * torque[1]) / this.shares[k]);
    const top = Math.max(...tilts), bottom = Math.min(...tilts);
    const scale = (highest - lowest) / Math.max(highest - lowest, top - bottom);
    const total = Math.min(Math.max(command[0], lowest - scale * bottom), highest - scale * top);
    const thrusts = ROTORS.map((k) => this.shares[k] * (total + scale * tilts[k]));
    const room = thrusts.map((thrust, k) => (this.mix[k][2] * torque[2] > 0 ? most - thrust : thrust - least) / Math.abs(this.mix[k][2]));
    const reach = Math.max(0, Math.min(...room)), yaw = clip(torque[2], -reach, reach);
    return thrusts.map((thrust, k) => Math.sqrt(clip(thrust + this.mix[k][2] * yaw, least, most) / p.lift));
  }
}
