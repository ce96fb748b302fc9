/** The dialog in which assets are edited: a table whose cells are fields; nothing is sent before it is saved. */

import { state } from "../store.js";
import { assetsFile, keep, kept } from "../api.js";
import { live } from "../clock.js";
import { Rows, button, h, offer, text, toast } from "../dom.js";
import { COLUMNS, readCsv } from "./csv.js";
import { Draft, kindOf } from "./draft.js";
import { allGroups, receiveAssets } from "./model.js";

const HEADS = { tag: "Tag", name: "Name", group: "Group", icon: "Icon", colour: "Colour", owner: "Owner", notes: "Notes" };
/** What the server takes of each column, by the browser's names for it. */
const LIMITS = {
  tag: { required: true, maxLength: 64, pattern: "[\\w.\\-]+", title: "Letters, digits, dots, dashes and underscores" },
  name: { maxLength: 100 },
  group: { maxLength: 64 },
  icon: { maxLength: 8 },
  colour: { pattern: "#[0-9a-fA-F]{6}", title: "# and six digits, as #c2410c" },
  owner: { maxLength: 100 },
  notes: { maxLength: 1000 },
};
/** Lists of values that two of the fields offer. */
const LISTS = { tag: "asset-tags", group: "asset-groups" };
const MARKS = { new: "+ new", changed: "● changed", removed: "✕ removed", "": "" };
/** Of more rows than this those are shown that are searched; each has eight fields. */
const MOST = 150;

/** A text field of one column, and for colours also a swatch; `apply` is called with a value that was typed. */
function makeField(key, apply) {
  const input = h("input", { type: "text", class: `asset-${key}`, autocomplete: "off", ...LIMITS[key] });
  if (LISTS[key]) input.setAttribute("list", LISTS[key]);
  const swatch = key === "colour" ? h("input", { type: "color" }) : null;
  for (const one of swatch ? [input, swatch] : [input]) one.addEventListener("change", () => apply(one.value.trim()));
  const show = (value, name, fixed) => {
    if (document.activeElement !== input || input.value.trim() === value) input.value = value;
    input.disabled = fixed;
    input.setAttribute("aria-label", `${HEADS[key]} of ${name}`);
    if (!swatch) return;
    swatch.disabled = fixed;
    swatch.className = value ? "" : "unset";
    swatch.value = input.value && input.validity.valid ? value : "#808080";
    swatch.setAttribute("aria-label", `Choose the colour of ${name}`);
  };
  return { element: swatch ? h("span", { class: "with-swatch" }, swatch, input) : input, show };
}

/** The table of a draft. `changed` is called after each change. @param {Draft} draft */
function makeTable(draft, changed) {
  const body = h("tbody", {});
  const heads = ["State", ...COLUMNS.map((key) => HEADS[key]), "Remove"].map((words) => h("th", { scope: "col" }, words));
  const element = h("table", { class: "assets" }, h("thead", {}, h("tr", {}, ...heads)), body);
  const makeRow = (_number, row) => {
    const fields = COLUMNS.map((key) => [key, makeField(key, (value) => ((row.asset[key] = value), changed()))]);
    const cells = fields.map(([key, field]) => h("td", { "data-head": HEADS[key] }, field.element));
    const mark = h("td", { class: "state" });
    const remove = button("", () => (draft.toggle(row), changed()), { class: "quiet" });
    const update = () => {
      const name = row.asset.tag || "the new asset";
      line.className = kindOf(row);
      text(mark, MARKS[kindOf(row)]);
      text(remove, row.removed ? "Undo" : "Remove");
      remove.setAttribute("aria-label", `${row.removed ? "Do not remove" : "Remove"} ${name}`);
      for (const [key, { show }] of fields) show(row.asset[key], name, row.removed || (key === "tag" && row.base !== null));
    };
    const line = h("tr", {}, mark, ...cells, h("td", {}, remove));
    return { element: line, update };
  };
  const rows = new Rows(body, makeRow);
  const show = (found) => {
    rows.show(found.map((row) => [row.number, row]));
    element.hidden = !draft.rows.length;
  };
  const focus = (row) => rows.rows.get(row.number).element.querySelector(row.asset.tag ? ".asset-name" : ".asset-tag").focus();
  return { element, show, focus };
}

