/** The dialog in which assets are edited: a table whose cells are fields; nothing is sent before it is saved. */

import { on, state } from "../store.js";
import { assets as fetchAssets, assetsFile, putAssets } from "../api.js";
import { live } from "../clock.js";
import { Rows, button, h, text, toast } from "../dom.js";
import { COLUMNS, readCsv } from "./csv.js";
import { Draft } from "./draft.js";
import { allGroups, receiveAssets } from "./model.js";

const HEADS = { tag: "Tag", name: "Name", group: "Group", icon: "Icon", colour: "Colour", owner: "Owner", notes: "Notes" };
/** The longest value of each column that the server takes. */
const LENGTHS = { tag: 64, name: 100, group: 64, icon: 8, colour: 7, owner: 100, notes: 1000 };
/** Lists of values that two of the fields offer. */
const LISTS = { tag: "asset-tags", group: "asset-groups" };
const MARKS = { new: "+ new", changed: "● changed", removed: "✕ removed", "": "" };
/** Of more rows than this those are shown that are searched; each has eight fields. */
const MOST = 150;

let open = null;
on(["assets"], () => open?.meanwhile([...state.assets.values()]));

/** A text field of one column, and for colours also a swatch; `apply` is called with a value that was typed. */
function makeField(key, apply) {
  const input = h("input", { type: "text", class: `asset-${key}`, autocomplete: "off", maxLength: LENGTHS[key] });
  if (LISTS[key]) input.setAttribute("list", LISTS[key]);
  const swatch = key === "colour" ? h("input", { type: "color" }) : null;
  for (const one of swatch ? [input, swatch] : [input]) one.addEventListener("change", () => apply(one.value.trim()));
  const show = (value, name, removed) => {
    if (document.activeElement !== input || input.value.trim() === value) input.value = value;
    input.disabled = removed;
    input.setAttribute("aria-label", `${HEADS[key]} of ${name}`);
    if (!swatch) return;
    swatch.disabled = removed;
    swatch.className = value ? "" : "unset";
    swatch.value = /^#[0-9a-f]{6}$/i.test(value) ? value : "#808080";
    swatch.setAttribute("aria-label", `Choose the colour of ${name}`);
  };
  return { element: swatch ? h("span", { class: "with-swatch" }, swatch, input) : input, input, show };
}

/** The table of a draft. `changed` is called after each change. @param {Draft} draft */
function makeTable(draft, changed) {
  let faults = [];
  const body = h("tbody", {});
  const heads = ["State", ...COLUMNS.map((key) => HEADS[key]), "Remove"].map((words) => h("th", { scope: "col" }, words));
  const element = h("table", { class: "assets" }, h("thead", {}, h("tr", {}, ...heads)), body);
  const makeRow = (number, row) => {
    const apply = (key) => (value) => {
      row.asset[key] = value;
      faults = faults.filter((one) => one.row !== row || one.field !== key);
      changed();
    };
    const fields = new Map(COLUMNS.map((key) => [key, makeField(key, apply(key))]));
    const cells = [...fields].map(([key, field]) => h("td", { "data-head": HEADS[key] }, field.element));
    const words = h("p", { class: "fault", id: `asset-fault-${number}`, hidden: true });
    cells[0].append(words);
    const mark = h("td", { class: "state" });
    const remove = button("", () => (draft.toggle(row), changed()), { class: "quiet" });
    const line = h("tr", {}, mark, ...cells, h("td", {}, remove));
    const update = () => {
      const name = row.asset.tag || "the new asset";
      const wrong = faults.filter((one) => one.row === row);
      line.className = draft.kind(row);
      text(mark, MARKS[draft.kind(row)]);
      text(remove, row.removed ? "Undo" : "Remove");
      remove.setAttribute("aria-label", `${row.removed ? "Do not remove" : "Remove"} ${name}`);
      const other = row.other && `Meanwhile ${row.other}; saving keeps what stands here.`;
      text(words, [...wrong.map((one) => one.words), other].filter(Boolean).join(" "));
      words.hidden = !words.textContent;
      for (const [key, { input, show }] of fields) {
        show(row.asset[key], name, row.removed);
        input.setAttribute("aria-invalid", String(wrong.some(({ field }) => field === key)));
        input.setAttribute("aria-describedby", words.id);
      }
    };
    return { element: line, update };
  };
  const rows = new Rows(body, makeRow);
  const show = (found) => {
    rows.show(found.map((row) => [row.number, row]));
    element.hidden = !draft.rows.length;
  };
  /** Show what is wrong, and move the focus there. */
  const blame = (found) => {
    faults = found;
    changed();
    body.querySelector('[aria-invalid="true"]')?.focus();
  };
  const isBlamed = (row) => faults.some((one) => one.row === row);
  const focus = (row) => rows.rows.get(row.number).element.querySelector(row.asset.tag ? ".asset-name" : ".asset-tag").focus();
  return { element, show, blame, isBlamed, focus };
}

