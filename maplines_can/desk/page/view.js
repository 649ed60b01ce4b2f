// The page: where in time it is, what it draws, and the connection to the server.

import {GAP, PARAMETERS, Store, UNITS, at, fusedWidth, isFault, parameter, width} from "./facts.js";
import * as charts from "./charts.js";
import * as tables from "./tables.js";
import {connect} from "./controls.js";

const $ = (id) => document.getElementById(id);

export const SPANS = [2, 5, 10, 20, 60, 300];
export const SPEEDS = [0.1, 0.2, 0.5, 1, 2, 5, 10];
/** Time between updates of tables while facts come [ms]. */
const TABLES = 250;
/** A longer time without facts is skipped while a log plays [s]. */
const LONG = 2;

class View {
  constructor(info) {
    this.store = new Store(info, () => this.draw());
    this.mode = info.is_live ? "newest" : "pause"; // or "play"
    this.number = 0; // of the facts that are shown
    this.time = this.store.begin; // while it plays
    this.shown = null; // the facts that are drawn
    this.span = 20;
    this.speed = 1;
    this.x = 20;
    this.hidden = new Set();
    this.draws = 0;
    this._tables = 0;
    this._due = false;
    this._sought = null; // time that is gone to
    this.zoomHome();
    this.drawTheme();
  }

  /** Show 100 m of the road from above, and 9 m to each side. */
  zoomHome() {
    const {clientWidth, clientHeight} = $("above");
    this.isHome = true;
    this.view = {ahead: 36, left: 0, perAhead: 100 / clientHeight, perLeft: 18 / clientWidth};
    this.draw();
  }

  get isLive() {
    return this.store.info.is_live;
  }

  /** Time that is 0 on the axes: that of the first facts [s]. */
  get zero() {
    return this.store.info.zero;
  }

  /** Begin and end of the time that is drawn: before the newest facts, or around those shown. */
  get window() {
    const {begin, end} = this.store;
    const t = this.shown?.t ?? this.time;
    const to = this.mode === "newest" ? end : Math.min(end, Math.max(t + this.span / 2, begin + this.span));
    return [to - this.span, to];
  }

  // ---- time ----

  _setMode(mode) {
    this.mode = mode;
    this._sought = null;
    this._tables = 0; // the tables and the status follow at once
  }

  /** Show the facts of a number, and stop. */
  go(number) {
    this._setMode("pause");
    this.number = Math.max(this.store.first, Math.min(this.store.last, number));
    this.time = this.store.get(this.number)?.t ?? this.time;
    this.draw();
  }

  goToTime(t) {
    this.go(this.store.numberAt(t));
    this.time = this._sought = t; // the number is exact once the facts around it are here
  }

  step(n) {
    this.go(this.number + n);
  }

  skip(seconds) {
    this.goToTime((this.shown?.t ?? this.time) + seconds);
  }

  newest() {
    this._setMode(this.isLive ? "newest" : "pause");
    this.number = this.store.last;
    this.draw();
  }

  toggle() {
    if (this.mode !== "pause") return this.go(this.number);
    if (this.number >= this.store.last) {
      if (this.isLive) return this.newest();
      this.number = this.store.first;
    }
    this._setMode("play");
    this.time = this.store.get(this.number)?.t ?? this.store.begin;
    this._before = performance.now();
    this.draw();
  }

  /** Go to the next or the previous facts with a fault. */
  fault(direction) {
    const after = (number) => direction * (number - this.number) > 0;
    const faults = this.store.changes.filter(([n, , texts]) => after(n) && texts.some(isFault));
    const found = direction > 0 ? faults[0] : faults.at(-1);
    if (found) {
      this.time = found[1];
      this.go(found[0]);
    }
  }

  /** Move on by the time that has passed, while it plays. */
  _play() {
    const now = performance.now();
    this.time += (Math.min(now - this._before, 500) / 1000) * this.speed;
    this._before = now;
    const {store} = this;
    let number = Math.max(this.number, store.numberAt(this.time));
    const next = store.want(number + 1);
    if (number === this.number && next && next.t - store.get(number)?.t > LONG) {
      number++; // over the gap
      this.time = next.t;
    }
    if (number >= store.last && (this.isLive || store.info.is_over)) this.newest();
    store.want(Math.min(store.last, number + Math.round(store.info.part * Math.max(1, this.speed))));
    this.number = Math.min(number, store.last);
  }

  // ---- drawing ----

  drawTheme() {
    this.theme = charts.themeOf(document.documentElement);
    this.draw();
  }

  /** Draw before the screen is refreshed. */
  draw() {
    if (this._due) return;
    this._due = true;
    requestAnimationFrame(() => {
      this._due = false;
      this._draw();
    });
  }

  _draw() {
    if (this.mode === "newest") this.number = this.store.last;
    if (this.mode === "play") this._play();
    if (this._sought !== null) this.number = this.store.numberAt(this._sought);
    const facts = this.store.want(this.number);
    const isNew = facts && facts !== this.shown;
    if (facts) this.shown = facts;
    if (this.mode !== "play" || isNew || !facts) this.paint((id) => charts.picture($(id), this.theme));
    this._showTables();
    if (this.mode === "play") this.draw();
  }

