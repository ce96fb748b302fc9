/** The superframe, and when each tag processed its messages: the paper's oscilloscope picture, from the tags' health. */

import { healthAge_s, reports, state } from "../store.js";
import { byId, h, s, text } from "../dom.js";
import { duration, number, roundStep } from "../format.js";
import { siteMode } from "../map/anchors.js";
import { facts } from "./parts.js";

export const title = "Timing";
export const topics = ["health", "selection", "theme", "mode"];
export const interval_ms = 200;
export const changesWithTime = true;
/** Without a superframe there is nothing to draw. */
export const isIdle = () => siteMode() === "free";

/** Limit of the rows in the picture. */
const MAX_ROWS = 24;
const ROW_HEIGHT = 30;
const TOP = 38;
const LEFT = 62;
let parts = null;

/** Build the tab. */
export function start(panel) {
  const about = h(
    "p",
    { class: "fine" },
    "Each tag's last complete superframe. The line is high while the tag processes a message; ",
    "a dot marks a fix. Top: the slots, and the anchors heard in them.",
  );
  const picture = h("div", { id: "phases" });
  const empty = h("p", { class: "empty" });
  const caption = h("p", { class: "count" });
  const ether = facts();
  const etherBox = h("section", { hidden: true }, h("h2", {}, "Emulated radio channel"), ether.element);
  parts = { picture, empty, caption, ether, etherBox };
  panel.append(h("h2", {}, "Superframe and positioning phases"), caption, picture, empty, about, etherBox);
  new ResizeObserver(() => panel.clientWidth && show()).observe(panel);
}

/** Bring the tab up to date. */
export function show() {
  const reporting = [...state.health.tags.values()].filter(({ tag }) => reports("tags", tag));
  const all = state.mode === "live" ? reporting.filter(({ phases }) => phases?.length).map(read) : [];
  all.sort((a, b) => a.tag.localeCompare(b.tag, "en", { numeric: true }));
  const chosen = all.filter((health) => health.tag === state.selection.tag);
  const shown = [...chosen, ...all.filter((health) => health.tag !== state.selection.tag)].slice(0, MAX_ROWS);
  parts.empty.hidden = shown.length > 0;
  parts.picture.replaceChildren(...(shown.length ? [draw(shown)] : []));
  text(
    parts.empty,
    state.mode === "live" ? "No positioning phases reported yet." : "Phases are shown on the live site only.",
  );
  const { slot_s = 0 } = state.site?.schedule ?? {};
  const slots = slotCount();
  const more = all.length > shown.length ? ` ${shown.length} of ${all.length} tags.` : "";
  const superframe = shown[0]?.phases[0].superframe;
  const latest = superframe === undefined ? "" : `Superframe ${number(superframe)}.`;
  text(
    parts.caption,
    slots ? `${slots} slots of ${duration(slot_s)}: ${duration(slots * slot_s)}. ${latest}${more}` : "",
  );
  showEther();
}

/** A tag's phases with named fields; on the wire they are arrays. */
function read(health) {
  const phases = health.phases.map(([superframe, slot, anchor, heard_s, done_s, fix]) => {
    return { superframe, slot, anchor, heard_s, done_s, fix };
  });
  return { tag: health.tag, phases };
}

function slotCount() {
  const site = siteMode() === "free" ? null : state.site;
  const anchors = site ? site.anchors.length + (site.unplaced?.length ?? 0) : 0;
  return site ? (site.schedule.slots ?? anchors * site.schedule.frames_per_node) : 0;
}

function draw(tags) {
  const width = Math.max(byId("phases").clientWidth || 340, 260);
  const height = TOP + tags.length * ROW_HEIGHT + 8;
  const slot_s = state.site?.schedule.slot_s ?? 2e-3;
  const latest = Math.max(...tags.flatMap((health) => health.phases.map((phase) => phase.done_s)));
  const end_s = Math.max(slotCount() * slot_s, latest);
  const at = (time_s) => LEFT + ((width - LEFT - 6) * (time_s + 0.1 * slot_s)) / (end_s + 0.1 * slot_s);
  const label = `Positioning phases of ${tags.map((health) => health.tag).join(", ")} over ${duration(end_s)}`;
  const picture = s("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  picture.append(...slotMarks(tags, slot_s, at, height), ...timeMarks(end_s, at));
  tags.forEach((health, index) => picture.append(trace(health, TOP + index * ROW_HEIGHT, at, end_s)));
  return picture;
}

/** Boxes of the slots from the first that was heard, with the anchor; a dot where none was heard. */
function slotMarks(tags, slot_s, at, height) {
  const heard = new Map(tags.flatMap(({ phases }) => phases.map(({ slot, anchor }) => [slot, anchor])));
  const first = tags[0].phases[0].slot;
  const marks = [];
  for (let slot = first; slot < Math.max(slotCount(), first + 1); slot++) {
    const x = at((slot - first) * slot_s);
    const next = at((slot - first + 1) * slot_s);
    marks.push(s("rect", { class: "slot", x, y: 18, width: Math.max(next - x - 1, 1), height: height - 24 }));
    const name = String(heard.get(slot) ?? "·");
    if (next - x > 11) marks.push(s("text", { x: (x + next) / 2, y: 31, class: "slot-name" }, name));
  }
  return marks;
}

function timeMarks(end_s, at) {
  const step = roundStep(end_s / 4);
  const marks = [s("text", { x: 0, y: 31, class: "row-name" }, "anchor")];
  for (let n = 0; n * step <= end_s + 1e-9; n++) {
    marks.push(
      s("text", { x: at(n * step), y: 11, class: "time" }, number(n * step * 1e3, step < 1e-3 ? 1 : 0, n ? "" : "ms")),
    );
  }
  return marks;
}

function trace(health, top, at, end_s) {
  const low = top + ROW_HEIGHT - 8;
  const high = top + 8;
  let line = `M${LEFT} ${low}`;
  const row = s("g", { class: health.tag === state.selection.tag ? "trace selected" : "trace" });
  for (const phase of health.phases) {
    const from = at(phase.heard_s);
    const to = Math.max(at(phase.done_s), from + 1.5);
    line += `H${from.toFixed(1)}V${high}H${to.toFixed(1)}V${low}`;
    const words = `anchor ${phase.anchor}, slot ${phase.slot}: ${duration(phase.done_s - phase.heard_s)}${phase.fix ? ", fix" : ""}`;
    row.append(
      s("rect", { class: "busy", x: from, y: high, width: to - from, height: low - high }, s("title", {}, words)),
    );
    if (phase.fix) row.append(s("circle", { class: "fix", cx: to, cy: high - 1, r: 2.2 }));
  }
  row.append(s("path", { class: "pin", d: `${line}H${at(end_s)}` }));
  const name = health.tag.length > 9 ? `${health.tag.slice(0, 8)}…` : health.tag;
  row.append(s("text", { x: 0, y: top + 17, class: "row-name" }, name, s("title", {}, health.tag)));
  return row;
}

function showEther() {
  const age = Math.min(...[...state.health.heardMs.ether.keys()].map((name) => healthAge_s("ether", name)));
  const ether = state.mode === "live" && age < state.thresholds.report_s ? state.health.ether : null;
  parts.etherBox.hidden = !ether;
  if (!ether) return;
  parts.ether.show({
    Transmissions: number(ether.transmissions),
    "Missed now": `${number(100 * (ether.missed_share ?? 0), 1)} %`,
    "Missed in all": number(ether.late),
    "Behind real time": `${number(ether.stalls)} times`,
    "Receptions lost": number(ether.overruns),
    "Simulated time": duration(ether.simulated_s),
  });
}
