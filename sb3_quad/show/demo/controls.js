/**
 * Buttons, sliders, keys, and zips that are dropped onto the page.
 *
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {import("./player.js").Player} Player
 * @typedef {import("./fleet.js").Settings} Settings
 */
import { $, Board } from "./board.js";
import { STARTS } from "./fleet.js";
import { addVehicle } from "./vehicle.js";
import { readAgent } from "./weights.js";

const SPEEDS = [1, 0.25, 0.1];
const TOOLS = /** @type {const} */ (["throw", "push", "draw"]);
const SWITCHES = /** @type {const} */ (["auto", "apart", "trails", "paused"]);
/** @type {Object<string, string>} */
const TITLES = {
  "upside down, at rest": "At rest, upside down (u)",
  "upside down": "Upside down, 2.8 m/s, 6.9 rad/s: the thesis's state s1 (a)",
  tumbling: "Tumbling, 3.5 m/s, 6.9 rad/s: the thesis's state s2 (b)",
  random: "Any attitude, velocity and spin (r)",
  "10 m away": "Level, the target 10 m away (f)",
};

/** @param {string} text @param {boolean} [wrong] */
export function say(text, wrong = false) {
  $("status").textContent = text;
  $("status").classList.toggle("wrong", wrong);
}

export class Controls {
  /** @param {Player} player @param {Board} board @param {Vehicle[]} vehicles @param {string[]} colours */
  constructor(player, board, vehicles, colours) {
    this.player = player;
    this.fleet = player.fleet;
    this.board = board;
    this.vehicles = vehicles;
    this.colours = colours;
    this.#buildStarts();
    this.#buildSliders();
    this.#offerVehicles();
    this.#listen();
    player.onChange = () => this.show();
    this.show();
  }

  /** Show what is switched on. */
  show() {
    const { player } = this;
    const press = (/** @type {Element} */ element, /** @type {boolean} */ on) => (element.ariaPressed = String(on));
    for (const each of SWITCHES) press($(each), player[each]);
    for (const each of SPEEDS) press($(`speed-${each}`), player.speed === each);
    for (const each of TOOLS) press($(`tool-${each}`), player.tool === each);
    for (const button of $("starts").children) press(button, button.id === `start-${player.startName}`);
    document.body.classList.toggle("touched", player.touched);
    if (player.tool === "draw" && !this.fleet.path) say("Draw a path in the picture, and they follow it.");
  }

  /** Begin a start that somebody asked for. @param {string} name */
  start(name) {
    say("");
    this.player.takeOver();
    this.player.start(name);
  }

  /** A controller on or off. @param {number} k */
  toggle(k) {
    if (!this.fleet.entries[k]) return;
    this.fleet.toggle(k);
    if (this.player.startName) this.player.start(this.player.startName);
    this.board.build();
  }

