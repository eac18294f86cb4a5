// The numbers of the page, and curves, means and distances that are computed from them.
const element = (id) => document.getElementById(id);
const about = JSON.parse(element("about").textContent);

async function bytes(id) {
  const block = element(id);
  const text = atob(block.textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  block.remove(); // the text needs more memory than the numbers
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Numbers of 24 bits, the upper bits of single precision, as differences: all first bytes, all second ones, all third.
async function floats(id) {
  const planes = await bytes(id);
  const n = planes.length / 3;
  const words = new Uint32Array(n);
  for (let i = 0, last = 0; i < n; i++) {
    last += planes[i] | (planes[n + i] << 8) | (planes[2 * n + i] << 16);
    words[i] = last << 8; // which drops the bits of `last` beyond 24
    last &= 0xffffff;
  }
  return new Float32Array(words.buffer);
}

const integers = async (id) => new Int32Array((await bytes(id)).buffer);

const shape = [...about.shape, 1, 1].slice(0, 3);
const dimension = about.dimension;
const times = about.times;
const inside = await bytes("inside");
const values = await floats("values"); // for each time, at the inside nodes in the order of the grid
const density = about.density ? await floats("density") : null; // √|D| of Fick's operator
const deviations = about.noise ? await floats("deviation") : null; // the standard deviations of the values due to noise
const scores = about.fades ? await floats("z") : null; // distances from the values of constant tensors, as normal numbers
const near = about.rim === null ? null : await bytes("near"); // whether the boundary contributes over a tenth
const anatomy = about.anatomy ? await bytes("anatomy") : null; // levels of grey at all nodes of the grid; 0 where there is none
const layers = await Promise.all(about.layers.map(async (layer, i) => ({ ...layer, values: await floats(`layer-${i}`) })));
const labels = about.labels.length ? await integers("labels") : null;

// Maps between positions in the grid, flat = (i·ny + j)·nz + k, and the numbers of inside nodes.
const nodeOfPlace = new Int32Array(inside.length).fill(-1);
let count = 0;
for (let p = 0; p < inside.length; p++) if (inside[p]) nodeOfPlace[p] = count++;
const placeOfNode = new Int32Array(count);
for (let p = 0; p < inside.length; p++) if (nodeOfPlace[p] >= 0) placeOfNode[nodeOfPlace[p]] = p;

const flatOf = (place) => (place[0] * shape[1] + place[1]) * shape[2] + place[2];

function nodeAt(place) {
  for (let a = 0; a < 3; a++) if (!(place[a] >= 0 && place[a] < shape[a])) return -1;
  return nodeOfPlace[flatOf(place)];
}

function placeAt(node) {
  const p = placeOfNode[node];
  const k = p % shape[2];
  const ij = (p - k) / shape[2];
  return [Math.floor(ij / shape[1]), ij % shape[1], k];
}

// The indices of a node in the volume, or the number of a vertex in the mesh; the page has only vertices inside.
function voxel(place) {
  if (surface) return [surface.numbers[place[0]]];
  const shown = about.offset.map((o, a) => o + place[a]);
  if (!about.axes) return shown;
  const { shown: axes, first, step } = about.axes;
  return axes.map((axis, a) => first[a] + step[a] * shown[axis]);
}

// The axis of the volume that an axis of the page shows.
const axisOfVolume = (axis) => (about.axes && axis < dimension ? about.axes.shown.indexOf(axis) : axis);

function position(place) {
  if (surface) return [...surface.vertices.subarray(3 * place[0], 3 * place[0] + 3)];
  const index = voxel(place);
  if (!about.world) return index.map((i, a) => about.origin[a] + i * about.spacing[a]);
  return about.world.map((row) => index.reduce((sum, i, a) => sum + row[a] * i, row[dimension]));
}

const mean = times.map((_, t) => {
  let sum = 0;
  for (let n = t * count; n < (t + 1) * count; n++) sum += values[n];
  return sum / count;
});

// A quantity is the stored signature times a factor at each time and, for one quantity, a weight at each node.
const ones = times.map(() => 1);
const power = (dimension === 2 ? "4πt" : "(4πt)³⁄²") + (about.fick ? "√|D|" : "");
const relative = { name: "HKS / mean", long: "HKS divided by its mean at each t", factor: mean.map((m) => 1 / m), centre: 1 };
const isFlat = about.normalisation === "raw" || about.normalisation === "flat";
const quantities = isFlat
  ? [
      { name: `${power}·HKS`, long: `${power}·HKS, 1 where ${about.fick ? "D is constant" : "flat"}`, factor: ones, weights: density, centre: 1 },
      relative,
      { name: "HKS", long: "HKS", factor: about.flat.map((f) => 1 / f), centre: null, log: true },
    ]
  : [
      { name: `HKS, ${about.normalisation}`, long: `HKS, normalised by ${about.normalisation}`, factor: ones, centre: null },
      relative,
    ];

const valueOf = (quantity, t, node, of = values) => of[t * count + node] * quantity.factor[t] * (quantity.weights?.[node] ?? 1);

const curve = (node, quantity, of = values) => times.map((_, t) => valueOf(quantity, t, node, of));

// Weights of the trapezoidal rule over log t between two times, normalised to the sum 1.
function weights(from, to) {
  const w = times.map(() => 0);
  for (let t = from; t < to; t++) {
    const step = Math.log(times[t + 1] / times[t]) / 2;
    w[t] += step;
    w[t + 1] += step;
  }
  const sum = w.reduce((a, b) => a + b, 0);
  if (sum === 0) w[from] = 1;
  return sum === 0 ? w : w.map((x) => x / sum);
}

function distances(node, from, to) {
  const found = new Float64Array(count);
  weights(from, to).forEach((weight, t) => {
    if (weight === 0) return;
    const own = values[t * count + node];
    const scale = weight / mean[t] ** 2;
    for (let n = 0; n < count; n++) found[n] += scale * (values[t * count + n] - own) ** 2;
  });
  return found.map(Math.sqrt);
}

// The means of a quantity over all nodes.
const meansOf = (quantity) => (quantity.means ??= quantity.weights
  ? statistics([...Array(count).keys()], quantity).map((s) => s.mean)
  : mean.map((m, t) => m * quantity.factor[t]));

// The mean and the standard deviation over some nodes at each time.
function statistics(nodes, quantity) {
  return times.map((_, t) => {
    let sum = 0;
    for (const n of nodes) sum += valueOf(quantity, t, n);
    const average = sum / nodes.length;
    let squares = 0;
    for (const n of nodes) squares += (valueOf(quantity, t, n) - average) ** 2;
    return { mean: average, deviation: Math.sqrt(squares / nodes.length) };
  });
}

// The three quartiles over some nodes at each time.
function quartiles(nodes, quantity) {
  const sorted = times.map((_, t) => Float64Array.from(nodes, (n) => valueOf(quantity, t, n)).sort());
  return [0.25, 0.5, 0.75].map((q) => sorted.map((sample) => sample[Math.round(q * (nodes.length - 1))]));
}

// Quantiles of numbers or, if there are many, of a sample.
function quantiles(count, numberAt, wanted) {
  const stride = Math.max(1, Math.floor(count / 20000));
  const sample = new Float64Array(Math.ceil(count / stride));
  for (let i = 0; i < sample.length; i++) sample[i] = numberAt(i * stride);
  const finite = sample.filter(Number.isFinite).sort();
  if (finite.length === 0) return wanted.map(() => 0);
  return wanted.map((q) => finite[Math.round(q * (finite.length - 1))]);
}
