// The drawing depends only on the state. Every change of the state redraws everything, at most once per frame.
let apart = new Float64Array(count); // the distance of each node from A
let farApart = 1; // a high quantile of these distances

function measure() {
  apart = distances(nodeAt(state.points.A), state.from, state.to);
  [farApart] = quantiles(count, (n) => apart[n], [0.98]);
  takeAlike();
}

// The slider is quadratic in the distance, because small distances matter most.
const alikeLimit = () => (element("alike").value / 100) ** 2 * (farApart || 1);

const spreads = new Map(); // the range of the colours at each time, by quantity

function spreadAt(t) {
  const { quantity } = state;
  if (!spreads.has(quantity)) spreads.set(quantity, []);
  return (spreads.get(quantity)[t] ??= quantiles(
    count,
    (n) => {
      const v = valueOf(quantity, t, n);
      return quantity.centre === null ? v : Math.abs(v - quantity.centre);
    },
    quantity.centre === null ? [0.02, 0.98] : [0.9, 0.9],
  ));
}

function signatureScale() {
  const { quantity } = state;
  const spans = element("same").checked ? times.map((_, t) => spreadAt(t)) : [spreadAt(state.time)];
  const stretch = 2 ** -element("contrast").value;
  if (quantity.centre !== null) {
    const halves = spans.map(([half]) => half).sort((a, b) => a - b);
    // Signatures are positive, so the colours reach from 0 to 2 at most, with any contrast.
    const half = Math.max(Math.min(halves[halves.length >> 1] * stretch, quantity.centre), 1e-6);
    return scaleOf("diverging", quantity.centre - half, quantity.centre + half);
  }
  const [low, high] = [Math.min(...spans.map((s) => s[0])), Math.max(...spans.map((s) => s[1]))];
  const [middle, half] = [(low + high) / 2, ((high - low) / 2) * stretch];
  return scaleOf("sequential", Math.max(low >= 0 ? 0 : -Infinity, middle - half), middle + half);
}

const byScale = (scale, numberAt) => (node, rgb) => {
  const value = numberAt(node);
  if (!Number.isFinite(value)) {
    rgb.fill(128);
    return;
  }
  const e = entry((value - scale.low) / (scale.high - scale.low));
  [rgb[0], rgb[1], rgb[2]] = [scale.table[e], scale.table[e + 1], scale.table[e + 2]];
};

// Values within the noise of those of constant tensors fade to grey. The smaller |z|, the greyer.
function faded(colour) {
  const limit = Number(element("fade").value);
  return (node, rgb) => {
    colour(node, rgb);
    const grey = 1 - Math.abs(scores[state.time * count + node]) / limit;
    if (grey > 0) for (let c = 0; c < 3; c++) rgb[c] += grey * (204 - rgb[c]);
  };
}

// Whether the boundary contributes over a tenth at a node and a time, if hatching is on.
const hatchedAt = (t) => (near && element("rim").checked ? (node) => near[t * count + node] === 1 : null);

const signatureAt = (node) => valueOf(state.quantity, state.time, node);

function signatureText(node) {
  const text = number(signatureAt(node));
  const [noise] = deviations ? curve(node, state.quantity, deviations).slice(state.time) : [];
  return noise >= 0 ? `${text} ± ${number(noise)}` : text;
}

const NODE = surface ? "vertex" : "node";
const images = {};
for (const id of ["signature", "distance", "layer"]) {
  images[id] = new (surface ? SurfaceImage : SliceImage)(element(id), {
    pick(place, second) {
      if (nodeAt(place) < 0) return;
      if (second) setActive("B");
      setPoint(state.active, place);
      render();
    },
    hover(place) {
      showHover(place);
    },
    lassoing: () => state.region.kind === "lasso",
    lasso(polygon, plane) {
      if (surface) take(verticesInPolygon(polygon), "lasso");
      else take(nodesInPolygon(polygon, plane), dimension === 3 ? `lasso, slice ${sliceText(plane)}` : "lasso");
      render();
    },
    redraw: () => render(),
  });
  element(id).addEventListener("keydown", onKey);
}
const chart = new Chart(element("chart"), element("legend"), (t) => {
  state.time = t;
  element("time").value = t;
  render();
});

function planePlace(plane) {
  const place = [0, 0, 0];
  place[plane.axis] = plane.index;
  return place;
}

function sliceText(plane) {
  const axis = axisOfVolume(plane.axis);
  return `${AXES[axis]} = ${voxel(planePlace(plane))[axis]}`;
}

function layerText(layer, node) {
  if (layer.kind !== "direction") return number(layer.values[node]);
  const vector = [0, 1, 2].slice(0, dimension).map((a) => layer.values[3 * node + a]);
  const length = Math.hypot(...vector); // the anisotropy, for colours
  return length ? vector.map((x) => (x / length).toFixed(2)).join(", ").replaceAll("-", "−") : "—";
}

