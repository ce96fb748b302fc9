/** In the empty map, how far the kernels are compiled: before a site's programs start for the first time. */

import { on, state } from "./store.js";
import { byId, h, text } from "./dom.js";

/** Show it for as long as it lasts. */
export function start() {
  const count = h("p", {});
  const bar = h("progress", { max: 1, "aria-label": "Compiled" });
  const left = h("p", { class: "fine" });
  const box = h("div", { id: "preparation", role: "status", hidden: true }, count, bar, left);
  byId("waiting").before(box);
  on(["preparation", "mode"], () => {
    const now = state.mode === "live" ? state.preparation : null;
    box.hidden = now === null;
    if (now === null) return;
    text(count, now.total ? `Compiling ${now.done} of ${now.total} kernels` : "Compiling the kernels");
    if (now.total) bar.value = now.done / now.total;
    else bar.removeAttribute("value");
    text(left, `${now.left_s === null ? "" : `About ${Math.max(1, Math.round(now.left_s))} s left. `}At the first start only; then tags appear here.`);
  });
}
