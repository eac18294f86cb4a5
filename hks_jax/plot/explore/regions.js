// Regions by a lasso, a distance or a label, and curves as a table.

// Whether a ray from a point crosses a polygon an odd number of times.
function isInPolygon(polygon, x, y) {
  let odd = false;
  for (let i = 0, j = polygon.length - 1; i < polygon.length; j = i++) {
    const [[xi, yi], [xj, yj]] = [polygon[i], polygon[j]];
    if (yi > y !== yj > y && x < xi + ((y - yi) / (yj - yi)) * (xj - xi)) odd = !odd;
  }
  return odd;
}

// The nodes of a slice whose cell centres lie in a polygon.
function nodesInPolygon(polygon, { axis, across, up, index }) {
  const found = [];
  const place = [0, 0, 0];
  place[axis] = index;
  for (let u = 0; u < shape[across]; u++) {
    for (let v = 0; v < shape[up]; v++) {
      if (!isInPolygon(polygon, u + 0.5, v + 0.5)) continue;
      [place[across], place[up]] = [u, v];
      const node = nodeAt(place);
      if (node >= 0) found.push(node);
    }
  }
  return found;
}

function nodesWhere(holds) {
  const found = [];
  for (let n = 0; n < count; n++) if (holds(n)) found.push(n);
  return found;
}

const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

// The columns are t and the given columns [name, numbers at each time].
function csv(columns) {
  const head = [withUnit("t", about.unit && `(${about.unit})`), ...columns.map(([name]) => name)];
  const rows = times.map((t, i) => [t, ...columns.map(([, numbers]) => Number(numbers[i].toPrecision(9)))]);
  return [head.map(quoted), ...rows].map((row) => row.join(",")).join("\n") + "\n";
}

function download(text, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
