/** The map's buttons, and the bar with help while a zone is drawn. */

import { changed, on, state } from "../store.js";
import { byId, h, text } from "../dom.js";
import { picking, stopPicking } from "../survey/picking.js";
import { moving, setMoving } from "../survey/plan.js";
import { chooseFloor, floors } from "./floors.js";
import { begin, cancel, editor, finish, undoPoint } from "./editor.js";
import { start as startFollow } from "./follow.js";
import { fitAll, redraw, showSpatial } from "./map.js";
import { view, zoom } from "./view.js";

/** Connect the buttons. */
export function start() {
  const click = (id, call) => byId(id).addEventListener("click", call);
  click("zoom-in", () => (zoom(1.25), redraw()));
  click("zoom-out", () => (zoom(0.8), redraw()));
  click("fit", fitAll);
  click("spatial", () => showSpatial(!view.spatial));
  startFollow();
  click("draw", (event) => startDrawing(event.detail === 0));
  click("drawing-finish", finish);
  click("drawing-undo", undoPoint);
  click("drawing-cancel", cancel);
  click("picking-cancel", () => (picking ? stopPicking() : setMoving(false)));
  on(["editor"], show);
  on(["picking", "plan"], showPicking);
  on(["site", "options"], showFloors);
  on(["mode"], () => {
    byId("draw").disabled = view.spatial || state.mode === "replay";
    if (editor.drawing && state.mode === "replay") cancel();
  });
}

/** A button for each floor, the highest first, and one for all; they stay while the floors do, and so does the focus. */
function showFloors() {
  const box = byId("floor-buttons");
  const list = [["All floors", null], ...floors().map(({ name }, index) => [name, index])].reverse();
  if (box.dataset.names !== JSON.stringify(list)) {
    box.dataset.names = JSON.stringify(list);
    box.replaceChildren(...list.map(([name, index]) => h("button", { type: "button", onclick: () => chooseFloor(index) }, name)));
  }
  box.hidden = list.length < 3;
  list.forEach(([, index], at) => box.children[at].setAttribute("aria-pressed", String(state.options.floor === index)));
}

/** Begin a zone; from the keyboard, with a cursor in the middle of the map. */
export function startDrawing(keyboard) {
  begin(keyboard ? [view.x_m, view.y_m] : null);
  byId("canvas").focus({ preventScroll: true });
  changed("editor");
}

/** The bar with what the set-up asks for on the map. */
function showPicking() {
  const moved = moving && !picking;
  byId("picking").hidden = !picking && !moved;
  byId("canvas").classList.toggle("drawing", picking !== null);
  text(byId("picking-help"), picking?.help ?? (moved ? "Drag the floor plan, or move it by the arrow keys." : ""));
  text(byId("picking-cancel"), moved ? "Done" : "Cancel");
}

function show() {
  const corners = editor.points.length;
  byId("drawing").hidden = !editor.drawing;
  byId("canvas").classList.toggle("drawing", editor.drawing);
  byId("drawing-finish").disabled = corners < 3;
  byId("drawing-undo").disabled = corners < 1;
  const how = corners < 3 ? "Click or tap the corners" : "The first corner, or Finish, closes it";
  text(byId("drawing-help"), `${how}.`);
}
