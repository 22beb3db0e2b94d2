// The map: ground, driven paths, candidates, regions, vehicles.

import { Ground } from "./ground.js";
import { STALE_S } from "./store.js";

const RETRY_MS = 2000;
const FOLLOW_PX_PER_M = 24, CONTOUR_PX = 3, PX_PER_M = [0.5, 150], GRID = [1, 2, 5, 10, 20, 50, 100, 200, 500];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class MapView {
  constructor(canvas, store, changed) {
    Object.assign(this, { canvas, store, changed, grounds: new Map(), notBefore: new Map(), layer: "elevation", mode: "follow", scale: FOLLOW_PX_PER_M, centre: [0, 0], pointer: null });
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", changed);
    new ResizeObserver(changed).observe(canvas);
    this.listen();
  }

  listen() {
    const { canvas } = this, pointers = new Map();
    const place = (event) => [event.offsetX, event.offsetY];
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, place(event));
    });
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = place(event);
      const last = pointers.get(event.pointerId);
      if (last && pointers.size === 1) this.pan(last[0] - event.offsetX, last[1] - event.offsetY);
      if (last && pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        const distance = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
        this.zoom(distance(place(event)) / Math.max(distance(last), 1), other);
      }
      if (last) pointers.set(event.pointerId, place(event));
      this.changed();
    });
    const lift = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
      this.changed();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), place(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, -60], ArrowDown: [0, 60] }[event.key];
      if (!step) return;
      event.preventDefault();
      this.pan(...step);
    });
  }

  setLayer(layer) {
    this.layer = layer;
    this.changed();
  }

  setMode(mode) {
    this.mode = mode;
    if (mode === "follow") this.scale = FOLLOW_PX_PER_M;
    this.changed();
  }

  pan(dx, dy) {
    this.mode = "free";
    this.centre = [this.centre[0] + dx / this.scale, this.centre[1] - dy / this.scale];
    this.changed();
  }

  // Keeps the point under the pointer where it is; keeps following when the vehicle is followed.
  zoom(factor, at = null) {
    const scale = Math.min(Math.max(this.scale * factor, PX_PER_M[0]), PX_PER_M[1]);
    if (this.mode === "all") this.mode = "free";
    if (at && this.mode === "free") {
      const [x, y] = this.toWorld(...at);
      this.scale = scale;
      const [nx, ny] = this.toWorld(...at);
      this.centre = [this.centre[0] + x - nx, this.centre[1] + y - ny];
    }
    this.scale = scale;
    this.changed();
  }

  toScreen(x, y) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [w / 2 + (x - this.centre[0]) * this.scale, h / 2 - (y - this.centre[1]) * this.scale];
  }

  toWorld(px, py) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [this.centre[0] + (px - w / 2) / this.scale, this.centre[1] - (py - h / 2) / this.scale];
  }

  get ground() {
    return this.grounds.get(this.store.session?.map?.id) ?? null;
  }

  fetchGround() {
    const map = this.store.session?.map;
    if (!map) return;
    if (this.grounds.get(map.id)?.hash === map.hash || performance.now() < (this.notBefore.get(map.id) ?? 0)) return;
    // One load of a map at a time; what it was before stays on the screen until then.
    this.notBefore.set(map.id, Infinity);
    const fresh = new Ground(map.id, map.hash);
    fresh.load().then(() => {
      this.notBefore.delete(map.id);
      this.grounds.set(map.id, fresh);
      this.changed();
    }, (reason) => {
      this.notBefore.set(map.id, performance.now() + RETRY_MS);
      console.warn(`map ${map.id}: ${reason}`);
    });
  }

  aim() {
    const { clientWidth: w, clientHeight: h } = this.canvas, session = this.store.session;
    if (this.mode === "all") {
      const trail = session?.trail ?? [];
      const span = (i) => [Math.min(...trail.map((p) => p[i])), Math.max(...trail.map((p) => p[i]))];
      const [xs, ys] = trail.length ? [span(1), span(2)] : [[-20, 20], [-20, 20]];
      const e = this.ground?.extent ?? { x: xs[0] - 5, y: ys[0] - 5, width: xs[1] - xs[0] + 10, height: ys[1] - ys[0] + 10 };
      this.scale = Math.min((w - 24) / e.width, (h - 24) / e.height);
      this.centre = [e.x + e.width / 2, e.y + e.height / 2];
    } else if (this.mode === "follow" && session?.newest) {
      this.centre = session.newest.position_m.slice(0, 2);
    }
  }

  draw() {
    this.fetchGround();
    const { canvas } = this, ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = canvas;
    if (!w || !h) return;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) [canvas.width, canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
    this.aim();
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = css("--paper");
    c.fillRect(0, 0, w, h);
    this.drawGround(c);
    this.drawGrid(c, w, h);
    for (const session of this.store.sessions.values()) {
      if (session.map?.id !== this.store.session?.map?.id) continue;
      if (session === this.store.session) {
        this.drawFan(c, session.fan);
        this.drawTrail(c, session.trail);
        this.drawRegion(c, session.region);
      } else {
        this.drawTrail(c, session.trail);
      }
      this.drawVehicle(c, session);
    }
    this.drawScale(c, w, h);
  }

  drawGround(c) {
    if (!this.ground) return;
    const { x, y, width, height } = this.ground.extent, [left, top] = this.toScreen(x, y + height);
    c.imageSmoothingEnabled = this.scale * this.ground.about.resolution_m < 6;
    c.drawImage(this.ground.picture(this.layer, this.dark.matches), left, top, width * this.scale, height * this.scale);
    if (this.layer === "elevation") this.drawContours(c);
    c.strokeStyle = css("--soft");
    c.lineWidth = 1;
    c.strokeRect(left, top, width * this.scale, height * this.scale);
  }

  drawContours(c) {
    const { clientWidth: w, clientHeight: h } = this.canvas, every = Math.ceil(CONTOUR_PX / (this.scale * this.ground.about.resolution_m));
    const pieces = this.ground.contours(this.toWorld(0, h), this.toWorld(w, 0), every);
    c.beginPath();
    for (let i = 0; i < pieces.length; i += 4) {
      c.moveTo(...this.toScreen(pieces[i], pieces[i + 1]));
      c.lineTo(...this.toScreen(pieces[i + 2], pieces[i + 3]));
    }
    c.lineCap = "round";
    c.strokeStyle = css("--contour");
    c.lineWidth = 1;
    c.stroke();
  }

  // Where no map is, a grid tells distances.
  drawGrid(c, w, h) {
    if (this.ground) return;
    const step = GRID.find((s) => s * this.scale > 60) ?? 1000, [x0, y1] = this.toWorld(0, 0), [x1, y0] = this.toWorld(w, h);
    c.strokeStyle = css("--line");
    c.lineWidth = 1;
    c.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) c.moveTo(this.toScreen(x, 0)[0], 0), c.lineTo(this.toScreen(x, 0)[0], h);
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) c.moveTo(0, this.toScreen(0, y)[1]), c.lineTo(w, this.toScreen(0, y)[1]);
    c.stroke();
  }

  line(c, points) {
    c.beginPath();
    points.forEach(([x, y], i) => {
      const at = this.toScreen(x, y);
      if (i) c.lineTo(...at);
      else c.moveTo(...at);
    });
  }

  stroke(c, colour, width, halo = 0, dash = []) {
    c.lineJoin = c.lineCap = "round";
    c.setLineDash([]);
    if (halo) {
      c.strokeStyle = css("--panel");
      c.lineWidth = width + halo;
      c.stroke();
    }
    c.setLineDash(dash);
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.stroke();
    c.setLineDash([]);
  }

  drawTrail(c, trail) {
    if (trail.length < 2) return;
    this.line(c, trail.map((p) => [p[1], p[2]]));
    this.stroke(c, css("--ink"), 2, 2);
  }

  drawFan(c, fan) {
    if (!fan || this.store.now - fan.at_s > 3) return;
    const [blue, vermilion] = [css("--blue"), css("--vermilion")];
    fan.paths.forEach((path, n) => {
      const points = [fan.start];
      for (let i = 0; i < path.length && path[i] !== null; i += 2) points.push([path[i], path[i + 1]]);
      this.line(c, points);
      c.globalAlpha = fan.flagged[n] ? 1 : 0.55;
      this.stroke(c, fan.flagged[n] ? vermilion : blue, fan.flagged[n] ? 1.5 : 1, 0, fan.flagged[n] ? [4, 4] : []);
    });
    c.globalAlpha = 1;
  }

  drawRegion(c, region) {
    if (!region || this.store.now - region.at_s > 3) return;
    const colour = css("--orange"), points = [region.start];
    for (let i = 0; i < region.path.length; i += 2) points.push([region.path[i], region.path[i + 1]]);
    for (const [, x, y, a, b, angle] of region.regions) {
      c.beginPath();
      c.ellipse(...this.toScreen(x, y), Math.max(a * this.scale, 1), Math.max(b * this.scale, 1), -angle, 0, 2 * Math.PI);
      c.globalAlpha = 0.14;
      c.fillStyle = colour;
      c.fill();
      c.globalAlpha = 1;
      this.stroke(c, colour, 1.3);
    }
    this.line(c, points);
    this.stroke(c, colour, 2, 1.5);
  }

  drawVehicle(c, session) {
    if (!session.newest) return;
    const [x, y] = this.toScreen(...session.newest.position_m), length = Math.max(this.store.service.vehicle_length_m * this.scale, 16), width = Math.max(this.store.service.vehicle_width_m * this.scale, 9);
    c.save();
    c.translate(x, y);
    c.rotate(-session.newest.attitude_rad[2]);
    c.beginPath();
    c.moveTo(length / 2, 0);
    c.lineTo(length / 4, width / 2);
    c.lineTo(-length / 2, width / 2);
    c.lineTo(-length / 2, -width / 2);
    c.lineTo(length / 4, -width / 2);
    c.closePath();
    c.fillStyle = session === this.store.session ? css("--ink") : css("--soft");
    // Pale where the vehicle is silent.
    c.globalAlpha = session.newest.age_s > STALE_S ? 0.3 : 0.85;
    c.fill();
    c.globalAlpha = 1;
    c.strokeStyle = css("--panel");
    c.lineWidth = 1.5;
    c.stroke();
    c.restore();
    if (this.store.sessions.size > 1) {
      c.font = "600 12px system-ui, sans-serif";
      c.lineWidth = 3;
      c.lineJoin = "round";
      c.strokeStyle = css("--panel");
      const beside = [x + 0.5 * length + 4, y - 0.5 * length + 4];
      c.strokeText(session.session, ...beside);
      c.fillStyle = css("--ink");
      c.fillText(session.session, ...beside);
    }
  }

  drawScale(c, w, h) {
    const metres = [...GRID].reverse().find((s) => s * this.scale <= 140) ?? 1, px = metres * this.scale, [x, y] = [12, h - 14];
    c.beginPath();
    c.moveTo(x, y - 5);
    c.lineTo(x, y);
    c.lineTo(x + px, y);
    c.lineTo(x + px, y - 5);
    this.stroke(c, css("--ink"), 1.5, 2.5);
    c.font = "12px system-ui, sans-serif";
    c.lineWidth = 3;
    c.strokeStyle = css("--panel");
    c.strokeText(`${metres} m`, x + 5, y - 5);
    c.fillStyle = css("--ink");
    c.fillText(`${metres} m`, x + 5, y - 5);
  }
}
