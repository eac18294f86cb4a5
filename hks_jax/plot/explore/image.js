// An image of one slice on a canvas with colours, chosen points and a region's outline, and its pointer events.
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// A tile with a dark diagonal line that repeats in both directions.
function hatching(dense) {
  const tile = document.createElement("canvas");
  const size = 7 * dense;
  [tile.width, tile.height] = [size, size];
  const pen = tile.getContext("2d");
  [pen.strokeStyle, pen.lineWidth] = ["rgb(40 40 40 / 0.85)", dense];
  for (const shift of [-size, 0, size]) {
    pen.moveTo(shift - 1, size + 1);
    pen.lineTo(shift + size + 1, -1);
  }
  pen.stroke();
  return tile;
}

class SliceImage {
  constructor(canvas, events) {
    this.canvas = canvas;
    this.events = events;
    this.tile = document.createElement("canvas");
    this.lasso = null;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", () => this.release(null));
    canvas.addEventListener("pointerleave", () => events.hover(null));
  }

  // The axis `across` of the plane points to the right, and the axis `up` points upwards.
  lay(plane) {
    this.plane = plane;
    const { across, up } = plane;
    const width = this.canvas.clientWidth || 300;
    const wanted = (width * shape[up] * about.spacing[up]) / (shape[across] * about.spacing[across]);
    const height = Math.round(Math.min(Math.max(wanted, 60), Math.max(1.35 * width, 240)));
    if (this.canvas.style.height !== `${height}px`) this.canvas.style.height = `${height}px`;
    const dense = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(width * dense);
    this.canvas.height = Math.round(height * dense);
    // The grid's coordinates in pixels of the canvas.
    const room = about.ends ? 15 * dense : 0;
    const lengths = [shape[across] * about.spacing[across], shape[up] * about.spacing[up]];
    const zoom = Math.min((this.canvas.width - 2 * room) / lengths[0], (this.canvas.height - 2 * room) / lengths[1]);
    this.cell = [zoom * about.spacing[across], zoom * about.spacing[up]];
    this.corner = [(this.canvas.width - zoom * lengths[0]) / 2, (this.canvas.height + zoom * lengths[1]) / 2];
    this.dense = dense;
  }

