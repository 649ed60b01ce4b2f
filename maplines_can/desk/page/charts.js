// Drawing on canvas. A picture is {ctx, width, height, theme}; lengths are CSS pixels.

import {at, correlations, ellipse, isFault, lateral, spread, jacobian} from "./facts.js";

/** Okabe and Ito's colours by slot, as in maplines_can/recordings/plots/log_panels.py. */
const SLOTS = {
  EGO_LEFT: "#0072B2", EGO_RIGHT: "#D55E00", NEXT_LEFT: "#56B4E9", NEXT_RIGHT: "#E69F00",
  CENTRE: "#009E73", EDGE_LEFT: "#666666", EDGE_RIGHT: "#000000", ROUTE: "#CC79A7",
};
const ON_DARK = {EGO_LEFT: "#3C9BE0", EDGE_LEFT: "#AAAAAA", EDGE_RIGHT: "#FFFFFF"};
export const STATES = {VALID: "#009E73", INIT: "#F0E442", INVALID: "#D55E00", NODATA: "#BBBBBB"};
const FAULT = "#D55E00";
/** Dashes by kind of a line [px]. */
const DASHES = {DASHED: [10, 8], VIRTUAL: [2, 4], UNKNOWN: [6, 3, 1, 3]};
/** Lines of a larger standard deviation everywhere are drawn without bands [m]. */
const VAGUE = 50;
const FONT = "12px system-ui, sans-serif";

export const colour = (slot, theme) =>
  (theme.isDark && ON_DARK[slot]) || SLOTS[slot] || theme.text;

export const title = (name) => name.toLowerCase().replaceAll("_", " ");

/** Return a number with three digits. */
export function short(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size === 0) return "0";
  return size >= 1e5 || size < 1e-3 ? value.toExponential(1) : String(+value.toPrecision(3));
}

/** Return the colours of the page. */
export function themeOf(root) {
  const style = getComputedStyle(root);
  const colours = ["text", "muted", "grid", "surface"].map((name) => [
    name, style.getPropertyValue(`--${name}`).trim(),
  ]);
  return {...Object.fromEntries(colours), isDark: style.colorScheme === "dark"};
}

/** Return the picture of a canvas, cleared, and as sharp as the screen. */
export function picture(canvas, theme, scale = globalThis.devicePixelRatio || 1) {
  const {clientWidth: width, clientHeight: height} = canvas;
  const [w, h] = [Math.round(width * scale), Math.round(height * scale)];
  if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, {width: w, height: h});
  const ctx = canvas.getContext("2d", {alpha: false});
  ctx.setTransform(scale, 0, 0, scale, 0, 0);
  ctx.fillStyle = theme.surface;
  ctx.fillRect(0, 0, width, height);
  Object.assign(ctx, {font: FONT, lineJoin: "round", globalAlpha: 1});
  ctx.setLineDash([]);
  return {ctx, width, height, theme};
}

/** Return about n round values from low to high, and their number of decimals. */
export function ticks(low, high, n) {
  const rough = (high - low) / Math.max(1, n);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((k) => k * power >= rough * 0.999);
  const values = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) values.push(k * step);
  return {values, decimals: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), step};
}

function tickText(value, {decimals}) {
  return decimals > 4 ? value.toExponential(1) : value.toFixed(decimals);
}

function path(ctx, points) {
  ctx.beginPath();
  points.forEach(([a, b], k) => (k ? ctx.lineTo(a, b) : ctx.moveTo(a, b)));
}

/** Fill the bands of 3, 2 and 1 standard deviations of [a, b, half of a sigma in b]. */
function bands(ctx, points) {
  for (const k of [3, 2, 1]) {
    path(ctx, [
      ...points.map(([a, b, s]) => [a + k * s[0], b + k * s[1]]),
      ...points.toReversed().map(([a, b, s]) => [a - k * s[0], b - k * s[1]]),
    ]);
    ctx.globalAlpha = 0.15;
    ctx.fill();
  }
  ctx.globalAlpha = 1;
}

// ---- bird's-eye view ------------------------------------------------------------------------

/** Return functions from metres to pixels; view has ahead and left of its middle, and m per px. */
export function project({width, height}, view) {
  return {
    toX: (left) => width / 2 - (left - view.left) / view.perLeft,
    toY: (ahead) => height / 2 - (ahead - view.ahead) / view.perAhead,
    ahead: (y) => view.ahead + (height / 2 - y) * view.perAhead,
    left: (x) => view.left + (width / 2 - x) * view.perLeft,
  };
}

