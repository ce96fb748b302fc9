/** Zones: their names, colours and corners; and the tags that entered and left. */

import { isChangeable, select, state, toggleSelection } from "../store.js";
import { shownName } from "../assets/model.js";
import { Rows, button, h, offer, options, text, toast } from "../dom.js";
import { saveFile } from "../files.js";
import { sentence, timeOfDay } from "../format.js";
import { add as addZones, change, editor, remove } from "../map/editor.js";
import { floors } from "../map/floors.js";
import { startDrawing } from "../map/tools.js";
import { zoneColour } from "../map/zones.js";
import { hexOf } from "../theme.js";
import { outlineFields } from "./outline.js";

export const title = "Zones";
export const topics = ["zones", "events", "selection", "mode", "editor", "site", "theme", "health"];
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
  const fault = h("p", { class: "reason", role: "alert", hidden: true });
  const others = h("ul", { class: "given" });
  const kept = h("section", { hidden: true }, h("h2", {}, "Kept, not shown"), others);
  const file = fileButtons();
  const outline = outlineFields();
  parts = { add, none, silent, fault, kept, file, outline, others: new Rows(others, makeOther) };
  Object.assign(parts, { zones: new Rows(zones, makeZone), events: new Rows(events, makeEvent) });
  panel.append(h("div", { class: "above" }, h("p", { class: "count" }), add), fault, none, zones, file.element, outline.element, kept);
  panel.append(h("section", {}, h("h2", {}, "Events"), silent, events));
}

/** Bring the tab up to date. */
export function show() {
  const live = state.mode === "live";
  const fault = live ? state.zonesFault : null;
  parts.fault.hidden = !fault;
  text(parts.fault, fault ? sentence(fault) : "");
  parts.add.disabled = !live || editor.drawing || Boolean(fault);
  parts.none.hidden = state.zones.length > 0 || Boolean(fault);
  parts.file.show(live && !fault);
  parts.outline.show();
  parts.kept.hidden = !live || !state.otherZones.length;
  parts.others.show(state.otherZones.map((other) => [JSON.stringify(other), other]));
  parts.zones.show(state.zones.map((zone) => [zone.id, zone]));
  const events = live ? state.events : [];
  text(parts.silent, live ? "No tag has entered or left a zone yet." : "Events are shown on the live site only.");
  parts.silent.hidden = events.length > 0;
  parts.events.show(events.map((event) => [`${event.unix_s} ${event.tag} ${event.zone} ${event.kind}`, event]));
}

/** Zones of another site with the same number, and a button that copies them to this one. */
function makeOther(_key, { site, zones }) {
  const count = `${zones.length} ${zones.length === 1 ? "zone" : "zones"}`;
  const copy = () => addZones(zones, `${count} of ${site} copied.`);
  const here = button("Copy here", copy, { class: "changes", "aria-label": `Copy the zones of ${site} here` });
  return { element: h("li", {}, h("span", {}, `Site ${site}: ${count}`), here) };
}

/** Zones to a file and from one, in the form of `skyless/v1/<site>/zones`. */
function fileButtons() {
  const save = h("button", { type: "button", onclick: exportZones }, "Export");
  const pick = h("input", { type: "file", accept: ".json,application/json", hidden: true });
  const load = h("button", { type: "button", class: "changes", onclick: () => pick.click() }, "Import …");
  pick.addEventListener("change", () => {
    if (pick.files[0]) importZones(pick.files[0]);
    pick.value = "";
  });
  const element = h("div", { class: "above files" }, save, load, pick);
  const show = (live) => {
    save.disabled = !state.zones.length;
    load.disabled = !live;
  };
  return { element, show };
}

function exportZones() {
  const name = state.site?.name ?? "";
  const words = JSON.stringify({ zones: state.zones, site: name }, null, 1);
  saveFile(new Blob([words], { type: "application/json" }), `zones ${name}.json`);
}

/** Add the zones of a file; the server checks them. @param {File} file */
async function importZones(file) {
  let zones = null;
  try {
    zones = JSON.parse(await file.text()).zones;
  } catch {
    // no JSON
  }
  if (!Array.isArray(zones) || !zones.length) return toast(`${file.name} holds no zones.`, "bad");
  await addZones(zones, `${zones.length} ${zones.length === 1 ? "zone" : "zones"} of ${file.name} added.`);
}

function makeZone(id, zone) {
  const swatch = h("input", { type: "color", "aria-label": `Colour of ${zone.name}` });
  swatch.addEventListener("change", () => change(id, { colour: swatch.value }));
  const name = h("input", { type: "text", maxLength: 60, "aria-label": "Name of the zone" });
  name.addEventListener("change", () => name.value.trim() && change(id, { name: name.value.trim() }));
  name.addEventListener("keydown", (event) => event.key === "Enter" && name.blur());
  const corners = button("Corners", () => toggleSelection("zone", id), { class: "quiet" });
  const del = button("Delete", () => remove(id), { class: "quiet changes" });
  const table = h("div", { class: "corners", hidden: true });
  const floor = options({ "aria-label": `Floor of ${zone.name}` }, [], (value) => change(id, { floor: value === "" ? null : Number(value) }));
  const element = h("li", {}, h("div", { class: "zone" }, swatch, name, floor, corners, del), table);
  let shown = "";
  const update = (now) => {
    const chosen = state.selection.zone === id;
    element.className = chosen ? "selected" : "";
    corners.setAttribute("aria-expanded", String(chosen));
    if (document.activeElement !== swatch) swatch.value = hexOf(zoneColour(now));
    if (document.activeElement !== name) name.value = now.name;
    const numbered = floors().filter(({ number }) => number !== undefined);
    floor.hidden = !numbered.length;
    offer(floor, [["", "all floors"], ...numbered.map((one) => [one.number, one.name])], now.floor ?? "");
    del.setAttribute("aria-label", `Delete ${now.name}`);
    for (const input of [swatch, name, floor, del]) input.disabled = !isChangeable();
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
        disabled: !isChangeable(),
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
    h("button", { type: "button", class: "name", onclick: () => select("tag", event.tag) }, shownName(event.tag)),
    h("span", {}, ` ${entered ? "entered" : "left"} ${event.name}`),
  );
  return { element };
}
