/** The recordings that can be replayed. */

import { changed, state } from "../store.js";
import { fileOf, recordings } from "../api.js";
import { Rows, h, text, toast } from "../dom.js";
import { bytes, dateTime, duration } from "../format.js";
import { open as play, close } from "../player.js";
import { KEYS } from "../player_bar.js";

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
    keys(),
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

function keys() {
  const rows = KEYS.map(([key, words]) => h("div", {}, h("dt", {}, key), h("dd", {}, words)));
  return h("section", {}, h("h2", {}, "Keys while a recording or a way is played"), h("dl", { class: "facts keys" }, ...rows));
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
  const download = h("a", { class: "button", href: fileOf(name), "aria-label": `Download ${name}` }, "Download");
  download.setAttribute("download", name);
  const element = h("li", {}, button, download);
  const update = (one) => {
    const incomplete = one.complete ? "" : " · still being written, or cut off";
    const tags = one.fixes === 0 ? "no fixes" : `${one.tags} ${one.tags === 1 ? "tag" : "tags"}`;
    const what = [one.site, dateTime(one.start_unix_s), duration(one.duration_s), tags, bytes(one.bytes)];
    text(about, what.filter(Boolean).join(" · ") + incomplete);
    element.className = state.player?.name === name ? "selected" : "";
    button.setAttribute("aria-pressed", String(state.player?.name === name));
  };
  return { element, update };
}
