/**
 * A perceptron with tanh or ReLU, the deterministic policy of an agent.
 *
 * @typedef {object} Layer
 * @property {number} inputs
 * @property {number} outputs
 * @property {string} activation tanh, relu or none
 * @property {Float32Array} weight row by row
 * @property {Float32Array} bias
 */

/** The output of a network, in place of nothing: a fresh array. @param {Layer[]} layers @param {Float32Array} input */
export function forward(layers, input) {
  let x = input;
  for (const { inputs, outputs, activation, weight, bias } of layers) {
    const y = new Float32Array(outputs);
    for (let row = 0, at = 0; row < outputs; row++) {
      let a = 0, b = 0; // two sums, since one would wait for itself
      for (const end = at + inputs - 1, start = at; at < end; at += 2) {
        a += weight[at] * x[at - start];
        b += weight[at + 1] * x[at - start + 1];
      }
      if (inputs % 2) a += weight[at] * x[inputs - 1], at++;
      const sum = a + b + bias[row];
      y[row] = activation === "tanh" ? Math.tanh(sum) : activation === "relu" && sum < 0 ? 0 : sum;
    }
    x = y;
  }
  return x;
}

/** Numbers of half precision as float32. @param {Uint16Array} halves */
export function fromHalf(halves) {
  return Float32Array.from(halves, (bits) => {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023;
    const size = exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : (fraction / 1024) * 2 ** -14;
    return bits & 0x8000 ? -size : size;
  });
}

/**
 * The layers of a flat array of weights and biases, layer by layer.
 * @param {Float32Array} numbers
 * @param {{inputs: number, outputs: number, activation: string}[]} shapes
 * @returns {Layer[]}
 */
export function layersOf(numbers, shapes) {
  let at = 0;
  const take = (/** @type {number} */ count) => numbers.subarray(at, (at += count));
  return shapes.map((shape) => ({ ...shape, weight: take(shape.inputs * shape.outputs), bias: take(shape.outputs) }));
}
