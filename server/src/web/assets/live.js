// The live page: takes updates from /live/events and draws them.

import { painted } from "./ground.js";
import { MapView } from "./map.js";
import { LatencyPlot, NisPlot } from "./plots.js";
import { Store } from "./store.js";
import * as panels from "./panels.js";

const SILENT_MS = 4000, CLASSES_SHOWN = 8;
const by = (id) => document.getElementById(id);
const store = new Store();
let paused = false, lastUpdate = 0, lostUpdates = 0, linked = false, dirty = false;

const map = new MapView(by("map"), store, () => schedule(true));
const nis = new NisPlot(by("nis-plot"), "Consistency of the soil filter");
const latency = new LatencyPlot(by("latency-plot"), "Time of predictions");

function schedule(ofUser = false) {
  if (dirty || (paused && !ofUser)) return;
  dirty = true;
  requestAnimationFrame(() => {
    dirty = false;
    draw();
  });
}

function connect() {
  const stream = new EventSource("live/events");
  const take = (event, isWhole) => {
    lastUpdate = performance.now();
    if (paused) return;
    if (isWhole) store.reset();
    linked = true;
    store.apply(JSON.parse(event.data));
    schedule();
  };
  stream.addEventListener("whole", (event) => take(event, true));
  stream.addEventListener("fresh", (event) => take(event, false));
  // The page reads too slowly; the service has gone on and sends everything anew.
  stream.addEventListener("lost", (event) => {
    lostUpdates += JSON.parse(event.data).updates;
  });
  stream.addEventListener("stopped", () => lose());
  stream.addEventListener("error", () => {
    lose();
    // A refused stream is not tried again by the browser.
    if (stream.readyState === EventSource.CLOSED && stream === current) setTimeout(() => (current = connect()), 2000);
  });
  return stream;
}

function lose() {
  linked = false;
  schedule();
}

let current = connect();

function pause(hold) {
  paused = hold;
  by("pause").setAttribute("aria-pressed", String(hold));
  by("pause").textContent = hold ? "Go on" : "Pause";
  // Going on begins with everything that the service remembers.
  if (!hold) {
    current.close();
    current = connect();
  }
  drawLink();
}

function drawLink() {
  const state = paused ? "paused" : linked ? "live" : lastUpdate ? "lost" : "connecting";
  const text = { live: lostUpdates ? `live, ${lostUpdates} updates lost` : "live", paused: "held still", connecting: "connecting", lost: "no connection, trying again" }[state];
  if (by("link").textContent !== text) {
    by("link").dataset.state = state;
    by("link").textContent = text;
    by("link").title = lostUpdates ? "This page or the link to it is too slow for all updates; what is shown is the newest" : "";
  }
}

function empty() {
  const place = by("empty"), session = store.session;
  let html = "";
  if (!linked && !paused && lastUpdate) {
    html = "<strong>No connection to the service</strong><p>What you see is from the last contact. See whether <code>nesam serve</code> runs and the network is up; this page connects by itself.</p>";
  } else if (!linked && !paused && !store.service) {
    html = "<strong>The service does not answer</strong><p>Start it with <code>nesam serve</code> and leave this page open: it connects by itself.</p>";
  } else if (!session) {
    html = "<strong>No vehicle yet</strong><p>A vehicle appears here when a session is opened. See one drive with <code>nesam demo</code>, or open a session with a client: <code>nesam.Client(\"HOST:PORT\").open_session(\"truck\")</code>.</p>";
  } else if (!session.newest && !session.trail.length) {
    html = `<strong>Session ${session.session.replace(/[&<>]/g, "")} is open</strong><p>It waits for its first measurement, over gRPC or Zenoh.</p>`;
  }
  panels.put(place, html);
  place.hidden = !html;
}

function tabs() {
  const names = [...store.sessions.keys()];
  const nav = by("vehicles");
  if (nav.dataset.names !== JSON.stringify(names)) {
    nav.dataset.names = JSON.stringify(names);
    nav.replaceChildren(...(names.length > 1 ? names : []).map((name) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = button.dataset.session = name;
      button.addEventListener("click", () => {
        store.selected = name;
        schedule(true);
      });
      return button;
    }));
  }
  for (const button of nav.children) button.setAttribute("aria-current", String(button.dataset.session === store.selected));
}

function clock(seconds) {
  const [h, m, s] = [seconds / 3600, (seconds / 60) % 60, seconds % 60].map((v) => String(Math.floor(v)).padStart(2, "0"));
  return `up ${h}:${m}:${s}`;
}

const minus = (metres) => metres.toFixed(1).replace("-", "\u2212");