/** Draw all lines from above, ahead up. */
export function birdsEye(target, facts, view, {hidden}) {
  const {ctx, theme} = target;
  const map = project(target, view);
  grid(target, map);
  if (facts?.scene) poseError(ctx, map, facts.scene.pose);
  car(ctx, map, theme);
  const names = facts ? Object.keys(facts.slots).filter((name) => !hidden.has(name)) : [];
  const drawn = names.filter((name) => facts.slots[name].line);
  for (const name of drawn) line(target, map, name, facts.slots[name]);
  if (facts?.consumer) consumer(target, map, facts.consumer);
  labels(target, map, drawn, facts);
}

function grid({ctx, width, height, theme}, map) {
  ctx.strokeStyle = theme.grid;
  ctx.fillStyle = theme.muted;
  ctx.lineWidth = 1;
  const ahead = ticks(map.ahead(height), map.ahead(0), height / 60);
  const left = ticks(map.left(width), map.left(0), width / 60);
  ctx.beginPath();
  for (const value of ahead.values) {
    ctx.moveTo(0, map.toY(value));
    ctx.lineTo(width, map.toY(value));
    ctx.fillText(`${tickText(value, ahead)} m`, 4, map.toY(value) - 3);
  }
  ctx.textAlign = "center";
  for (const value of left.values) {
    const x = map.toX(value);
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
    if (x > 44 && x < width - 20) ctx.fillText(tickText(value, left), x, height - 4);
  }
  ctx.textAlign = "start";
  ctx.stroke();
}

/** Draw the outline of a car whose rear axle is at the origin. */
function car(ctx, map, theme) {
  ctx.strokeStyle = theme.text;
  ctx.lineWidth = 1.5;
  const outline = [[-1, 0.9], [3.2, 0.9], [3.7, 0.6], [3.7, -0.6], [3.2, -0.9], [-1, -0.9]];
  path(ctx, outline.map(([x, y]) => [map.toX(y), map.toY(x)]));
  ctx.closePath();
  ctx.stroke();
}

/** Draw the ellipses of 1, 2 and 3 sigma of the pose, and the heading within 1 sigma. */
function poseError(ctx, map, pose) {
  const upper = [pose[0], pose[1], pose[2], pose[3]];
  const {major, minor, angle} = ellipse(upper);
  ctx.strokeStyle = ctx.fillStyle = SLOTS.ROUTE;
  for (const k of [3, 2, 1]) {
    const points = [];
    for (let step = 0; step <= 48; step++) {
      const [c, s] = [k * major * Math.cos((step * Math.PI) / 24), k * minor * Math.sin((step * Math.PI) / 24)];
      const ahead = c * Math.cos(angle) - s * Math.sin(angle);
      const left = c * Math.sin(angle) + s * Math.cos(angle);
      points.push([map.toX(left), map.toY(ahead)]);
    }
    path(ctx, points);
    ctx.globalAlpha = 0.25;
    ctx.fill();
  }
  ctx.globalAlpha = 1;
  ctx.lineWidth = 1;
  const heading = Math.tan(Math.min(1.5, Math.sqrt(pose[5])));
  path(ctx, [-1, 0, 1].map((side) => [map.toX(8 * heading * side), map.toY(side ? 8 : 0)]));
  ctx.stroke();
}

/** Return points of a line in pixels, with a standard deviation across: [x, y, [dx, dy]]. */
function along(map, {mean, cov}, [low, high], height) {
  const from = Math.max(low, map.ahead(height) - 1);
  const to = Math.min(high, map.ahead(0) + 1);
  const n = Math.max(2, Math.min(120, Math.round((map.toY(from) - map.toY(to)) / 6)));
  const points = [];
  for (let k = 0; from <= to && k <= n; k++) {
    const x = from + ((to - from) * k) / n;
    const sigma = spread(cov, 4, [jacobian(mean, x)], [0]);
    const left = lateral(mean, x);
    points.push([map.toX(left), map.toY(x), [map.toX(left + sigma) - map.toX(left), 0], sigma]);
  }
  return points;
}

function line({ctx, theme, height}, map, name, slot) {
  const points = along(map, slot.line, slot.line.x, height);
  const own = slot.usable ? colour(name, theme) : theme.muted;
  ctx.strokeStyle = ctx.fillStyle = own;
  if (slot.usable && points.some((point) => point[3] < VAGUE)) bands(ctx, points);
  ctx.setLineDash(slot.usable ? DASHES[slot.line.kind] ?? [] : [1, 5]);
  ctx.lineWidth = 2;
  path(ctx, points);
  ctx.stroke();
  ctx.setLineDash([]);
  if (slot.usable) (slot.line.mixture ?? []).forEach((one) => component(ctx, map, slot.line, one, height));
}

