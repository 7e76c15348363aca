/**
 * The page: what it shows, what its controls do, and the loop that flies.
 *
 * @typedef {import("./flight.js").Agent} Agent
 * @typedef {import("./fleet.js").Entry} Entry
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./scene.js").Body} Body
 */
import { Camera } from "./camera.js";
import { rotation, turnBody } from "./dynamics.js";
import { Fleet, LOG_SECONDS, physicalLimit, STARTS } from "./fleet.js";
import { listen } from "./hand.js";
import { Plot } from "./plots.js";
import { faded, Scene } from "./scene.js";
import { readAgent, unpackLayers } from "./weights.js";

const LANE = 2.4; // m between vehicles
const FASTEST = 14; // m/s of a throw
const TUMBLE = 1.1; // rad/s of a throw, per m/s
const STRONGEST = 1.2; // of a push, weights
const PAUSE = 1.4; // s between attempts of the automatic flight
const CYCLE = ["random", "10 m away", "upside down", "random", "s2", "s1"];
/** @type {Object<string, string>} */
const TITLES = {
  "upside down": "At rest, upside down (u)",
  s1: "The thesis's state s1: upside down, 2.8 m/s, 6.9 rad/s (a)",
  s2: "The thesis's state s2: tumbling, 3.5 m/s, 6.9 rad/s (b)",
  random: "Any attitude, velocity and spin (r)",
  "10 m away": "Level, the target 10 m away (f)",
};
const SPEEDS = [1, 0.25, 0.1];
const SLIDERS = [
  { id: "mass", label: "Mass", low: 0.6, high: 1.6, step: 0.01, text: (/** @type {number} */ x) => `× ${x.toFixed(2)}` },
  { id: "motors", label: "Motors", low: 0.3, high: 2, step: 0.01, text: (/** @type {number} */ x) => `× ${x.toFixed(2)}` },
  { id: "battery", label: "Battery", low: 0.5, high: 1.2, step: 0.01, text: (/** @type {number} */ x) => `${Math.round(100 * x)} %` },
  { id: "delay", label: "Delay", low: 0, high: 8, step: 1, text: (/** @type {number} */ x) => `${Math.round(x * fleet.vehicle.control_step * 1000)} ms` },
  { id: "force", label: "Steady force", low: 0, high: 0.6, step: 0.01, text: newtons },
  { id: "gusts", label: "Gusts", low: 0, high: 0.4, step: 0.01, text: newtons },
  { id: "noise", label: "Sensor noise", low: 0, high: 0.25, step: 0.01, text: (/** @type {number} */ x) => `${Math.round(100 * x)} %` },
];

/** @param {number} weights */
function newtons(weights) {
  return weights ? `${(weights * fleet.weight).toPrecision(2)} N` : "0 N";
}

/** @template {HTMLElement} T @param {string} id @returns {T} */
const $ = (id) => /** @type {T} */ (document.getElementById(id));
const data = JSON.parse($("data").textContent ?? "");
/** @type {Vehicle[]} */
const vehicles = data.vehicles;
const canvas = /** @type {HTMLCanvasElement} */ ($("scene"));
const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false }));
const narrow = matchMedia("(max-width: 860px)");
const camera = new Camera();
const scene = new Scene(context, camera);
const agents = await Promise.all(
  data.agents.map(async (/** @type {any} */ agent) => (agent.shapes ? { ...agent, layers: await unpackLayers(agent) } : agent)),
);
const first = vehicles.find((each) => each.name === data.vehicle) ?? vehicles[0];
const fleet = new Fleet(agents, data.agents.map((/** @type {any} */ each) => each.colour), first, Date.now() % 65536);
fleet.entries.forEach((entry, k) => (entry.active = k < (narrow.matches ? 3 : 4)));

let paused = false, speed = 1, carry = 0, last = 0, frames = 0, idle = 0, round = 0;
let auto = true, apart = true, trails = true, startName = "s1";
/** @type {"throw" | "push"} */
let tool = "throw";
let focus = 0; // whose rotor thrusts are plotted
let grabbed = { position: [0, 0, 0], quaternion: [1, 0, 0, 0] };
/** @type {number[]} */
let dragged = [0, 0, 0]; // the target, as its drag began
/** @type {WeakMap<Entry, number[]>} */
const angles = new WeakMap();