/** Open the dialog; with a tag, at its row, which is made where it has none. @param {string|null} tag */
export function editAssets(tag = null) {
  const draft = new Draft([...state.assets.values()]);
  const said = h("p", { class: "said", role: "status" });
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const more = h("p", { class: "fine" });
  const summary = h("p", { class: "count", role: "status" });
  const search = h("input", { type: "search", placeholder: "Find", "aria-label": "Find in the table", oninput: () => show() });
  const group = h("input", { type: "text", placeholder: "Group", autocomplete: "off", maxLength: LENGTHS.group });
  group.setAttribute("list", LISTS.group);
  const tags = h("datalist", { id: LISTS.tag });
  const groups = h("datalist", { id: LISTS.group });
  const pick = h("input", { type: "file", accept: ".csv,text/csv", hidden: true, "aria-label": "File of assets" });
  let found = [];

  const show = () => {
    const wanted = search.value.trim().toLowerCase();
    const has = ({ asset }) => Object.values(asset).some((value) => value.toLowerCase().includes(wanted));
    found = draft.rows.filter((row) => table.isBlamed(row) || !row.asset.tag || has(row));
    if (found.length > MOST) found.sort((a, b) => Number(table.isBlamed(b)) - Number(table.isBlamed(a)));
    table.show(found.slice(0, MOST));
    const hidden = found.length > MOST ? `${found.length - MOST} more rows: find them by their words.` : "";
    text(more, draft.rows.length ? hidden : "No assets yet. Add one, or import a file.");
    const missing = withoutAsset(draft);
    const names = new Set([...allGroups().keys(), ...draft.rows.map(({ asset }) => asset.group)].filter(Boolean));
    for (const [list, values] of [[tags, missing.slice(0, 200)], [groups, [...names].sort()]]) {
      list.replaceChildren(...values.map((value) => h("option", { value })));
    }
    addAll.hidden = missing.length < 2;
    text(addAll, `Add the ${missing.length} tags without an asset`);
    group.hidden = setGroup.hidden = found.length < 2;
    group.setAttribute("aria-label", `Group of all ${found.length} rows found`);
    text(setGroup, `Set for ${found.length} rows`);
    const { counts, any } = draft.changes();
    text(summary, any ? `Not saved yet: ${counts.new} new, ${counts.changed} changed, ${counts.removed} removed.` : "No changes.");
    save.disabled = !any;
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
  /** Another page has saved: its changes come into the table. */
  const meanwhile = (assets) => {
    const changed = draft.rebase(assets);
    if (!changed.length) return false;
    const kept = draft.rows.filter(({ other }) => other).map(({ asset }) => asset.tag);
    const both = kept.length ? ` Both have changed ${kept.join(", ")}: the table has this page's words.` : "";
    const which = changed.length > 5 ? `${changed.length} assets` : changed.join(", ");
    text(said, `Another page has saved ${which} meanwhile; the table has it now.${both}`);
    show();
    return true;
  };
  const store = async () => {
    fail("");
    const faults = draft.faults();
    table.blame(faults);
    if (faults.length) return;
    save.disabled = true;
    try {
      if (meanwhile(await fetchAssets())) return fail("Not saved yet: look at what another page has changed, and save again.");
      await putAssets(draft.assets(), state.site?.name ?? "");
      open = null;
      receiveAssets(draft.assets());
      dialog.close();
      toast("Assets saved.");
    } catch ({ message }) {
      // The server names the asset and the field: asset 'tag7': colour is 'red'; it should be …
      const row = draft.rows.find(({ asset }) => message.startsWith(`asset '${asset.tag}': `));
      const field = COLUMNS.find((key) => message.includes(`': ${key} is `)) ?? "tag";
      if (!row) fail(`Not saved: ${message}`);
      table.blame(row ? [{ row, field, words: `Not saved: ${message}` }] : []);
    }
  };

  const table = makeTable(draft, show);
  const addAll = button("", () => (withoutAsset(draft).reverse().forEach((name) => draft.add({ tag: name })), show()));
  const setGroup = button("", () => (draft.setGroup(found, group.value.trim()), show()));
  const file = h("a", { class: "button", href: assetsFile(), download: "assets.csv" }, "Export CSV");
  const save = button("Save", store, { class: "primary" });
  const tools = [button("Add", () => add({})), addAll, button("Import CSV …", () => pick.click()), file, search, group, setGroup];
  const dialog = h(
    "dialog",
    { id: "assets-dialog", "aria-labelledby": "assets-title" },
    h("h2", { id: "assets-title" }, "Assets: what the tags are attached to"),
    h("div", { class: "above" }, ...tools, pick, tags, groups),
    said,
    fault,
    h("div", { class: "assets-box", tabindex: "0", role: "region", "aria-label": "Assets" }, table.element, more),
    h("div", { class: "foot" }, summary, save, button("Close", () => dialog.close())),
  );
  dialog.addEventListener("cancel", (event) => {
    if (!draft.changes().any || event.target !== dialog) return;
    event.preventDefault(); // Escape must not lose what was typed
    fail("There are changes that are not saved: save them, or close without saving.");
  });
  dialog.addEventListener("close", () => {
    open = null;
    dialog.remove();
  });
  document.body.append(dialog);
  dialog.showModal();
  open = { meanwhile };
  if (tag !== null && !state.assets.has(tag)) return add({ tag });
  search.value = tag ?? "";
  show();
}

/** Tags of the live site that have no asset yet. */
function withoutAsset(draft) {
  const known = new Set(draft.rows.map(({ asset }) => asset.tag));
  return live.sorted.map(({ name }) => name).filter((name) => !known.has(name));
}
