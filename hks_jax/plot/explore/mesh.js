// An orthographic image of a surface on a canvas, turned by dragging. A pixel has the colour of the three vertices of its face.
const view = { turn: 30, tilt: 20 }; // the angle about the vertical axis z and the elevation, in degrees

const surface = about.mesh ? { vertices: await floats("vertices"), faces: await integers("faces"), numbers: await integers("numbers") } : null;

if (surface) {
  const { vertices } = surface;
  const [low, high] = [[0, 1, 2].map(() => Infinity), [0, 1, 2].map(() => -Infinity)];
  for (let i = 0; i < vertices.length; i++) {
    low[i % 3] = Math.min(low[i % 3], vertices[i]);
    high[i % 3] = Math.max(high[i % 3], vertices[i]);
  }
  surface.middle = low.map((l, a) => (l + high[a]) / 2);
  surface.radius = 0;
  for (let v = 0; v < vertices.length; v += 3) {
    surface.radius = Math.max(surface.radius, Math.hypot(...surface.middle.map((m, a) => vertices[v + a] - m)));
  }
}

// The directions to the right, up and towards the reader.
function frameOfView() {
  const [a, e] = [view.turn, view.tilt].map((degrees) => (degrees * Math.PI) / 180);
  const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
  return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
}

// The pixel and depth of each vertex, the nearest face at each pixel, and the weights of its vertices.
let drawn = null;

function rasterise(width, height) {
  const key = [width, height, view.turn, view.tilt].join();
  if (drawn?.key === key) return drawn;
  const { vertices, faces, middle, radius } = surface;
  const frame = frameOfView();
  const zoom = (0.49 * Math.min(width, height)) / radius;
  const at = new Float32Array(vertices.length);
  for (let v = 0; v < vertices.length; v += 3) {
    const p = [0, 1, 2].map((a) => vertices[v + a] - middle[a]);
    const [x, y, z] = frame.map((axis) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]);
    at.set([width / 2 + zoom * x, height / 2 - zoom * y, zoom * z], v);
  }
  const face = new Int32Array(width * height).fill(-1);
  const depth = new Float32Array(width * height).fill(-Infinity);
  const weights = new Float32Array(2 * width * height);
  const light = new Float32Array(faces.length / 3);
  for (let f = 0; f < light.length; f++) {
    const [a, b, c] = [3 * faces[3 * f], 3 * faces[3 * f + 1], 3 * faces[3 * f + 2]];
    const [ux, uy, uz] = [at[b] - at[a], at[b + 1] - at[a + 1], at[b + 2] - at[a + 2]];
    const [vx, vy, vz] = [at[c] - at[a], at[c + 1] - at[a + 1], at[c + 2] - at[a + 2]];
    const twice = ux * vy - uy * vx;
    if (twice === 0) continue;
    light[f] = 0.55 + (0.45 * Math.abs(twice)) / Math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, twice);
    const x0 = Math.max(0, Math.floor(Math.min(at[a], at[b], at[c])));
    const x1 = Math.min(width - 1, Math.ceil(Math.max(at[a], at[b], at[c])));
    const y0 = Math.max(0, Math.floor(Math.min(at[a + 1], at[b + 1], at[c + 1])));
    const y1 = Math.min(height - 1, Math.ceil(Math.max(at[a + 1], at[b + 1], at[c + 1])));
    for (let y = y0; y <= y1; y++) {
      for (let x = x0; x <= x1; x++) {
        const [dx, dy] = [x + 0.5 - at[a], y + 0.5 - at[a + 1]];
        const [second, third] = [(dx * vy - dy * vx) / twice, (ux * dy - uy * dx) / twice];
        if (second < -1e-6 || third < -1e-6 || second + third > 1 + 1e-6) continue;
        const z = at[a + 2] + second * uz + third * vz;
        const pixel = y * width + x;
        if (z <= depth[pixel]) continue;
        [depth[pixel], face[pixel]] = [z, f];
        [weights[2 * pixel], weights[2 * pixel + 1]] = [second, third];
      }
    }
  }
  drawn = { key, width, height, at, face, depth, weights, light };
  return drawn;
}

// Whether a vertex is visible, with a tolerance because the surface's slope may raise a neighbouring pixel.
function isVisible(node, { at, depth, width, height }) {
  const [x, y] = [Math.floor(at[3 * node]), Math.floor(at[3 * node + 1])];
  if (x < 0 || y < 0 || x >= width || y >= height) return false;
  return at[3 * node + 2] > depth[y * width + x] - 0.02 * Math.min(width, height);
}

class SurfaceImage extends SliceImage {
  lay() {
    const dense = window.devicePixelRatio || 1;
    const width = this.canvas.clientWidth || 300;
    const height = Math.round(Math.min(width, 420));
    if (this.canvas.style.height !== `${height}px`) this.canvas.style.height = `${height}px`;
    [this.canvas.width, this.canvas.height] = [Math.round(width * dense), Math.round(height * dense)];
    [this.dense, this.cell, this.corner] = [dense, [1, 1], [0, this.canvas.height]];
    this.raster = rasterise(this.canvas.width, this.canvas.height);
  }

