/**
 * Gestures of a pointer: throw or push vehicles, draw a path, drag the target, turn the camera, zoom.
 *
 * @typedef {import("./camera.js").Camera} Camera
 *
 * @typedef {object} Holdable something in the picture
 * @property {"vehicle" | "target"} kind
 * @property {number} index of the vehicle
 * @property {number[]} position m, its lane included
 *
 * @typedef {object} Gestures
 * @property {() => Holdable[]} things
 * @property {"throw" | "push" | "draw"} tool what dragging a vehicle does, or anywhere draws
 * @property {(index: number) => void} grab
 * @property {(way: number[], velocity: number[]) => void} carry way from where it was grabbed, m; m/s
 * @property {(velocity: number[]) => void} release
 * @property {(way: number[] | null) => void} push an arrow from the vehicle, m; null: no longer
 * @property {(x: number, y: number, begins: boolean) => void} draw a place in the picture, pixels
 * @property {() => void} drawn the path ends
 * @property {(way: number[] | null) => void} target way from where it was, m; null: the drag begins
 */

import { STEEPEST } from "./camera.js";

const REACH = { mouse: 34, touch: 46 }; // pixels
const FLICK = 0.09; // s before the release that make the velocity

/** @param {HTMLCanvasElement} canvas @param {Camera} camera @param {Gestures} gestures */
export function listen(canvas, camera, gestures) {
  /** @type {Map<number, {x: number, y: number}>} */
  const pointers = new Map();
  /** @type {{kind: string, index: number, depth: number, x: number, y: number, samples: number[][]} | null} */
  let held = null;

  /** @param {PointerEvent} event */
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  };

  /** What is nearest to a pointer, within reach. @param {{x: number, y: number}} at @param {number} reach */
  const find = (at, reach) => {
    let best = null, least = reach;
    for (const thing of gestures.things()) {
      const [x, y, depth] = camera.project(thing.position);
      const behind = thing.kind === "target" ? 6 : 0; // a vehicle at its target is taken first
      const away = Math.hypot(x - at.x, y - at.y) + behind;
      if (depth > 0.3 && away < least) [best, least] = [{ ...thing, depth }, away];
    }
    return best;
  };

  /** The velocity of what is held, m/s. @param {PointerEvent} event the latest one */
  const velocity = (event) => {
    const samples = held?.samples ?? [];
    const now = event.timeStamp / 1000, last = samples[samples.length - 1];
    if (!held || samples.length < 2 || now - last[0] > FLICK) return [0, 0, 0];
    const first = samples.slice(0, -1).find(([time]) => last[0] - time < FLICK) ?? samples[samples.length - 2];
    const way = camera.way(last[1] - first[1], last[2] - first[2], held.depth);
    return way.map((each) => each / Math.max(last[0] - first[0], 0.016));
  };

  canvas.addEventListener("pointerdown", (event) => {
    const at = place(event);
    pointers.set(event.pointerId, at);
    canvas.setPointerCapture(event.pointerId);
    if (pointers.size > 1) {
      if (held) finish(event);
      return;
    }
    const thing = find(at, event.pointerType === "mouse" ? REACH.mouse : REACH.touch);
    const isPush = gestures.tool === "push" || event.button === 2 || event.shiftKey;
    const kind = gestures.tool === "draw" ? "draw" : !thing ? "camera" : thing.kind === "target" ? "target" : isPush ? "push" : "throw";
    const { index, depth } = thing ?? { index: 0, depth: 1 };
    held = { kind, index, depth, ...at, samples: [[event.timeStamp / 1000, at.x, at.y]] };
    if (kind === "throw") gestures.grab(held.index);
    if (kind === "target") gestures.target(null);
    if (kind === "draw") gestures.draw(at.x, at.y, true);
    canvas.dataset.hand = kind;
  });

  canvas.addEventListener("pointermove", (event) => {
    const at = place(event), before = pointers.get(event.pointerId);
    if (!before) {
      const thing = find(at, REACH.mouse);
      canvas.dataset.hand = thing ? `over-${thing.kind}` : "";
      return;
    }
    if (pointers.size === 2) {
      const spread = () => {
        const [a, b] = [...pointers.values()];
        return Math.hypot(a.x - b.x, a.y - b.y);
      };
      const apart = spread();
      pointers.set(event.pointerId, at);
      zoom(spread() / Math.max(apart, 1));
      return;
    }
    pointers.set(event.pointerId, at);
    if (!held) return;
    held.samples.push([event.timeStamp / 1000, at.x, at.y]);
    if (held.samples.length > 60) held.samples.shift();
    const way = camera.way(at.x - held.x, at.y - held.y, held.depth);
    if (held.kind === "throw") gestures.carry(way, velocity(event));
    else if (held.kind === "draw") gestures.draw(at.x, at.y, false);
    else if (held.kind === "push") gestures.push(way);
    else if (held.kind === "target") gestures.target(way);
    else {
      camera.yaw -= (at.x - before.x) * 0.006;
      camera.pitch = Math.min(STEEPEST, Math.max(-0.2, camera.pitch + (at.y - before.y) * 0.005));
    }
  });

  const finish = (/** @type {PointerEvent} */ event) => {
    if (held?.kind === "throw") gestures.release(velocity(event));
    if (held?.kind === "push") gestures.push(null);
    if (held?.kind === "draw") gestures.drawn();
    held = null;
    canvas.dataset.hand = "";
  };
  for (const name of /** @type {const} */ (["pointerup", "pointercancel"])) {
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      if (held) finish(event);
    });
  }
  const zoom = (/** @type {number} */ factor) => (camera.zoom = Math.min(4, Math.max(0.3, camera.zoom * factor)));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.001));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  return { isHolding: () => held !== null && held.kind !== "camera" };
}
