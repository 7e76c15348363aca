/**
 * A quadcopter as envs/vehicles/*.yaml describe it, and what a flight needs of it.
 *
 * @typedef {[number, number, number]} Triple
 * @typedef {[number, number, number, number]} Quadruple
 *
 * @typedef {object} Layout
 * @property {[number, number][]} rotor_positions x, y of each rotor, m
 * @property {number[]} rotor_directions sign of the yaw moment of each rotor
 *
 * @typedef {object} VehicleFields
 * @property {string} name
 * @property {number} mass kg
 * @property {Triple} inertia kg m²
 * @property {number} moment_thrust_ratio m
 * @property {number} thrust_coefficient N s², 0 if unknown
 * @property {number} [motor_gain] 1/s, in place of the next two where they are the same
 * @property {number} [motor_gain_up] 1/s, of rotors that speed up
 * @property {number} [motor_gain_down] 1/s, of rotors that slow down
 * @property {"euler" | "exact"} [motor_integration] see physics.py
 * @property {Triple} [drag] along the body axes, N s/m
 * @property {Triple} [rotor_drag] by the sum of the rotor speeds, kg/rad
 * @property {number} [translational_lift] kg/m
 * @property {[number, number]} [airspeed_moment] of roll and pitch, kg m/rad
 * @property {Triple} [rate_damping] N m s
 * @property {number} [rotor_inertia] kg m²
 * @property {number} [ground_effect_radius] m
 * @property {Quadruple} [thrust_factors]
 * @property {number} gravity m/s²
 * @property {[number, number]} thrust_limits of a rotor, in hover thrusts
 * @property {number} physics_step s
 * @property {number} control_step s
 * @property {number} delay control steps
 * @property {number} collision_radius m
 * @property {Object<string, any> | null} [geometric_gains]
 * @property {Object<string, number> | null} [time_optimal] least times, s, to within 0.1 m of targets, by their distance, m
 *
 * @typedef {VehicleFields & Layout} Vehicle
 *
 * @typedef {object} World what differs from the nominal vehicle, as `randomize` of the environments has it
 * @property {number} mass factor; the thrusts in N stay
 * @property {number} motors factor of the motor gains
 * @property {number} thrust factor of the thrust of a command, as a tired battery has it
 * @property {number | null} delay control steps; null: the vehicle's own
 *
 * @typedef {object} Air the terms of envs/simulation/aerodynamics.py
 * @property {Triple} drag by the sum of the rotor speeds
 * @property {number} lift
 * @property {[number, number]} moment of roll and pitch
 * @property {Triple} damping
 * @property {number[]} spins moments of inertia of the rotors, with the sign of their direction about z
 * @property {number} radius of the ground effect
 * @property {Quadruple} factors of the rotors' thrusts
 *
 * @typedef {object} Parameters what the dynamics read
 * @property {number} mass
 * @property {Triple} inertia
 * @property {number} lift kF
 * @property {number} up share of its error that the speed of a rotor that speeds up loses in a physics step
 * @property {number} down of one that slows down
 * @property {number} exact 1 where motors are integrated exactly, else 0
 * @property {Triple} drag
 * @property {Air} air
 * @property {number} gravity
 * @property {number} middle thrust of action 0, N
 * @property {number} half thrust of action 1 less that, N
 * @property {number[]} hoverSpeeds rad/s
 * @property {number} radius m
 * @property {number} delay control steps
 * @property {Quadruple[]} arms moment per thrust about roll, pitch and yaw, by rotor, m
 * @property {number} dt physics step, s
 * @property {number} substeps in a control step
 */

/** @type {World} */
export const CALM = { mass: 1, motors: 1, thrust: 1, delay: null };

/** Thrust of one rotor in hover, N. @param {Vehicle} v */
export const hoverThrust = (v) => (v.mass * v.gravity) / 4;

