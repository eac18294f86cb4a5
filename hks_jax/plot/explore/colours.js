// Colour tables with 256 entries, colour bars, and numbers as text.
const tables = Object.fromEntries(
  Object.entries(about.colours).map(([name, text]) => [name, Uint8Array.from(atob(text), (c) => c.charCodeAt(0))]),
);

function entry(fraction) {
  return 3 * Math.max(0, Math.min(255, Math.round(255 * fraction)));
}

// A scale consists of colours and the values of the first and the last colour. Values that differ by rounding get one colour.
function scaleOf(table, low, high) {
  const least = 1e-5 * (Math.max(Math.abs(low), Math.abs(high)) || 1);
  if (high - low < least) [low, high] = [low - least / 2, high + least / 2];
  return { table: tables[table], low, high };
}

function showBar(bar, scale, centre) {
  const steps = Array.from({ length: 17 }, (_, i) => {
    const e = entry(i / 16);
    return `rgb(${scale.table[e]} ${scale.table[e + 1]} ${scale.table[e + 2]})`;
  });
  const strip = document.createElement("div");
  strip.className = "strip";
  strip.style.background = `linear-gradient(to right, ${steps.join(", ")})`;
  const ticks = document.createElement("div");
  ticks.className = "ticks";
  const middle = centre ?? (scale.low + scale.high) / 2;
  for (const value of [scale.low, middle, scale.high]) {
    const tick = document.createElement("span");
    tick.textContent = tickText(value, Math.max(Math.abs(scale.low), Math.abs(scale.high)));
    ticks.append(tick);
  }
  bar.replaceChildren(strip, ticks);
}

const raised = (text) => [...text].map((c) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[c] ?? "⁻").join("");

// Three digits, or as many as the largest number beside it needs; a power of ten instead of many zeros.
function number(x, largest = Math.abs(x)) {
  if (!Number.isFinite(x)) return "–";
  if (x === 0 || Math.abs(x) < 1e-6 * largest) return "0";
  const exponent = Math.floor(Math.log10(largest) + 2e-4); // 9.996 is shown as 10
  if (exponent >= 4 || exponent < -3) {
    const digits = (x / 10 ** exponent).toFixed(2).replace(/\.?0+$/, "");
    const tens = `10${raised(String(exponent))}`;
    return (digits === "1" ? tens : `${digits}·${tens}`).replace("-", "−");
  }
  return x.toFixed(Math.max(0, 2 - exponent)).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
}

// A rounded number without trailing zeros.
const tickText = (x, largest) => number(x, largest).replace(/\.(\d*?)0+$/, (_, kept) => (kept ? `.${kept}` : ""));

const withUnit = (text, unit) => (unit ? `${text} ${unit}` : text);
const spreadText = (t) => (about.lengths ? ` (√(Dt) ≈ ${withUnit(tickText(Number(about.lengths[t].toPrecision(2))), about.lengthUnit)})` : "");
const timeText = (t) => withUnit(number(times[t]), about.unit);