  /** Draw everything on the pictures that a function gives by the names of the canvases. */
  paint(pictureOf) {
    const {shown} = this;
    this.draws++;
    charts.birdsEye(pictureOf("above"), shown, this.view, this);
    this._paintSeries(pictureOf);
    this._paintMatrix(pictureOf("matrix"));
    const {begin, end, changes, info} = this.store;
    const whole = {begin, end, changes, isOver: info.is_live || info.is_over, window: this.window};
    charts.timeline(pictureOf("timeline"), {...whole, cursor: shown?.t ?? begin});
  }

  _paintSeries(pictureOf) {
    const [from, to] = this.window;
    const marks = this.store.changes
      .filter(([, t, texts]) => t >= from && t <= to && texts.some(isFault)).map(([, t]) => t);
    const frame = {window: [from, to], cursor: this.shown?.t ?? from, zero: this.zero, marks, hasTimes: false};
    const sampled = this.sampled($("chart-y").clientWidth);
    const k = PARAMETERS.indexOf($("parameter").value);
    const draw = (id, what) => charts.series(pictureOf(id), what, frame);
    draw("chart-y", {
      name: `lateral position y at x = ${this.x} m`, unit: "m", least: 0.5,
      curves: [
        ...this._curves(sampled, (line) => at(line, this.x)),
        ...this._fused(sampled, (line) => at(line, this.x)),
      ],
    });
    const lane = sampled.map((facts) => facts && this._point(facts, width(facts, this.x), true));
    const widths = lane.filter(Boolean);
    const isJoint = !widths.length || widths.some((point) => point[2] !== null);
    draw("chart-width", {
      name: `width of the ego lane at x = ${this.x} m${isJoint ? "" : " (no joint covariance on this bus: no bands)"}`,
      unit: "m", least: 0.3,
      curves: [
        {colour: charts.colour("CENTRE", this.theme), points: lane},
        {colour: this.theme.text, points: sampled.map((facts) => facts && this._point(facts, fusedWidth(facts, this.x), true))},
      ],
    });
    const unit = UNITS[PARAMETERS[k]];
    draw("chart-parameter", {
      name: PARAMETERS[k], unit, least: [0.2, 0.01, 1e-4, 1e-6][k],
      curves: [
        ...this._curves(sampled, (line) => parameter(line, k)),
        ...this._fused(sampled, (line) => parameter(line, k)),
      ],
    });
    const load = sampled.map((facts) => facts?.traffic ? [facts.t, 100 * (facts.traffic.load ?? 0), null, true] : null);
    draw("chart-load", {
      name: "bus load", unit: "%", least: 2,
      curves: [{colour: this.theme.text, points: load}],
    });
    frame.hasTimes = true;
    const rows = this._states(sampled);
    const height = `${44 + 20 * Math.max(1, rows.length)}px`;
    if ($("chart-states").style.height !== height) $("chart-states").style.height = height;
    charts.strips(pictureOf("chart-states"), rows, frame);
  }

  /** Return facts of the time that is drawn, about two pixels apart; null where there is a gap. */
  sampled(pixels) {
    const [from, to] = this.window;
    const {store} = this;
    const [low, high] = [store.numberAt(from), store.numberAt(to)];
    const stride = Math.max(1, Math.ceil((high - low) / (pixels / 2)));
    const found = [];
    let last = -Infinity;
    for (let n = Math.ceil(low / stride) * stride; n <= high; n += stride) {
      const facts = store.want(n);
      if (!facts || facts.t < from) continue;
      if (facts.t - last > GAP * stride) found.push(null);
      found.push(facts);
      last = facts.t;
    }
    return found;
  }

  /** Wait until all facts of the time that is drawn are here, 30 s at most. */
  async whole() {
    const [low, high] = this.window.map((t) => this.store.numberAt(t));
    for (let tries = 0; tries < 300; tries++) {
      let missing = 0;
      for (let n = low; n <= high; n++) missing += this.store.want(n) === undefined;
      if (!missing) return;
      await new Promise((done) => setTimeout(done, 100));
    }
  }

  _point(facts, value, isUsable) {
    return value && [facts.t, value.value, value.sigma, isUsable];
  }

  _curves(sampled, valueOf) {
    const names = new Set(sampled.flatMap((facts) => (facts ? Object.keys(facts.slots) : [])));
    return this.store.info.slots.filter((name) => names.has(name) && !this.hidden.has(name)).map((name) => ({
      name,
      colour: charts.colour(name, this.theme),
      points: sampled.map((facts) => {
        const slot = facts?.slots[name];
        return slot?.line ? this._point(facts, valueOf(slot.line), slot.usable) : null;
      }),
    }));
  }

