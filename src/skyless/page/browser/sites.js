/** Which site of the broker is shown: the choice in the header, and what the empty map says while no site is alive. */

import { on, state } from "./store.js";
import { byId, h, options, text } from "./dom.js";

/** The site that the page's address names; null: the server chooses. @returns {number|null} */
export function chosenSite() {
  const named = new URL(location.href).searchParams.get("site");
  return named && /^\d{1,5}$/.test(named) ? Number(named) : null;
}

/** Offer the sites that are alive in place of the site's name, and keep the waiting words true. */
export function start() {
  const list = options({ id: "sites", "aria-label": "Site", hidden: true }, [], choose);
  byId("site-name").after(list);
  on(["sites", "site", "mode"], () => {
    const offered = state.sites.filter(([id, , alive]) => alive || id === state.liveId);
    list.hidden = state.mode !== "live" || state.liveId === null || offered.length < 2;
    byId("site-name").hidden = !list.hidden;
    list.replaceChildren(
      ...offered.map(([id, name, alive]) =>
        h("option", { value: String(id), selected: id === state.liveId }, `${name} (site ${id})${alive ? "" : ", offline"}`),
      ),
    );
    text(byId("waiting"), waitingWords());
  });
}

function waitingWords() {
  const gone = state.sites.filter(([, , alive]) => !alive).map(([id, name]) => `Site ${id}, ${name}, was here; none of its programs is online.`);
  return [...gone, "Waiting for a site …"].join(" ");
}

/** Open the page of another site from the beginning, so that nothing of this one is left on it. */
function choose(value) {
  const address = new URL(location.href);
  address.searchParams.set("site", value);
  location.assign(address);
}
