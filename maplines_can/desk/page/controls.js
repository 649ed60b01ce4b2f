// Buttons, keys, wheel and touch; PNG and CSV.

import {PARAMETERS, at, parameter, width} from "./facts.js";
import {axes, colour, picture, project, title} from "./charts.js";
import {SPANS, SPEEDS} from "./view.js";

const $ = (id) => document.getElementById(id);
const CHARTS = ["chart-y", "chart-width", "chart-parameter", "chart-load", "chart-states"];

/** Connect everything that a person can do to the view. */
export function connect(view) {
  options("speed", SPEEDS, (speed) => `${speed}×`, 1, (speed) => (view.speed = Number(speed)));
  options("span", SPANS, (span) => (span < 60 ? `${span} s` : `${span / 60} min`), 20, (span) => (view.span = Number(span)));
  options("parameter", PARAMETERS, String, "y_off");
  options("of", ["scene", ...view.store.info.slots], (name) => (name === "scene" ? "the whole scene" : title(name)),
    view.store.info.has_scene ? "scene" : view.store.info.slots[0]);
  if (!view.store.info.has_scene) $("of").options[0].remove();
  for (const id of ["speed", "span", "parameter", "of"]) $(id).addEventListener("change", () => view.draw());
  $("x").addEventListener("input", () => {
    if (Number.isFinite($("x").valueAsNumber)) view.x = $("x").valueAsNumber;
    view.draw();
  });
  chips(view);
  theme(view);
  const actions = actionsOf(view);
  for (const [id, action] of Object.entries(actions.buttons)) $(id).addEventListener("click", action);
  $("position").addEventListener("input", () => view.goToTime($("position").valueAsNumber));
  document.addEventListener("keydown", (event) => key(event, actions.keys));
  pan($("above"), view);
  for (const id of CHARTS) chart($(id), view);
  $("timeline").addEventListener("click", ({offsetX, target}) => {
    const {begin, end} = view.store;
    view.goToTime(begin + ((offsetX - 8) / (target.clientWidth - 16)) * (end - begin));
  });
  new ResizeObserver(() => (view.isHome ? view.zoomHome() : view.draw())).observe(document.body);
}

function options(id, values, text, chosen, use = () => {}) {
  $(id).replaceChildren(...values.map((value) => new Option(text(value), value, false, value === chosen)));
  $(id).addEventListener("change", () => use($(id).value));
}

function actionsOf(view) {
  const buttons = {
    previous: () => view.fault(-1), back: () => view.step(-1), play: () => view.toggle(),
    forward: () => view.step(1), next: () => view.fault(1), live: () => view.newest(),
    png: () => savePicture(view), csv: () => saveTable(view), help: toggleHelp,
    "zoom-in": () => zoom(view, 0.8), "zoom-out": () => zoom(view, 1.25),
    "zoom-reset": () => view.zoomHome(),
  };
  const keys = {
    " ": buttons.play, ArrowLeft: ({shiftKey}) => (shiftKey ? view.skip(-1) : view.step(-1)),
    ArrowRight: ({shiftKey}) => (shiftKey ? view.skip(1) : view.step(1)),
    p: buttons.previous, n: buttons.next, Home: () => view.go(view.store.first), End: buttons.live,
    ",": () => next("speed", -1), ".": () => next("speed", 1),
    z: () => next("span", -1), x: () => next("span", 1),
    "+": buttons["zoom-in"], "-": buttons["zoom-out"], 0: buttons["zoom-reset"],
    s: buttons.png, c: buttons.csv, d: () => $("theme").click(), "?": toggleHelp,
  };
  return {buttons, keys};
}

/** Do what a key stands for, but where it is typed into a field or pressed on a button. */
function key(event, keys) {
  const {target, ctrlKey, metaKey, altKey} = event;
  const isField = target.matches("input, select") || (event.key === " " && target.matches("button"));
  if (isField || ctrlKey || metaKey || altKey || !(event.key in keys)) return;
  event.preventDefault();
  keys[event.key](event);
}

function toggleHelp() {
  $("keys").hidden = !$("keys").hidden;
  $("help").setAttribute("aria-expanded", String(!$("keys").hidden));
}

/** Choose the next option of a select. */
function next(id, by) {
  const select = $(id);
  select.selectedIndex = Math.max(0, Math.min(select.length - 1, select.selectedIndex + by));
  select.dispatchEvent(new Event("change"));
}

function chips(view) {
  const buttons = view.store.info.slots.map((name) => {
    const button = document.createElement("button");
    const swatch = Object.assign(document.createElement("span"), {className: "swatch"});
    swatch.style.background = colour(name, view.theme);
    button.append(swatch, title(name));
    button.dataset.slot = name;
    button.setAttribute("aria-pressed", "true");
    button.addEventListener("click", () => {
      view.hidden[view.hidden.has(name) ? "delete" : "add"](name);
      button.setAttribute("aria-pressed", String(!view.hidden.has(name)));
      view.draw();
    });
    return button;
  });
  $("slots").replaceChildren(...buttons);
}

/** Follow the scheme of the system unless the switch says otherwise. */
function theme(view) {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let chosen = null;
  const apply = () => {
    const isDark = chosen ?? dark.matches;
    document.documentElement.dataset.theme = isDark ? "dark" : "light";
    $("theme").textContent = isDark ? "light" : "dark";
    view.drawTheme();
    for (const button of $("slots").children)
      button.firstChild.style.background = colour(button.dataset.slot, view.theme);
  };
  dark.addEventListener("change", apply);
  $("theme").addEventListener("click", () => {
    const isDark = !(chosen ?? dark.matches);
    chosen = isDark === dark.matches ? null : isDark;
    apply();
  });
  apply();
}