/** Open the dialog; with a tag, at its row, which is made where it has none. @param {string|null} tag */
export function editAssets(tag = null) {
  const draft = new Draft([...state.assets.values()]);
  const said = h("p", { class: "said", role: "status" });
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const more = h("p", { class: "fine" });
  const summary = h("p", { class: "count", role: "status" });
  const search = h("input", { type: "search", placeholder: "Find", "aria-label": "Find in the table", oninput: () => show() });
  const tags = h("datalist", { id: LISTS.tag });
  const groups = h("datalist", { id: LISTS.group });
  const pick = h("input", { type: "file", accept: ".csv,text/csv", hidden: true, "aria-label": "File of assets" });

  const show = () => {
    const wanted = search.value.trim().toLowerCase();
    const has = ({ asset }) => !asset.tag || Object.values(asset).some((value) => value.toLowerCase().includes(wanted));
    const found = draft.rows.filter(has);
    table.show(found.slice(0, MOST));
    const hidden = found.length > MOST ? `${found.length - MOST} more rows: find them by their words.` : "";
    text(more, draft.rows.length ? hidden : "No assets yet. Add one, or import a file.");
    const missing = withoutAsset(draft);
    const names = new Set([...allGroups().keys(), ...draft.rows.map(({ asset }) => asset.group)].filter(Boolean));
    offer(tags, missing.slice(0, 200).map((name) => [name, ""]), "");
    offer(groups, [...names].sort().map((name) => [name, ""]), "");
    addAll.hidden = missing.length < 2;
    text(addAll, `Add the ${missing.length} tags without an asset`);
    const counts = draft.changes();
    save.disabled = counts[""] === draft.rows.length;
    const words = `Not saved yet: ${counts.new} new, ${counts.changed} changed, ${counts.removed} removed.`;
    text(summary, save.disabled ? "No changes." : words);
  };
  const fail = (words) => {
    text(fault, words);
    fault.hidden = !words;
  };
  const add = (asset) => {
    search.value = "";
    const row = draft.add(asset);
    show();
    table.focus(row);
  };
  pick.addEventListener("change", async () => {
    const [file] = pick.files;
    fail("");
    try {
      const assets = readCsv(await file.arrayBuffer());
      draft.merge(assets);
      text(said, `${file.name} has ${assets.length} assets. The table shows what saving will change; assets that the file has not stay.`);
    } catch (error) {
      fail(`${file.name}: ${error.message}`);
    }
    pick.value = "";
    show();
  });
  /** Take what the site has now into the table; false where no other page has changed it. */
  const meanwhile = (assets) => {
    const { changed, both } = draft.rebase(assets);
    if (!changed.length) return false;
    const mine = both.length ? ` Both have changed ${both.join(", ")}: saving keeps what stands here.` : "";
    const which = changed.length > 5 ? `${changed.length} assets` : changed.join(", ");
    text(said, `Another page has saved ${which} meanwhile; the table has it now.${mine}`);
    show();
    return true;
  };
  const store = async (event) => {
    event.preventDefault();
    fail("");
    save.disabled = true;
    try {
      if (meanwhile((await kept("assets")).assets)) return fail("Not saved yet: look at what another page has changed, and save again.");
      await keep("assets", { assets: draft.assets() }, state.site?.name ?? "");
      receiveAssets(draft.assets());
      dialog.close();
      toast("Assets saved.");
    } catch ({ message }) {
      fail(`Not saved: ${message}`);
      save.disabled = false;
    }
  };

  const table = makeTable(draft, show);
  const addAll = button("", () => (withoutAsset(draft).reverse().forEach((name) => draft.add({ tag: name })), show()));
  const file = h("a", { class: "button", href: assetsFile(), download: "assets.csv" }, "Export CSV");
  const save = button("Save", null, { type: "submit", class: "primary" });
  const tools = [button("Add", () => add({})), addAll, button("Import CSV …", () => pick.click()), file, search];
  const dialog = h(
    "dialog",
    { id: "assets-dialog", "aria-labelledby": "assets-title" },
    h("h2", { id: "assets-title" }, "Assets: what the tags are attached to"),
    h("div", { class: "above" }, ...tools, pick, tags, groups),
    said,
    fault,
    h(
      "form",
      { onsubmit: store },
      h("div", { class: "assets-box", tabindex: "0", role: "region", "aria-label": "Assets" }, table.element, more),
      h("div", { class: "foot" }, summary, save, button("Close", () => dialog.close())),
    ),
  );
  dialog.addEventListener("cancel", (event) => {
    if (save.disabled || event.target !== dialog) return;
    event.preventDefault(); // Escape must not lose what was typed
    fail("There are changes that are not saved: save them, or close without saving.");
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  if (tag !== null && !state.assets.has(tag)) return add({ tag });
  search.value = tag ?? "";
  show();
}

/** Tags of the live site that have no asset yet. */
function withoutAsset(draft) {
  const known = new Set(draft.rows.map(({ asset }) => asset.tag));
  return live.sorted.map(({ name }) => name).filter((name) => !known.has(name));
}
