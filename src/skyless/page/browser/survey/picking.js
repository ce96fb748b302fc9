/** What the next click on the map is for, while a step of the set-up asks for an anchor or a point. */

import { changed } from "../store.js";

/** @type {{help: string, anchor: ((id: number) => void)|null, point: ((at: number[]) => void)|null}|null} */
export let picking = null;

/** Ask for an anchor on the map: `choose` is called with its identifier. */
export function pickAnchor(help, choose) {
  picking = { help, anchor: choose, point: null };
  changed("picking");
}

/** Ask for a point on the map: `choose` is called with its site coordinates. */
export function pickPoint(help, choose) {
  picking = { help, anchor: null, point: choose };
  changed("picking");
}

/** Ask for nothing any more. */
export function stopPicking() {
  if (!picking) return;
  picking = null;
  changed("picking");
}