// ---- view from above, charts ----------------------------------------------------------------

function zoom(view, factor, at = null, toTheSideOnly = false) {
  const map = project({width: $("above").clientWidth, height: $("above").clientHeight}, view.view);
  const [left, ahead] = at ? [map.left(at[0]), map.ahead(at[1])] : [view.view.left, view.view.ahead];
  const own = view.view;
  if (!toTheSideOnly) {
    own.perAhead = limited(own.perAhead * factor, 0.005, 2);
    own.ahead = ahead + (own.ahead - ahead) * factor;
  }
  own.perLeft = limited(own.perLeft * factor, 0.001, 1);
  own.left = left + (own.left - left) * factor;
  view.isHome = false;
  view.draw();
}

const limited = (value, low, high) => Math.max(low, Math.min(high, value));

/** Let pointers move the view from above, two of them zoom it, and a wheel, too. */
function pan(canvas, view) {
  const down = new Map();
  const apart = () => {
    const [a, b] = [...down.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId);
    if (!before) return;
    const was = down.size === 2 ? apart() : 0;
    down.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (down.size === 2) return zoom(view, was / Math.max(1, apart()), before);
    view.isHome = false;
    view.view.left += (event.offsetX - before[0]) * view.view.perLeft;
    view.view.ahead += (event.offsetY - before[1]) * view.view.perAhead;
    view.draw();
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => down.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const step = event.deltaY || event.deltaX; // shift turns a wheel on some systems
    zoom(view, step > 0 ? 1.15 : 1 / 1.15, [event.offsetX, event.offsetY], event.shiftKey);
  }, {passive: false});
}

function chart(canvas, view) {
  canvas.addEventListener("click", ({offsetX}) => {
    const size = {width: canvas.clientWidth, height: canvas.clientHeight};
    view.goToTime(axes(size, view.window, [0, 1], false).time(offsetX));
  });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.shiftKey) return; // the page scrolls
    event.preventDefault();
    next("span", (event.deltaY || event.deltaX) > 0 ? 1 : -1);
  }, {passive: false});
}

// ---- PNG and CSV ----------------------------------------------------------------------------

function save(name, blob) {
  const link = Object.assign(document.createElement("a"), {href: URL.createObjectURL(blob), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

function fileName(view, suffix) {
  return `maplines-${((view.shown?.t ?? 0) - view.zero).toFixed(2)}s.${suffix}`;
}

/** Return a picture of all that is drawn, twice as fine as the screen, as a canvas. */
export function wholePicture(view) {
  const scale = 2;
  const above = $("above");
  const right = [...CHARTS, "matrix"].map($);
  const height = 30 + Math.max(above.clientHeight, right.reduce((sum, one) => sum + one.clientHeight + 4, 0));
  const all = document.createElement("canvas");
  all.width = scale * (above.clientWidth + 10 + right[0].clientWidth);
  all.height = scale * height;
  const ctx = all.getContext("2d");
  ctx.scale(scale, scale);
  ctx.fillStyle = view.theme.surface;
  ctx.fillRect(0, 0, all.width, all.height);
  ctx.fillStyle = view.theme.text;
  ctx.font = "14px system-ui, sans-serif";
  ctx.fillText(`${view.store.info.name} · ${$("clock").textContent}`, 8, 20);
  view.paint((id) => picture($(id), view.theme, scale));
  const put = (one, x, y) => ctx.drawImage(one, x, y, one.clientWidth, one.clientHeight);
  put(above, 0, 30);
  right.reduce((y, one) => (put(one, above.clientWidth + 10, y), y + one.clientHeight + 4), 30);
  view.draw();
  return all;
}

function savePicture(view) {
  wholePicture(view).toBlob((blob) => save(fileName(view, "png"), blob));
}

/** Return a table of the facts in the time that is drawn, a row for each of the lines shown. */
export function table(view) {
  const names = ["t", "slot", "usable", "state", "age", "kind", "status", "x_min", "x_max",
    ...PARAMETERS, ...PARAMETERS.map((name) => `sigma_${name}`), "x", "y", "sigma_y",
    "lane_width", "sigma_lane_width", "bus_load"];
  const rows = view.sampled(Infinity).filter(Boolean).flatMap((facts) => {
    const lane = width(facts, view.x);
    return Object.entries(facts.slots).filter(([name]) => !view.hidden.has(name)).map(([name, slot]) => {
      const {line} = slot;
      const place = line && at(line, view.x);
      const own = line && PARAMETERS.map((_, k) => parameter(line, k));
      return [facts.t, name, slot.usable, slot.state, slot.age, line?.kind, line?.status, ...(line?.x ?? ["", ""]),
        ...(own ? [...own.map(({value}) => value), ...own.map(({sigma}) => sigma)] : Array(8).fill("")),
        view.x, place?.value, place?.sigma, lane?.value, lane?.sigma, facts.traffic?.load];
    });
  });
  return [names, ...rows].map((row) => row.map((cell) => cell ?? "").join(",")).join("\n") + "\n";
}

async function saveTable(view) {
  await view.whole();
  save(fileName(view, "csv"), new Blob([table(view)], {type: "text/csv"}));
}