  // In the radiological view, left is on the right: positions from left to right count from the other side.
  across(x) {
    const { across } = this.plane;
    return about.mirrored && about.ends?.[across] === "LR" ? shape[across] - x : x;
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left) * this.canvas.width) / box.width;
    const y = ((event.clientY - box.top) * this.canvas.height) / box.height;
    return [this.across((x - this.corner[0]) / this.cell[0]), (this.corner[1] - y) / this.cell[1]]; // in cells from the corner
  }

  gridPlace([x, y]) {
    const { axis, across, up, index } = this.plane;
    const place = [0, 0, 0];
    place[axis] = index;
    place[across] = Math.floor(x);
    place[up] = Math.floor(y);
    return place;
  }

  press(event) {
    if (event.button !== 0) return;
    const at = this.place(event);
    if (this.events.lassoing()) {
      this.canvas.setPointerCapture(event.pointerId);
      this.lasso = [at];
    } else if (event.pointerType !== "touch") {
      this.events.pick(this.gridPlace(at), event.shiftKey);
    }
  }

  move(event) {
    const at = this.place(event);
    if (this.lasso) {
      this.lasso.push(at);
      this.drawLasso(); // over the present image, because nothing else has changed
    } else if (event.buttons & 1 && event.pointerType !== "touch") {
      this.events.pick(this.gridPlace(at), event.shiftKey);
    }
    this.events.hover(this.gridPlace(at));
  }

  release(event) {
    const drawn = this.lasso;
    this.lasso = null;
    if (drawn) this.events.redraw();
    if (!event) return;
    // A lasso narrower than two cells is a click, and so is the end of every touch that did not scroll.
    const wide = drawn && [0, 1].some((a) => {
      const along = drawn.map((at) => at[a]);
      return Math.max(...along) - Math.min(...along) >= 2;
    });
    if (wide) this.events.lasso(drawn, this.plane);
    else if (drawn || event.pointerType === "touch") this.events.pick(this.gridPlace(this.place(event)), event.shiftKey);
  }

  // colour(node, out) writes three numbers from 0 to 255.
  draw(colour, { points, chosen, sticks, hatched, opaque }) {
    const { axis, across, up, index } = this.plane;
    const [nu, nv] = [shape[across], shape[up]];
    [this.tile.width, this.tile.height] = [nu, nv];
    const pixels = new ImageData(nu, nv);
    const rgb = [0, 0, 0];
    const place = [0, 0, 0];
    place[axis] = index;
    const opacity = anatomy && !opaque ? element("opacity").value / 100 : 1;
    for (let u = 0; u < nu; u++) {
      for (let v = 0; v < nv; v++) {
        [place[across], place[up]] = [u, v];
        const node = nodeAt(place);
        const grey = anatomy ? anatomy[flatOf(place)] : 0;
        if (node < 0 && !grey) continue;
        if (node < 0) rgb.fill(grey);
        else colour(node, rgb);
        if (node >= 0 && grey) for (let c = 0; c < 3; c++) rgb[c] += (1 - opacity) * (grey - rgb[c]);
        const p = 4 * ((nv - 1 - v) * nu + Math.floor(this.across(u + 0.5)));
        for (let c = 0; c < 3; c++) pixels.data[p + c] = rgb[c];
        pixels.data[p + 3] = 255;
      }
    }
    this.tile.getContext("2d").putImageData(pixels, 0, 0);
    const pen = this.canvas.getContext("2d");
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.imageSmoothingEnabled = false;
    const [w, h] = [nu * this.cell[0], nv * this.cell[1]];
    pen.drawImage(this.tile, this.corner[0], this.corner[1] - h, w, h);
    if (hatched) this.drawHatching(pen, hatched);
    if (sticks) this.drawSticks(pen, sticks);
    if (chosen) this.drawOutline(pen, chosen);
    if (about.ends) this.drawEnds(pen);
    for (const [name, at] of Object.entries(points)) if (at) this.drawPoint(pen, name, at);
  }

  // Diagonal lines over the cells of the nodes for which hatched(node) holds.
  drawHatching(pen, hatched) {
    const { axis, across, up, index } = this.plane;
    const place = [0, 0, 0];
    place[axis] = index;
    pen.fillStyle = pen.createPattern(hatching(this.dense), "repeat");
    for (let u = 0; u < shape[across]; u++) {
      for (let v = 0; v < shape[up]; v++) {
        [place[across], place[up]] = [u, v];
        const node = nodeAt(place);
        if (node < 0 || !hatched(node)) continue;
        const [[x0, y0], [x1, y1]] = [this.toPixels(u, v), this.toPixels(u + 1, v + 1)].map((at) => at.map(Math.round));
        pen.fillRect(Math.min(x0, x1), y1, Math.abs(x1 - x0), y0 - y1);
      }
    }
  }

  toPixels(x, y) {
    return [this.corner[0] + this.across(x) * this.cell[0], this.corner[1] - y * this.cell[1]];
  }

  drawSticks(pen, directions) {
    const { axis, across, up, index } = this.plane;
    const every = Math.max(1, Math.ceil((7 * this.dense) / Math.min(...this.cell)));
    const place = [0, 0, 0];
    place[axis] = index;
    pen.strokeStyle = "rgb(255 255 255 / 0.75)";
    pen.lineWidth = this.dense;
    pen.beginPath();
    for (let u = 0; u < shape[across]; u += every) {
      for (let v = 0; v < shape[up]; v += every) {
        [place[across], place[up]] = [u, v];
        const node = nodeAt(place);
        if (node < 0) continue;
        const half = 0.48 * every * Math.min(...this.cell);
        const [dx, dy] = [(this.across(1) - this.across(0)) * half * directions[3 * node + across], half * directions[3 * node + up]];
        const [x, y] = this.toPixels(u + 0.5, v + 0.5);
        pen.moveTo(x - dx, y + dy);
        pen.lineTo(x + dx, y - dy);
      }
    }
    pen.stroke();
  }

  drawOutline(pen, chosen) {
    const { axis, across, up, index } = this.plane;
    const place = [0, 0, 0];
    place[axis] = index;
    const has = (u, v) => {
      [place[across], place[up]] = [u, v];
      const node = nodeAt(place);
      return node >= 0 && chosen[node] === 1;
    };
    pen.beginPath();
    for (let u = 0; u < shape[across]; u++) {
      for (let v = 0; v < shape[up]; v++) {
        if (!has(u, v)) continue;
        const sides = [[-1, 0, 0, 0, 0, 1], [1, 0, 1, 0, 1, 1], [0, -1, 0, 0, 1, 0], [0, 1, 0, 1, 1, 1]];
        for (const [du, dv, u0, v0, u1, v1] of sides) {
          if (has(u + du, v + dv)) continue;
          pen.moveTo(...this.toPixels(u + u0, v + v0));
          pen.lineTo(...this.toPixels(u + u1, v + v1));
        }
      }
    }
    this.strokeTwice(pen, style("--region"), 2);
  }

  drawLasso() {
    const pen = this.canvas.getContext("2d");
    pen.beginPath();
    this.lasso.forEach((at, i) => (i ? pen.lineTo(...this.toPixels(...at)) : pen.moveTo(...this.toPixels(...at))));
    this.strokeTwice(pen, style("--region"), 2);
  }

  strokeTwice(pen, colour, width) {
    for (const [line, more] of [["#fff", 2], [colour, 0]]) {
      pen.strokeStyle = line;
      pen.lineWidth = (width + more) * this.dense;
      pen.stroke();
    }
  }

  drawPoint(pen, name, at) {
    const { axis, across, up, index } = this.plane;
    const [x, y] = this.toPixels(at[across] + 0.5, at[up] + 0.5);
    pen.save();
    if (at[axis] !== index) pen.globalAlpha = 0.35; // in another slice
    pen.beginPath();
    pen.arc(x, y, 6 * this.dense, 0, 2 * Math.PI);
    this.strokeTwice(pen, style(`--${name.toLowerCase()}`), 2.5);
    this.write(pen, name, x + 14 * this.dense, y - 10 * this.dense, style(`--${name.toLowerCase()}`));
    pen.restore();
  }

  drawEnds(pen) {
    const { across, up } = this.plane;
    const [x0, y0] = this.toPixels(0, 0);
    const [x1, y1] = this.toPixels(shape[across], shape[up]);
    const off = 8 * this.dense;
    const out = x0 < x1 ? off : -off;
    this.write(pen, about.ends[across][0], x0 - out, (y0 + y1) / 2, style("--soft"));
    this.write(pen, about.ends[across][1], x1 + out, (y0 + y1) / 2, style("--soft"));
    this.write(pen, about.ends[up][0], (x0 + x1) / 2, y0 + off, style("--soft"));
    this.write(pen, about.ends[up][1], (x0 + x1) / 2, y1 - off, style("--soft"));
  }

  write(pen, text, x, y, colour) {
    pen.font = `600 ${13 * this.dense}px system-ui, sans-serif`;
    [pen.textAlign, pen.textBaseline, pen.lineJoin] = ["center", "middle", "round"];
    [pen.strokeStyle, pen.lineWidth, pen.fillStyle] = [style("--card"), 3 * this.dense, colour];
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
  }
}