/** @param {string} text @param {boolean} [wrong] */
function say(text, wrong = false) {
  $("status").textContent = text;
  $("status").classList.toggle("wrong", wrong);
}

// ---------------------------------------------------------------- flights

/** @param {string} name */
function start(name) {
  startName = name;
  fleet.begin(STARTS[name](fleet.uniform));
  carry = idle = 0;
  setPaused(false);
  for (const button of document.querySelectorAll("[data-start]")) {
    button.setAttribute("aria-pressed", String(button instanceof HTMLElement && button.dataset.start === name));
  }
}

/** The visitor has done something: the page no longer flies on its own. */
function takeOver() {
  setAuto(false);
  document.body.classList.add("touched");
}

/** @param {Entry} entry */
function laneOf(entry) {
  const flying = fleet.flying;
  const place = flying.findIndex((each) => each === entry);
  return [0, apart ? -(place - (flying.length - 1) / 2) * LANE : 0, 0];
}

/** What is drawn of the flights, part of a control step after their last state. @param {number} share @returns {Body[]} */
function bodies(share) {
  return fleet.flying.map((entry) => {
    const { flight, before } = entry;
    const lane = laneOf(entry);
    const part = flight.lost || fleet.held ? 1 : share;
    const between = flight.state.map((each, k) => before[k] + part * (each - before[k]));
    const size = Math.hypot(between[3], between[4], between[5], between[6]) || 1;
    for (let k = 3; k < 7; k++) between[k] /= size;
    const add = (/** @type {ArrayLike<number>} */ v) => [0, 1, 2].map((k) => v[k] + lane[k]);
    return {
      label: entry.agent.label,
      colour: entry.colour,
      position: add(between),
      rotation: rotation(between),
      thrusts: flight.thrusts,
      angles: angles.get(entry) ?? [0, 0, 0, 0],
      target: add(flight.state.subarray(17)),
      trail: entry.trail,
      lane,
      lost: flight.lost,
      force: fleet.force.map((each) => each / fleet.weight),
      near: !flight.lost && flight.settled >= 0,
    };
  });
}

/** @param {number} seconds */
function turnRotors(seconds) {
  for (const entry of fleet.flying) {
    const now = angles.get(entry) ?? [0, 0, 0, 0];
    const { thrusts, lost, vehicle } = entry.flight;
    angles.set(entry, now.map((each, k) => each + (lost ? 0 : seconds * 26 * Math.sqrt(thrusts[k]) * -vehicle.rotor_directions[k])));
  }
}

const hand = listen(canvas, camera, {
  things: () => bodies(1).flatMap(({ position, target }, index) => [
    { kind: /** @type {const} */ ("vehicle"), index, position },
    { kind: /** @type {const} */ ("target"), index, position: target },
  ]),
  tool: () => tool,
  grab: (index) => {
    takeOver();
    const { state } = fleet.flying[index].flight;
    grabbed = { position: [...state.subarray(0, 3)], quaternion: [...state.subarray(3, 7)] };
    fleet.hold(thrown([0, 0, 0]));
    for (const entry of fleet.entries) entry.trail = [];
    setPaused(false);
  },
  carry: (way, velocity) => {
    const lowest = fleet.vehicle.collision_radius + 0.15;
    const position = grabbed.position.map((each, k) => each + way[k]);
    position[2] = Math.max(lowest, position[2]);
    tumble(spin(velocity), 1 / 60);
    fleet.hold({ ...thrown(velocity), position });
  },
  release: (velocity) => {
    const thrownNow = thrown(velocity);
    fleet.begin({ ...thrownNow, position: fleet.start.position });
    startName = "";
    carry = idle = 0;
  },
  push: (way, _) => {
    takeOver();
    const size = way ? Math.hypot(...way) : 0;
    const scale = size > 0 ? (Math.min(size / 2, STRONGEST) * fleet.weight) / size : 0;
    fleet.push = (way ?? [0, 0, 0]).map((each) => each * scale);
  },
  target: (way) => {
    takeOver();
    if (!way) dragged = [...fleet.start.target];
    else moveTarget(dragged.map((each, k) => each + way[k]));
  },
});

