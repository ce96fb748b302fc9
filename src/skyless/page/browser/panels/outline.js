/** "Record outline": a tag is carried around a place, and its positions become the outline of a zone. */

import { isChangeable, on, state } from "../store.js";
import { labelOf } from "../assets/model.js";
import { live } from "../clock.js";
import { button, h, offer, text } from "../dom.js";
import { addZone } from "../map/editor.js";
import { follow } from "../map/follow.js";
import { outlineOf } from "../map/outline.js";
import { ALERT, ALERTS, STD, TIME, X, Y } from "../tracks.js";

/** Positions of a larger standard deviation are left out. */
const MAX_STD_M = 1;
const GRADES = Object.values(ALERTS).map(({ grade }) => grade);

/** The fields and the button: an element, and `show`, which brings them up to date. */
export function outlineFields() {
  /** @type {{name: string, site: number|null, last_s: number, positions: number[][]}|null} */
  let walk = null;
  const tag = h("select", { id: "outline-tag" });
  const margin = h("input", { type: "number", id: "outline-margin", min: "0", max: "5", step: "0.05", value: "0.3" });
  const go = button("", () => (walk ? stop() : record(tag.value)), { id: "outline" });
  const note = h("p", { class: "fine", role: "status" });
  const labels = Object.entries({ Tag: tag, "Margin, m": margin }).map(([words, field]) => h("label", { class: "field" }, words, field));
  const element = h("section", { class: "changes" }, h("h2", {}, "A zone by walking around it"), h("div", { class: "fields" }, ...labels, go), note);
  const show = () => {
    offer(tag, live.sorted.map(({ name }) => [name, labelOf(name)]), walk?.name ?? tag.value);
    tag.disabled = walk !== null;
    go.disabled = !isChangeable() || !tag.value;
    text(go, walk ? "Stop" : "Record outline");
  };
  const marginFault = () => (margin.value && margin.validity.valid ? "" : `The margin is ${margin.value || "no number"}; it should be 0 to 5 m, in steps of 5 cm.`);
  const record = (name) => {
    walk = { name, site: state.liveId, last_s: live.all.get(name)?.lastTime ?? -Infinity, positions: [] };
    if (state.part) follow(name); // of a large site the server sends what is in view, and the followed tag
    text(note, "Walk around the place with the tag.");
    show();
  };
  const stop = async () => {
    if (marginFault()) return text(note, marginFault());
    const { positions } = walk;
    walk = null;
    show();
    try {
      await addZone(outlineOf(positions, margin.valueAsNumber));
      text(note, "");
    } catch (error) {
      text(note, `No zone: ${error.message}`);
    }
  };
  on(["tags"], () => {
    if (walk?.site !== state.liveId) walk = null;
    const track = live.all.get(walk?.name);
    if (!track) return;
    for (let index = track.find(walk.last_s) + 1; index < track.count; index++) {
      const [at_s, x_m, y_m, std_m, alert] = [TIME, X, Y, STD, ALERT].map((column) => track.value(index, column));
      walk.last_s = at_s;
      if (GRADES[alert] !== "bad" && !(std_m > MAX_STD_M)) walk.positions.push([x_m, y_m]);
    }
    if (walk.positions.length) text(note, marginFault() || `${walk.positions.length} good positions so far.`);
  });
  return { element, show };
}