function showHover(place) {
  const node = place ? nodeAt(place) : -1;
  const texts = node < 0 ? [] : [`${NODE} ${voxel(place).join(", ")}`, `${state.quantity.name} ${signatureText(node)}`, `distance ${number(apart[node], farApart)}`];
  if (node >= 0 && layers.length) texts.push(`${layers[state.layer].name} ${layerText(layers[state.layer], node)}`);
  element("hover").textContent = texts.join("   ·   ");
}

function drawImages() {
  const plane = planeOf();
  const { points, region, quantity } = state;
  const shared = { points, chosen: region.nodes && region.chosen };
  for (const image of Object.values(images)) if (image.canvas.offsetParent) image.lay(plane);

  const scale = signatureScale();
  const coloured = byScale(scale, signatureAt);
  images.signature.draw(scores ? faded(coloured) : coloured, { ...shared, hatched: hatchedAt(state.time) });
  showBar(element("signature-bar"), scale, quantity.centre);
  element("signature-name").textContent = `${quantity.name} at t = ${timeText(state.time)}`;

  const far = scaleOf("distance", 0, farApart);
  // Curves whose last time feels the boundary differ by the boundary.
  images.distance.draw(byScale(far, (node) => apart[node]), { ...shared, hatched: hatchedAt(state.to) });
  showBar(element("distance-bar"), far);
  element("distance-name").textContent = "A";

  if (layers.length) drawLayer(layers[state.layer], shared);
  const touch = region.kind === "lasso" ? "none" : "";
  for (const [id, image] of Object.entries(images)) {
    image.canvas.style.touchAction = touch;
    const what = { signature: quantity.long, distance: "Distance from A", layer: layers.length ? layers[state.layer].name : "" }[id];
    image.canvas.setAttribute("aria-label", `${what}. Arrow keys move point ${state.active}.`);
  }
}

function drawLayer(layer, shared) {
  const bar = element("layer-bar");
  if (layer.kind === "direction") {
    const colour = (node, rgb) => {
      for (let a = 0; a < 3; a++) rgb[a] = Math.min(255, 25 + 330 * Math.abs(layer.values[3 * node + a]));
    };
    images.layer.draw(colour, { ...shared, sticks: layer.values, opaque: true });
    const along = (a) => (about.ends ? [...about.ends[a]].join("–") : AXES[a]);
    bar.textContent = ["red", "green", "blue"].slice(0, dimension).map((name, a) => `${name}: along ${along(a)}`).join(", ");
  } else {
    layer.span ??= quantiles(count, (n) => layer.values[n], [0.01, 0.98]);
    const scale = scaleOf("grey", ...layer.span);
    images.layer.draw(byScale(scale, (node) => layer.values[node]), { ...shared, opaque: true });
    showBar(bar, scale);
  }
}

const band = (line, spread) => ({ low: line.map((m, t) => m - spread[t]), high: line.map((m, t) => m + spread[t]), spread });

function seriesShown() {
  const { quantity, points, region } = state;
  const all = meansOf(quantity);
  const shown = [{ name: "mean", note: "all points", colour: "--mean", line: all, thin: true }];
  if (region.nodes) {
    if (region.quantity !== quantity) Object.assign(region, { quantity, found: statistics(region.nodes, quantity) });
    const { found } = region;
    const [line, spread] = [found.map((s) => s.mean), found.map((s) => s.deviation)];
    shown.push({ name: "region", note: `${region.note}; mean ± standard deviation`, colour: "--region", line, ...band(line, spread) });
  }
  for (const [name, place] of Object.entries(points)) {
    if (!place) continue;
    const line = curve(nodeAt(place), quantity);
    const noise = deviations ? band(line, curve(nodeAt(place), quantity, deviations)) : {};
    const note = `${NODE} ${voxel(place).join(", ")}${deviations ? "; ± noise" : ""}`;
    const dashes = name === "B" ? "8 4" : null;
    const pale = times.map((_, t) => hatchedAt(t)?.(nodeAt(place)) ?? false);
    shown.push({ name, note, colour: `--${name.toLowerCase()}`, dashes, line, pale, ...noise });
  }
  return shown;
}

