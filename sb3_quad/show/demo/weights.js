/**
 * Networks from text in the page, and from the zips of Stable-Baselines3 that are dropped onto it.
 *
 * @typedef {import("./flight.js").Agent} Agent
 * @typedef {import("./vehicle.js").Vehicle} Vehicle
 * @typedef {{inputs: number, outputs: number, activation: string}} Shape
 */
import { fromHalf, layersOf } from "./network.js";
import { OBSERVATION_SIZE } from "./tables.js";

/** @param {Uint8Array} bytes @param {"deflate" | "deflate-raw"} format */
async function inflate(bytes, format) {
  const stream = new Blob([/** @type {BlobPart} */ (bytes)]).stream().pipeThrough(new DecompressionStream(format));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * The layers of a packed agent: base64 of deflated planes, each of one byte of every number.
 * @param {{shapes: Shape[], bits: number, weights: string}} packed
 */
export async function unpackLayers({ shapes, bits, weights }) {
  const planes = await inflate(Uint8Array.from(atob(weights), (letter) => letter.charCodeAt(0)), "deflate");
  const width = bits / 8, count = planes.length / width;
  const bytes = new Uint8Array(planes.length);
  for (let k = 0; k < planes.length; k++) bytes[(k % count) * width + Math.floor(k / count)] = planes[k];
  return layersOf(bits === 16 ? fromHalf(new Uint16Array(bytes.buffer)) : new Float32Array(bytes.buffer), shapes);
}

/**
 * The files of a zip, read when they are asked for.
 * @param {Uint8Array} bytes
 * @returns {Map<string, () => Promise<Uint8Array>>}
 */
function readZip(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const files = new Map();
  let end = bytes.length - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw new Error("this is no zip");
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const [method, packed] = [view.getUint16(at + 10, true), view.getUint32(at + 20, true)];
    const [named, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const local = view.getUint32(at + 42, true);
    const name = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + named));
    files.set(name, async () => {
      const begin = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
      const content = bytes.subarray(begin, begin + packed);
      if (method !== 0 && method !== 8) throw new Error(`${name} is compressed in a way that this page does not read`);
      return method === 8 ? inflate(content, "deflate-raw") : content;
    });
    at += 46 + named + extra + comment;
  }
  return files;
}

/**
 * The tensors that the pickle of a state_dict names: each with its storage, first number and shape. No other class is made.
 * @param {Uint8Array} bytes
 * @returns {Map<string, {storage: string, offset: number, shape: number[], dense: boolean}>}
 */
function readStateDict(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  /** @type {any[]} */ const stack = [];
  /** @type {any[]} */ const marks = [];
  /** @type {any[]} */ const memo = [];
  let at = 0;
  const line = () => new TextDecoder().decode(bytes.subarray(at, (at = bytes.indexOf(10, at) + 1) - 1));
  const number = (/** @type {number} */ size) => {
    at += size;
    return size === 1 ? view.getUint8(at - 1) : size === 2 ? view.getUint16(at - 2, true) : view.getInt32(at - 4, true);
  };
  const fromMark = () => stack.splice(marks.pop());
  const set = (/** @type {any[]} */ pairs) => {
    for (let k = 0; k < pairs.length; k += 2) stack[stack.length - 1].set?.(pairs[k], pairs[k + 1]);
  };
  /** @type {Object<string, () => void>} */
  const operations = {
    "\x80": () => number(1),
    c: () => stack.push(`${line()} ${line()}`),
    q: () => (memo[number(1)] = stack[stack.length - 1]),
    r: () => (memo[number(4)] = stack[stack.length - 1]),
    h: () => stack.push(memo[number(1)]),
    j: () => stack.push(memo[number(4)]),
    ")": () => stack.push([]),
    "}": () => stack.push(new Map()),
    "(": () => marks.push(stack.length),
    t: () => stack.push(fromMark()),
    "\x85": () => stack.push(stack.splice(-1)),
    "\x86": () => stack.push(stack.splice(-2)),
    "\x87": () => stack.push(stack.splice(-3)),
    X: () => {
      const size = number(4);
      stack.push(new TextDecoder().decode(bytes.subarray(at, (at += size))));
    },
    K: () => stack.push(number(1)),
    M: () => stack.push(number(2)),
    J: () => stack.push(number(4)),
    "\x88": () => stack.push(true),
    "\x89": () => stack.push(false),
    N: () => stack.push(null),
    Q: () => {
      const [, type, storage] = stack.pop();
      if (type !== "torch FloatStorage") throw new Error("its weights are not float32");
      stack.push(storage);
    },
    R: () => {
      const [what, given] = stack.splice(-2);
      if (what === "collections OrderedDict") stack.push(new Map());
      else if (what === "torch._utils _rebuild_tensor_v2") {
        const [storage, offset, shape, stride] = given;
        const dense = shape.every((/** @type {number} */ _, /** @type {number} */ k) => {
          const inner = shape.slice(k + 1).reduce((/** @type {number} */ a, /** @type {number} */ b) => a * b, 1);
          return stride[k] === inner || shape[k] === 1;
        });
        stack.push({ storage, offset, shape, dense });
      } else throw new Error(`its weights are pickled with ${what}, which this page does not read`);
    },
    s: () => set(stack.splice(-2)),
    u: () => set(fromMark()),
    b: () => stack.pop(), // attributes of the dictionary
  };
  for (;;) {
    const letter = String.fromCharCode(bytes[at++]);
    if (letter === ".") return stack.pop();
    const operation = operations[letter];
    if (!operation) throw new Error("its weights are pickled in a way that this page does not read");
    operation();
  }
}