/** Least and greatest thrust of one rotor, N. @param {Vehicle} v @returns {[number, number]} */
export const thrustRange = (v) => [v.thrust_limits[0] * hoverThrust(v), v.thrust_limits[1] * hoverThrust(v)];

/** Distance of the outermost rotor from the centre of mass, m. @param {Layout} v */
export const armLength = (v) => Math.max(...v.rotor_positions.map(([x, y]) => Math.hypot(x, y)));

/** Moments per thrust about roll, pitch and yaw. @param {Vehicle} v @returns {Quadruple[]} */
export function armsOf(v) {
  const rows = [
    v.rotor_positions.map(([, y]) => y),
    v.rotor_positions.map(([x]) => -x),
    v.rotor_directions.map((sign) => v.moment_thrust_ratio * sign),
  ];
  return /** @type {Quadruple[]} */ (rows);
}

/** Factors of the rotors' thrusts. @param {Vehicle} v @returns {Quadruple} */
export const factorsOf = (v) => v.thrust_factors ?? [1, 1, 1, 1];

/** What of the air acts on a vehicle. @param {Vehicle} v @returns {Air} */
const airOf = (v) => ({
  drag: v.rotor_drag ?? [0, 0, 0],
  lift: v.translational_lift ?? 0,
  moment: v.airspeed_moment ?? [0, 0],
  damping: v.rate_damping ?? [0, 0, 0],
  // A rotor turns against the yaw moment of its drag.
  spins: v.rotor_directions.map((sign) => -sign * (v.rotor_inertia ?? 0)),
  radius: v.ground_effect_radius ?? 0,
  factors: factorsOf(v),
});

/** Rotor thrusts from [ΣF, Mx, My, Mz], (4, 4), by Gauss and Jordan. @param {Vehicle} v */
export function mixerInverse(v) {
  const mixer = [[1, 1, 1, 1], ...armsOf(v)].map((row) => row.map((each, k) => each * factorsOf(v)[k]));
  const rows = mixer.map((row, i) => [...row, ...[0, 1, 2, 3].map((k) => (k === i ? 1 : 0))]);
  for (let k = 0; k < 4; k++) {
    const best = rows.slice(k).reduce((far, row, j) => (Math.abs(row[k]) > Math.abs(rows[far][k]) ? k + j : far), k);
    [rows[k], rows[best]] = [rows[best], rows[k]];
    rows[k] = rows[k].map((each) => each / rows[k][k]);
    for (let j = 0; j < 4; j++) if (j !== k) rows[j] = rows[j].map((each, i) => each - rows[j][k] * rows[k][i]);
  }
  return rows.map((row) => row.slice(4));
}

/** Thrust of each rotor in hover, in m g / 4: other than 1 where the centre of mass is not in their middle. @param {Vehicle} v */
export const hoverShares = (v) => mixerInverse(v).map(([share]) => Math.round(4e12 * share) / 1e12);

/** kF, N s²; where it is unknown, the one that makes 1,000 rad/s of hover. @param {Vehicle} v */
const lift = (v) => v.thrust_coefficient || hoverThrust(v) / 1e6;

/** k_m of rotors that speed up and that slow down, 1/s. @param {Vehicle} v */
const motorGains = (v) => [v.motor_gain_up ?? v.motor_gain ?? NaN, v.motor_gain_down ?? v.motor_gain ?? NaN];

/** From a command to its thrust, s: delay, half the control step, and the motors. @param {Vehicle} v */
export function commandLag(v) {
  const [up, down] = motorGains(v);
  return (v.delay + 0.5) * v.control_step + 0.5 / up + 0.5 / down;
}

