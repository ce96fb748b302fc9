/** A line above the map with what the watch of the anchors finds; gone when nothing is found any more. */

import { on, select } from "./store.js";
import { byId, h } from "./dom.js";
import { open } from "./tabs.js";
import { findingWords, findings, outdated } from "./survey/watch.js";

const MOST = 2;
let shown = "[]";

/** Keep the line up to date. */
export function start() {
  on(["watch", "mode"], show);
  setInterval(show, 5000);
}

function show() {
  const found = findings();
  const old = outdated();
  const key = JSON.stringify([found.length && old, found]);
  if (key === shown) return;
  shown = key;
  const box = byId("watch");
  box.hidden = found.length === 0;
  box.className = found.some((finding) => finding.kind === "moved") ? "bad" : "";
  const lines = found.slice(0, MOST).map((finding) => h("p", {}, findingWords(finding)));
  if (found.length > MOST) lines.push(h("p", {}, `And ${found.length - MOST} more: see the anchors.`));
  if (old) lines.push(h("p", { class: "fine" }, "The watch does not report any more; this may have changed."));
  const first = found[0]?.anchors[0];
  const go = h("button", { type: "button", onclick: () => (open("anchors"), select("anchor", first)) }, "Show");
  box.replaceChildren(h("div", {}, ...lines), go);
}
