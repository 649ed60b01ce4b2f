// Tables, texts and names of the pictures for screen readers.

import {at, isFault} from "./facts.js";
import {short, title} from "./charts.js";

const $ = (id) => document.getElementById(id);

/** Make the rows of a table be these; a cell is a text or [text, class]. */
function fill(table, heads, rows) {
  const body = table.tBodies[0];
  if (table.tHead.textContent !== heads.join(""))
    table.tHead.replaceChildren(row("th", heads.map((head) => [head, ""])));
  rows.forEach((cells, k) => {
    const own = body.rows[k] ?? body.appendChild(row("td", cells.map(() => "")));
    cells.forEach((cell, i) => {
      const [text, name] = Array.isArray(cell) ? cell : [cell, ""];
      const td = own.cells[i];
      if (td.textContent !== text) td.textContent = text;
      if (td.className !== name) td.className = name;
    });
  });
  while (body.rows.length > rows.length) body.deleteRow(-1);
}

function row(kind, cells) {
  const tr = document.createElement("tr");
  for (const [text, name] of cells) {
    const cell = Object.assign(document.createElement(kind), {textContent: text ?? "", className: name ?? ""});
    if (kind === "th") cell.scope = "col";
    tr.append(cell);
  }
  return tr;
}

const state = (name) => [name ?? "–", name === "VALID" ? "good" : "bad"];
const ms = (seconds) => (seconds === null || seconds === undefined ? "∞" : `${Math.round(1000 * seconds)} ms`);
const bad = (n) => [String(n), n ? "bad" : ""];

function place(line, x) {
  const found = line && at(line, x);
  return found ? `${found.value.toFixed(2)} ± ${found.sigma.toFixed(2)} m` : "–";
}

function why(slot) {
  if (slot.usable) return ["yes", "good"];
  const reasons = [
    slot.left_out && `left out: ${slot.left_out}`, slot.two_senders && "two senders",
    slot.stale && "stale", slot.state !== "VALID" && slot.state,
    slot.line?.status === "OUT_OF_RANGE" && "out of range",
  ].filter(Boolean);
  return [`no: ${reasons.join(", ") || "too old"}`, "bad"];
}

/** Show the slots of facts, with the place of their lines at x. */
export function showLines(facts, x) {
  const heads = ["line", "usable", "E2E", "age", "kind", "covariance", "valid x", "y(0)", `y(${x} m)`];
  const rows = Object.entries(facts.slots).map(([name, slot]) => {
    const {line} = slot;
    return [
      title(name), why(slot), state(slot.state), ms(slot.age), line ? title(line.kind) : "–",
      line ? title(line.status) : "–", line ? line.x.map(short).join(" … ") + " m" : "–",
      place(line, 0), place(line, x),
    ];
  });
  fill($("line-table"), heads, rows);
  const left = Object.entries(facts.slots).filter(([, slot]) => slot.left_out);
  const texts = left.map(([name, slot]) => `${title(name)} (${title(slot.left_out)})`);
  $("left-out").textContent = texts.length ? `Left out by the sender: ${texts.join(", ")}` : "";
}

/** Show messages, their cycle since facts before, and the load of the bus. */
export function showMessages(facts, before) {
  const heads = ["message", "E2E", "check", "cycle", "ok", "lost", "repeated", "wrong sequence", "wrong", "no new data", "senders"];
  const rows = Object.entries(facts.messages).map(([name, own]) => [
    title(name), state(own.state), own.status ?? "–", cycle(facts, before, name), String(own.ok),
    bad(own.lost), bad(own.repeated), bad(own.wrong_sequence), bad(own.errors),
    bad(own.no_new_data), own.two_senders ? ["two", "bad"] : "one",
  ]);
  fill($("message-table"), heads, rows);
  $("traffic").textContent = facts.traffic ? trafficText(facts.traffic) : "";
  const counts = Object.entries(facts.counts).map(([reason, n]) => `${title(reason)} ${n}`);
  $("dropped").textContent = `Frames that gave no line: ${counts.join(", ") || "none"}`;
}

function trafficText(traffic) {
  const load = traffic.load === null ? "–" : `${(100 * traffic.load).toFixed(1)} %`;
  const {others} = traffic;
  return (
    `Bus load ${load} · ${traffic.frames} frames, ${others.frames} of them with ${others.ids} ` +
    `other CAN IDs · ${traffic.error_frames} error frames`
  );
}

function cycle(facts, before, name) {
  const n = facts.messages[name].ok - (before?.messages[name]?.ok ?? Infinity);
  return n > 0 ? `${Math.round((1000 * (facts.t - before.t)) / n)} ms` : "–";
}

/** Show changes up to some facts, newest first; a click calls `go` with their number. */
export function showChanges(changes, number, zero, go) {
  const list = $("changes");
  const shown = changes.filter((change) => change[0] <= number).slice(-200).reverse();
  const key = `${shown[0]?.[0]} ${shown.length} ${zero}`;
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(
    ...shown.map(([of, t, texts]) => {
      const item = document.createElement("li");
      const button = Object.assign(document.createElement("button"), {
        textContent: `${(t - zero).toFixed(2)} s  ${texts.join("; ")}`,
        className: texts.some(isFault) ? "bad" : "",
      });
      button.addEventListener("click", () => go(of));
      item.append(button);
      return item;
    }),
  );
}

/** Give the pictures names that say what they show. */
export function describe(facts, x, window) {
  const lines = Object.entries(facts.slots).map(([name, slot]) =>
    slot.usable ? `${title(name)} at ${place(slot.line, x)}` : `${title(name)} not usable`,
  );
  label("above", `Lines from above, at ${x} m ahead: ${lines.join("; ") || "none"}`);
  const span = `${(window[1] - window[0]).toFixed(0)} seconds`;
  label("chart-y", `Lateral position of the lines at ${x} m over ${span}`);
  label("chart-width", `Width of the ego lane at ${x} m over ${span}`);
  label("chart-parameter", `Parameter ${$("parameter").value} of the lines over ${span}`);
  label("chart-load", `Bus load over ${span}`);
  const states = Object.entries(facts.messages).map(([name, own]) => `${title(name)} ${own.state}`);
  label("chart-states", `E2E states over ${span}; now ${states.join(", ")}`);
  label("matrix", `Correlation matrix of ${$("of").selectedOptions[0]?.textContent ?? "nothing"}`);
}

function label(id, text) {
  if ($(id).getAttribute("aria-label") !== text) $(id).setAttribute("aria-label", text);
}