  // The vertex nearest to a position on the canvas, in pixels from its lower left corner.
  gridPlace([x, y]) {
    const { face, weights, width, height } = this.raster;
    const [column, row] = [Math.floor(x), Math.floor(height - y)];
    if (column < 0 || row < 0 || column >= width || row >= height) return [-1, 0, 0];
    const pixel = row * width + column;
    if (face[pixel] < 0) return [-1, 0, 0];
    const [second, third] = [weights[2 * pixel], weights[2 * pixel + 1]];
    const parts = [1 - second - third, second, third];
    return [surface.faces[3 * face[pixel] + parts.indexOf(Math.max(...parts))], 0, 0];
  }

  press(event) {
    if (event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    if (this.events.lassoing()) this.lasso = [this.place(event)];
    else this.from = { x: event.clientX, y: event.clientY, ...view, moved: false };
  }

  move(event) {
    if (!this.from) return super.move(event);
    const [dx, dy] = [event.clientX - this.from.x, event.clientY - this.from.y];
    if (Math.hypot(dx, dy) < 4 && !this.from.moved) return undefined;
    this.from.moved = true;
    setView(this.from.turn - dx / 2, this.from.tilt + dy / 2);
    return this.events.redraw();
  }

  release(event) {
    const { from } = this;
    this.from = null;
    if (!from) super.release(event);
    else if (event && !from.moved) this.events.pick(this.gridPlace(this.place(event)), event.shiftKey);
  }

  draw(colour, { points, chosen, hatched }) {
    const { width, height, face, weights, light, at } = this.raster;
    const pixels = new ImageData(width, height);
    const rgb = [0, 0, 0];
    for (let pixel = 0; pixel < face.length; pixel++) {
      const f = face[pixel];
      if (f < 0) continue;
      const [second, third] = [weights[2 * pixel], weights[2 * pixel + 1]];
      const sum = [0, 0, 0];
      let part = 0;
      let boundary = 0;
      for (let corner = 0; corner < 3; corner++) {
        const weight = corner === 0 ? 1 - second - third : corner === 1 ? second : third;
        const node = surface.faces[3 * f + corner];
        colour(node, rgb);
        for (let c = 0; c < 3; c++) sum[c] += weight * rgb[c];
        if (chosen && chosen[node] === 1) part += weight;
        if (hatched?.(node)) boundary += weight;
      }
      const line = boundary > 0.5 && (pixel % width + Math.floor(pixel / width)) % Math.round(7 * this.dense) < this.dense;
      if (line) for (let c = 0; c < 3; c++) sum[c] *= 0.25;
      const edge = part > 0.3 && part < 0.7;
      for (let c = 0; c < 3; c++) pixels.data[4 * pixel + c] = edge ? [112, 72, 182][c] : light[f] * sum[c];
      pixels.data[4 * pixel + 3] = 255;
    }
    const pen = this.canvas.getContext("2d");
    pen.putImageData(pixels, 0, 0);
    for (const [name, place] of Object.entries(points)) {
      if (!place) continue;
      this.plane = { axis: 2, across: 0, up: 1, index: isVisible(place[0], this.raster) ? 0 : -1 };
      this.drawPoint(pen, name, [at[3 * place[0]] - 0.5, height - at[3 * place[0] + 1] - 0.5, 0]);
    }
  }
}

function setView(turn, tilt) {
  view.turn = ((Math.round(turn) + 540) % 360) - 180;
  view.tilt = Math.max(-90, Math.min(90, Math.round(tilt)));
  [element("turn").value, element("tilt").value] = [view.turn, view.tilt];
}

// The visible vertices in a polygon, in pixels from the lower left corner.
function verticesInPolygon(polygon) {
  return nodesWhere((node) => {
    const [x, y] = [drawn.at[3 * node], drawn.height - drawn.at[3 * node + 1]];
    return isInPolygon(polygon, x, y) && isVisible(node, drawn);
  });
}

// The neighbour of a vertex that is farthest in a direction on the screen, if there is one.
function neighbourTowards(node, right, up) {
  const { faces } = surface;
  let [best, most] = [null, 0];
  const frame = frameOfView();
  for (let f = 0; f < faces.length; f += 3) {
    const corners = [faces[f], faces[f + 1], faces[f + 2]];
    if (!corners.includes(node)) continue;
    for (const other of corners) {
      const step = [0, 1, 2].map((a) => surface.vertices[3 * other + a] - surface.vertices[3 * node + a]);
      const along = [0, 1, 2].reduce((sum, a) => sum + step[a] * (right * frame[0][a] + up * frame[1][a]), 0);
      if (along > most) [best, most] = [other, along];
    }
  }
  return best;
}

function frontVertex() {
  const towards = frameOfView()[2];
  let [best, most] = [0, -Infinity];
  for (let n = 0; n < count; n++) {
    const depth = [0, 1, 2].reduce((sum, a) => sum + surface.vertices[3 * n + a] * towards[a], 0);
    if (depth > most) [best, most] = [n, depth];
  }
  return best;
}
