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

/** @type {{tag: string, site: number|null, last_s: number, positions: number[][]}|null} */
let recorded = null;

/** The fields and the button: an element, and `show`, which brings them up to date. */
export function outlineFields() {
  const tag = h("select", { id: "outline-tag" });
  const margin = h("input", { type: "number", id: "outline-margin", min: "0", max: "5", step: "0.05", value: "0.3" });
  const go = button("", () => (recorded ? stop() : record()), { id: "outline" });
  const note = h("p", { class: "fine", role: "status" });
  const labels = Object.entries({ Tag: tag, "Margin, m": margin }).map(([words, field]) => h("label", { class: "field" }, words, field));
  const element = h("section", { class: "changes" }, h("h2", {}, "A zone by walking around it"), h("div", { class: "fields" }, ...labels, go), note);
  const show = () => {
    offer(tag, live.sorted.map(({ name }) => [name, labelOf(name)]), recorded?.tag ?? tag.value);
    tag.disabled = recorded !== null;
    go.disabled = !isChangeable() || !tag.value;
    text(go, recorded ? "Stop" : "Record outline");
  };
  const record = () => {
    recorded = { tag: tag.value, site: state.liveId, last_s: live.all.get(tag.value).lastTime, positions: [] };
    if (state.part) follow(tag.value); // of a large site the server sends what is in view, and the followed tag
    text(note, "Walk around the place with the tag.");
    show();
  };
  const stop = async () => {
    if (!margin.value || !margin.validity.valid) return text(note, `The margin is ${margin.value || "no number"}; it should be 0 to 5 m, in steps of 5 cm.`);
    const { positions } = recorded;
    recorded = null;
    show();
    try {
      await addZone(outlineOf(positions, margin.valueAsNumber));
      text(note, "");
    } catch (error) {
      text(note, `No zone: ${error.message}`);
    }
  };
  on(["tags"], () => {
    if (recorded && recorded.site !== state.liveId) recorded = null;
    if (recorded && collect(recorded)) text(note, `${recorded.positions.length} good positions so far.`);
  });
  return { element, show };
}

/** Add the positions that have come; returns whether there are some. */
function collect(record) {
  const track = live.all.get(record.tag);
  const before = record.positions.length;
  for (let index = track ? track.find(record.last_s) + 1 : 0; index < (track?.count ?? 0); index++) {
    record.last_s = track.value(index, TIME);
    if (GRADES[track.value(index, ALERT)] === "bad" || track.value(index, STD) > MAX_STD_M) continue;
    record.positions.push([track.value(index, X), track.value(index, Y)]);
  }
  return record.positions.length > before;
}
