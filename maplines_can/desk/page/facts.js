// Facts as the server sends them (maplines_can/desk/facts.py), and what is computed from them.
// Units are SI. Covariances are upper triangles, row by row.

export const PARAMETERS = ["y_off", "beta", "c0", "c1"];
export const UNITS = {y_off: "m", beta: "rad", c0: "1/m", c1: "1/m²"};
/** Facts that are farther apart are not joined [s]. */
export const GAP = 0.5;
/** x counts as in a range up to this [m], as in MapLine. */
const TOLERANCE = 2 ** -10;
/** Most facts that the page keeps. */
const KEPT = 9000;

/** Return the place of an entry in an upper triangle of n rows. */
export function place(i, j, n) {
  const [row, column] = i < j ? [i, j] : [j, i];
  return row * n - (row * (row - 1)) / 2 + column - row;
}

/** Return the lateral position of a cubic at x. */
export function lateral([yOff, beta, c0, c1], x) {
  return yOff + x * (Math.tan(beta) + x * (c0 / 2 + (x * c1) / 6));
}

/** Return the derivative of the lateral position with respect to the parameters. */
export function jacobian([, beta], x) {
  const slope = Math.tan(beta);
  return [1, (1 + slope * slope) * x, (x * x) / 2, (x * x * x) / 6];
}

/** Return sqrt(v' C v) for the entries of v that stand in the rows from `starts` on, 4 each. */
export function spread(upper, n, vectors, starts) {
  let variance = 0;
  vectors.forEach((left, a) =>
    vectors.forEach((right, b) => {
      for (let i = 0; i < left.length; i++)
        for (let j = 0; j < right.length; j++)
          variance += left[i] * right[j] * upper[place(starts[a] + i, starts[b] + j, n)];
    }),
  );
  return Math.sqrt(Math.max(0, variance));
}

/** Return mean and standard deviation of a line at x, or null outside of its valid range. */
export function at(line, x) {
  if (!(x >= line.x[0] - TOLERANCE && x <= line.x[1] + TOLERANCE)) return null;
  return {value: lateral(line.mean, x), sigma: spread(line.cov, 4, [jacobian(line.mean, x)], [0])};
}

/** Return a parameter with its standard deviation. */
export function parameter(line, k) {
  return {value: line.mean[k], sigma: Math.sqrt(Math.max(0, line.cov[place(k, k, 4)]))};
}

const LANE = ["EGO_LEFT", "EGO_RIGHT"];

/**
 * Return the width of the ego lane at x, from the joint covariance of its lines; sigma is null if
 * there is none. Null if a line is missing, not usable or not valid there.
 */
export function width(facts, x) {
  const slots = LANE.map((name) => facts.slots[name]);
  if (!slots.every((slot) => slot?.line && slot.usable)) return null;
  return distance(slots.map(({line}) => line), facts.scene?.usable ? facts.scene : null, x);
}

/** Return the width of the lane that a consumer has fused, or null. */
export function fusedWidth(facts, x) {
  const fused = facts.consumer?.fused;
  const lines = LANE.map((name) => fused?.lines[name]);
  return lines.every(Boolean) ? distance(lines, fused, x) : null;
}

/** Return the lateral distance of the lines of the ego lane; scene has their joint covariance. */
function distance(lines, scene, x) {
  const ends = lines.map((line) => at(line, x));
  if (!ends.every(Boolean)) return null;
  const value = ends[0].value - ends[1].value;
  const places = LANE.map((name) => scene?.slots.indexOf(name) ?? -1);
  if (places.includes(-1)) return {value, sigma: null};
  const [plus, minus] = lines.map(({mean}) => jacobian(mean, x));
  const vectors = [plus, minus.map((d) => -d)];
  const starts = places.map((k) => 4 * k);
  return {value, sigma: spread(scene.joint, 4 * scene.slots.length, vectors, starts)};
}

/** Return the correlations of a covariance, (n, n). */
export function correlations(upper, n) {
  const sigma = Array.from({length: n}, (_, i) => Math.sqrt(upper[place(i, i, n)]));
  return sigma.map((own, i) =>
    sigma.map((other, j) => (own * other > 0 ? upper[place(i, j, n)] / (own * other) : 0)),
  );
}

/** Return the half axes of the ellipse of one sigma over the first two of three, and its angle. */
export function ellipse([along, mixed, , across]) {
  const mean = (along + across) / 2;
  const root = Math.hypot((along - across) / 2, mixed);
  const angle = Math.atan2(2 * mixed, along - across) / 2;
  return {major: Math.sqrt(mean + root), minor: Math.sqrt(Math.max(0, mean - root)), angle};
}