/** @param {number[]} target */
function moveTarget(target) {
  target[2] = Math.max(0.5, target[2]);
  fleet.setTarget(target);
}

/** The spin of something thrown, body frame, rad/s. @param {number[]} velocity */
function spin(velocity) {
  const { forward } = camera.axes;
  const world = [0, 1, 2].map((k) => {
    const [i, j] = [(k + 1) % 3, (k + 2) % 3];
    return TUMBLE * (velocity[i] * forward[j] - velocity[j] * forward[i]);
  });
  const state = new Float64Array(20);
  state.set(grabbed.quaternion, 3);
  const r = rotation(state);
  return [0, 1, 2].map((k) => r[k] * world[0] + r[3 + k] * world[1] + r[6 + k] * world[2]);
}

/** Turn what is held. @param {number[]} rates @param {number} seconds */
function tumble(rates, seconds) {
  const state = new Float64Array(20);
  state.set(grabbed.quaternion, 3);
  const size = Math.hypot(...rates);
  if (size < 0.2) return;
  const half = (Math.min(size, 12) * seconds) / 2;
  const axis = rates.map((each) => (each / size) * Math.sin(half));
  turnBody(state, Math.cos(half), axis[0], axis[1], axis[2]);
  grabbed.quaternion = [...state.subarray(3, 7)];
}

/** @param {number[]} velocity */
function thrown(velocity) {
  const size = Math.hypot(...velocity);
  const held = velocity.map((each) => each * Math.min(1, FASTEST / Math.max(size, 1e-9)));
  return { position: grabbed.position, quaternion: grabbed.quaternion, velocity: held, rates: spin(held), target: fleet.start.target };
}

// ---------------------------------------------------------------- what is shown

const plots = {
  error: new Plot($("plot-error"), { low: 0.01, high: 20, ticks: [0.01, 0.1, 1, 10], log: true, unit: "m" }),
  tilt: new Plot($("plot-tilt"), { low: 0, high: 180, ticks: [0, 90, 180], unit: "°" }),
  thrust: new Plot($("plot-thrust"), { low: 0, high: 2, ticks: [0, 1, 2], unit: "hover thrusts" }),
};

function drawPlots() {
  const flying = fleet.flying;
  const curves = (/** @type {number} */ row, scale = 1) =>
    flying.map(({ colour, log }) => ({ colour, width: 2, points: log.map((each) => [each[0], each[row] * scale]) }));
  plots.error.draw(curves(1), LOG_SECONDS, scene.palette, [0.1]);
  plots.tilt.draw(curves(2, 180 / Math.PI), LOG_SECONDS, scene.palette);
  const chosen = fleet.entries[focus]?.active ? fleet.entries[focus] : flying[0];
  const [low, high] = fleet.vehicle.thrust_limits.map((each) => each * fleet.settings.battery);
  plots.thrust.axis.high = high > 2 ? Math.ceil(high) : 2;
  plots.thrust.axis.ticks = high > 2 ? [0, 1, plots.thrust.axis.high] : [0, 1, 2];
  const rotors = (chosen ? [3, 4, 5, 6] : []).map((row) => ({
    colour: faded(chosen.colour, 1.05 - 0.2 * (row - 3)),
    width: 1.5,
    points: chosen.log.map((each) => [each[0], each[row]]),
  }));
  plots.thrust.draw(rotors, LOG_SECONDS, scene.palette, [low, high]);
  $("thrust-of").textContent = chosen ? chosen.agent.label : "";
}

