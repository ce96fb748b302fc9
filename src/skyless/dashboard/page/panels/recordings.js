/** The recordings that can be replayed. */

import { changed, state } from "../store.js";
import { recordings } from "../api.js";
import { Rows, h, text, toast } from "../dom.js";
import { bytes, dateTime, duration } from "../format.js";
import { open as play, close } from "../player.js";

export const title = "Replay";
export const topics = ["recordings", "player", "mode"];
export const interval_ms = 60;

let parts = null;
let error = "";

/** Build the tab. */
export function start(panel) {
  const refresh = h("button", { type: "button", onclick: load }, "Refresh");
  const back = h("button", { type: "button", class: "primary", onclick: close }, "Back to live");
  const list = h("ul", { class: "recordings" });
  const empty = h("p", { class: "empty" });
  parts = { back, empty, rows: new Rows(list, makeRow) };
  panel.append(
    h("div", { class: "above" }, h("p", { class: "count" }, "Recordings, newest first"), back, refresh),
    empty,
    list,
  );
}

/** Show the list; fetched when first seen. */
export function show() {
  if (state.recordings === null) {
    state.recordings = [];
    load();
  }
  parts.back.hidden = state.mode === "live";
  text(parts.empty, error || "No recordings yet. `skyless record` makes one.");
  parts.empty.hidden = state.recordings.length > 0;
  parts.rows.show(state.recordings.map((one) => [one.name, one]));
}

async function load() {
  try {
    state.recordings = await recordings();
    error = "";
  } catch (problem) {
    error = problem.message;
  }
  changed("recordings");
}

function makeRow(name) {
  const about = h("span", { class: "about" });
  const button = h("button", { type: "button", class: "recording" }, h("strong", {}, name), about);
  button.addEventListener("click", async () => {
    try {
      await play(name);
    } catch (problem) {
      toast(`${name} cannot be replayed: ${problem.message}`, "bad");
    }
  });
  const element = h("li", {}, button);
  const update = (one) => {
    const incomplete = one.complete ? "" : " · still being written, or cut off";
    text(about, `${dateTime(one.start_unix_s)} · ${duration(one.duration_s)} · ${bytes(one.bytes)}${incomplete}`);
    element.className = state.player?.name === name ? "selected" : "";
    button.setAttribute("aria-pressed", String(state.player?.name === name));
  };
  return { element, update };
}
