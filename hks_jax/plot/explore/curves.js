// A chart of the signature over t, with lines and bands on a logarithmic axis of t.
const SVG = "http://www.w3.org/2000/svg";

function shapeOf(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

function ticksOfLogarithm(low, high, most) {
  const all = [];
  for (let e = Math.floor(Math.log10(low)) - 1; e <= Math.ceil(Math.log10(high)); e++) {
    for (const m of [1, 2, 5]) all.push({ m, x: m * 10 ** e });
  }
  const seen = all.filter(({ x }) => x >= low * 0.999 && x <= high * 1.001);
  for (const kept of [[1, 2, 5], [1, 5], [1]]) {
    const found = seen.filter(({ m }) => kept.includes(m));
    if (found.length <= most && found.length > 0) return found.map(({ x }) => x);
  }
  const tens = seen.filter(({ m }) => m === 1);
  const every = Math.ceil(tens.length / most);
  return (tens.length ? tens.filter((_, i) => i % every === 0) : seen).map(({ x }) => x);
}

function ticksOfNumbers(low, high, most) {
  const rough = (high - low) / most;
  const ten = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * ten).find((s) => s >= rough);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high * (1 + 1e-12) + 1e-12 * step; i++) found.push(i * step);
  return found;
}

const PALE = 0.35;

// The path along those segments, from the point t to the point t + 1, for which chosen(t) holds.
function strokes(points, chosen) {
  let d = "";
  for (let t = 0; t + 1 < points.length; t++) {
    if (chosen(t)) d += `${t && chosen(t - 1) ? "" : `M${points[t]}`}L${points[t + 1]}`;
  }
  return d;
}

class Chart {
  constructor(svg, legend, choose) {
    this.svg = svg;
    this.legend = legend;
    const pick = (event) => {
      const x = event.clientX - svg.getBoundingClientRect().left;
      const apart = times.map((_, t) => Math.abs(this.x(t) - x));
      choose(apart.indexOf(Math.min(...apart)));
    };
    svg.addEventListener("pointerdown", pick);
    svg.addEventListener("pointermove", (event) => event.buttons & 1 && pick(event));
  }

  x(t) {
    return this.left + (this.right - this.left) * this.fraction(times[t]);
  }

  fraction(time) {
    const [first, last] = [times[0], times[times.length - 1]];
    return first === last ? 0.5 : Math.log(time / first) / Math.log(last / first);
  }

  // A series is {name, colour, line, low, high, thin, pale}, with `line`, the bounds of a band, and `pale` (whether the
  // boundary contributes over a tenth) at each time.
  draw(series, { quantity, now, from, to }) {
    const width = this.svg.clientWidth || 500;
    const height = this.svg.clientHeight || 320;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const all = series.flatMap((one) => [...one.line, ...(one.low ?? []), ...(one.high ?? [])]).filter(Number.isFinite);
    let [low, high] = [Math.min(...all), Math.max(...all)];
    const log = low > 0 && (Boolean(quantity.log) || high > 6 * low);
    if (log) [low, high] = [low / 1.1, high * 1.1];
    else {
      if (quantity.centre !== null) [low, high] = [Math.min(low, quantity.centre), Math.max(high, quantity.centre)];
      const margin = 0.06 * (high - low) || 0.1 * (Math.abs(high) || 1);
      [low, high] = [low - margin, high + margin];
    }
    const scaled = (v) => (log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low));
    [this.left, this.right, this.top, this.bottom] = [58, width - 14, 10, height - 40];
    const y = (v) => this.bottom - (this.bottom - this.top) * scaled(v);
    const parts = [];
    const shade = (x0, x1) =>
      x1 > x0 && parts.push(shapeOf("rect", { class: "outside", x: x0, y: this.top, width: x1 - x0, height: this.bottom - this.top }));
    shade(this.left, this.x(from));
    shade(this.x(to), this.right);
    for (const tick of log ? ticksOfLogarithm(low, high, 7) : ticksOfNumbers(low, high, 6)) {
      parts.push(shapeOf("line", { class: "grid", x1: this.left, x2: this.right, y1: y(tick), y2: y(tick) }));
      parts.push(shapeOf("text", { x: this.left - 6, y: y(tick) + 4, "text-anchor": "end" }, tickText(tick, log ? tick : Math.max(Math.abs(low), Math.abs(high)))));
    }
    for (const tick of ticksOfLogarithm(times[0], times[times.length - 1], Math.max(2, Math.floor(width / 90)))) {
      const x = this.left + (this.right - this.left) * this.fraction(tick);
      parts.push(shapeOf("line", { class: "grid", x1: x, x2: x, y1: this.top, y2: this.bottom }));
      parts.push(shapeOf("text", { x, y: this.bottom + 17, "text-anchor": "middle" }, tickText(tick)));
    }
    const label = withUnit("t", about.unit && `in ${about.unit}`);
    parts.push(shapeOf("text", { x: (this.left + this.right) / 2, y: height - 5, "text-anchor": "middle" }, label));
    const path = (line) => line.map((v, t) => `${this.x(t).toFixed(1)},${y(v).toFixed(1)}`);
    for (const one of series) {
      if (!one.low) continue;
      const bottom = one.low.map((v) => (log ? Math.max(v, low) : v));
      const points = [...path(one.high), ...path(bottom).reverse()].join(" ");
      parts.push(shapeOf("polygon", { points, style: `fill: var(${one.colour}); opacity: 0.18` }));
    }
    for (const one of series) {
      const drawn = `fill: none; stroke: var(${one.colour}); stroke-width: ${one.thin ? 1.6 : 2.4}; stroke-linejoin: round; stroke-dasharray: ${one.dashes ?? "none"}`;
      for (const faint of [false, true]) {
        const d = strokes(path(one.line), (t) => Boolean(one.pale?.[t] || one.pale?.[t + 1]) === faint);
        if (d) parts.push(shapeOf("path", { d, style: drawn, opacity: faint ? PALE : 1, "data-name": one.name }));
      }
      const dot = `fill: var(${one.colour})`;
      parts.push(shapeOf("circle", { cx: this.x(now), cy: y(one.line[now]), r: 3.5, style: dot }));
    }
    parts.push(shapeOf("line", { class: "now", x1: this.x(now), x2: this.x(now), y1: this.top, y2: this.bottom }));
    this.svg.replaceChildren(...parts);
    this.svg.setAttribute("aria-label", `${quantity.long} over t: ${series.map((one) => one.name).join(", ")}`);
    const faint = series.some((one) => one.pale?.includes(true));
    const note = { name: "pale: the boundary contributes over 10 %", colour: "--mean", opacity: PALE };
    this.legend.replaceChildren(...[...series, ...(faint ? [note] : [])].map((one) => this.entry(one)));
  }

  entry(one) {
    const item = document.createElement("li");
    const mark = document.createElement("i");
    mark.style.borderTop = `0.2rem ${one.dashes ? "dashed" : "solid"} var(${one.colour})`;
    mark.style.opacity = one.opacity ?? 1;
    item.append(mark, one.note ? `${one.name} (${one.note})` : one.name);
    return item;
  }
}
