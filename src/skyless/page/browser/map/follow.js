/** Following a tag: the map stays centred on it until the user ends it. */

import { changed, on, state } from "../store.js";
import { byId, text, toast } from "../dom.js";
import { shownName } from "../assets/model.js";
import { freshness, tracks } from "../clock.js";
import { X, Y, Z } from "../tracks.js";
import { pan, toX, toY, view } from "./view.js";

/** @type {string|null} */
let followed = null;

/** Name of the followed tag, null without one. */
export function following() {
  return followed;
}

/** Follow the selected tag, or end following. */
export function toggleFollow() {
  if (followed !== null) return endFollow();
  if (state.selection.tag === null) return toast("Select a tag first: click it on the map or in the list.");
  follow(state.selection.tag);
}

/** Follow a tag. */
export function follow(name) {
  followed = name;
  show();
  changed("tags");
}

/** Let the map stand still again. */
export function endFollow() {
  followed = null;
  show();
}

/** Centre the map on the followed tag; returns whether the map has moved. */
export function centre(seen) {
  const one = followed === null ? null : seen.find(({ track }) => track.name === followed);
  if (!one) return false;
  const dx = view.width / 2 - toX(one.row[X], one.row[Y]);
  const dy = view.height / 2 - toY(one.row[X], one.row[Y], one.row[Z]);
  if (Math.hypot(dx, dy) < 0.3) return false;
  pan(dx, dy);
  return true;
}

function show() {
  state.followed = followed;
  byId("following").hidden = followed === null;
  byId("follow").setAttribute("aria-pressed", String(followed !== null));
  describe();
}

function describe() {
  if (followed === null) return;
  const track = tracks().all.get(followed);
  const gone = !track || !["fresh", "late", "asleep"].includes(freshness(track));
  text(byId("following-words"), gone ? `Following ${shownName(followed)}: gone` : `Following ${shownName(followed)}`);
}

/** Connect the button and the bar. */
export function start() {
  byId("follow").addEventListener("click", toggleFollow);
  byId("following-end").addEventListener("click", endFollow);
  on(["mode"], () => (state.past || !tracks().all.has(followed)) && endFollow());
  setInterval(describe, 1000);
}
