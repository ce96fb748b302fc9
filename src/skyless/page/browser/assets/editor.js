/** The dialog in which assets are edited: a table whose cells are fields; nothing is sent before it is saved. */

import { on, state } from "../store.js";
import { assets as fetchAssets, assetsFile, putAssets } from "../api.js";
import { live } from "../clock.js";
import { Rows, h, text, toast } from "../dom.js";
import { COLUMNS, readCsv } from "./csv.js";
import { Draft } from "./draft.js";
import { allGroups, receiveAssets } from "./model.js";

const HEADS = { tag: "Tag", name: "Name", group: "Group", icon: "Icon", colour: "Colour", owner: "Owner", notes: "Notes" };
const MARKS = { new: "+ new", changed: "● changed", removed: "✕ removed", "": "" };
/** Of more rows than this those are shown that are searched; each has eight fields. */
const MOST = 150;

let open = null;
on(["assets"], () => open?.meanwhile([...state.assets.values()]));

/** Open the dialog; with a tag, at its row, which is made where it has none. @param {string|null} tag */
export function editAssets(tag = null) {
  const draft = new Draft([...state.assets.values()]);
  let faults = [];
  const title = h("h2", { id: "assets-title" }, "Assets: what the tags are attached to");
  const search = h("input", { type: "search", placeholder: "Find", "aria-label": "Find in the table", oninput: () => show() });
  const said = h("p", { class: "said", role: "status" });
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const body = h("tbody", {});
  const heads = ["State", ...COLUMNS.map((key) => HEADS[key]), "Remove"].map((words) => h("th", { scope: "col" }, words));
  const table = h("table", { class: "assets" }, h("thead", {}, h("tr", {}, ...heads)), body);
  const tags = h("datalist", { id: "asset-tags" });
  const groups = h("datalist", { id: "asset-groups" });
  const more = h("p", { class: "fine" });

  const makeRow = (_number, row) => {
    const mark = h("td", { class: "state" });
    const inputs = Object.fromEntries(COLUMNS.map((key) => [key, fieldOf(key, row)]));
    const words = h("p", { class: "fault", id: `asset-fault-${row.number}`, hidden: true });
    const remove = h("button", { type: "button", class: "quiet", onclick: () => (draft.toggle(row), show()) });
    const cells = COLUMNS.map((key) => h("td", { "data-head": HEADS[key] }, inputs[key].element));
    cells[0].append(words);
    const update = () => {
      const kind = draft.kind(row);
      element.className = kind;
      text(mark, MARKS[kind]);
      for (const key of COLUMNS) inputs[key].show(row.asset[key], row.asset.tag, row.removed);
      text(remove, row.removed ? "Undo" : "Remove");
      remove.setAttribute("aria-label", `${row.removed ? "Do not remove" : "Remove"} ${row.asset.tag || "the new asset"}`);
      const wrong = faults.filter((one) => one.row === row);
      const notes = [...wrong.map((one) => one.words), row.other && `Meanwhile ${row.other}; saving keeps what stands here.`];
      text(words, notes.filter(Boolean).join(" "));
      words.hidden = !words.textContent;
      for (const key of COLUMNS) {
        inputs[key].input.setAttribute("aria-invalid", String(wrong.some(({ field }) => field === key)));
        inputs[key].input.setAttribute("aria-describedby", words.id);
      }
    };
    const element = h("tr", {}, mark, ...cells, h("td", {}, remove));
    return { element, update };
  };

  const fieldOf = (key, row) => {
    const list = { tag: "asset-tags", group: "asset-groups" }[key];
    const input = h("input", { type: "text", class: `asset-${key}`, autocomplete: "off", maxLength: key === "notes" ? 500 : 100 });
    if (list) input.setAttribute("list", list);
    const swatch = key === "colour" ? h("input", { type: "color" }) : null;
    const apply = (value) => {
      row.asset[key] = value.trim();
      faults = faults.filter((one) => one.row !== row || one.field !== key);
      show();
    };
    input.addEventListener("change", () => apply(input.value));
    swatch?.addEventListener("change", () => apply(swatch.value));
    const show_ = (value, name, removed) => {
      if (document.activeElement !== input || input.value.trim() === value) input.value = value;
      input.disabled = removed;
      input.setAttribute("aria-label", `${HEADS[key]} of ${name || "the new asset"}`);
      if (!swatch) return;
      swatch.disabled = removed;
      swatch.className = value ? "" : "unset";
      swatch.value = /^#[0-9a-f]{6}$/i.test(value) ? value : "#808080";
      swatch.setAttribute("aria-label", `Choose the colour of ${name || "the new asset"}`);
    };
    return { element: swatch ? h("span", { class: "with-swatch" }, swatch, input) : input, input, show: show_ };
  };

  const rows = new Rows(body, makeRow);
  const show = () => {
    const wanted = search.value.trim().toLowerCase();
    const isWanted = (row) => faults.some((one) => one.row === row) || !row.asset.tag || Object.values(row.asset).some((value) => value.toLowerCase().includes(wanted)); // prettier-ignore
    const found = draft.rows.filter(isWanted);
    rows.show(found.slice(0, MOST).map((row) => [row.number, row]));
    table.hidden = !draft.rows.length;
    const hidden = found.length - MOST;
    text(more, !draft.rows.length ? "No assets yet. Add one, or import a file." : hidden > 0 ? `${hidden} more rows: find them by their words.` : "");
    const missing = withoutAsset(draft);
    tags.replaceChildren(...missing.slice(0, 200).map((value) => h("option", { value })));
    const names = new Set([...allGroups().keys(), ...draft.rows.map(({ asset }) => asset.group)].filter(Boolean));
    groups.replaceChildren(...[...names].sort().map((value) => h("option", { value })));
    addAll.hidden = missing.length < 2;
    text(addAll, `Add the ${missing.length} tags without an asset`);
    const counts = draft.counts();
    const any = Object.values(counts).some(Boolean);
    text(summary, any ? `Not saved yet: ${counts.new} new, ${counts.changed} changed, ${counts.removed} removed.` : "No changes.");
    save.disabled = !any;
    setGroup.element.hidden = found.length < 2;
    setGroup.show(found);
  };

  const setGroup = groupSetter((found, group) => {
    for (const row of found) if (!row.removed) row.asset.group = group;
    show();
  });
  const add = (asset = {}) => {
    search.value = "";
    const row = draft.add(asset);
    show();
    const at = asset.tag ? ".asset-name" : ".asset-tag";
    rows.rows.get(row.number).element.querySelector(at).focus();
  };
  const addOne = h("button", { type: "button", onclick: () => add() }, "Add");
  const addAll = h("button", { type: "button", onclick: () => (withoutAsset(draft).reverse().forEach((name) => draft.add({ tag: name })), show()) });
  const pick = h("input", { type: "file", accept: ".csv,text/csv", hidden: true, "aria-label": "File of assets" });
  const load = h("button", { type: "button", onclick: () => pick.click() }, "Import CSV …");
  pick.addEventListener("change", async () => {
    const [file] = pick.files;
    pick.value = "";
    if (!file) return;
    fail("");
    try {
      const assets = readCsv(await file.text());
      draft.merge(assets);
      text(said, `${file.name} has ${assets.length} assets. The table shows what saving will change; assets that the file has not stay.`);
    } catch (error) {
      fail(`${file.name}: ${error.message}`);
    }
    show();
  });
  const file = h("a", { class: "button", href: assetsFile(), download: "assets.csv" }, "Export CSV");
  const summary = h("p", { class: "count", role: "status" });
  const save = h("button", { type: "button", class: "primary", onclick: () => store() }, "Save");
  const cancel = h("button", { type: "button", onclick: () => dialog.close() }, "Close");

  const fail = (words) => {
    text(fault, words);
    fault.hidden = !words;
  };
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
    faults = draft.faults();
    show();
    if (faults.length) return focusFault();
    save.disabled = true;
    try {
      if (meanwhile(await fetchAssets())) return fail("Not saved yet: look at what another page has changed, and save again.");
      const sent = draft.assets();
      const answer = await putAssets(sent, state.site?.name ?? "");
      open = null;
      receiveAssets(answer.assets ?? sent);
      dialog.close();
      toast("Assets saved.");
    } catch (error) {
      const row = draft.rows.find(({ asset }) => asset.tag && error.message.includes(`'${asset.tag}'`));
      const field = COLUMNS.find((key) => key !== "tag" && error.message.includes(key)) ?? "tag";
      if (row) faults = [{ row, field, words: `Not saved: ${error.message}` }];
      else fail(`Not saved: ${error.message}`);
      show();
      if (row) focusFault();
    }
  };
  const focusFault = () => {
    const input = body.querySelector('[aria-invalid="true"]');
    input?.focus();
    input?.scrollIntoView({ block: "nearest" });
  };

  const tools = h("div", { class: "above" }, addOne, addAll, load, file, search, setGroup.element);
  const foot = h("div", { class: "foot" }, summary, save, cancel);
  const box = h("div", { class: "assets-box", tabindex: "0", role: "region", "aria-label": "Assets" }, table, more);
  const dialog = h("dialog", { id: "assets-dialog", "aria-labelledby": "assets-title" }, title, tools, pick, said, fault, box, foot, tags, groups);
  const unsaved = () => Object.values(draft.counts()).some(Boolean);
  dialog.addEventListener("cancel", (event) => {
    if (!unsaved() || event.target !== dialog) return;
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
  show();
  const row = tag === null ? null : draft.rows.find(({ asset }) => asset.tag === tag);
  if (row) search.value = tag;
  if (tag !== null && !row) add({ tag });
  else if (row) show();
}

/** Tags of the live site that have no asset yet. */
function withoutAsset(draft) {
  const known = new Set(draft.rows.map(({ asset }) => asset.tag));
  return live.sorted.map(({ name }) => name).filter((name) => !known.has(name));
}

/** A field that sets the group of all rows that are found. */
function groupSetter(apply) {
  const input = h("input", { type: "text", placeholder: "Group", autocomplete: "off", maxLength: 100 });
  input.setAttribute("list", "asset-groups");
  let found = [];
  const button = h("button", { type: "button", onclick: () => apply(found, input.value.trim()) });
  const show = (rows) => {
    found = rows;
    input.setAttribute("aria-label", `Group of all ${rows.length} rows found`);
    text(button, `Set for ${rows.length} rows`);
  };
  return { element: h("span", { class: "set-group" }, input, button), show };
}
