/**
 * Other places for anchors, tried on the map: they are dragged, and the predicted σ is computed again. Nothing of it is
 * sent to the site; what comes of it is a sheet for those who mount the anchors, or a table of positions.
 */

import { changed, on, select, state } from "../store.js";
import { installersSheet } from "../api.js";
import { byId, h, text, toast } from "../dom.js";
import { save } from "./export.js";
import { choose, recompute } from "./overlay.js";

const SNAP_M = 0.05;
const AXES = ["x_m", "y_m", "z_m"];

/** Where anchors would be, by their identifiers; null while none are tried. @type {Map<number, any>|null} */
export let places = null;
let computing = false;
/** @type {boolean|null} what is to be computed next: a coarse prediction, a fine one, or nothing */
let due = null;
let fields = null;

/** Begin to try places, with the predicted σ on the map. */
export function startPlacing() {
  if (state.mode !== "live" || !state.site?.anchors.length) return toast("Places are tried at a live site with anchors.");
  places = new Map();
  if (state.options.overlay !== "sigma") choose("sigma");
  changed("placing");
}

/** Forget the places that were tried, and end or go on. */
export function resetPlaces(end) {
  const had = places?.size;
  places = end ? null : new Map();
  changed("placing");
  if (had) predict(false);
}

/** An anchor where it would be. */
export function placed(anchor) {
  return places?.has(anchor.id) ? { ...anchor, ...places.get(anchor.id) } : anchor;
}

/** Anchors that would be elsewhere, as the server takes them. */
export function movedAnchors() {
  return [...(places ?? [])].map(([id, at]) => ({ id, ...at }));
}

/** Move an anchor; while it is dragged the prediction is coarse. */
export function placeAnchor(id, values, dragged) {
  const anchor = state.site?.anchors.find((one) => one.id === id);
  if (!places || !anchor) return;
  const { x_m, y_m, z_m } = placed(anchor);
  const snapped = Object.entries(values).map(([axis, value]) => [axis, Number((Math.round(value / SNAP_M) * SNAP_M).toFixed(3))]);
  if (dragged && state.selection.anchor !== id) select("anchor", id);
  places.set(id, { x_m, y_m, z_m, ...Object.fromEntries(snapped) });
  changed("placing");
  predict(dragged);
}

/** Predict, one request at a time: of those that come meanwhile, the newest. */
export async function predict(coarse) {
  due = coarse;
  if (computing) return;
  computing = true;
  while (due !== null) {
    const next = due;
    due = null;
    await recompute(next);
  }
  computing = false;
}

/** Fill the bar over the map. */
export function start() {
  fields = AXES.map((axis) => {
    const input = h("input", { type: "number", step: String(SNAP_M), id: `placing-${axis}` });
    input.addEventListener("change", () => {
      if (Number.isFinite(input.valueAsNumber)) placeAnchor(state.selection.anchor, { [axis]: input.valueAsNumber }, false);
    });
    return h("label", {}, `${axis[0]} `, input);
  });
  byId("placing-fields").append(...fields, "m");
  byId("placing-reset").addEventListener("click", () => resetPlaces(false));
  byId("placing-end").addEventListener("click", () => resetPlaces(true));
  byId("placing-sheet").addEventListener("click", saveSheet);
  byId("placing-table").addEventListener("click", saveTable);
  on(["placing", "selection", "site", "mode"], show);
}

function show() {
  if (places && state.mode !== "live") return resetPlaces(true);
  const bar = byId("placing");
  bar.hidden = !places;
  if (!places) return;
  const anchor = state.site?.anchors.find((one) => one.id === state.selection.anchor);
  const moved = places.size === 1 ? "1 anchor elsewhere" : `${places.size} anchors elsewhere`;
  const what = anchor ? `Anchor ${anchor.id}:` : "Drag an anchor, or select one.";
  text(byId("placing-help"), `Predicted σ, ${moved}; nothing is sent to the site. ${what}`);
  byId("placing-fields").hidden = !anchor;
  byId("placing-reset").disabled = !places.size;
  if (!anchor) return;
  const at = placed(anchor);
  fields.forEach((label, index) => {
    const input = label.lastChild;
    if (document.activeElement !== input) input.value = String(at[AXES[index]]);
  });
}

async function saveSheet() {
  const button = byId("placing-sheet");
  button.disabled = true;
  try {
    save(await installersSheet(movedAnchors()), "pdf");
  } catch (error) {
    toast(`No sheet: ${error.message}`, "bad");
  }
  button.disabled = false;
}

function saveTable() {
  const rows = state.site.anchors.map(placed).map(({ id, x_m, y_m, z_m }) => `${id},${x_m},${y_m},${z_m}\n`);
  save(new Blob(["id,x_m,y_m,z_m\n", ...rows], { type: "text/csv" }), "csv");
}
