// Read-outs, soil, alarms, diagnoses.

import { STALE_S } from "./store.js";

export const esc = (text) => String(text ?? "").replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
const DEG = 180 / Math.PI;
const fixed = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits).replace("-", "\u2212") : "\u2013");

// Changes the page only where the text differs, so that a reader's place and selection stay.
export function put(element, html) {
  if (element.dataset.shown !== html) {
    element.dataset.shown = html;
    element.innerHTML = html;
  }
}

const reading = (name, value, unit = "", stale = false, title = "") =>
  `<div${stale ? ' class="stale"' : ""}${title ? ` title="${esc(title)}"` : ""}><dt>${name}</dt><dd>${value}${unit ? ` <small>${unit}</small>` : ""}</dd></div>`;

export function vehicle(elements, session, alive) {
  elements.name.textContent = session ? `${session.vehicle}${session.vehicle === session.session ? "" : `, session ${session.session}`}${alive ? ", in the Zenoh network" : ""}` : "";
  const n = session?.newest;
  if (!n) {
    put(elements.list, "");
    elements.outcomes.textContent = session ? "waiting for the first measurement" : "no session is open";
    return;
  }
  const [x, y, z] = n.position_m, [roll, pitch, yaw] = n.attitude_rad.map((a) => a * DEG), speed = Math.hypot(...n.velocity_m_s.slice(0, 2));
  put(elements.list, [
    reading("speed", fixed(speed, 2), "m/s"), reading("roll", fixed(roll, 1), "\u00b0", false, "left side up is positive"), reading("x", fixed(x, 2), "m"), reading("age", fixed(n.age_s, 1), "s", n.age_s > STALE_S, "time since the newest measurement arrived"),
    reading("commanded", fixed(n.command.speed_m_s, 2), "m/s"), reading("pitch", fixed(pitch, 1), "\u00b0", false, "nose down is positive"), reading("y", fixed(y, 2), "m"), reading("history", session.history_steps, "of 32", false, "measured steps that the next prediction starts from"),
    reading("second cmd", fixed(n.command.second, 2), "", false, "steering in the unit of the vehicle card"), reading("yaw", fixed(yaw, 1), "\u00b0", false, "counter-clockwise from east"), reading("z", fixed(z, 2), "m"), reading("yaw rate", fixed(n.angular_velocity_rad_s[2] * DEG, 1), "\u00b0/s"),
  ].join(""));
  const counts = Object.entries(session.outcomes).sort((a, b) => b[1] - a[1]);
  elements.outcomes.textContent = `measurements: ${counts.map(([kind, count]) => `${count} ${kind.replaceAll("_", " ")}`).join(", ") || "none since the page was opened"}`;
}

const SOIL = {
  k_phi: ["<i>K<sub>φ</sub></i>", "frictional modulus of sinkage", 1e-3, "kN/mⁿ⁺²"], k_c: ["<i>K<sub>c</sub></i>", "cohesive modulus of sinkage", 1e-3, "kN/mⁿ⁺¹"],
  n: ["<i>n</i>", "sinkage exponent", 1, ""], c: ["<i>c</i>", "cohesion", 1e-3, "kPa"], phi: ["<i>φ</i>", "angle of internal friction", DEG, "°"], k_shear: ["<i>K</i>", "shear deformation modulus", 1e3, "mm"],
};
const digits = (v) => (Math.abs(v) >= 100 ? 0 : Math.abs(v) >= 10 ? 1 : 2);

export function soil(element, text, session) {
  const s = session?.soil;
  text.textContent = !s ? "" : `${s.class ? `on ${s.class.replaceAll("_", " ")}, ` : ""}${s.epoch} update${s.epoch === 1 ? "" : "s"}`;
  if (!s) return put(element, `<p class="soft">${!session ? "no vehicle" : session.newest ? "not known here: the page asks the network for nothing, and nobody has predicted from this place yet" : "known with the first prediction"}</p>`);
  const rows = s.names.map((name, i) => {
    const [symbol, meaning, factor, unit] = SOIL[name], [low, high] = s.bounds[i], scale = s.logarithmic[i] ? Math.log : (v) => v;
    const at = (v) => `${(100 * Math.min(Math.max((scale(v) - scale(low)) / (scale(high) - scale(low)), 0), 1)).toFixed(2)}%`;
    const value = s.value[i] * factor, known = s.learned[i] && s.epoch > 0, band = s.low ? [s.low[i] * factor, s.high[i] * factor] : null;
    const withUnit = (v) => `${fixed(v, digits(v))}${unit ? ` ${unit}` : ""}`, told = withUnit(value), prior = withUnit(s.prior[i] * factor);
    const between = band ? `${fixed(band[0], digits(band[0]))} to ${fixed(band[1], digits(band[1]))}` : "no band";
    const label = known ? `${meaning} ${told}, 95 % ${between}` : `${meaning} not learned, estimate ${told}`;
    return `<tr class="${known ? "known" : "unknown"}" title="${esc(label)}; prior ${prior}"><th scope="row" aria-label="${esc(meaning)}">${symbol}</th>
      <td class="track"><svg role="img" aria-label="${esc(label)}"><line class="rail" x1="0" x2="100%" y1="9" y2="9"/>${s.low ? `<line class="spread" x1="${at(s.low[i])}" x2="${at(s.high[i])}" y1="9" y2="9.01"/>` : ""}<line class="prior" x1="${at(s.prior[i])}" x2="${at(s.prior[i])}" y1="2" y2="16"/><circle class="dot" cx="${at(s.value[i])}" cy="9" r="4"/></svg></td>
      <td class="value">${known ? `${told}<br><small>${between}</small>` : `not learned<br><small>prior ${prior}</small>`}</td></tr>`;
  });
  put(element, `<table><tbody>${rows.join("")}</tbody></table>`);
}

