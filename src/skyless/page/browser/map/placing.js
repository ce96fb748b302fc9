/**
 * The bar to try other places for anchors: they are dragged on the map, and the predicted σ is computed again. What comes
 * of it is a sheet for those who mount the anchors, or a table of positions.
 */

import { anchorName, on, select, state } from "../store.js";
import { installersSheet } from "../api.js";
import { byId, h, text, toast } from "../dom.js";
import { csvOf } from "../files.js";
import { save } from "./export.js";
import { choose, recompute } from "./overlay.js";
import { movedAnchors, place, placed, places, setPlaces } from "./places.js";

const AXES = ["x_m", "y_m", "z_m"];

let computing = false;
/** @type {boolean|null} what is to be computed next: a coarse prediction, a fine one, or nothing */
let due = null;
let fields = [];

/** Begin to try places, with the predicted σ on the map. */
export function startPlacing() {
  setPlaces(new Map());
  if (state.options.overlay !== "sigma") choose("sigma");
}

/** Forget the places that were tried, and end or go on. */
function resetPlaces(end) {
  const had = places?.size;
  setPlaces(end ? null : new Map());
  if (had) predict(false);
}

/** Move an anchor; while it is dragged the prediction is coarse. */
export function placeAnchor(id, values, dragged) {
  if (dragged && state.selection.anchor !== id) select("anchor", id);
  if (place(id, values)) predict(dragged);
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
    const input = h("input", { type: "number", step: "0.05", id: `placing-${axis}` });
    input.addEventListener("change", () => {
      if (Number.isFinite(input.valueAsNumber)) placeAnchor(state.selection.anchor, { [axis]: input.valueAsNumber }, false);
    });
    return input;
  });
  byId("placing-fields").append(...fields.map((input, index) => h("label", {}, `${AXES[index][0]} `, input)), "m");
  byId("placing-reset").addEventListener("click", () => resetPlaces(false));
  byId("placing-end").addEventListener("click", () => resetPlaces(true));
  byId("placing-sheet").addEventListener("click", saveSheet);
  byId("placing-table").addEventListener("click", saveTable);
  on(["placing", "selection", "site", "mode"], show);
}

function show() {
  if (places && state.mode !== "live") return resetPlaces(true);
  byId("placing").hidden = !places;
  if (!places) return;
  const anchor = state.site?.anchors.find((one) => one.id === state.selection.anchor);
  const moved = places.size === 1 ? "1 anchor elsewhere" : `${places.size} anchors elsewhere`;
  const nothing = places.size ? `${moved}; nothing` : "Nothing";
  const what = anchor ? `Anchor ${anchorName(anchor.id)}:` : "Drag an anchor, or select one.";
  text(byId("placing-help"), `${nothing} is sent to the site. ${what}`);
  byId("placing-fields").hidden = !anchor;
  byId("placing-reset").disabled = !places.size;
  if (!anchor) return;
  const at = placed(anchor);
  fields.forEach((input, index) => {
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
  const rows = state.site.anchors.map(placed).map((anchor) => [anchor.id, ...AXES.map((axis) => anchor[axis])]);
  save(new Blob([csvOf(["id", ...AXES], rows)], { type: "text/csv" }), "csv");
}
