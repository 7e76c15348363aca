/**
 * Where the quantities of a state and the features of an observation stand. page.py puts the tables of
 * envs/simulation/state.py and observation.py here, so that both languages use the same ones.
 *
 * @typedef {{position: number, quaternion: number, velocity: number, body_rates: number, rotor_speeds: number, target: number, target_velocity: number, target_acceleration: number, target_heading: number, target_heading_rate: number, target_ahead: number}} StateRows
 * @typedef {{position: number, rotation: number, velocity: number, body_rates: number}} FeatureRows
 *
 * @typedef {object} Tables
 * @property {StateRows} X the first row of each quantity; the attitude is a quaternion (w, x, y, z), body to world
 * @property {StateRows} SIZES how many rows each takes
 * @property {number} STATE_SIZE
 * @property {number} AHEAD s, after which the experts look at the acceleration of the reference
 * @property {FeatureRows} F the first row of each group of features
 * @property {number} OBSERVATION_SIZE
 * @property {number[]} DEFAULT_STD σ of Eq. 3.16 (Table A.2)
 */

/** @type {Tables} */
const TABLES = JSON.parse("TABLES");
export const { X, SIZES, STATE_SIZE, AHEAD, F, OBSERVATION_SIZE, DEFAULT_STD } = TABLES;

/** A quantity of a state, such as its position; a view. @param {Float64Array} s @param {keyof StateRows} name */
export const part = (s, name) => s.subarray(X[name], X[name] + SIZES[name]);
