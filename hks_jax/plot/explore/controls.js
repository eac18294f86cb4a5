// The state that a reader sets, and the elements that set it.
const AXES = ["x", "y", "z"];
const [nearest, farthest] = [0, times.length - 1];

const state = {
  time: Math.floor(farthest / 3),
  axis: 2,
  index: [0, 0, 0], // the index of the slice along each axis
  quantity: quantities[0],
  layer: 0,
  from: nearest,
  to: farthest,
  active: "A",
  points: { A: null, B: null },
  region: { kind: "none", nodes: null, note: "" },
};

function options(select, names) {
  select.replaceChildren(...names.map((name, i) => {
    const option = document.createElement("option");
    option.value = String(i);
    option.textContent = name;
    return option;
  }));
}

function onInput(id, act) {
  element(id).addEventListener("input", () => {
    act(element(id));
    render();
  });
}

function planeOf() {
  const [across, up] = [0, 1, 2].filter((a) => a !== state.axis);
  return { axis: state.axis, across, up, index: state.index[state.axis] };
}

const REGIONS = ["none", "a lasso on an image", "points similar to A"];

function setUp() {
  const named = (axis) => AXES[axisOfVolume(axis)];
  element("title").textContent = about.title;
  element("facts").textContent = about.facts.map(([name, value]) => `${name}: ${value}`).join(" · ");
  element("software").textContent = about.software;
  element("reading").textContent = isFlat && about.fick
    ? `${power}·HKS of Fick's operator div(D∇u) is 1 where D is constant and no boundary is near. At small t it is above 1 ` +
      "where less can flow away than with the local D, and below 1 where more can. Neumann (natural) boundaries raise it nearby. " +
      "At large t heat is uniform in space; HKS / mean then shows the differences."
    : isFlat
    ? `${power}·HKS is 1 where space is flat and no boundary is near. At small t it is above 1 where the curvature is positive, ` +
      "below 1 where it is negative. Neumann (natural) boundaries raise it nearby, up to twofold along a straight side. " +
      "Dirichlet boundaries lower it to 0. The mean of both cancels the effect of a straight boundary of a flat domain, but not that of its bends and " +
      "corners: beside a round boundary it is above 1. At large t every node feels the boundary, and it grows everywhere because heat has filled " +
      "the domain; then it shows the domain's shape and not curvature."
    : "This signature is normalised, so only its differences between places are meaningful.";
  element("time").max = element("from").max = element("to").max = farthest;
  element("time").value = state.time;
  element("to").value = farthest;
  element("from").value = nearest;
  for (const id of ["time", "from", "to"]) element(id).disabled = farthest === 0;
  for (const row of document.querySelectorAll(".volume")) row.hidden = dimension === 2;
  for (const row of document.querySelectorAll(".surface")) row.hidden = !surface;
  for (const row of document.querySelectorAll(".noise")) row.hidden = !deviations;
  for (const row of document.querySelectorAll(".fades")) row.hidden = !scores;
  for (const row of document.querySelectorAll(".rim")) row.hidden = !near;
  for (const row of document.querySelectorAll(".anatomy")) row.hidden = !anatomy;
  options(element("plane"), AXES.map((_, a) => `across ${named(a)} (${[0, 1, 2].filter((b) => b !== a).map(named).join(", ")})`));
  options(element("quantity"), quantities.map((q) => q.name));
  options(element("layer-name"), layers.map((layer) => layer.name));
  options(element("region"), [...REGIONS, ...about.labels.map(([, name]) => name)]);
  element("quantity").value = quantities.indexOf(state.quantity);
  element("plane").value = state.axis;
  element("layer-figure").hidden = layers.length === 0;
  element("directions").hidden = !layers.some((layer) => layer.kind === "direction");

  onInput("time", (input) => (state.time = Number(input.value)));
  onInput("slice", (input) => (state.index[state.axis] = Number(input.value)));
  onInput("plane", (input) => {
    state.axis = Number(input.value);
    if (state.points.A) state.index[state.axis] = state.points.A[state.axis];
  });
  for (const id of ["turn", "tilt"]) {
    onInput(id, () => setView(Number(element("turn").value), Number(element("tilt").value)));
  }
  onInput("quantity", (input) => (state.quantity = quantities[input.value]));
  onInput("contrast", () => {});
  onInput("same", () => {});
  onInput("rim", () => {});
  onInput("fade", () => {});
  onInput("opacity", () => {});
  onInput("layer-name", (input) => (state.layer = Number(input.value)));
  onInput("from", (input) => setSpan(Number(input.value), Math.max(Number(input.value), state.to)));
  onInput("to", (input) => setSpan(Math.min(Number(input.value), state.from), Number(input.value)));
  onInput("region", (input) => setRegion(Number(input.value)));
  onInput("alike", () => takeAlike());
  for (const radio of document.querySelectorAll("input[name=active]")) {
    radio.addEventListener("input", () => {
      state.active = radio.value;
      if (!state.points[state.active]) setPoint(state.active, state.points.A);
      render();
    });
  }
  element("clear").addEventListener("click", () => {
    state.points.B = null;
    setActive("A");
    render();
  });
  element("save").addEventListener("click", save);
}

