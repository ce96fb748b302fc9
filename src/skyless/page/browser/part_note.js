/** A line on the map that says how many tags are drawn where the server sends a part of them, and whether a filter dims some. */

import { on, state } from "./store.js";
import { byId, text, throttle } from "./dom.js";
import { number } from "./format.js";
import { live } from "./clock.js";
import { filtering } from "./map/filter.js";
import { manyShown } from "./map/many.js";
import { rowLimit } from "./pace.js";

/** Keep the line up to date. */
export function start() {
  on(["tags", "mode"], throttle(500, show));
}

function show() {
  if (manyShown()) return showMany(state.many);
  const part = state.mode === "live" ? state.part : null;
  byId("part").hidden = !part && !filtering();
  const words = [];
  if (part) {
    const more = part.inside >= rowLimit() ? ": zoom in to see the others" : "";
    words.push(`${number(live.all.size)} of ${number(part.of)} tags are shown${more}`);
  }
  if (filtering()) words.push("tags that the list leaves out are faint");
  text(byId("part"), words.join("; "));
}

/** All tags in sight, as points or as counts. */
function showMany({ kind, count }) {
  byId("part").hidden = false;
  const how = kind === "B" ? " tags, shown as counts: zoom in to see single ones" : " tags are shown as points";
  text(byId("part"), `${number(count)}${how}`);
}