function buildScore() {
  $("score").replaceChildren(...fleet.entries.map((entry, k) => {
    const row = document.createElement("tr");
    const head = document.createElement("th");
    head.scope = "row";
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = entry.active;
    box.style.setProperty("--colour", entry.colour);
    box.addEventListener("change", () => toggle(k, box.checked));
    label.append(box, entry.agent.label);
    label.title = entry.agent.kind === "network" ? `trained on ${entry.agent.vehicle || "random quadcopters"}; key ${k + 1}` : `on the true state; key ${k + 1}`;
    head.append(label);
    row.append(head, ...[0, 1, 2].map(() => document.createElement("td")));
    row.addEventListener("pointerenter", () => (focus = k));
    return row;
  }));
  showScore();
}

function showScore() {
  const rows = $("score").children;
  fleet.entries.forEach((entry, k) => {
    const { flight, attempts, survived, active, why } = entry;
    const cells = rows[k].querySelectorAll("td");
    rows[k].classList.toggle("off", !active || !flight);
    const seconds = (/** @type {number | undefined} */ time) => (time !== undefined && time >= 0 ? `${time.toFixed(2)} s` : "–");
    const texts = flight
      ? [attempts ? `${survived} of ${attempts}` : "–", flight.lost ? "lost" : seconds(active ? flight.arrival : NaN), flight.lost ? "–" : seconds(active ? flight.settled : NaN)]
      : ["cannot fly it", "–", "–"];
    texts.forEach((text, j) => {
      if (cells[j].textContent !== text) cells[j].textContent = text;
    });
    rows[k].classList.toggle("lost", Boolean(flight?.lost) && active);
    if (why) cells[0].title = why;
  });
  const limit = physicalLimit(fleet.vehicle, fleet.start);
  $("limit").hidden = limit === null;
  if (limit !== null) $("limit-time").textContent = `${limit.toFixed(2)} s`;
  $("hover").hidden = fleet.canHover;
}

/** @param {number} k @param {boolean} [on] */
function toggle(k, on = !fleet.entries[k]?.active) {
  const entry = fleet.entries[k];
  if (!entry) return;
  entry.active = on;
  entry.log = [];
  entry.trail = [];
  entry.flight?.begin(fleet.start);
  entry.judged = true;
  if (on && startName) start(startName);
  buildScore();
}

// ---------------------------------------------------------------- controls

/** @param {string} id @param {boolean} on */
const press = (id, on) => $(id).setAttribute("aria-pressed", String(on));

/** @param {boolean} on */
function setPaused(on) {
  paused = on;
  press("pause", on);
}

/** @param {boolean} on */
function setAuto(on) {
  auto = on;
  press("auto", on);
}

/** @param {number} factor */
function setSpeed(factor) {
  speed = factor;
  for (const each of SPEEDS) press(`speed-${each}`, each === factor);
}

/** @param {"throw" | "push"} name */
function setTool(name) {
  tool = name;
  for (const each of ["throw", "push"]) press(`tool-${each}`, each === name);
  canvas.dataset.tool = name;
}