  #buildStarts() {
    $("starts").append(...Object.keys(STARTS).map((name) => {
      const button = document.createElement("button");
      const textContent = name[0].toUpperCase() + name.slice(1);
      Object.assign(button, { type: "button", id: `start-${name}`, title: TITLES[name], textContent });
      button.addEventListener("click", () => this.start(name));
      return button;
    }));
  }

  /**
   * What each slider sets, from where to where, and how its value reads.
   * @returns {[keyof Settings, string, number, number, number, (x: number) => string][]}
   */
  #sliders() {
    const factor = (/** @type {number} */ x) => `× ${x.toFixed(2)}`;
    const percent = (/** @type {number} */ x) => `${Math.round(100 * x)} %`;
    const newtons = (/** @type {number} */ x) => (x ? `${(x * this.fleet.weight).toPrecision(2)} N` : "0 N");
    const delay = (/** @type {number} */ x) => `${Math.round(1000 * x * this.fleet.vehicle.control_step)} ms`;
    return [
      ["mass", "Mass", 0.6, 1.6, 0.01, factor],
      ["motors", "Motors", 0.3, 2, 0.01, factor],
      ["battery", "Battery", 0.5, 1.2, 0.01, percent],
      ["delay", "Delay", 0, 8, 1, delay],
      ["force", "Steady force", 0, 0.6, 0.01, newtons],
      ["gusts", "Gusts", 0, 0.4, 0.01, newtons],
      ["noise", "Sensor noise", 0, 0.25, 0.01, percent],
      ["pace", "Path speed", 0.5, 6, 0.1, (x) => `${x.toFixed(1)} m/s`],
    ];
  }

  #buildSliders() {
    $("sliders").replaceChildren(...this.#sliders().map(([id, title, min, max, step, text]) => {
      const line = document.createElement("label"), name = document.createElement("span");
      const input = document.createElement("input"), output = document.createElement("output");
      const value = this.fleet.settings[id];
      name.textContent = title;
      output.textContent = text(value);
      Object.assign(input, { type: "range", id, min, max: Math.max(max, value), step });
      input.value = String(value);
      input.addEventListener("input", () => {
        this.fleet.set({ [id]: Number(input.value) });
        output.textContent = text(Number(input.value));
      });
      line.append(name, input, output);
      return line;
    }));
  }

  #offerVehicles() {
    const select = /** @type {HTMLSelectElement} */ ($("vehicle"));
    const flown = this.fleet.vehicle.name;
    select.replaceChildren(...this.vehicles.map(({ name }) => new Option(name, name, false, name === flown)));
  }

  #listen() {
    const { player, fleet } = this;
    for (const each of SWITCHES) $(each).addEventListener("click", () => player.set({ [each]: !player[each] }));
    for (const each of SPEEDS) $(`speed-${each}`).addEventListener("click", () => player.set({ speed: each }));
    for (const each of TOOLS) $(`tool-${each}`).addEventListener("click", () => player.set({ tool: each }));
    $("ask").addEventListener("click", () => /** @type {HTMLDialogElement} */ ($("help")).showModal());
    $("calm").addEventListener("click", () => {
      fleet.set({ mass: 1, motors: 1, battery: 1, delay: fleet.vehicle.delay, force: 0, gusts: 0, noise: 0, pace: 2 });
      this.#buildSliders();
    });
    $("vehicle").addEventListener("change", (event) => {
      const { value } = /** @type {HTMLSelectElement} */ (event.target);
      fleet.setVehicle(this.vehicles.find(({ name }) => name === value) ?? fleet.vehicle);
      this.#buildSliders();
      this.board.build();
      this.start(player.startName || "random");
    });
    const file = /** @type {HTMLInputElement} */ ($("file"));
    file.addEventListener("change", () => {
      if (file.files?.[0]) void this.take(file.files[0]);
      file.value = "";
    });
    const over = (/** @type {boolean} */ on) => document.body.classList.toggle("over", on);
    addEventListener("dragover", (event) => {
      event.preventDefault();
      over(true);
    });
    addEventListener("dragleave", (event) => event.relatedTarget || over(false));
    addEventListener("drop", (event) => {
      event.preventDefault();
      over(false);
      const dropped = event.dataTransfer?.files[0];
      if (dropped) void this.take(dropped);
    });
    addEventListener("keydown", (event) => this.#key(event));
  }

  /** A further agent flies from now on. @param {import("./flight.js").Agent} agent */
  join(agent) {
    const entry = this.fleet.add(agent, this.colours[this.fleet.entries.length % this.colours.length]);
    this.#offerVehicles();
    this.board.build();
    this.start(this.player.startName || "random");
    return entry;
  }

  /** Read a zip and let its agent fly. @param {File} file */
  async take(file) {
    try {
      const { agent, vehicle } = await readAgent(file.name.replace(/\.zip$/, ""), await file.arrayBuffer());
      if (vehicle && agent.vehicle) agent.vehicle = addVehicle(this.vehicles, vehicle);
      while (this.fleet.entries.some((entry) => entry.agent.label === agent.label)) agent.label += "′";
      const entry = this.join(agent);
      const trained = agent.vehicle || (vehicle ? "random quadcopters" : "a vehicle that it does not name");
      say(entry.why || `${agent.label} flies, trained on ${trained}`, Boolean(entry.why));
    } catch (error) {
      // What a damaged file raises depends on where the damage is; what we raise ourselves is a plain Error.
      const plain = error instanceof Error && error.constructor === Error;
      say(`${file.name}: ${plain ? error.message : "it is damaged, or no zip of Stable-Baselines3"}`, true);
    }
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const { player } = this;
    /** @type {Object<string, () => void>} */
    const keys = {
      " ": () => player.set({ paused: !player.paused }),
      m: () => player.set({ speed: SPEEDS[(SPEEDS.indexOf(player.speed) + 1) % SPEEDS.length] }),
      u: () => this.start("upside down, at rest"),
      r: () => this.start("random"),
      a: () => this.start("upside down"),
      b: () => this.start("tumbling"),
      f: () => this.start("10 m away"),
      Enter: () => {
        player.takeOver();
        player.again();
      },
      t: () => player.set({ tool: "throw" }),
      p: () => player.set({ tool: "push" }),
      d: () => player.set({ tool: "draw" }),
      k: () => player.kick(),
      l: () => player.set({ trails: !player.trails }),
      o: () => player.set({ apart: !player.apart }),
      c: () => player.camera.reset(),
      "?": () => $("ask").click(),
      ArrowLeft: () => player.nudge(-1, 0),
      ArrowRight: () => player.nudge(1, 0),
      ArrowUp: () => player.nudge(0, 1),
      ArrowDown: () => player.nudge(0, -1),
    };
    const action = /^[1-9]$/.test(event.key) ? () => this.toggle(Number(event.key) - 1) : keys[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey || $("help").hasAttribute("open")) return;
    const { target } = event;
    const presses = event.key === " " || event.key === "Enter"; // what the element itself answers
    const isButton = target instanceof HTMLButtonElement || (target instanceof HTMLInputElement && target.type !== "range");
    if (target instanceof HTMLSelectElement || (isButton && presses)) return;
    if (target instanceof HTMLInputElement && target.type === "range" && event.key.startsWith("Arrow")) return;
    event.preventDefault();
    action();
  }
}