/** Draw a component of a mixture within its sigma, the stronger the more weight it has. */
function component(ctx, map, {x}, [weight, mean, cov], height) {
  const points = along(map, {mean, cov}, x, height);
  ctx.globalAlpha = 0.35 + 0.65 * weight;
  ctx.lineWidth = 1;
  for (const [side, dash] of [[-1, [1, 3]], [0, [5, 3]], [1, [1, 3]]]) {
    ctx.setLineDash(dash);
    path(ctx, points.map(([a, b, [d]]) => [a + side * d, b]));
    ctx.stroke();
  }
  ctx.setLineDash([]);
  ctx.globalAlpha = 1;
}

/** Draw what a consumer has: the fused lane with its bands, and the lines of a camera (dots). */
function consumer({ctx, theme, height}, map, {fused, camera}) {
  ctx.strokeStyle = ctx.fillStyle = theme.text;
  for (const own of Object.values(fused?.lines ?? {})) {
    const points = along(map, own, own.x, height);
    bands(ctx, points);
    ctx.lineWidth = 1;
    path(ctx, points);
    ctx.stroke();
  }
  for (const {line: own, is_rejected: isRejected} of Object.values(camera)) {
    ctx.fillStyle = isRejected ? theme.muted : SLOTS.NEXT_RIGHT;
    for (const [x, y] of along(map, own, own.x, height))
      ctx.fillRect(x - 1.5, y - 1.5, 3, 3);
  }
}

/** Name the lines where they end, those that would overlap below each other. */
function labels({ctx, theme, width, height}, map, names, facts) {
  const taken = [];
  ctx.textAlign = "center";
  for (const name of names) {
    const slot = facts.slots[name];
    const end = Math.min(slot.line.x[1], map.ahead(18));
    const text = slot.usable ? title(name) : `${title(name)}: not usable`;
    const half = ctx.measureText(text).width / 2 + 4;
    const x = Math.max(half, Math.min(width - half, map.toX(lateral(slot.line.mean, end))));
    let y = Math.max(14, Math.min(height - 20, map.toY(end) - 4));
    while (taken.some(([a, b, c]) => Math.abs(a - x) < c + half && Math.abs(b - y) < 14)) y += 14;
    taken.push([x, y, half]);
    ctx.fillStyle = theme.surface;
    ctx.globalAlpha = 0.75;
    ctx.fillRect(x - half, y - 11, 2 * half, 14);
    ctx.globalAlpha = 1;
    ctx.fillStyle = slot.usable ? colour(name, theme) : theme.muted;
    ctx.fillText(text, x, y);
  }
  ctx.textAlign = "start";
}

// ---- charts over time -----------------------------------------------------------------------

const LEFT = 62;
const TOP = 20;

/** Return functions from times and values to pixels. */
export function axes({width, height}, [from, to], [low, high], hasTimes) {
  const [right, bottom] = [width - 8, height - (hasTimes ? 20 : 6)];
  return {
    toX: (t) => LEFT + ((t - from) / (to - from)) * (right - LEFT),
    toY: (value) => bottom - ((value - low) / (high - low || 1)) * (bottom - TOP),
    time: (x) => from + ((x - LEFT) / (right - LEFT)) * (to - from),
    right,
    bottom,
  };
}

/** Return round limits of curves [[t, value, sigma, usable], ...]; null stands for a gap. */
function limits(curves, least) {
  let [low, high] = [Infinity, -Infinity];
  const widest = Math.max(least, 3 * median(curves));
  for (const {points} of curves)
    for (const point of points) {
      if (!point) continue;
      const reach = Math.min(3 * (point[2] ?? 0), widest);
      low = Math.min(low, point[1] - reach);
      high = Math.max(high, point[1] + reach);
    }
  if (low > high) return [0, 1];
  const margin = Math.max(least - (high - low), 0) / 2;
  const {step} = ticks(low - margin, high + margin + 1e-12, 8);
  return [Math.floor((low - margin) / step) * step, Math.ceil((high + margin) / step) * step];
}

/** Return three times the median of the standard deviations. */
function median(curves) {
  const found = curves.flatMap(({points}) => points.filter((p) => p && p[3]).map((p) => p[2] ?? 0));
  return 3 * (found.sort((a, b) => a - b)[found.length >> 1] ?? 0);
}

/**
 * Draw curves with their bands over time.
 *
 * what: {name, unit, least: least height of the axis, curves: [{name, colour, points}]};
 * frame: {window: [from, to], cursor, zero: time that is 0 on the axis, hasTimes, marks}.
 */