function buildControls() {
  $("starts").append(...Object.keys(STARTS).map((name) => {
    const button = document.createElement("button");
    button.type = "button";
    button.dataset.start = name;
    button.textContent = name.length > 2 ? name[0].toUpperCase() + name.slice(1) : name;
    button.title = TITLES[name];
    button.addEventListener("click", () => {
      takeOver();
      start(name);
    });
    return button;
  }));
  $("sliders").append(...SLIDERS.map(({ id, label, low, high, step, text }) => {
    const line = document.createElement("label");
    const input = document.createElement("input");
    const output = document.createElement("output");
    Object.assign(input, { type: "range", id, min: String(low), max: String(high), step: String(step) });
    const name = document.createElement("span");
    name.textContent = label;
    const show = () => {
      const value = fleet.settings[/** @type {keyof typeof fleet.settings} */ (id)];
      input.value = String(value);
      output.textContent = text(value);
    };
    input.addEventListener("input", () => {
      fleet.set({ [id]: Number(input.value) });
      show();
    });
    line.addEventListener("refresh", show);
    show();
    line.append(name, input, output);
    return line;
  }));
  const select = /** @type {HTMLSelectElement} */ ($("vehicle"));
  const offer = () => select.replaceChildren(...vehicles.map(({ name }) => new Option(name, name, false, name === fleet.vehicle.name)));
  offer();
  select.addEventListener("change", () => {
    const chosen = vehicles.find(({ name }) => name === select.value);
    if (!chosen) return;
    takeOver();
    fleet.setVehicle(chosen);
    refreshSliders();
    buildScore();
    start(startName || "random");
  });
  $("calm").addEventListener("click", () => {
    fleet.set({ mass: 1, motors: 1, battery: 1, delay: fleet.vehicle.delay, force: 0, gusts: 0, noise: 0 });
    refreshSliders();
  });
  $("pause").addEventListener("click", () => setPaused(!paused));
  $("auto").addEventListener("click", () => setAuto(!auto));
  $("trails").addEventListener("click", () => press("trails", (trails = !trails)));
  $("apart").addEventListener("click", () => press("apart", (apart = !apart)));
  for (const each of SPEEDS) $(`speed-${each}`).addEventListener("click", () => setSpeed(each));
  for (const each of /** @type {const} */ (["throw", "push"])) $(`tool-${each}`).addEventListener("click", () => setTool(each));
  const help = /** @type {HTMLDialogElement} */ ($("help"));
  $("ask").addEventListener("click", () => help.showModal());
  const file = /** @type {HTMLInputElement} */ ($("file"));
  file.addEventListener("change", () => {
    if (file.files?.[0]) void take(file.files[0], offer);
    file.value = "";
  });
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("over");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("over");
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("over");
    const dropped = event.dataTransfer?.files[0];
    if (dropped) void take(dropped, offer);
  });
}

function refreshSliders() {
  for (const line of $("sliders").children) line.dispatchEvent(new Event("refresh"));
}

/** Read a dropped zip and let its agent fly. @param {File} file @param {() => void} offer */
async function take(file, offer) {
  try {
    const { agent, vehicle } = await readAgent(file.name.replace(/\.zip$/, ""), await file.arrayBuffer());
    const known = vehicle && vehicles.some(({ name }) => name === vehicle.name);
    if (vehicle && !known && agent.vehicle) vehicles.push(vehicle);
    offer();
    while (fleet.entries.some((entry) => entry.agent.label === agent.label)) agent.label += "′";
    const entry = fleet.add(agent, data.colours[fleet.entries.length % data.colours.length]);
    takeOver();
    buildScore();
    start(startName || "random");
    say(entry.why || `${agent.label} flies, trained on ${agent.vehicle || (vehicle ? "random quadcopters" : "a vehicle it does not name")}`, Boolean(entry.why));
  } catch (error) {
    const reason = error instanceof SyntaxError || error instanceof RangeError || error instanceof TypeError ? "it is damaged, or no zip of Stable-Baselines3" : /** @type {Error} */ (error).message;
    say(`${file.name}: ${reason}`, true);
  }
}

/** @type {Object<string, () => void>} */
const KEYS = {
  " ": () => setPaused(!paused),
  m: () => setSpeed(SPEEDS[(SPEEDS.indexOf(speed) + 1) % SPEEDS.length]),
  u: () => (takeOver(), start("upside down")),
  r: () => (takeOver(), start("random")),
  a: () => (takeOver(), start("s1")),
  b: () => (takeOver(), start("s2")),
  f: () => (takeOver(), start("10 m away")),
  Enter: () => (takeOver(), fleet.begin(fleet.start)),
  t: () => setTool("throw"),
  p: () => setTool("push"),
  k: () => {
    takeOver();
    kick = 0.15;
  },
  l: () => press("trails", (trails = !trails)),
  o: () => press("apart", (apart = !apart)),
  c: () => camera.reset(),
  "?": () => $("ask").click(),
  ArrowLeft: () => nudge(-1, 0),
  ArrowRight: () => nudge(1, 0),
  ArrowUp: () => nudge(0, 1),
  ArrowDown: () => nudge(0, -1),
};
let kick = 0; // s left of a kick by the keyboard

