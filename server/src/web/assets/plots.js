// Two small plots: consistency of the soil filter, time of predictions.

import { chiSquareInterval, quantile, TIMINGS_S } from "./store.js";

const NS = "http://www.w3.org/2000/svg";
const esc = (text) => String(text).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
const SHOWN_TESTS = 60;

class Plot {
  constructor(place, label) {
    this.place = place;
    this.svg = document.createElementNS(NS, "svg");
    this.svg.setAttribute("role", "img");
    this.wait = document.createElement("p");
    this.wait.className = "wait";
    place.append(this.svg, this.wait);
    this.label = label;
    this.hover = null;
    this.svg.addEventListener("pointermove", (event) => {
      this.hover = event.offsetX;
      this.last && this.draw(this.last);
    });
    this.svg.addEventListener("pointerleave", () => {
      this.hover = null;
      this.last && this.draw(this.last);
    });
  }

  frame() {
    const { clientWidth: w, clientHeight: h } = this.place;
    return { w, h, left: 40, right: w - 8, top: 6, bottom: h - 20 };
  }

  say(text, waiting) {
    this.wait.hidden = !waiting;
    this.wait.textContent = waiting ? text : "";
    this.svg.setAttribute("aria-label", `${this.label}: ${text}`);
    if (waiting) this.svg.innerHTML = "";
  }
}

// NIS over degrees of freedom on a logarithmic axis, one dot per buffer.
export class NisPlot extends Plot {
  draw(session) {
    this.last = session;
    const tests = (session?.tests ?? []).slice(-SHOWN_TESTS);
    if (!tests.length) {
      this.say(!session ? "no vehicle" : session.map ? "no full buffer of the soil filter since this page was opened" : "no map: the soil is not learned", true);
      return "";
    }
    const f = this.frame(), ratios = tests.map((t) => t.nis / t.dof), [low, high] = chiSquareInterval(tests.at(-1).dof);
    const top = Math.max(4, ...ratios) * 1.15, bottom = Math.min(0.4, ...ratios) / 1.15;
    const x = (i) => f.left + ((i + 0.5) / Math.max(tests.length, 20)) * (f.right - f.left);
    const y = (v) => f.bottom - (Math.log(v / bottom) / Math.log(top / bottom)) * (f.bottom - f.top);
    const ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].filter((t) => t > bottom && t < top);
    let svg = `<rect class="band" x="${f.left}" width="${f.right - f.left}" y="${y(high)}" height="${y(low) - y(high)}"/>`;
    for (const t of ticks) svg += `<path class="grid" d="M${f.left} ${y(t)}H${f.right}"/><text x="${f.left - 6}" y="${y(t) + 4}" text-anchor="end">${t}</text>`;
    svg += `<path class="one" d="M${f.left} ${y(1)}H${f.right}"/>`;
    tests.forEach((t, i) => {
      const [px, py] = [x(i), y(ratios[i])];
      svg += t.rejected ? `<path class="refused" d="M${px - 4} ${py - 4}l8 8m0 -8l-8 8"/>` : `<circle class="dot" cx="${px}" cy="${py}" r="2.8"/>`;
    });
    svg += `<text x="${f.left}" y="${f.bottom + 15}">buffer ${tests[0].judged}</text>`;
    // The second number needs room beside the first.
    if (tests.length >= 4) svg += `<text x="${x(tests.length - 1)}" y="${f.bottom + 15}" text-anchor="${tests.length > 12 ? "end" : "start"}">${tests.at(-1).judged}</text>`;
    if (this.hover !== null) {
      const i = Math.min(tests.length - 1, Math.max(0, Math.round(((this.hover - f.left) / (f.right - f.left)) * Math.max(tests.length, 20) - 0.5)));
      const note = `buffer ${tests[i].judged}: NIS ${tests[i].nis.toFixed(1)} over ${tests[i].dof} = ${ratios[i].toFixed(2)}${tests[i].rejected ? ", refused" : ""}`;
      svg += `<path class="probe" d="M${x(i)} ${f.top}V${f.bottom}"/><text class="note" x="${f.right}" y="${f.top + 10}" text-anchor="end">${note}</text>`;
    }
    const inside = ratios.filter((r) => r >= low && r <= high).length, refused = tests.filter((t) => t.rejected).length;
    const text = `NIS / dof, ${inside} of ${tests.length} in the 95 % band${refused ? `, ${refused} refused` : ""}`;
    this.say(text, false);
    this.svg.innerHTML = svg;
    return text;
  }
}

// Queue and computation of predictions of the last minute.
export class LatencyPlot extends Plot {
  draw(store) {
    this.last = store;
    const shown = store.timings;
    if (!shown.length) {
      this.say(store.timed ? "no prediction was asked for within a minute" : "no prediction was asked for since this page was opened", true);
      return "";
    }
    const f = this.frame(), total = (t) => t[1] + t[2], sorted = shown.map(total).sort((a, b) => a - b);
    const top = Math.max(quantile(sorted, 0.995) * 1.25, 2);
    const x = (at) => f.right - ((store.now - at) / TIMINGS_S) * (f.right - f.left), y = (ms) => f.bottom - (Math.min(ms, top) / top) * (f.bottom - f.top);
    const step = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((s) => top / s <= 5) ?? 10000;
    let svg = "";
    for (let t = 0; t <= top; t += step) svg += `<path class="grid" d="M${f.left} ${y(t)}H${f.right}"/><text x="${f.left - 6}" y="${y(t) + 4}" text-anchor="end">${t}</text>`;
    // A dot where it was answered; below it, as a line, what of that it waited.
    for (const t of shown) {
      const [px, py] = [x(t[0]).toFixed(1), y(total(t))];
      if (y(t[2]) - py > 1.5) svg += `<path class="queue" d="M${px} ${y(t[2]).toFixed(1)}V${py.toFixed(1)}"/>`;
      svg += `<circle class="dot" cx="${px}" cy="${py.toFixed(1)}" r="1.7"/>`;
    }
    svg += `<text x="${f.left}" y="${f.bottom + 15}">60 s ago</text><text x="${f.right}" y="${f.bottom + 15}" text-anchor="end">now</text>`;
    if (this.hover !== null) {
      const near = shown.reduce((a, b) => (Math.abs(x(b[0]) - this.hover) < Math.abs(x(a[0]) - this.hover) ? b : a));
      svg += `<path class="probe" d="M${x(near[0])} ${f.top}V${f.bottom}"/><text class="note" x="${f.right}" y="${f.top + 10}" text-anchor="end">${esc(`${near[3]} candidates: ${near[2].toFixed(1)} ms, ${near[1].toFixed(1)} ms in the queue`)}</text>`;
    }
    const text = `ms in the service, median ${quantile(sorted, 0.5).toFixed(1)}, 99 % ${quantile(sorted, 0.99).toFixed(1)}`;
    this.say(text, false);
    this.svg.innerHTML = svg;
    return text;
  }
}