/** By the module of a policy's class: where the layers of its actor are, the last one's name, and what follows it. */
const FAMILIES = {
  "stable_baselines3.common.policies": {
    ...{ hidden: "mlp_extractor.policy_net", last: "action_net", end: "none", default: "tanh" },
  },
  "stable_baselines3.sac.policies": { hidden: "actor.latent_pi", last: "actor.mu", end: "tanh", default: "relu" },
  "stable_baselines3.td3.policies": { hidden: "actor.mu", last: "", end: "tanh", default: "relu" },
};

/**
 * The agent in a zip of Stable-Baselines3, and the vehicle that it says it was trained on.
 * @param {string} label
 * @param {ArrayBuffer} content
 * @returns {Promise<{agent: Agent, vehicle: Vehicle | null}>}
 */
export async function readAgent(label, content) {
  const files = readZip(new Uint8Array(content));
  const read = async (/** @type {Map<string, () => Promise<Uint8Array>>} */ from, /** @type {string} */ name) => {
    const file = from.get(name);
    if (!file) throw new Error(`it is no zip of Stable-Baselines3: ${name} is missing`);
    return file();
  };
  const data = JSON.parse(new TextDecoder().decode(await read(files, "data")));
  const module = data.policy_class?.__module__;
  const family = FAMILIES[/** @type {keyof typeof FAMILIES} */ (module)];
  if (!family) throw new Error(`its policy is of ${module}; this page flies MlpPolicy of PPO, A2C, SAC and TD3`);
  const activation = /'torch\.nn\.modules\.activation\.(\w+)'/.exec(data.policy_kwargs?.activation_fn ?? "");
  const inner = activation ? activation[1].toLowerCase() : family.default;
  if (inner !== "tanh" && inner !== "relu") throw new Error(`its layers are followed by ${inner}, not tanh or ReLU`);

  const weights = readZip((await read(files, "policy.pth")).slice());
  const root = [...weights.keys()].find((name) => name.endsWith("data.pkl"))?.slice(0, -8) ?? "";
  const tensors = readStateDict(await read(weights, `${root}data.pkl`));
  const stem = (/** @type {string} */ key) => key.replace(/\.weight$/, "");
  const keys = [...tensors.keys()].filter((key) => key.endsWith(".weight"));
  const hidden = keys.map(stem).filter((key) => key.startsWith(`${family.hidden}.`));
  hidden.sort((a, b) => Number(a.split(".").pop()) - Number(b.split(".").pop()));
  const names = family.last ? [...hidden, family.last] : hidden;
  /** @type {import("./network.js").Layer[]} */
  const layers = [];
  for (const name of names) {
    const [weight, bias] = await Promise.all([`${name}.weight`, `${name}.bias`].map(async (key) => {
      const tensor = tensors.get(key);
      if (!tensor?.dense) throw new Error(`its ${key} is not there, or not in one piece`);
      const size = tensor.shape.reduce((a, b) => a * b, 1);
      const bytes = (await read(weights, `${root}data/${tensor.storage}`)).slice();
      return { shape: tensor.shape, values: new Float32Array(bytes.buffer).subarray(tensor.offset, tensor.offset + size) };
    }));
    if (weight.shape.length !== 2 || weight.values.length !== weight.shape[0] * weight.shape[1]) {
      throw new Error(`its ${name} is no linear layer`);
    }
    const finite = [weight, bias].every(({ values }) => values.every(Number.isFinite));
    if (!finite) throw new Error(`its ${name} holds numbers that are not finite`);
    const [outputs, inputs] = weight.shape;
    const last = name === names[names.length - 1];
    const after = last ? (data.use_sde && data.policy_kwargs?.squash_output ? "tanh" : family.end) : inner;
    layers.push({ inputs, outputs, activation: after, weight: weight.values, bias: bias.values });
  }
  if (data.vec_normalize?.norm_obs) throw new Error("it was trained with VecNormalize; sb3-quad demo makes a page of it");
  const settings = data.flight_settings ?? {};
  if (settings.features && settings.features !== "body") throw new Error(`its features are those of ${settings.features}, which this page does not compute`);
  const { last_action = false, history = null, position_integral = null, preview = null } = settings;
  const size = (history ?? [0]).length * (OBSERVATION_SIZE + (last_action ? 4 : 0)) + 3 * (preview ?? []).length;
  if (!layers.length || layers[0].inputs !== size || layers[layers.length - 1].outputs !== 4) {
    const actual = layers.length ? `${layers[0].inputs} numbers and gives ${layers[layers.length - 1].outputs}` : "nothing";
    throw new Error(`its network takes ${actual}; by its settings it takes ${size}, and a quadcopter takes 4`);
  }
  const row = (/** @type {any} */ scaling) => (Array.isArray(scaling?.[0]) ? scaling[0] : scaling) ?? undefined;
  return {
    agent: {
      label,
      kind: "network",
      vehicle: settings.vehicles ? "" : settings.vehicle?.name,
      layout: settings.rotor_layout ?? settings.vehicle,
      action: settings.action,
      observation: { last_action, history, position_integral, preview },
      mean: row(settings.observation_mean),
      std: row(settings.observation_std),
      layers,
    },
    vehicle: settings.vehicle ?? null,
  };
}
