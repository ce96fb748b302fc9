/** A line on the map that says how many tags are drawn where the server sends a part of them. */

import { on, state } from "./store.js";
import { byId, text, throttle } from "./dom.js";
import { number } from "./format.js";
import { live } from "./clock.js";
import { rowLimit } from "./pace.js";

/** Keep the line up to date. */
export function start() {
  on(["tags", "mode"], throttle(500, show));
}

function show() {
  const { part } = state;
  byId("part").hidden = !part || state.mode !== "live";
  if (!part) return;
  const more = part.inside >= rowLimit() ? ": zoom in to see the others" : "";
  const here = `${number(live.all.size)} of ${number(part.of)} tags are shown`;
  text(byId("part"), `${here}${more}`);
}
