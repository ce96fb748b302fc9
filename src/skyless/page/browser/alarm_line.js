/** Alarms in the header: how many are open; and below it the severest critical one that nobody has acknowledged. */

import { on, state } from "./store.js";
import { SEVERITIES, counts, criticals, isActive, isUnseen, selectSubject } from "./alarms/model.js";
import { byId, h, text } from "./dom.js";
import { sentence } from "./format.js";
import { open as openTab } from "./tabs.js";

/** Keep the count and the line up to date. */
export function start() {
  for (const id of ["alarm-count", "alarm-all"]) byId(id).addEventListener("click", () => openTab("alarms"));
  byId("alarm-show").addEventListener("click", () => selectSubject(criticals()[0]));
  on(["alarms"], show);
  show();
}

function show() {
  const unseen = state.alarms.filter(isUnseen);
  const active = counts().seen;
  const count = `${unseen.length}${state.moreAlarms ? "+" : ""}`;
  const words = `${count} ${count === "1" ? "alarm is" : "alarms are"} not acknowledged, ${active} acknowledged and active`;
  const worst = Object.keys(SEVERITIES).find((one) => unseen.some(({ severity }) => severity === one));
  const button = byId("alarm-count");
  button.hidden = !unseen.length && !active;
  button.className = worst ?? "";
  text(button.lastElementChild, count);
  button.setAttribute("aria-label", words);
  button.title = words;
  const badge = [" ", h("span", { class: `unread ${worst}`, title: words }, count)];
  byId("tab-alarms").replaceChildren("Alarms", ...(unseen.length ? badge : []));
  const [first, ...others] = criticals();
  byId("alarm-line").hidden = !first;
  byId("alarm-words").title = first?.sentence ?? "";
  text(byId("alarm-words"), first ? sentence(`${isActive(first) ? "critical" : "critical, ended"}: ${first.sentence}`) : "");
  text(byId("alarm-all"), others.length ? `and ${others.length} more` : "All alarms");
}
