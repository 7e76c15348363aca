/** The page: its parts put together, and the loop that flies and draws. */
import { $, Board } from "./board.js";
import { Camera } from "./camera.js";
import { Controls, say } from "./controls.js";
import { Fleet } from "./fleet.js";
import { listen } from "./hand.js";
import { Player } from "./player.js";
import { Scene } from "./scene.js";
import { School } from "./school.js";
import { unpackLayers } from "./weights.js";

const SKY = ["zenith", "haze", "ground", "grid", "gridFar", "shadow"];
const COLOURS = [...SKY, "target", "frame", "lost", "blade", "force", "rule", "quiet"]; // of style.css
const SHOWN = { wide: 4, narrow: 3 }; // controllers that fly at first
const SHEET = 5; // where there is no path yet, to draw one, m
const MARGIN = 1.5; // around what the camera follows, m

const data = JSON.parse($("data").textContent ?? "");
/** @param {any} agent */
const unpacked = async (agent) => (agent.shapes ? { ...agent, layers: await unpackLayers(agent) } : agent);
const agents = await Promise.all(data.agents.map(unpacked));
const canvas = /** @type {HTMLCanvasElement} */ ($("scene"));
const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false }));
const narrow = matchMedia("(max-width: 860px)");
const camera = new Camera();
const scene = new Scene(context, camera);
const vehicle = data.vehicles.find((/** @type {{name: string}} */ { name }) => name === data.vehicle);
const fleet = new Fleet(agents, agents.map(({ colour }) => colour), vehicle, Date.now() % 65536);
fleet.entries.forEach((entry, k) => (entry.active = k < (narrow.matches ? SHOWN.narrow : SHOWN.wide)));
const player = new Player(fleet, camera);
const board = new Board(fleet, (k) => controls.toggle(k));
const controls = new Controls(player, board, data.vehicles, data.colours);
const school = new School(controls, Date.now() % 65536);
const hand = listen(canvas, camera, player);
let frames = 0, last = 0;

function readPalette() {
  const style = getComputedStyle(document.documentElement);
  scene.palette = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function resize() {
  const { width, height } = canvas.getBoundingClientRect();
  const ratio = Math.min(devicePixelRatio, 2);
  Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  Object.assign(camera, { width, height });
  camera.inset = narrow.matches ? { top: 84, right: 8, bottom: 12, left: 8 } : { top: 90, right: 16, bottom: 104, left: 16 };
  camera.prepare();
}

/** @param {number} seconds */
function draw(seconds) {
  const bodies = player.bodies();
  const seen = [...bodies.filter((body) => !body.lost).map((body) => body.position), ...bodies.map((body) => body.target)];
  const line = player.line, draws = player.tool === "draw" && !line.length;
  if (!hand.isHolding()) camera.follow([...seen, ...line], draws ? SHEET : MARGIN, seconds);
  scene.draw(bodies, fleet.vehicle, player.trails, line);
  if (frames % 4 === 0) {
    board.plot(scene.palette);
    school.draw(scene.palette);
  }
  if (frames % 6 === 0) board.show();
}

/** @param {number} now ms */
function frame(now) {
  const seconds = Math.min((now - last) / 1000, 0.05);
  last = now;
  frames += 1;
  player.advance(seconds);
  draw(seconds);
  requestAnimationFrame(frame);
}

player.onEnd = () => {
  const outcomes = fleet.flying.map(({ agent, flight }) => {
    const end = flight.arrival >= 0 ? `arrives after ${flight.arrival.toFixed(2)} s` : "survives";
    return `${agent.label} ${flight.lost ? "is lost" : end}`;
  });
  if (!player.auto && !$("status").classList.contains("wrong")) say(outcomes.join("; "));
};
readPalette();
board.build();
new ResizeObserver(resize).observe(canvas);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readPalette);
resize();
player.start("upside down");
player.set({ auto: !matchMedia("(prefers-reduced-motion: reduce)").matches });
draw(Infinity);
requestAnimationFrame((now) => {
  last = now;
  frame(now);
});
/** For the console, and for tests. */
Object.assign(window, { demo: { fleet, camera, player, controls, school, frames: () => frames, ready: performance.now() } });
