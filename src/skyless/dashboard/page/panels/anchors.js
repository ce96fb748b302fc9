/** Anchors and their clocks: a list, the selected one in detail, and the other programs of the site. */

import { on, select, state } from "../store.js";
import { Chart } from "../chart.js";
import { Rows, h, slowly, text } from "../dom.js";
import { DASH, duration, length, number } from "../format.js";
import { anchors as past } from "../history.js";
import { anchorMark } from "../legend.js";
import { CONDITIONS, condition, masterNow } from "../map/anchors.js";
import { split } from "../tabs.js";
import { facts } from "./tag_detail.js";

export const title = "Anchors";
const WINDOW_S = 120;
/** Counters that have a line of their own. */
const SHOWN = new Set(["sent", "heard", "late"]);
let parts = null;
let isOpen = () => false;

/** Build the tab. */
export function start(panel, open) {
  isOpen = open;
  const heads = ["", "Anchor", "Offset", "Rate", "Sync σ", "Late"];
  const head = h("tr", {}, ...heads.map((words) => h("th", { scope: "col" }, words)));
  head.cells[0].append(h("span", { class: "unseen" }, "State"));
  const body = h("tbody", {});
  const table = h("table", { class: "list anchors" }, h("thead", {}, head), body);
  const nodes = h("ul", { class: "nodes" });
  const note = h(
    "p",
    { class: "empty", hidden: true },
    "Health is shown live; a recording's states tell nothing of it.",
  );
  parts = { note, rows: new Rows(body, makeRow), detail: makeDetail(), nodes, nodeRows: new Rows(nodes, makeNode) };
  parts.box = h("div", { class: "scroll-x" }, table);
  parts.panel = panel;
  panel.append(note, parts.box, parts.detail.element);
  panel.append(h("section", {}, h("h2", {}, "Programs"), nodes));
  on(["health", "selection", "site", "mode"], slowly(200, show));
  setInterval(show, 1000);
}

/** Bring the tab up to date, if anybody sees it. */
export function show() {
  if (!parts || !isOpen()) return;
  parts.note.hidden = state.mode === "live";
  const ids = new Set((state.site?.anchors ?? []).map((anchor) => anchor.id));
  for (const id of state.health.anchors.keys()) ids.add(id);
  parts.rows.show([...ids].map((id) => [id, id]));
  parts.detail.show(state.selection.anchor);
  split(parts.panel, parts.box, !parts.detail.element.hidden);
  const nodes = [...state.health.nodes].sort(livingFirst);
  parts.nodeRows.show(nodes.map((node) => [`${node.kind}/${node.name}`, node]));
}

/** Those that are gone, maybe since long, come last. */
function livingFirst(a, b) {
  const order = b.online - a.online || a.kind.localeCompare(b.kind);
  return order || String(a.name).localeCompare(String(b.name), undefined, { numeric: true });
}

function makeRow(id) {
  const cells = Array.from({ length: 6 }, () => h("td", {}));
  const button = h("button", { type: "button", class: "name", onclick: () => toggle(id) });
  cells[1].append(button);
  const element = h("tr", { onclick: (event) => event.target === button || toggle(id) }, ...cells);
  let mark = "";
  const update = () => {
    const kind = condition(id);
    const master = id === masterNow();
    if (mark !== kind + master) {
      cells[0].replaceChildren(anchorMark(kind, master), h("span", { class: "unseen" }, CONDITIONS[kind].words));
      cells[0].title = CONDITIONS[kind].words;
    }
    mark = kind + master;
    text(button, master ? `${id} master` : String(id));
    button.setAttribute("aria-pressed", String(state.selection.anchor === id));
    element.className = `${kind} ${state.selection.anchor === id ? "selected" : ""}`;
    const health = state.mode === "live" ? state.health.anchors.get(id) : null;
    const values = [
      master ? "reference" : offset(health?.offset_s),
      master ? DASH : number(health?.rate_ppm, 3, "ppm"),
      master ? DASH : sigma(health?.offset_std_m),
      number(health?.late),
    ];
    values.forEach((value, index) => text(cells[index + 2], value));
  };
  return { element, update };
}

