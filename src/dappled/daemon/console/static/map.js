// Draw track, footprints and frames on a canvas, in metres around the first position. No tiles, no network.
import { image } from "./pictures.js";

const METRES = 111319.49;

export class FieldMap {
  constructor(canvas, note) {
    this.canvas = canvas;
    this.note = note;
    this.pen = canvas.getContext("2d");
    this.origin = null;
    this.track = [];          // of the vehicle, [lon, lat]
    this.vehicle = null;
    this.frames = new Map();  // index → {corners, image}
    this.selected = null;
    this.background = null;
    this.area = null;         // planned: rings, bounds, and what no frame has seen yet
    this.following = true;
    this.centre = [0, 0];     // metres east, north
    this.scale = 4;           // CSS pixels per metre
    this.asked = false;
    this.listen();
    new ResizeObserver(() => this.redraw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  place([lon, lat]) {
    this.origin ??= [lon, lat];
    const east = ((lon - this.origin[0] + 540) % 360) - 180;
    return [east * METRES * Math.cos(this.origin[1] * Math.PI / 180), (lat - this.origin[1]) * METRES];
  }

  setPath(path) {
    if (path.length > this.track.length) this.track = path;
    this.redraw();
  }

  setVehicle(vehicle) {
    this.vehicle = vehicle;
    if (vehicle) {
      const last = this.track.at(-1), here = [vehicle.longitude_deg, vehicle.latitude_deg];
      if (!last || last[0] !== here[0] || last[1] !== here[1]) this.track.push(here);
      if (this.track.length > 7200) this.track.shift();
    }
    this.redraw();
  }

  setFrame(index, corners, hasPicture) {
    if (!corners) return;
    const frame = this.frames.get(index) ?? { image: null };
    frame.corners = corners.map(([lat, lon]) => [lon, lat]);
    if (hasPicture && !frame.image) {
      frame.image = image(`/api/frames/${index}/map.png`, () => this.redraw());
    }
    this.frames.set(index, frame);
    if (this.frames.size > 60) this.frames.delete(this.frames.keys().next().value);
    this.redraw();
  }

  setBackground(bounds) {
    if (!bounds || this.background) return;
    image("/api/map", (picture) => { this.background = { image: picture, bounds }; this.redraw(); });
  }

  setArea(area) {
    if (!area || this.area) return;
    this.area = { ...area, version: -1, holes: null };
    this.redraw();
  }

  setHoles(version) {
    if (!this.area || this.area.version === version) return;
    this.area.version = version;
    image(`/api/holes.png?v=${version}`, (picture) => { this.area.holes = picture; this.redraw(); });
  }

  select(index) { this.selected = index; this.redraw(); }

  fit() {
    const planned = (this.area?.rings ?? []).flat().map(([lat, lon]) => [lon, lat]);
    const points = [...this.track, ...[...this.frames.values()].flatMap((frame) => frame.corners), ...planned].map((one) => this.place(one));
    if (!points.length) return;
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    const [west, east, south, north] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.scale = Math.min((w - 56) / Math.max(east - west, 8), (h - 76) / Math.max(north - south, 8));
    this.centre = [(west + east) / 2, (south + north) / 2 - 14 / this.scale];   // scale and buttons lie below
  }

  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  draw() {
    const { canvas, pen } = this, w = canvas.clientWidth, h = canvas.clientHeight, ratio = devicePixelRatio || 1;
    if (!w) return;
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const colours = getComputedStyle(canvas), ink = colours.getPropertyValue("--ink"), line = colours.getPropertyValue("--line");
    const soft = colours.getPropertyValue("--soft"), link = colours.getPropertyValue("--link");
    pen.fillStyle = colours.getPropertyValue("--raised");
    pen.fillRect(0, 0, w, h);
    if (this.following) this.fit();
    this.drawBackground(w, h);
    this.drawGrid(w, h, line, soft);
    const on = (point) => { const [x, y] = this.place(point); return [w / 2 + (x - this.centre[0]) * this.scale, h / 2 - (y - this.centre[1]) * this.scale]; };
    for (const frame of this.frames.values()) this.drawPicture(frame, on);
    this.drawArea(on, link);
    for (const [index, frame] of this.frames) {
      pen.strokeStyle = index === this.selected ? link : soft;
      pen.lineWidth = index === this.selected ? 2.5 : 0.8;
      pen.beginPath();
      frame.corners.forEach((corner, i) => pen[i ? "lineTo" : "moveTo"](...on(corner)));
      pen.closePath();
      pen.stroke();
    }
    pen.strokeStyle = ink;
    pen.lineWidth = 1.6;
    pen.lineJoin = "round";
    pen.beginPath();
    this.track.forEach((point, i) => pen[i ? "lineTo" : "moveTo"](...on(point)));
    pen.stroke();
    if (this.vehicle) this.drawVehicle(on([this.vehicle.longitude_deg, this.vehicle.latitude_deg]), this.vehicle.yaw_deg, ink);
    this.drawScale(w, h, ink);
  }

  drawPicture(frame, on) {
    if (!frame.image?.complete || !frame.image.naturalWidth) return;
    const lons = frame.corners.map((c) => c[0]), lats = frame.corners.map((c) => c[1]);
    const [left, top] = on([Math.min(...lons), Math.max(...lats)]), [right, bottom] = on([Math.max(...lons), Math.min(...lats)]);
    this.pen.drawImage(frame.image, left, top, right - left, bottom - top);
  }

  drawArea(on, link) {
    if (!this.area) return;
    const { rings, bounds, holes } = this.area, pen = this.pen;
    if (holes) {
      const [left, top] = on([bounds.west, bounds.north]), [right, bottom] = on([bounds.east, bounds.south]);
      pen.imageSmoothingEnabled = false;
      pen.drawImage(holes, left, top, right - left, bottom - top);
      pen.imageSmoothingEnabled = true;
    }
    pen.strokeStyle = link;
    pen.lineWidth = 1.5;
    pen.setLineDash([6, 4]);
    for (const ring of rings) {
      pen.beginPath();
      ring.forEach(([lat, lon], i) => pen[i ? "lineTo" : "moveTo"](...on([lon, lat])));
      pen.closePath();
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  drawBackground(w, h) {
    if (!this.background) return;
    const { image, bounds } = this.background;
    const at = ([lon, lat]) => { const [x, y] = this.place([lon, lat]); return [w / 2 + (x - this.centre[0]) * this.scale, h / 2 - (y - this.centre[1]) * this.scale]; };
    const [left, top] = at([bounds.west, bounds.north]), [right, bottom] = at([bounds.east, bounds.south]);
    this.pen.drawImage(image, left, top, right - left, bottom - top);
  }

  drawGrid(w, h, line, soft) {
    const step = nice(70 / this.scale), pen = this.pen;
    pen.strokeStyle = line;
    pen.fillStyle = soft;
    pen.lineWidth = 1;
    pen.font = "11px system-ui, sans-serif";
    if (!this.origin) {
      pen.textAlign = "center";
      pen.fillText("waiting for a position", w / 2, h / 2);
      return;
    }
    pen.beginPath();
    for (let x = Math.ceil((this.centre[0] - w / 2 / this.scale) / step) * step; ; x += step) {
      const px = Math.round(w / 2 + (x - this.centre[0]) * this.scale) + 0.5;
      if (px > w) break;
      pen.moveTo(px, 0); pen.lineTo(px, h);
    }
    for (let y = Math.ceil((this.centre[1] - h / 2 / this.scale) / step) * step; ; y += step) {
      const py = Math.round(h / 2 - (y - this.centre[1]) * this.scale) + 0.5;
      if (py < 0) break;
      pen.moveTo(0, py); pen.lineTo(w, py);
    }
    pen.stroke();
  }

  drawVehicle([x, y], yaw, ink) {
    const pen = this.pen;
    pen.save();
    pen.translate(x, y);
    pen.fillStyle = ink;
    pen.strokeStyle = getComputedStyle(this.canvas).getPropertyValue("--raised");
    pen.lineWidth = 1.5;
    pen.beginPath();
    if (yaw === null) pen.arc(0, 0, 5, 0, 7);
    else {
      pen.rotate(yaw * Math.PI / 180);
      pen.moveTo(0, -10); pen.lineTo(6.5, 8); pen.lineTo(0, 4.5); pen.lineTo(-6.5, 8); pen.closePath();
    }
    pen.fill(); pen.stroke();
    pen.restore();
  }

  drawScale(w, h, ink) {
    if (!this.origin) return;
    const metres = nice(90 / this.scale), length = metres * this.scale, pen = this.pen;
    const text = metres >= 1000 ? `${metres / 1000} km` : `${+metres.toPrecision(2)} m`;
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.fillStyle = getComputedStyle(this.canvas).getPropertyValue("--raised");
    pen.globalAlpha = 0.85;
    pen.fillRect(6, h - 26, length + pen.measureText(text).width + 20, 20);
    pen.globalAlpha = 1;
    pen.strokeStyle = pen.fillStyle = ink;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(12, h - 19); pen.lineTo(12, h - 13); pen.lineTo(12 + length, h - 13); pen.lineTo(12 + length, h - 19);
    pen.stroke();
    pen.fillText(text, 18 + length, h - 12);
    pen.textAlign = "center";
    pen.fillText("N", 18, 26);
    pen.beginPath(); pen.moveTo(18, 6); pen.lineTo(22, 15); pen.lineTo(14, 15); pen.closePath(); pen.fill();
  }

  zoom(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    this.following = false;
    const dx = (x - this.canvas.clientWidth / 2) / this.scale, dy = (this.canvas.clientHeight / 2 - y) / this.scale;
    const scale = Math.min(Math.max(this.scale * factor, 0.002), 400);
    const ratio = 1 - this.scale / scale;
    this.centre = [this.centre[0] + dx * ratio, this.centre[1] + dy * ratio];
    this.scale = scale;
    this.redraw();
  }

  pan(dx, dy) {
    this.following = false;
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.redraw();
  }

  listen() {
    const { canvas } = this, fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      fingers.set(event.pointerId, event);
      if (fingers.size === 1) { this.pan(event.clientX - before.clientX, event.clientY - before.clientY); return; }
      const other = [...fingers.values()].find((one) => one.pointerId !== event.pointerId);
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (apart(before) > 4) this.zoom(apart(event) / apart(before));
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const box = canvas.getBoundingClientRect();
      this.zoom(Math.exp(-event.deltaY / 400), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
      if (moves[event.key]) { this.pan(...moves[event.key]); event.preventDefault(); }
      else if (event.key === "+" || event.key === "=") this.zoom(1.4);
      else if (event.key === "-") this.zoom(1 / 1.4);
    });
  }
}

function nice(metres) {
  const power = 10 ** Math.floor(Math.log10(metres)), lead = metres / power;
  return (lead < 2 ? 1 : lead < 5 ? 2 : 5) * power;
}