export function series(target, what, frame) {
  const {ctx, theme, width} = target;
  const range = what.range ?? limits(what.curves, what.least);
  const map = axes(target, frame.window, range, frame.hasTimes);
  ctx.fillStyle = theme.text;
  ctx.fillText(what.unit ? `${what.name} [${what.unit}]` : what.name, LEFT, 13);
  valueAxis(target, map, range);
  times(target, map, frame);
  ctx.save();
  ctx.beginPath();
  ctx.rect(LEFT, TOP, map.right - LEFT, map.bottom - TOP);
  ctx.clip();
  for (const curve of what.curves) runs(curve.points).forEach((run) => curveRun(ctx, map, curve, run));
  ctx.restore();
  cursor(target, map, frame);
  if (!what.curves.some(({points}) => points.some(Boolean))) {
    ctx.fillStyle = theme.muted;
    ctx.fillText(what.none ?? "nothing in this time", (LEFT + width) / 2 - 50, (TOP + map.bottom) / 2 + 4);
  }
}

/** Return the pieces of a curve between its gaps, and where it changes to not usable and back. */
function runs(points) {
  const found = [];
  let run = [];
  for (const point of points) {
    const isOther = (k) => (point[k] === null) !== (run[0][k] === null);
    if (run.length && (!point || point[3] !== run[0][3] || isOther(2))) {
      found.push(run);
      run = [];
    }
    if (point) run.push(point);
  }
  return run.length ? [...found, run] : found;
}

function curveRun(ctx, map, {colour: own}, run) {
  ctx.strokeStyle = ctx.fillStyle = own;
  const isUsable = run[0][3];
  if (isUsable && run[0][2] !== null)
    bands(ctx, run.map(([t, value, sigma]) => [map.toX(t), map.toY(value), [0, map.toY(value + sigma) - map.toY(value)]]));
  ctx.lineWidth = 1.5;
  ctx.setLineDash(isUsable ? [] : [1, 4]);
  const points = run.map(([t, value]) => [map.toX(t), map.toY(value)]);
  path(ctx, points.length > 1 ? points : [points[0], [points[0][0] + 1.5, points[0][1]]]);
  ctx.stroke();
  ctx.setLineDash([]);
}

function valueAxis({ctx, theme}, map, [low, high]) {
  const found = ticks(low, high, (map.bottom - TOP) / 16);
  ctx.strokeStyle = theme.grid;
  ctx.fillStyle = theme.muted;
  ctx.lineWidth = 1;
  ctx.textAlign = "end";
  ctx.beginPath();
  for (const value of found.values) {
    const y = map.toY(value);
    ctx.moveTo(LEFT, y);
    ctx.lineTo(map.right, y);
    ctx.fillText(tickText(value, found), LEFT - 5, y + 4);
  }
  ctx.stroke();
  ctx.textAlign = "start";
}

function times({ctx, theme, height}, map, {window: [from, to], zero, hasTimes}) {
  const found = ticks(from - zero, to - zero, (map.right - LEFT) / 70);
  ctx.strokeStyle = theme.grid;
  ctx.fillStyle = theme.muted;
  ctx.textAlign = "center";
  ctx.beginPath();
  for (const value of found.values) {
    const x = map.toX(value + zero);
    ctx.moveTo(x, TOP);
    ctx.lineTo(x, map.bottom);
    if (hasTimes && x < map.right - 12) ctx.fillText(`${tickText(value, found)} s`, x, height - 5);
  }
  ctx.stroke();
  ctx.textAlign = "start";
}

function cursor({ctx, theme}, map, frame) {
  ctx.fillStyle = FAULT;
  for (const t of frame.marks) ctx.fillRect(map.toX(t) - 1, TOP - 5, 2, 5);
  const x = map.toX(frame.cursor);
  ctx.strokeStyle = theme.text;
  ctx.lineWidth = 1;
  path(ctx, [[x, TOP - 5], [x, map.bottom]]);
  ctx.stroke();
}

/** Draw the states of messages as strips: rows [{name, spans: [[from, to, state]]}]. */
export function strips(target, rows, frame) {
  const {ctx, theme} = target;
  const map = axes(target, frame.window, [0, Math.max(1, rows.length)], frame.hasTimes);
  ctx.fillStyle = theme.text;
  ctx.fillText("E2E state: V valid, I init, X invalid, – no data", LEFT, 13);
  times(target, map, frame);
  rows.forEach(({name, spans}, k) => {
    const [top, bottom] = [map.toY(rows.length - k) + 1, map.toY(rows.length - k - 1) - 1];
    ctx.fillStyle = theme.muted;
    ctx.textAlign = "end";
    ctx.fillText(title(name), LEFT - 4, (top + bottom) / 2 + 4, LEFT - 6);
    ctx.textAlign = "start";
    for (const [from, to, state] of spans) strip(ctx, map, [from, to, top, bottom], state);
  });
  cursor(target, map, frame);
}