/** Return whether a text of a change tells a fault, and not that all is well again. */
export function isFault(text) {
  return !/(-> (INIT|VALID)|: back)$/.test(text);
}

/** Facts by their numbers, loaded in parts from the server as they are asked for. */
export class Store {
  constructor(info, changed) {
    this.info = info;
    this.changes = []; // [number, t, texts], by number
    this._facts = new Map();
    this._whole = new Set();
    this._wanted = [];
    this._loading = new Set();
    this._changed = changed;
    this._latest = -1;
    this._nextChange = 0;
  }

  /** Number of the first facts that the server keeps, and of the last ones. */
  get first() {
    return this.info.first * this.info.part;
  }

  get last() {
    return Math.max(this._latest, this.info.count - 1);
  }

  /** Time of the first facts that are kept, and of the last ones [s]. */
  get begin() {
    return this.info.starts[0] ?? 0;
  }

  get end() {
    return Math.max(this.info.end, this._facts.get(this._latest)?.t ?? -Infinity);
  }

  get(number) {
    return this._facts.get(number);
  }

  /** Return facts; if they are not here, ask for them and return undefined. */
  want(number) {
    const facts = this._facts.get(number);
    if (facts === undefined && number >= this.first && number <= this.last)
      this._ask(Math.floor(number / this.info.part));
    return facts;
  }

  /** Take the newest facts. */
  put(number, facts) {
    this._facts.set(number, facts);
    this._latest = number;
    if (facts.changes.length) this._addChange([number, facts.t, facts.changes]);
    this._forget(number);
  }

  /** Take what the server keeps by now. */
  update(info) {
    this.info = info;
    while (this.changes.length && this.changes[0][0] < this.first) this.changes.shift();
  }

  /** Ask for changes that are not here. */
  async loadChanges() {
    const {next, changes} = await (await fetch(`/changes/${this._nextChange}`)).json();
    this._nextChange = next;
    changes.forEach((change) => this._addChange(change));
  }

  _addChange(change) {
    const {changes} = this;
    let k = changes.length;
    while (k && changes[k - 1][0] > change[0]) k--;
    if (!k || changes[k - 1][0] !== change[0]) changes.splice(k, 0, change);
  }

  /** Return the number of the last facts up to a time. */
  numberAt(t) {
    const {starts, first, part, count} = this.info;
    let k = bisect(starts.length, (i) => starts[i] > t) - 1;
    if (k < 0) return this.first;
    const begin = (first + k) * part;
    const n = k + 1 < starts.length ? part : Math.max(count, this._latest + 1) - begin;
    const known = (i) => this._facts.get(begin + i)?.t;
    if (known(0) === undefined || known(n - 1) === undefined) {
      const end = starts[k + 1] ?? this.end;
      return begin + Math.min(n - 1, Math.floor(((t - starts[k]) / (end - starts[k] || 1)) * n));
    }
    return begin + Math.max(0, bisect(n, (i) => (known(i) ?? Infinity) > t) - 1);
  }

  _ask(part) {
    if (this._whole.has(part) || this._loading.has(part)) return;
    this._wanted = [part, ...this._wanted.filter((other) => other !== part)].slice(0, 100);
    this._load();
  }

  async _load() {
    if (this._loading.size >= 2 || !this._wanted.length) return;
    const part = this._wanted.shift();
    this._loading.add(part);
    try {
      const answer = await fetch(`/parts/${part}`);
      const found = answer.ok ? await answer.json() : [];
      found.forEach((facts, k) => this._facts.set(part * this.info.part + k, facts));
      if (found.length === this.info.part || !answer.ok) this._whole.add(part);
      this._forget(part * this.info.part);
      this._changed();
    } catch {
      await new Promise((done) => setTimeout(done, 1000)); // the server has gone
    }
    this._loading.delete(part);
    this._load();
  }

  /** Forget the facts that are farthest from those of a number. */
  _forget(number) {
    if (this._facts.size <= KEPT) return;
    const far = [...this._facts.keys()].sort((a, b) => Math.abs(b - number) - Math.abs(a - number));
    far.slice(0, KEPT / 3).forEach((k) => {
      this._facts.delete(k);
      this._whole.delete(Math.floor(k / this.info.part));
    });
  }
}

/** Return the first of n places for which a test holds, or n. */
export function bisect(n, test) {
  let [low, high] = [0, n];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (test(middle)) high = middle;
    else low = middle + 1;
  }
  return low;
}