/** Move the target in the picture. @param {number} x @param {number} y */
function nudge(x, y) {
  takeOver();
  const { right, up } = camera.axes;
  moveTarget(fleet.start.target.map((each, k) => each + x * right[k] + y * up[k]));
}

addEventListener("keydown", (event) => {
  const { target } = event;
  const typing = target instanceof HTMLInputElement || target instanceof HTMLSelectElement || $("help").hasAttribute("open");
  const presses = target instanceof HTMLButtonElement && (event.key === " " || event.key === "Enter");
  if (typing && !(target instanceof HTMLInputElement && target.type === "checkbox" && event.key !== " ")) return;
  if (presses || event.ctrlKey || event.metaKey || event.altKey) return;
  if (/^[1-9]$/.test(event.key)) toggle(Number(event.key) - 1);
  else if (KEYS[event.key]) KEYS[event.key]();
  else return;
  event.preventDefault();
});

// ---------------------------------------------------------------- the loop

function readPalette() {
  const style = getComputedStyle(document.documentElement);
  const names = ["zenith", "haze", "ground", "grid", "gridFar", "shadow", "target", "frame", "lost", "blade", "force", "rule", "quiet"];
  scene.palette = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function resize() {
  const box = canvas.getBoundingClientRect();
  const ratio = Math.min(devicePixelRatio, 2);
  canvas.width = Math.round(box.width * ratio);
  canvas.height = Math.round(box.height * ratio);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  [camera.width, camera.height] = [box.width, box.height];
  camera.inset = narrow.matches ? { top: 84, right: 8, bottom: 12, left: 8 } : { top: 90, right: 16, bottom: 76, left: 16 };
  camera.prepare();
}

/** @param {number} seconds */
function advance(seconds) {
  if (paused) return;
  if (kick > 0) {
    kick -= seconds * speed;
    fleet.push = kick > 0 ? camera.axes.right.map((each) => each * fleet.weight) : [0, 0, 0];
  }
  carry += seconds * speed;
  const step = fleet.vehicle.control_step;
  for (; carry >= step; carry -= step) fleet.step();
  turnRotors(seconds * Math.max(speed, 0.25));
  if (!fleet.done || !fleet.rounds) return;
  if (idle === 0) announce();
  idle += seconds;
  if (auto && idle > PAUSE) start(CYCLE[round++ % CYCLE.length]);
}

function announce() {
  const told = fleet.flying.map(({ agent, flight }) => `${agent.label} ${flight.lost ? "is lost" : flight.arrival >= 0 ? `arrives after ${flight.arrival.toFixed(2)} s` : "survives"}`);
  if (!auto && !fleet.held) say(told.join("; "));
}

/** @param {number} now ms */
function frame(now) {
  const seconds = Math.min((now - last) / 1000, 0.05);
  last = now;
  frames += 1;
  advance(seconds);
  const shown = bodies(carry / fleet.vehicle.control_step);
  if (!hand.isHolding()) {
    const seen = shown.filter((body) => !body.lost);
    camera.follow([...seen.map((body) => body.position), ...shown.map((body) => body.target)], 1.5, seconds);
  }
  scene.draw(shown, fleet.vehicle, { trails, grabbed: fleet.held });
  if (frames % 4 === 0) drawPlots();
  if (frames % 6 === 0) showScore();
  requestAnimationFrame(frame);
}

readPalette();
buildControls();
buildScore();
setTool("throw");
setSpeed(1);
setAuto(!matchMedia("(prefers-reduced-motion: reduce)").matches);
press("trails", trails);
press("apart", apart);
new ResizeObserver(resize).observe(canvas);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readPalette);
resize();
start("s1");
camera.follow(bodies(1).flatMap((body) => [body.position, body.target]), 1.5, Infinity);
requestAnimationFrame((now) => {
  last = now;
  frame(now);
});
/** For the console, and for tests. */
Object.assign(window, { demo: { fleet, camera, start, bodies: () => bodies(1), frames: () => frames, take, ready: performance.now() } });