function save() {
  const q = state.quantity.name;
  const columns = seriesShown().flatMap((one) => {
    if (one.name !== "region") {
      const noise = one.spread ? [[`${q} ${one.name} standard deviation by noise`, one.spread]] : [];
      return [[`${q} ${one.name}${one.note ? `: ${one.note}` : ""}`, one.line], ...noise];
    }
    const [lower, median, upper] = quartiles(state.region.nodes, state.quantity);
    const size = [`points in region: ${state.region.note}`, times.map(() => state.region.nodes.length)];
    return [
      size, [`${q} region mean`, one.line], [`${q} region standard deviation`, one.spread],
      [`${q} region lower quartile`, lower], [`${q} region median`, median], [`${q} region upper quartile`, upper],
    ];
  });
  download(csv(columns), "hks-curves.csv");
}

// The largest coordinate, which determines the number of digits.
const reach = surface
  ? surface.vertices.reduce((most, x) => Math.max(most, Math.abs(x)), 0)
  : Math.max(...[[0, 0, 0], shape.map((n) => n - 1)].flatMap((corner) => position(corner).map(Math.abs)));

function showPoints() {
  const names = ["A", "B"].filter((name) => state.points[name]);
  const rows = [["", ...names], [NODE, ...names.map((name) => voxel(state.points[name]).join(", "))]];
  rows.push([withUnit("position", about.lengthUnit && `in ${about.lengthUnit}`), ...names.map((name) => position(state.points[name]).map((x) => number(x, reach)).join(", "))]);
  const nodes = names.map((name) => nodeAt(state.points[name]));
  rows.push([`${state.quantity.name} at t`, ...nodes.map(signatureText)]);
  for (const layer of layers) rows.push([layer.name, ...nodes.map((n) => layerText(layer, n))]);
  element("points").replaceChildren(...rows.map((cells, r) => {
    const row = document.createElement("tr");
    row.append(...cells.map((text, c) => {
      const cell = document.createElement(r === 0 || c === 0 ? "th" : "td");
      cell.scope = r === 0 ? "col" : "row";
      if (r && c) cell.removeAttribute("scope");
      cell.textContent = text;
      if (r === 0 && c) cell.style.color = `var(--${text.toLowerCase()})`;
      return cell;
    }));
    return row;
  }));
  const both = nodes.length === 2;
  element("clear").disabled = !both;
  element("apart").textContent = both ? `Distance between A and B: ${number(apart[nodes[1]], farApart)}` : "";
  const active = state.points[state.active];
  element("status").textContent = `Point ${state.active} at ${NODE} ${voxel(active).join(", ")}: ${state.quantity.name} ${number(signatureAt(nodeAt(active)))}, distance ${number(apart[nodeAt(active)], farApart)}`;
}

// The share of the nodes that feel the boundary at each time.
const shares = times.map((_, t) => (near ? near.subarray(t * count, (t + 1) * count).reduce((sum, one) => sum + one, 0) / count : 0));

function showControls() {
  const { axis, index } = planeOf();
  const felt = shares[state.time];
  element("time-text").textContent = `t = ${timeText(state.time)}${spreadText(state.time)}`;
  element("rim-text").textContent = `hatch the boundary (${Math.round(100 * felt)} %)`;
  element("fade-text").textContent = `|z| = ${element("fade").value}`;
  element("time").setAttribute("aria-valuetext", element("time-text").textContent);
  element("slice").max = shape[axis] - 1;
  element("slice").value = index;
  element("slice-text").textContent = sliceText(planeOf());
  element("slice").setAttribute("aria-valuetext", element("slice-text").textContent);
  for (const id of ["from", "to"]) {
    element(`${id}-text`).textContent = timeText(state[id]);
    element(id).setAttribute("aria-valuetext", timeText(state[id]));
  }
  const { kind, nodes } = state.region;
  element("alike-row").hidden = kind !== "alike";
  element("alike-text").textContent = number(alikeLimit());
  element("alike").setAttribute("aria-valuetext", number(alikeLimit()));
  const empty = kind === "lasso" ? "Draw around points on an image." : kind === "none" ? "" : "No points.";
  element("region-text").textContent = nodes ? `${nodes.length} of ${count} points (${((100 * nodes.length) / count).toFixed(1)} %)` : empty;
}

function renderNow() {
  waiting = false;
  showControls();
  drawImages();
  showPoints();
  const { quantity, time, from, to } = state;
  element("chart-name").textContent = quantity.long;
  chart.draw(seriesShown(), { quantity, now: time, from, to });
}

let waiting = false;

function render() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(renderNow);
}

state.points.A = surface ? [frontVertex(), 0, 0] : [...about.start, 0].slice(0, 3);
state.index = [...state.points.A];
// If most of the domain is far above 1, as in small volumes, all of it would have one colour.
const typical = () => quantiles(count, (n) => valueOf(quantities[0], state.time, n), [0.5])[0];
if (isFlat && typical() > 2) state.quantity = relative;
setUp();
measure();
renderNow();
document.querySelector("main").removeAttribute("aria-busy");
new ResizeObserver(render).observe(document.body);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", render);
