/** The sites at a hub: a row for each, those in trouble first, which leads to the site's page. */

import { Rows, byId, h, text } from "./dom.js";
import { DASH, dateTime, sentence } from "./format.js";
import { dropToken, fetchJson } from "./api.js";
import * as theme from "./theme.js";

const PERIOD_MS = 1000;
/** Words and marks by condition; the colour is not all that says it. */
const CONDITIONS = { good: "● Good", degraded: "▲ Degraded", bad: "✕ Bad", cut: "✕ Not heard", unknown: "○ Unknown" };

const rows = new Rows(byId("rows"), makeRow);
let sites = [];

dropToken();
theme.start();
byId("find").addEventListener("input", show);
poll();

async function poll() {
  let fault = "";
  try {
    const answer = await fetchJson("api/sites");
    sites = answer.sites;
    if (!answer.connected) fault = `The hub ${answer.hub} cannot be reached. Nothing shown here is current.`;
  } catch (error) {
    fault = `Connection lost: ${error.message} Nothing shown here is current.`;
  }
  if (fault) sites = sites.map(({ number, name }) => ({ number, name, condition: "unknown", reason: "" }));
  byId("banner").hidden = !fault;
  text(byId("banner"), fault);
  show();
  setTimeout(poll, PERIOD_MS);
}

function show() {
  const words = byId("find").value.trim().toLowerCase();
  const found = sites.filter(({ number, name }) => `${name} ${number}`.toLowerCase().includes(words));
  const good = sites.filter(({ condition }) => condition === "good").length;
  text(byId("site-name"), `${sites.length} ${sites.length === 1 ? "site" : "sites"}, ${good} good`);
  rows.show(found.map((site) => [site.number, site]));
}

function makeRow(number) {
  const name = h("a", { href: `?site=${number}` });
  const [condition, reason, tags, anchors, versions, heard] = ["state", "", "figure", "figure wide", "wide", "wide"].map((kind) =>
    h("td", { class: kind }),
  );
  const cells = [h("td", {}, name), h("td", { class: "figure" }, String(number)), condition, reason, tags, anchors, versions, heard];
  const element = h("tr", {}, ...cells);
  const update = (site) => {
    if (element.className !== site.condition) element.className = site.condition;
    text(name, site.name || `Site ${number}`);
    text(condition, CONDITIONS[site.condition]);
    text(reason, site.reason && sentence(site.reason));
    text(tags, String(site.tags_heard ?? DASH));
    text(anchors, String(site.anchors_online ?? DASH));
    const known = Object.entries(site.versions ?? {});
    text(versions, known.length === 1 ? known[0][0] : known.map(([version, count]) => `${version} (${count})`).join(", ") || DASH);
    text(heard, site.heard_unix_s ? dateTime(site.heard_unix_s) : DASH);
  };
  return { element, update };
}