function setActive(name) {
  state.active = name;
  for (const radio of document.querySelectorAll("input[name=active]")) radio.checked = radio.value === name;
}

function setSpan(from, to) {
  [state.from, state.to] = [from, to];
  [element("from").value, element("to").value] = [from, to];
  measure();
}

function setPoint(name, place) {
  if (nodeAt(place) < 0) return;
  state.points[name] = [...place];
  if (name === "A") measure();
}

// The next inside node from a position in steps along one axis, or null if there is none.
function stepFrom(place, axis, step) {
  const next = [...place];
  let last = null;
  for (let left = Math.abs(step); left > 0; ) {
    next[axis] += Math.sign(step);
    if (next[axis] < 0 || next[axis] >= shape[axis]) break;
    if (nodeAt(next) < 0) continue;
    last = [...next];
    left--;
  }
  return last;
}

// Steps along the edges of a surface that lead in this direction on the screen.
function walk(place, [axis, step]) {
  let node = place[0];
  const [right, up] = axis === 0 ? [Math.sign(step), 0] : [0, Math.sign(step)];
  for (let i = 0; i < Math.abs(step); i++) node = neighbourTowards(node, right, up) ?? node;
  return [node, 0, 0];
}

function onKey(event) {
  const { axis, across, up } = planeOf();
  const size = event.shiftKey ? 5 : 1;
  const right = surface ? size : size * (images.signature.across(1) - images.signature.across(0));
  const steps = {
    ArrowLeft: [across, -right], ArrowRight: [across, right], ArrowDown: [up, -size], ArrowUp: [up, size],
    ...(dimension === 3 ? { PageDown: [axis, -size], PageUp: [axis, size] } : {}),
  };
  const step = steps[event.key];
  if (!step || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  const from = state.points[state.active];
  const place = surface ? walk(from, step) : stepFrom(from, ...step);
  if (!place) return;
  setPoint(state.active, place);
  state.index = [...place];
  render();
}

function setRegion(choice) {
  const label = about.labels[choice - REGIONS.length];
  state.region = { kind: ["none", "lasso", "alike"][choice] ?? "label", nodes: null, note: "" };
  if (label) take(nodesWhere((n) => labels[n] === label[0]), label[1]);
  if (state.region.kind === "alike") takeAlike();
}

function takeAlike() {
  if (state.region.kind !== "alike") return;
  const most = alikeLimit();
  take(nodesWhere((n) => apart[n] <= most), `at most ${number(most)} from A`);
}

function take(nodes, note) {
  const chosen = new Uint8Array(count);
  for (const n of nodes) chosen[n] = 1;
  state.region = { kind: state.region.kind, nodes: nodes.length ? nodes : null, chosen, note };
}
