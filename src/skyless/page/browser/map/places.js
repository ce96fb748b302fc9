/** Where anchors would be, while other places are tried for them. Nothing of it is sent to the site. */

import { changed, state } from "../store.js";

const SNAP_M = 0.05;

/** Places by the anchors' identifiers; null while none are tried. @type {Map<number, any>|null} */
export let places = null;

/** Begin to try places, forget those that were tried, or with null end. @param {Map<number, any>|null} value */
export function setPlaces(value) {
  places = value;
  changed("placing");
}

/** An anchor where it would be. */
export function placed(anchor) {
  return places?.has(anchor.id) ? { ...anchor, ...places.get(anchor.id) } : anchor;
}

/** Anchors that would be elsewhere, as the server takes them. */
export function movedAnchors() {
  return [...(places ?? [])].map(([id, at]) => ({ id, ...at }));
}

/** Move an anchor along the axes that are given; false where none is tried. */
export function place(id, values) {
  const anchor = state.site?.anchors.find((one) => one.id === id);
  if (!places || !anchor) return false;
  const { x_m, y_m, z_m } = placed(anchor);
  const at = { x_m, y_m, z_m };
  for (const [axis, value] of Object.entries(values)) at[axis] = Number((Math.round(value / SNAP_M) * SNAP_M).toFixed(3));
  places.set(id, at);
  changed("placing");
  return true;
}
