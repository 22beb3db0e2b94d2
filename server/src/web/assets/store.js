// What the page knows: updates of the service, put together.

const TRAIL_MAX = 600, TESTS_MAX = 200, TIMINGS_MAX = 1200, RATES_S = 5;
export const TIMINGS_S = 60;
// A vehicle whose newest measurement is older than this is silent.
export const STALE_S = 1;

function keepLast(list, fresh, most) {
  list.push(...fresh);
  if (list.length > most) list.splice(0, list.length - most);
}

export class Store {
  constructor() {
    this.reports = [];
    this.selected = null;
    this.reset();
  }

  // A whole update holds everything that the service still remembers.
  reset() {
    this.sessions = new Map();
    this.timings = [];
    this.timed = 0;
    this.timedEvery = 1;
    this.counts = [];
    this.alarms = [];
    this.service = null;
    this.now = 0;
  }

  apply(update) {
    this.now = update.now_s;
    this.service = update.service;
    this.alarms = update.alarms;
    if (update.reports) this.reports = update.reports;
    this.applyTimings(update.timings);
    const names = new Set(update.sessions.map((s) => s.session));
    for (const name of this.sessions.keys()) if (!names.has(name)) this.sessions.delete(name);
    for (const fresh of update.sessions) this.applySession(fresh);
    if (!this.sessions.has(this.selected)) this.selected = this.sessions.keys().next().value ?? null;
  }

  // Timings of the last minute; of too many every second, fourth, ... is kept, so that they are evenly chosen.
  applyTimings(fresh) {
    const candidates = fresh.reduce((sum, t) => sum + t[3], this.counts.at(-1)?.candidates ?? 0);
    this.counts.push({ at_s: this.now, predictions: this.service.predictions, candidates });
    while (this.counts.length > 2 && this.counts[1].at_s <= this.now - RATES_S) this.counts.shift();
    const kept = fresh.filter(() => this.timed++ % this.timedEvery === 0);
    this.timings = [...this.timings, ...kept].filter((t) => t[0] > this.now - TIMINGS_S);
    if (this.timings.length < TIMINGS_MAX / 4) this.timedEvery = Math.max(this.timedEvery / 2, 1);
    while (this.timings.length > TIMINGS_MAX) {
      this.timings = this.timings.filter((_, i) => i % 2 === 0);
      this.timedEvery *= 2;
    }
  }

  // Predictions or candidates a second, over the last seconds.
  rate(what) {
    const first = this.counts[0], last = this.counts.at(-1);
    return first === last ? NaN : (last[what] - first[what]) / (last.at_s - first.at_s);
  }

  applySession(fresh) {
    let held = this.sessions.get(fresh.session);
    if (!held) {
      held = { trail: [], tests: [], fan: null, region: null };
      this.sessions.set(fresh.session, held);
    }
    const { trail, tests, fan, region, ...rest } = fresh;
    Object.assign(held, rest);
    // A clock that was set or a restarted vehicle begins a new path.
    for (const point of trail) {
      const last = held.trail.at(-1);
      if (last && point[0] < last[0]) held.trail.length = 0;
      keepLast(held.trail, [point], TRAIL_MAX);
    }
    keepLast(held.tests, tests, TESTS_MAX);
    if (fan) held.fan = fan;
    if (region) held.region = region;
  }

  get session() {
    return this.sessions.get(this.selected) ?? null;
  }

  // Selects the vehicle so many places further on.
  step(by) {
    const names = [...this.sessions.keys()];
    if (names.length > 1) this.selected = names[(names.indexOf(this.selected) + by + names.length) % names.length];
  }
}

export const quantile = (sorted, share) => (sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : NaN);

// P(chi² > x) for an even number of degrees of freedom, exact.
export function chiSquareTail(dof, x) {
  let term = Math.exp(-x / 2), sum = term;
  for (let j = 1; j < dof / 2; j++) sum += term *= x / 2 / j;
  return sum;
}

const bounds = new Map();
// Two-sided 95 % interval of chi² over its degrees of freedom.
export function chiSquareInterval(dof) {
  if (!bounds.has(dof)) {
    const at = (tail) => {
      let low = 0, high = 10 * dof + 50;
      for (let i = 0; i < 60; i++) {
        const middle = (low + high) / 2;
        if (chiSquareTail(dof, middle) > tail) low = middle;
        else high = middle;
      }
      return low / dof;
    };
    bounds.set(dof, [at(0.975), at(0.025)]);
  }
  return bounds.get(dof);
}