function offset(value_s) {
  return value_s == null ? DASH : number(value_s, 4, "s");
}

function sigma(value_m) {
  if (value_m == null) return DASH;
  return value_m < 0.01 ? `${(value_m * 1000).toFixed(1)} mm` : length(value_m);
}

function toggle(id) {
  if (state.selection.anchor === id) select(null);
  else select("anchor", id);
}

function makeDetail() {
  const heading = h("h2", {});
  const list = facts([
    "State",
    "Follows",
    "Term",
    "Superframe",
    "Sent",
    "Skipped, too late",
    "Heard",
    "Longest unheard",
    "Uptime",
    "MQTT",
    "Counted",
  ]);
  const offsets = new Chart("Clock offset, change (µs)", [{ name: "offset", colour: "accent" }], (v) => number(v, 1), {
    least: 1,
  });
  const rates = new Chart(
    "Clock rate against the master (ppm)",
    [{ name: "rate", colour: "warn" }],
    (v) => number(v, 3),
    {
      least: 0.01,
    },
  );
  const sigmas = new Chart("σ of the offset (mm)", [{ name: "σ", colour: "good" }], (v) => number(v, 1), {
    zero: true,
    least: 1,
  });
  const charts = h("div", {}, offsets.element, rates.element, sigmas.element);
  const element = h(
    "section",
    { class: "detail", "aria-label": "The selected anchor", hidden: true },
    heading,
    list.element,
    charts,
  );
  const showDetail = (id) => {
    const health = state.mode === "live" ? state.health.anchors.get(id) : null;
    element.hidden = !health;
    if (!health) return;
    text(heading, `Anchor ${id}`);
    list.show(anchorFacts(id, health));
    charts.hidden = id === masterNow();
    const history = past.get(id);
    if (!history || charts.hidden) return;
    const now = history.time.at(-1);
    const times = history.time.map((time) => time - now);
    for (const [chart, values] of [
      [offsets, history.offset_us],
      [rates, history.rate_ppm],
      [sigmas, history.std_mm],
    ]) {
      chart.element.hidden = values.every((value) => value === null);
      if (!chart.element.hidden) chart.show([times, values], WINDOW_S);
    }
  };
  return { element, show: showDetail };
}

function anchorFacts(id, health) {
  const ages = Object.entries(health.heard_age_s ?? {}).sort((a, b) => b[1] - a[1]);
  const counted = Object.entries(health.counters).filter(([name, count]) => count && !SHOWN.has(name));
  return {
    State: `${CONDITIONS[condition(id)].words}, ${health.role}`,
    Follows: health.master === null || health.master === id ? null : `anchor ${health.master}`,
    Term: number(health.term),
    Superframe: number(health.superframe),
    Sent: number(health.sent),
    "Skipped, too late": number(health.late),
    Heard: number(health.heard),
    "Longest unheard": ages.length ? `anchor ${ages[0][0]}, ${duration(ages[0][1])}` : null,
    Uptime: duration(health.uptime_s),
    MQTT: `${number(health.mqtt.published)} sent, ${number(health.mqtt.dropped)} given up`,
    Counted: counted.map(([name, count]) => `${count} ${name.replaceAll("_", " ")}`).join(", ") || null,
  };
}

function makeNode(_key, node) {
  const mark = h("span", { class: "node-mark", "aria-hidden": "true" });
  const words = h("span", {});
  const element = h("li", {}, mark, h("span", {}, `${node.kind} ${node.name}`), words);
  const update = (now) => {
    element.className = now.online ? "good" : "bad";
    text(mark, now.online ? "■" : "✕");
    text(words, now.online ? [now.host, now.pid ? `pid ${now.pid}` : ""].filter(Boolean).join(" · ") : "gone");
  };
  return { element, update };
}