/** What the dynamics read of a vehicle in a world. @param {Vehicle} v @param {World} world @returns {Parameters} */
export function parametersOf(v, world = CALM) {
  const [low, high] = thrustRange(v);
  const exact = v.motor_integration === "exact" ? 1 : 0;
  const [up, down] = motorGains(v).map((gain) => {
    const x = gain * world.motors * v.physics_step;
    return Math.min(1, x / (1 + exact * (x / 2 + (x * x) / 12)));
  });
  const mass = v.mass * world.mass;
  return {
    mass,
    inertia: v.inertia,
    lift: lift(v),
    up,
    down,
    exact,
    drag: v.drag ?? [0, 0, 0],
    air: airOf(v),
    gravity: v.gravity,
    middle: ((high + low) / 2) * world.thrust,
    half: ((high - low) / 2) * world.thrust,
    hoverSpeeds: hoverShares(v).map((share) => Math.sqrt((share * hoverThrust(v) * world.mass) / lift(v))),
    radius: v.collision_radius,
    delay: world.delay ?? v.delay,
    arms: armsOf(v),
    dt: v.physics_step,
    substeps: Math.round(v.control_step / v.physics_step),
  };
}

/**
 * Add a vehicle to others unless one of them flies the same, and return its name: another one if its own is taken; page.py's _add.
 * @param {Vehicle[]} vehicles
 * @param {Vehicle} vehicle
 */
export function addVehicle(vehicles, vehicle) {
  const flies = (/** @type {Vehicle} */ v) => JSON.stringify(parametersOf(v));
  let { name } = vehicle;
  for (;;) {
    const known = vehicles.find((each) => each.name === name);
    if (!known) vehicles.push({ ...vehicle, name });
    if (!known || flies(known) === flies(vehicle)) return name;
    name += "′";
  }
}

/**
 * From a vehicle's own axes and rotors to those of a layout; layout.py's find_turn.
 *
 * @typedef {object} Turn
 * @property {number} angle of the body axes about z, rad
 * @property {number[]} order rotor k of the layout is the vehicle's rotor order[k]
 */

const TOLERANCE = (20 * Math.PI) / 180;
const SLACK = Math.PI / 180;

/** @param {number[]} items @returns {number[][]} */
function permutations(items) {
  if (items.length < 2) return [items];
  return items.flatMap((first, k) => permutations(items.filter((_, j) => j !== k)).map((rest) => [first, ...rest]));
}

/** @param {number} angle */
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/**
 * The smallest turn that brings the rotors to where a layout has them; null: no turn does.
 * @param {Layout} ours
 * @param {Layout} theirs
 * @returns {Turn | null}
 */
export function findTurn(ours, theirs) {
  const [places, goals] = [ours, theirs].map(({ rotor_positions: rotors }) => {
    const [mx, my] = [0, 1].map((k) => rotors.reduce((sum, place) => sum + place[k] / 4, 0));
    return rotors.map(([x, y]) => Math.atan2(y - my, x - mx));
  });
  const turns = [];
  for (const order of permutations([0, 1, 2, 3])) {
    if (order.some((from, k) => ours.rotor_directions[from] !== theirs.rotor_directions[k])) continue;
    const apart = order.map((from, k) => wrapped(goals[k] - places[from]));
    const sum = (/** @type {(a: number) => number} */ part) => apart.reduce((total, each) => total + part(each), 0);
    let angle = Math.atan2(sum(Math.sin), sum(Math.cos));
    const misfit = Math.max(...apart.map((each) => Math.abs(wrapped(each - angle))));
    const eighth = Math.round(angle / (Math.PI / 4)) * (Math.PI / 4);
    if (Math.abs(angle - eighth) < SLACK) angle = eighth;
    turns.push({ misfit, angle, order });
  }
  const least = Math.min(...turns.map((each) => each.misfit));
  if (!(least < TOLERANCE)) return null;
  const key = (/** @type {Turn} */ turn) => [Math.round(Math.abs(turn.angle) * 1e6), -turn.angle];
  const fitting = turns.filter((each) => each.misfit < least + SLACK);
  fitting.sort((a, b) => key(a)[0] - key(b)[0] || key(a)[1] - key(b)[1]);
  return { angle: fitting[0].angle, order: fitting[0].order };
}