function legend() {
  const session = store.session, sample = (colour, width, dash = "") => `<svg viewBox="0 0 24 10" aria-hidden="true"><path d="M1 5H23" fill="none" stroke="var(${colour})" stroke-width="${width}" stroke-dasharray="${dash}"/></svg>`;
  const lines = [], [low, high] = map.ground?.about.height_range_m ?? [];
  if (session?.trail.length) lines.push(`${sample("--ink", 2.5)}driven`);
  if (session?.fan) lines.push(`${sample("--blue", 1.5)}${session.fan.samples} candidates, ${session.fan.horizon_s.toFixed(1)} s`);
  if (session?.fan?.flagged.some(Boolean)) lines.push(`${sample("--vermilion", 1.5, "4 3")}outside what was trained or known`);
  if (session?.region) lines.push(`${sample("--orange", 2.5)}one of them, 90 % regions`);
  if (map.ground && map.layer === "elevation") lines.push(`<span class="soft">contours every ${map.ground.contour_m} m; dark ${minus(low)} m, light ${minus(high)} m</span>`);
  if (map.ground && map.layer === "semantics" && !map.ground.colours) lines.push('<span class="soft">this map has no semantics</span>');
  // Classes of the map in their colours, as far as it names some.
  if (map.ground && map.layer === "semantics") {
    const classes = map.ground.about.classes.filter((one) => one.colour);
    const patch = (colour) => `<svg viewBox="0 0 24 10" aria-hidden="true"><path d="M1 0h22v10h-22z" fill="rgb(${colour.map((v) => painted(v, map.dark.matches))})"/></svg>`;
    for (const { name, colour } of classes.slice(0, CLASSES_SHOWN)) lines.push(`${patch(colour)}${panels.esc(name.replaceAll("_", " "))}`);
    if (classes.length > CLASSES_SHOWN) lines.push(`<span class="soft">and ${classes.length - CLASSES_SHOWN} more under the pointer</span>`);
  }
  panels.put(by("legend"), lines.map((line) => `<li>${line}</li>`).join(""));
}

function cursor() {
  const at = map.pointer && map.toWorld(...map.pointer), place = by("cursor");
  place.hidden = !at;
  if (!at) return;
  const height = map.ground?.height(...at), name = map.ground?.className(...at);
  place.textContent = `x ${at[0].toFixed(2)}  y ${at[1].toFixed(2)}${Number.isFinite(height) ? `  z ${height.toFixed(2)} m` : " m"}${name ? `  ${name.replaceAll("_", " ")}` : ""}`;
}

function describeMap() {
  const n = store.session?.newest;
  const text = n ? `Map. ${store.selected} at x ${n.position_m[0].toFixed(0)} m, y ${n.position_m[1].toFixed(0)} m, heading ${((n.attitude_rad[2] * 180) / Math.PI).toFixed(0)} degrees` : "Map, no vehicle";
  if (by("map").getAttribute("aria-label") !== text) by("map").setAttribute("aria-label", text);
}

// How predictions came true, in a sentence.
function forecasts(check) {
  if (!check) return "";
  const after = (check.steps / 10).toFixed(1), { checked, error_rms_m, expected_rms_m } = check;
  return `came true ${error_rms_m.toFixed(2)} m off after ${after} s, expected ${expected_rms_m.toFixed(2)} m (${checked} so far)`;
}

function draw() {
  drawLink();
  tabs();
  const session = store.session, service = store.service;
  by("bundle").textContent = service ? `${service.bundle} ${service.bundle_hash.slice(0, 10)} · ${service.vehicle_card.split(" (")[0]} · nesam ${service.version}` : "";
  by("bundle").title = service ? `Bundle, vehicle card, version of the service. ${service.vehicle_card}` : "";
  by("clock").textContent = service ? clock(store.now) : "";
  by("map-name").textContent = session?.map ? `${session.map.id}, version ${session.map.version}` : session ? "no map" : "";
  for (const [id, on] of [["layer-elevation", map.layer === "elevation"], ["layer-semantics", map.layer === "semantics"], ["view-follow", map.mode === "follow"], ["view-all", map.mode === "all"]]) by(id).setAttribute("aria-pressed", String(on));
  map.draw();
  legend();
  cursor();
  describeMap();
  empty();
  by("nis-text").textContent = nis.draw(session);
  by("forecast-text").textContent = forecasts(session?.forecasts);
  by("latency-text").textContent = latency.draw(store);
  panels.vehicle({ list: by("vehicle"), name: by("vehicle-name"), outcomes: by("outcomes") }, session, service?.vehicles_alive?.includes(session?.vehicle));
  panels.alarms(by("alarms"), by("alarm-count"), store);
  panels.soil(by("soil"), by("soil-text"), session);
  panels.service(by("service"), store);
  panels.reports(by("reports"), by("report-count"), store.reports);
  document.body.dataset.drawn = String(Number(document.body.dataset.drawn ?? 0) + 1);
}

for (const layer of ["elevation", "semantics"]) by(`layer-${layer}`).addEventListener("click", () => map.setLayer(layer));
for (const mode of ["follow", "all"]) by(`view-${mode}`).addEventListener("click", () => map.setMode(mode));
by("zoom-in").addEventListener("click", () => map.zoom(1.4));
by("zoom-out").addEventListener("click", () => map.zoom(1 / 1.4));
by("pause").addEventListener("click", () => pause(!paused));
by("help-open").addEventListener("click", () => by("help").showModal());

const KEYS = {
  1: () => map.setLayer("elevation"), 2: () => map.setLayer("semantics"), f: () => map.setMode("follow"), a: () => map.setMode("all"),
  "+": () => map.zoom(1.4), "=": () => map.zoom(1.4), "-": () => map.zoom(1 / 1.4),
  "[": () => (store.step(-1), schedule(true)), "]": () => (store.step(1), schedule(true)), "?": () => by("help").showModal(),
};
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || by("help").open) return;
  if (event.key === " " && !["BUTTON", "SUMMARY"].includes(event.target.tagName)) {
    event.preventDefault();
    pause(!paused);
  } else if (KEYS[event.key.toLowerCase()]) {
    KEYS[event.key.toLowerCase()]();
  }
});

// A stream that says nothing for long is lost, whatever the browser thinks of it.
setInterval(() => {
  if (linked && !paused && performance.now() - lastUpdate > SILENT_MS) lose();
}, 1000);
draw();
