/**
 * The score of each controller, and the plots of the latest seconds.
 *
 * @typedef {import("./fleet.js").Entry} Entry
 */
import { Fleet, LOG_SECONDS, physicalLimit } from "./fleet.js";
import { Plot } from "./plots.js";
import { faded } from "./airframe.js";

/** An element of the page. @template {HTMLElement} T @param {string} id @returns {T} */
export const $ = (id) => /** @type {T} */ (document.getElementById(id));

/** @param {number | undefined} time */
const inSeconds = (time) => (time !== undefined && time >= 0 ? `${time.toFixed(2)} s` : "–");

/** @param {number} metres */
const inMetres = (metres) => metres.toFixed(metres < 10 ? 3 : 1);

/** What the columns say of a controller. @param {Entry} entry @param {boolean} follows whether there is a path */
function cellsOf({ flight, attempts, survived, active, log }, follows) {
  if (!flight) return ["cannot fly it", "–", "–"];
  const score = attempts ? `${survived} of ${attempts}` : "–";
  if (!active) return [score, "–", "–"];
  if (follows && !flight.lost && log.length) {
    const square = log.reduce((sum, [, distance]) => sum + distance ** 2, 0) / log.length;
    return [score, inMetres(Math.sqrt(square)), inMetres(flight.distance)];
  }
  return flight.lost ? [score, "lost", "–"] : [score, inSeconds(flight.arrival), inSeconds(flight.settled)];
}

export class Board {
  /** @param {Fleet} fleet @param {(k: number) => void} toggle */
  constructor(fleet, toggle) {
    this.fleet = fleet;
    this.toggle = toggle;
    this.chosen = 0; // whose rotor thrusts are plotted
    this.error = new Plot($("plot-error"), { low: 0.01, high: 20, ticks: [0.01, 0.1, 1, 10], log: true });
    this.tilt = new Plot($("plot-tilt"), { low: 0, high: 180, ticks: [0, 90, 180] });
    this.thrust = new Plot($("plot-thrust"), { low: 0, high: 2, ticks: [0, 1, 2] });
  }

  /** Make the rows again. */
  build() {
    $("score").replaceChildren(...this.fleet.entries.map((entry, k) => this.#row(entry, k)));
    this.show();
  }

  /** @param {Entry} entry @param {number} k */
  #row({ agent, active, colour }, k) {
    const row = document.createElement("tr"), head = document.createElement("th");
    const label = document.createElement("label"), box = document.createElement("input");
    head.scope = "row";
    Object.assign(box, { type: "checkbox", checked: active });
    box.style.setProperty("--colour", colour);
    box.addEventListener("change", () => this.toggle(k));
    label.append(box, agent.label);
    const origin = agent.kind === "network" ? `trained on ${agent.vehicle || "random quadcopters"}` : "on the true state";
    label.title = `${origin}; key ${k + 1}`;
    head.append(label);
    row.append(head, ...[0, 1, 2].map(() => document.createElement("td")));
    row.addEventListener("pointerenter", () => (this.chosen = k));
    return row;
  }

  show() {
    const { path } = this.fleet;
    $("column-2").textContent = path ? "RMS, m" : "To 0.1\u00a0m";
    $("column-3").textContent = path ? "Now, m" : "Stays";
    $("reference").hidden = !path;
    $("reference-speed").textContent = path ? `${Math.hypot(...path.course.at(path.time).slice(3, 6)).toFixed(1)} m/s` : "";
    this.fleet.entries.forEach((entry, k) => {
      const row = $("score").children[k], cells = row.querySelectorAll("td");
      cellsOf(entry, Boolean(path)).forEach((text, j) => {
        if (cells[j].textContent !== text) cells[j].textContent = text;
      });
      cells[0].title = entry.why;
      row.classList.toggle("off", !entry.active || !entry.flight);
      row.classList.toggle("lost", entry.active && Boolean(entry.flight?.lost));
    });
    const limit = physicalLimit(this.fleet);
    $("limit").hidden = limit === null;
    $("limit-time").textContent = inSeconds(limit ?? undefined);
    $("hover").hidden = this.fleet.canHover;
  }

  /** @param {Object<string, string>} palette */
  plot(palette) {
    const { flying, entries, vehicle, settings } = this.fleet;
    const curves = (/** @type {number} */ row, scale = 1) =>
      flying.map(({ colour, log }) => ({ colour, width: 2, points: log.map((each) => [each[0], each[row] * scale]) }));
    this.error.draw(curves(1), LOG_SECONDS, palette, [0.1]);
    this.tilt.draw(curves(2, 180 / Math.PI), LOG_SECONDS, palette);
    const chosen = entries[this.chosen]?.active ? entries[this.chosen] : flying[0];
    const limits = vehicle.thrust_limits.map((each) => each * settings.battery);
    const high = Math.max(2, Math.ceil(limits[1]));
    Object.assign(this.thrust.axis, { high, ticks: [0, 1, high] });
    const rotors = (chosen ? [3, 4, 5, 6] : []).map((row) => ({
      colour: faded(chosen.colour, 1.6 - 0.2 * row),
      width: 1.5,
      points: chosen.log.map((each) => [each[0], each[row]]),
    }));
    this.thrust.draw(rotors, LOG_SECONDS, palette, limits);
    $("thrust-of").textContent = chosen?.agent.label ?? "";
  }
}
