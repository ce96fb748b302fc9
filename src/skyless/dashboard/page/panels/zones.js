/** Zones: named, recoloured, moved by numbers, deleted; and who entered and left. */

import { on, select, state } from "../store.js";
import { Rows, h, slowly, text } from "../dom.js";
import { timeOfDay } from "../format.js";
import { change, editor, remove } from "../map/editor.js";
import { startDrawing } from "../map/tools.js";
import { zoneColour } from "../map/zones.js";

export const title = "Zones";
let parts = null;
let isOpen = () => false;

/** Build the tab. */
export function start(panel, open) {
  isOpen = open;
  const add = h("button", { type: "button", class: "primary", id: "add-zone" }, "Draw a zone");
  add.addEventListener("click", (event) => startDrawing(event.detail === 0));
  const zones = h("ul", { class: "zones" });
  const events = h("ol", { class: "events", id: "events", role: "log", "aria-label": "Events" });
  const none = h("p", { class: "empty" }, "No zones yet. Draw one on the map with mouse, finger or keyboard.");
  const silent = h("p", { class: "empty" }, "Nobody has entered or left a zone yet.");
  parts = {
    add,
    none,
    silent,
    zones: new Rows(zones, makeZone),
    events: new Rows(events, makeEvent),
    eventBox: events,
  };
  panel.append(h("div", { class: "above" }, h("p", { class: "count" }), add), none, zones);
  panel.append(h("section", {}, h("h2", {}, "Entered and left"), silent, events));
  on(["zones", "events", "selection", "mode", "editor"], slowly(60, show));
}

/** Bring the tab up to date, if anybody sees it. */
export function show() {
  if (!parts || !isOpen()) return;
  const live = state.mode === "live";
  parts.add.disabled = !live || editor.drawing;
  parts.none.hidden = state.zones.length > 0;
  parts.zones.show(state.zones.map((zone) => [zone.id, zone]));
  const events = live ? state.events : [];
  text(parts.silent, live ? "Nobody has entered or left a zone yet." : "Events are shown live only.");
  parts.silent.hidden = events.length > 0;
  parts.events.show(events.map((event) => [`${event.unix_s} ${event.tag} ${event.zone} ${event.kind}`, event]));
}

function makeZone(id, zone) {
  const swatch = h("input", { type: "color", "aria-label": `Colour of ${zone.name}` });
  swatch.addEventListener("change", () => change(id, { colour: swatch.value }));
  const name = h("input", { type: "text", maxLength: 60, "aria-label": "Name of the zone" });
  name.addEventListener("change", () => name.value.trim() && change(id, { name: name.value.trim() }));
  name.addEventListener("keydown", (event) => event.key === "Enter" && name.blur());
  const corners = h("button", { type: "button", class: "quiet", onclick: () => toggle(id) }, "Corners");
  const away = h("button", { type: "button", class: "quiet", onclick: () => remove(id) }, "Delete");
  const table = h("div", { class: "corners", hidden: true });
  const element = h("li", {}, h("div", { class: "zone" }, swatch, name, corners, away), table);
  let shown = "";
  const update = (now) => {
    const chosen = state.selection.zone === id;
    element.className = chosen ? "selected" : "";
    corners.setAttribute("aria-expanded", String(chosen));
    const colour = zoneColour(now);
    if (document.activeElement !== swatch && colour.startsWith("#")) swatch.value = colour;
    if (document.activeElement !== name) name.value = now.name;
    away.setAttribute("aria-label", `Delete ${now.name}`);
    for (const input of [swatch, name, away]) input.disabled = state.mode !== "live";
    table.hidden = !chosen;
    const key = JSON.stringify(now.polygon_m);
    if (chosen && key !== shown && !table.contains(document.activeElement)) table.replaceChildren(...cornerRows(now));
    if (chosen) shown = key;
  };
  return { element, update };
}

function cornerRows(zone) {
  return zone.polygon_m.map((corner, index) => {
    const inputs = ["x", "y"].map((axis, part) => {
      const input = h("input", {
        type: "number",
        step: "0.05",
        value: String(corner[part]),
        "aria-label": `Corner ${index + 1}, ${axis} in metres`,
        disabled: state.mode !== "live",
      });
      input.addEventListener("change", () => moveBy(zone.id, index, part, Number(input.value)));
      return h("label", {}, `${axis} `, input);
    });
    return h("div", {}, h("span", {}, String(index + 1)), ...inputs, "m");
  });
}

function moveBy(id, index, part, value) {
  const zone = state.zones.find((one) => one.id === id);
  if (!zone || !Number.isFinite(value)) return;
  const polygon_m = zone.polygon_m.map((corner, n) =>
    n === index ? corner.map((old, axis) => (axis === part ? value : old)) : corner,
  );
  change(id, { polygon_m });
}

function makeEvent(_key, event) {
  const entered = event.kind === "enter";
  const element = h(
    "li",
    { class: entered ? "enter" : "leave" },
    h("span", { class: "when" }, timeOfDay(event.unix_s)),
    h("span", { class: "arrow", "aria-hidden": "true" }, entered ? "→" : "←"),
    h("button", { type: "button", class: "name", onclick: () => select("tag", event.tag) }, event.tag),
    h("span", {}, ` ${entered ? "entered" : "left"} ${event.name}`),
  );
  return { element };
}

function toggle(id) {
  if (state.selection.zone === id) select(null);
  else select("zone", id);
}