  /** Return the curves of the lane that a consumer has fused. */
  _fused(sampled, valueOf) {
    const names = new Set(sampled.flatMap((facts) => facts?.consumer?.fused?.slots ?? []));
    return [...names].map((name) => ({
      name: `fused ${name}`,
      colour: this.theme.text,
      points: sampled.map((facts) => {
        const line = facts?.consumer?.fused?.lines[name];
        return line ? this._point(facts, valueOf(line), true) : null;
      }),
    }));
  }

  _states(sampled) {
    const rows = new Map();
    let before = null;
    for (const facts of sampled) {
      for (const [name, own] of Object.entries(facts?.messages ?? {})) {
        if (!rows.has(name)) rows.set(name, []);
        const spans = rows.get(name);
        const last = spans.at(-1);
        if (last && before && last[2] === own.state) last[1] = facts.t;
        else {
          if (last && before) last[1] = facts.t;
          spans.push([facts.t, facts.t, own.state]);
        }
      }
      before = facts;
    }
    return [...rows].map(([name, spans]) => ({name, spans}));
  }

  _paintMatrix(target) {
    const {scene, slots} = this.shown ?? {};
    const of = $("of").value;
    const line = slots?.[of]?.line;
    if (of === "scene" && scene)
      charts.matrix(target, scene.joint, 4 * scene.slots.length, {groups: scene.slots});
    else if (line) charts.matrix(target, line.cov, 4, {texts: PARAMETERS});
    else charts.nothing(target, of === "scene" ? "no scene: no pose error comes" : "no such line");
  }

  _showTables() {
    const now = performance.now();
    const wait = this.mode === "pause" ? 0 : this._tables + TABLES - now;
    $("position").value = this.shown?.t ?? 0;
    if (!this.shown || wait > 0) return;
    this._tables = now;
    const {store, shown} = this;
    const ratio = charts.short(this.view.perAhead / this.view.perLeft);
    const consumer = shown.consumer ? "; fused lane: bands as dark as text; camera: dots" : "";
    $("scale").textContent = `ahead is up; drawn ${ratio} times as wide as long${consumer}`;
    tables.showLines(shown, this.x);
    tables.showMessages(shown, store.get(store.numberAt(shown.t - 2)));
    tables.showChanges(store.changes, this.number, this.zero, (number) => this.go(number));
    tables.describe(shown, this.x, this.window);
    this._showTransport();
  }

  _showTransport() {
    const {store, shown} = this;
    const clock = new Date(1000 * shown.t).toISOString().replace("T", " ").slice(0, 23);
    const behind = this.isLive && this.mode !== "newest" ? `, ${(store.end - shown.t).toFixed(1)} s ago` : "";
    $("clock").textContent =
      `${(shown.t - this.zero).toFixed(2)} s${behind}${shown.t > 1e8 ? ` · ${clock} UTC` : ""}`;
    Object.assign($("position"), {min: store.begin, max: store.end});
    $("position").setAttribute("aria-valuetext", `${(shown.t - this.zero).toFixed(2)} seconds`);
    $("play").textContent = this.mode === "pause" ? "play" : "pause";
    $("live").disabled = this.mode === "newest";
    this.showStatus();
  }

  /** Say in the head what the facts are of, and whether they come. */
  showStatus() {
    const {info} = this.store;
    const {link} = this.shown ?? {};
    const texts = {newest: "live", pause: "paused", play: `playing at ${this.speed}×`};
    const found = info.error || (!info.is_live && !info.is_over && `reading, ${info.count} facts so far`);
    const text = this.isGone ? "the server has gone" : link && !link.up ? "the interface is lost" : found || texts[this.mode];
    if ($("status").textContent !== text) $("status").textContent = text;
    $("status").className = this.isGone || info.error || (link && !link.up) ? "bad" : "good";
    $("name").textContent = info.name;
  }
}

/** Ask what the server keeps, again and again. */
async function poll(view) {
  for (;;) {
    await new Promise((done) => setTimeout(done, view.store.info.is_over ? 5000 : 1000));
    try {
      const info = await (await fetch("/info")).json();
      if (info.session !== view.store.info.session) return location.reload();
      const hasMore = info.count !== view.store.info.count;
      view.isGone = false;
      view.store.update(info);
      if (hasMore && !view.isLive) await view.store.loadChanges();
      if (hasMore && view.mode !== "newest") view.draw();
    } catch {
      view.isGone = true;
    }
    view.showStatus();
  }
}

function listen(view) {
  const events = new EventSource("/events");
  events.onmessage = ({data, lastEventId}) => {
    view.store.put(Number(lastEventId), JSON.parse(data));
    if (view.mode === "newest") view.draw();
  };
}

async function start() {
  const info = await (await fetch("/info")).json();
  const view = new View(info);
  globalThis.maplines = {view, charts, facts: {at, width, parameter}}; // for tests, and the console
  connect(view);
  view.showStatus();
  await view.store.loadChanges();
  if (info.is_live) listen(view);
  poll(view);
  view.draw();
}

start();