function strip(ctx, map, [from, to, top, bottom], state) {
  const x = Math.max(LEFT, map.toX(from));
  const w = Math.min(map.right, map.toX(to)) - x;
  if (w <= 0) return;
  ctx.fillStyle = STATES[state];
  ctx.fillRect(x, top, Math.max(1, w), bottom - top);
  if (w < 14 || bottom - top < 10) return;
  ctx.fillStyle = "#000";
  ctx.fillText({VALID: "V", INIT: "I", INVALID: "X", NODATA: "–"}[state], x + 4, (top + bottom) / 2 + 4);
}

// ---- correlations, time line ----------------------------------------------------------------

/** Return the colour of a correlation: blue for -1, orange for 1, the surface for 0. */
function shade(value, theme) {
  const to = value < 0 ? [0, 114, 178] : [213, 94, 0];
  const from = theme.isDark ? [28, 32, 38] : [255, 255, 255];
  const share = Math.min(1, Math.abs(value));
  return `rgb(${to.map((c, k) => Math.round(from[k] + (c - from[k]) * share)).join(" ")})`;
}

/** Say why there is no picture. */
export function nothing({ctx, theme}, text) {
  ctx.fillStyle = theme.muted;
  ctx.fillText(text, 8, 24);
}

/** Draw a correlation matrix; groups are names of blocks of 4 rows, texts those of the rows. */
export function matrix(target, upper, n, {groups, texts}) {
  const {ctx, width, height, theme} = target;
  const rows = correlations(upper, n);
  const margin = groups ? 74 : 44;
  const side = Math.max(20, Math.min(width - margin - 8, height - 30));
  const cell = side / n;
  ctx.textAlign = "center";
  rows.forEach((row, i) =>
    row.forEach((value, j) => {
      ctx.fillStyle = shade(value, theme);
      ctx.fillRect(margin + j * cell, 24 + i * cell, cell + 0.5, cell + 0.5);
      if (cell < 34) return;
      ctx.fillStyle = Math.abs(value) > 0.6 ? "#fff" : theme.text;
      ctx.fillText(value.toFixed(2).replace(/^-0.00$/, "0.00"), margin + (j + 0.5) * cell, 24 + (i + 0.5) * cell + 4);
    }),
  );
  const names = groups ?? texts;
  const block = side / names.length;
  ctx.fillStyle = theme.muted;
  ctx.strokeStyle = theme.grid;
  names.forEach((name, k) => {
    ctx.textAlign = "end";
    ctx.fillText(title(name), margin - 5, 24 + (k + 0.5) * block + 4, margin - 8);
    ctx.textAlign = "center";
    const text = groups ? title(name).replace(/ (l|r).*/, " $1") : title(name);
    ctx.fillText(text, margin + (k + 0.5) * block, 17, block);
    ctx.strokeRect(margin + k * block, 24, block, side);
    ctx.strokeRect(margin, 24 + k * block, side, block);
  });
  ctx.textAlign = "start";
}

/** Draw the whole time with its faults, what is not known yet, and where we are. */
export function timeline(target, {begin, end, cursor: t, changes, isOver, window: [from, to]}) {
  const {ctx, width, height, theme} = target;
  const toX = (time) => 8 + ((time - begin) / (end - begin || 1)) * (width - 16);
  ctx.fillStyle = theme.grid;
  ctx.fillRect(8, height / 2 - 2, width - 16, 4);
  ctx.globalAlpha = 0.6;
  ctx.fillRect(toX(Math.max(from, begin)), 2, Math.max(2, toX(Math.min(to, end)) - toX(Math.max(from, begin))), height - 4);
  ctx.globalAlpha = 1;
  let last = -10;
  for (const [, time, texts] of changes) {
    const x = toX(time);
    if (x < last + 1 || !texts.some(isFault)) continue;
    last = x;
    ctx.fillStyle = FAULT;
    ctx.fillRect(x - 1, 3, 2, height - 6);
  }
  ctx.fillStyle = theme.text;
  path(ctx, [[toX(t) - 6, 0], [toX(t) + 6, 0], [toX(t), 7]]);
  ctx.fill();
  ctx.fillRect(toX(t) - 0.75, 0, 1.5, height);
  if (!isOver) ctx.fillText("…", width - 8, height / 2);
}

export {at};
