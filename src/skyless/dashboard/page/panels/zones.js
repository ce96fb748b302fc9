/** Zones: their names, colours and corners; and the tags that entered and left. */

import { select, state, toggleSelection } from "../store.js";
import { Rows, h, text } from "../dom.js";
import { timeOfDay } from "../format.js";
import { change, editor, remove } from "../map/editor.js";
import { startDrawing } from "../map/tools.js";
import { zoneColour } from "../map/zones.js";

export const title = "Zones";
export const topics = ["zones", "events", "selection", "mode", "editor"];
export const interval_ms = 60;

let parts = null;

/** Build the tab. */
export function start(panel) {
  const add = h("button", { type: "button", class: "primary", id: "add-zone" }, "Draw a zone");
  add.addEventListener("click", (event) => startDrawing(event.detail === 0));
  const zones = h("ul", { class: "zones" });
  const events = h("ol", { class: "events", id: "events", role: "log", "aria-label": "Events" });
  const none = h("p", { class: "empty" }, "No zones yet. Draw one on the map with mouse, finger or keyboard.");
  const silent = h("p", { class: "empty" });
  parts = { add, none, silent, zones: new Rows(zones, makeZone), events: new Rows(events, makeEvent) };
  panel.append(h("div", { class: "above" }, h("p", { class: "count" }), add), none, zones);
  panel.append(h("section", {}, h("h2", {}, "Events"), silent, events));
}

/** Bring the tab up to date. */
export function show() {
  const live = state.mode === "live";
  parts.add.disabled = !live || editor.drawing;
  parts.none.hidden = state.zones.length > 0;
  parts.zones.show(state.zones.map((zone) => [zone.id, zone]));
  const events = live ? state.events : [];
  text(parts.silent, live ? "No tag has entered or left a zone yet." : "Events are shown on the live site only.");
  parts.silent.hidden = events.length > 0;
  parts.events.show(events.map((event) => [`${event.unix_s} ${event.tag} ${event.zone} ${event.kind}`, event]));
}

function makeZone(id, zone) {
  const swatch = h("input", { type: "color", "aria-label": `Colour of ${zone.name}` });
  swatch.addEventListener("change", () => change(id, { colour: swatch.value }));
  const name = h("input", { type: "text", maxLength: 60, "aria-label": "Name of the zone" });
  name.addEventListener("change", () => name.value.trim() && change(id, { name: name.value.trim() }));
  name.addEventListener("keydown", (event) => event.key === "Enter" && name.blur());
  const corners = h(
    "button",
    { type: "button", class: "quiet", onclick: () => toggleSelection("zone", id) },
    "Corners",
  );
  const del = h("button", { type: "button", class: "quiet", onclick: () => remove(id) }, "Delete");
  const table = h("div", { class: "corners", hidden: true });
  const element = h("li", {}, h("div", { class: "zone" }, swatch, name, corners, del), table);
  let shown = "";
  const update = (now) => {
    const chosen = state.selection.zone === id;
    element.className = chosen ? "selected" : "";
    corners.setAttribute("aria-expanded", String(chosen));
    const colour = zoneColour(now);
    if (document.activeElement !== swatch && colour.startsWith("#")) swatch.value = colour;
    if (document.activeElement !== name) name.value = now.name;
    del.setAttribute("aria-label", `Delete ${now.name}`);
    for (const input of [swatch, name, del]) input.disabled = state.mode !== "live";
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
      input.addEventListener("change", () => setCoordinate(zone.id, index, part, Number(input.value)));
      return h("label", {}, `${axis} `, input);
    });
    return h("div", {}, h("span", {}, String(index + 1)), ...inputs, "m");
  });
}

function setCoordinate(id, index, part, value) {
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