const SIGNS = {
  alarm: '<svg viewBox="0 0 12 12" class="alarm" role="img" aria-label="Alarm"><path fill="currentColor" d="M6 0l6 6-6 6-6-6z"/></svg>',
  warning: '<svg viewBox="0 0 12 12" class="warning" role="img" aria-label="Warning"><path fill="currentColor" d="M6 0.5l6 11H0z"/></svg>',
  notice: '<svg viewBox="0 0 12 12" class="notice" role="img" aria-label="Notice"><circle cx="6" cy="6" r="4.5" fill="none" stroke="currentColor" stroke-width="2"/></svg>',
};

export function alarms(element, count, store) {
  const several = store.sessions.size > 1;
  const line = (a) => `<li data-id="${esc(a.id)}">${SIGNS[a.level]}<span class="what">${several && a.session ? `${esc(a.session)}: ` : ""}${esc(a.what)}</span><span class="advice">${esc(a.advice)}</span></li>`;
  put(element, store.alarms.map(line).join("") || '<li class="none">none</li>');
  const grave = store.alarms.filter((a) => a.level === "alarm").length;
  count.textContent = grave ? `${grave} to act on` : "";
}

export function service(element, store) {
  const s = store.service;
  if (!s) return put(element, "");
  const cache = s.terrain_cache;
  const percent = (rate) => (rate === null ? "\u2013" : fixed(100 * rate, 1));
  put(element, [
    reading("predictions", fixed(store.rate("predictions"), 1), "/s"), reading("candidates", fixed(store.rate("candidates"), 0), "/s"),
    reading("waiting", s.waiting.predictions + s.waiting.commands), reading("answered", s.predictions),
    reading("cache hits, 10 s", percent(cache.recent_hit_rate), "%", false, "share of terrain lookups that needed no encoding, last ten seconds"), reading("cache hits, all", percent(cache.hit_rate), "%", false, `${cache.looked_up} lookups, ${cache.encoded} encoded`),
    reading("vehicles", s.vehicles_alive ? s.vehicles_alive.length : "\u2013", s.vehicles_alive ? "on Zenoh" : ""), reading("recording", s.recording ? fixed(s.recording.bytes / 1e6, 1) : "off", s.recording ? "MB" : ""),
  ].join(""));
}

const VERDICTS = { explained: "explained", none: "no effect found", ambiguous: "ambiguous", unexplained: "unexplained" };
const significant = (v) => (v === null || v === undefined ? "\u2013" : Number(v.toPrecision(3)).toString().replace("-", "\u2212"));

function parameter(p) {
  return `${esc(p.name)} ${significant(p.value)}${p.ci95 ? ` [${significant(p.ci95[0])}, ${significant(p.ci95[1])}]` : ""}${p.unit && p.unit !== "-" ? ` ${esc(p.unit)}` : ""}`;
}

function report(r) {
  const effects = (r.effects ?? []).map((e) => {
    const rivals = (e.rivals ?? []).map((v) => v.id).filter((id) => id !== e.id);
    const perhaps = e.onset_possible_s ? `, perhaps from ${significant(e.onset_possible_s)} s, and another size then` : "";
    const begun = e.onset_s ? `, from ${significant(e.onset_s)} s` : perhaps;
    return `<p class="effect"><strong>${esc(e.id)}</strong> ${(e.parameters ?? []).map(parameter).join(", ")}${begun}${rivals.length ? ` <span class="soft">not told from ${rivals.map(esc).join(", ")}</span>` : ""}</p>`;
  });
  const stages = [["before", "before", r.before], ["soil alone", "soil", r.soil_only], ["with effect", "after", r.after]].filter(([, kind, e]) => e?.position_m != null && (kind !== "after" || effects.length));
  const most = Math.max(...stages.map(([, , e]) => e.position_m));
  const bars = stages.map(([name, kind, e]) => `<span>${name}</span><i class="${kind}" data-share="${(e.position_m / most).toFixed(4)}"></i><span>${fixed(e.position_m, 3)} m${e.ci95 ? ` <span class="soft">[${fixed(e.ci95[0], 3)}, ${fixed(e.ci95[1], 3)}]</span>` : ""}</span>`);
  const axes = ["x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"];
  const table = stages.length ? `<details><summary>every axis, on ${r.held_out ?? "the"} drives that were not fitted</summary><table><thead><tr><th></th>${axes.map((a) => `<th scope="col">${a.replace("_", " ")}</th>`).join("")}</tr></thead><tbody>${stages.map(([name, , e]) => `<tr><th scope="row">${name}</th>${axes.map((a) => `<td>${e.mae_mean?.[a] == null ? "\u2013" : fixed(e.mae_mean[a], 3)}</td>`).join("")}</tr>`).join("")}</tbody></table></details>` : "";
  return `<article><h3>${esc(r.set)} <span>${VERDICTS[r.verdict] ?? esc(r.verdict)}</span></h3>${effects.join("") || `<p class="soft">${esc(r.reason)}</p>`}${bars.length ? `<div class="bars" role="img" aria-label="position error ${stages.map(([n, , e]) => `${n} ${fixed(e.position_m, 3)} m`).join(", ")}">${bars.join("")}</div>` : ""}${table}</article>`;
}

export function reports(element, count, list) {
  count.textContent = list.length ? `${list.length}, position error of 3.2 s forecasts` : "";
  put(element, list.map(report).join("") || '<p class="soft">None yet. When the vehicle does not move as predicted, run <code>nesam diagnose --set NAME --json reports/NAME.json</code> and serve with <code>--reports reports</code>.</p>');
  for (const bar of element.querySelectorAll("i[data-share]")) bar.style.width = `${100 * bar.dataset.share}%`;
}
