/** The rules that raise alarms: those of the site file, which only it changes, and those of the page, with a form. */

import { changed, state } from "../store.js";
import { keep, kept } from "../api.js";
import { allGroups, shownName } from "../assets/model.js";
import { live } from "../clock.js";
import { Rows, button, h, offer, options, text, toast } from "../dom.js";

/** The kinds of rules: words, the fields of each, the words and unit of its limit, and the time that it usually waits. */
const KINDS = {
  inside: { words: "A tag is in a zone", fields: ["zone", "tags"] },
  outside: { words: "A tag is not in a zone", fields: ["zone", "tags"] },
  silent: { words: "A tag sends no positions", fields: ["tags"], after: 10 },
  near: { words: "Two tags are near each other", fields: ["tags", "others", "limit"], limit: "Distance", unit: "m" },
  crowded: { words: "Too many tags are in a zone", fields: ["zone", "tags", "limit"], limit: "Most tags allowed", unit: "tags" },
  "anchor-offline": { words: "An anchor is offline", fields: [], after: 10 },
  "anchor-moved": { words: "An anchor has moved", fields: [] },
  "protection-level": { words: "A protection level is too large", fields: ["tags", "limit"], limit: "Limit", unit: "m" },
  battery: { words: "A battery is low", fields: ["tags", "limit"], limit: "Least charge", unit: "%", factor: 100 },
};
const HELP = "Empty: always. Otherwise as mon-fri 06:00-18:00, sat 08:00-12:00, in the time of the server.";

/** The list of rules, and the form for one of them. */
export function rulesSection() {
  const list = h("ul", { class: "rules", "aria-label": "Rules" });
  const none = h("p", { class: "empty" }, "No rules yet: nothing raises an alarm.");
  const place = h("div", {});
  const add = button("Add a rule", () => edit(null), { id: "add-rule" });
  const element = h("section", {}, h("div", { class: "above" }, h("h2", { class: "count" }, "Rules"), add), none, place, list);
  const edit = (rule) => {
    place.replaceChildren(ruleForm(rule, () => (place.replaceChildren(), add.focus())));
    place.querySelector("select").focus();
    place.scrollIntoView({ block: "nearest" });
  };
  const rows = new Rows(list, (_key, { rule, own }) => makeRule(rule, own, edit));
  const show = () => {
    const all = [...state.rules.map((rule) => ({ rule, own: true })), ...state.fileRules.map((rule) => ({ rule, own: false }))];
    rows.show(all.map((one) => [JSON.stringify(one), one]));
    none.hidden = all.length > 0;
    add.disabled = state.mode !== "live" || !state.site;
  };
  return { element, show };
}

function makeRule(rule, own, edit) {
  const name = rule.name || rule.id;
  const words = h("div", {}, h("strong", {}, name), h("p", { class: "fine" }, ruleWords(rule)));
  const file = h("span", { class: "badge", title: "This rule is changed in the site file" }, "site file");
  const change = button("Edit", () => edit(rule), { class: "quiet changes", "aria-label": `Edit ${name}` });
  const del = button("Delete", () => remove(rule), { class: "quiet changes", "aria-label": `Delete ${name}` });
  return { element: h("li", { class: rule.severity ?? "warning" }, words, ...(own ? [change, del] : [file])) };
}

/** A rule in a few words. */
function ruleWords({ kind, zone, tags, others, limit, after_s, severity, hours }) {
  const { words, limit: label, unit, factor = 1 } = KINDS[kind];
  const names = (list) => list.map(whoWords).join(", ");
  return [
    words,
    zone && (state.zones.find(({ id }) => id === zone)?.name ?? `zone ${zone}, which does not exist`),
    tags?.length ? names(tags) : "",
    others?.length ? `near ${names(others)}` : "",
    (limit ?? null) !== null && label ? `${label.toLowerCase()} ${Number((factor * limit).toFixed(3))} ${unit}` : "",
    after_s ? `after ${after_s} s` : "",
    severity ?? "warning",
    hours,
  ].filter(Boolean).join(" · ");
}

function whoWords(who) {
  return who.startsWith("group:") ? `group ${who.slice(6)}` : shownName(who);
}

/** Store the page's rules after a change to the newest that the server has. */
async function store(apply) {
  const rules = apply((await kept("alarm_rules")).rules);
  await keep("alarm_rules", { rules }, state.site?.name ?? "");
  state.rules = rules;
  changed("rules");
}

async function remove(rule) {
  try {
    await store((now) => now.filter(({ id }) => id !== rule.id));
    const back = () => store((now) => [...now, rule]).catch((error) => toast(`Not stored: ${error.message}`, "bad"));
    toast(`${rule.name || rule.id} deleted.`, "note", { name: "Undo", run: back });
  } catch (error) {
    toast(`Not deleted: ${error.message}`, "bad");
  }
}

let serial = 0;

function labelled(words, element) {
  element.id = `rule-${++serial}`;
  return h("div", { class: "field" }, h("label", { htmlFor: element.id }, words), element);
}

function field(value, properties = {}) {
  return h("input", { type: "text", value: String(value ?? ""), autocomplete: "off", ...properties });
}

function choice(value, pairs, properties = {}, choose = () => {}) {
  const list = options(properties, pairs, choose);
  list.value = value;
  return list;
}

/** The form of a rule, or with null of a new one. `close` removes it. The browser says what is missing. */
function ruleForm(rule, close) {
  const kinds = Object.entries(KINDS).map(([key, { words }]) => [key, words]);
  const zones = state.zones.map(({ id, name }) => [id, name]);
  const kind = choice(rule?.kind ?? "inside", kinds, {}, () => fill());
  const factor = () => KINDS[kind.value].factor ?? 1;
  const scaled = (value) => (value == null ? "" : Number((value * factor()).toFixed(6)));
  const atLeast0 = { type: "number", step: "any", min: "0", required: true };
  const name = field(rule?.name || rule?.id, { required: true, pattern: ".*\\S.*", title: "People read it in the alarm" });
  const words = zones.length ? "Choose a zone" : "The tab Zones makes zones";
  const zone = choice(rule?.zone ?? "", [["", words], ...zones], { required: true });
  const tags = whoField("Tags and groups", "all tags", rule?.tags);
  const others = whoField("Not near to", "any other tag", rule?.others);
  const limit = field(scaled(rule?.limit), atLeast0);
  const back = field(scaled(rule?.hysteresis ?? 0), atLeast0);
  const after = field(rule?.after_s ?? 0, atLeast0);
  const clear = field(rule?.clear_after_s ?? 1, atLeast0);
  const hours = field(rule?.hours);
  const severity = choice(rule?.severity ?? "warning", ["info", "warning", "critical"].map((one) => [one, one]));
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const limits = h("div", { class: "fields" }, labelled("Limit", limit), labelled("Ends when back by", back));
  const boxes = { zone: labelled("Zone", zone), tags: tags.element, others: others.element, limit: limits };
  const fill = () => {
    const { fields, limit: what, unit, after: usual } = KINDS[kind.value];
    for (const [key, box] of Object.entries(boxes)) {
      box.hidden = !fields.includes(key);
      for (const one of box.querySelectorAll("input, select")) one.disabled = box.hidden; // need not be filled in
    }
    text(limits.querySelector("label"), `${what} (${unit})`);
    if (!rule) after.value = String(usual ?? 0);
  };
  /** The rule as it is typed. */
  const read = () => {
    const { fields } = KINDS[kind.value];
    const known = { zone: zone.value, tags: tags.values(), others: others.values(), limit: limit.value / factor() };
    const own = Object.fromEntries(fields.map((key) => [key, known[key]]));
    if ("limit" in own) own.hysteresis = back.value / factor();
    const times = { after_s: Number(after.value), clear_after_s: Number(clear.value), hours: hours.value.trim() };
    const what = { id: rule?.id ?? freshId(name.value), kind: kind.value, name: name.value.trim() };
    return { ...what, ...own, ...times, severity: severity.value };
  };
  let loaded = JSON.stringify(rule);
  const insert = (made) => (now) => {
    const theirs = JSON.stringify(now.find(({ id }) => id === made.id) ?? null);
    const isOurs = theirs === loaded;
    loaded = theirs;
    if (!isOurs) throw new Error("another page has changed or deleted this rule meanwhile. Save again to store what stands here.");
    return [...new Map([...now, made].map((one) => [one.id, one])).values()];
  };
  const save = async (event) => {
    event.preventDefault();
    const made = read();
    try {
      await store(insert(made));
      close();
      toast(`${made.name} saved.`);
    } catch ({ message }) {
      text(fault, `Not saved: ${message}`);
      fault.hidden = false;
    }
  };
  const form = h(
    "form",
    { class: "rule-form", "aria-label": rule ? `Rule ${name.value}` : "New rule", onsubmit: save },
    labelled("Raised when", kind),
    labelled("Name", name),
    ...Object.values(boxes),
    h("div", { class: "fields" }, labelled("After (s)", after), labelled("Ends after (s)", clear), labelled("Severity", severity)),
    labelled("Hours", hours),
    h("p", { class: "fine" }, HELP),
    fault,
    h("div", { class: "above" }, button("Save", null, { type: "submit", class: "primary" }), button("Cancel", close)),
  );
  fill();
  return form;
}

/** An identifier from a name that no rule has yet. */
function freshId(name) {
  const taken = new Set([...state.rules, ...state.fileRules].map(({ id }) => id));
  const plain = name.normalize("NFKD").toLowerCase().replaceAll(/[^a-z0-9]+/g, "-");
  const base = plain.replaceAll(/^-|-$/g, "").slice(0, 28) || "rule";
  let id = base;
  for (let number = 2; taken.has(id); number++) id = `${base}-${number}`;
  return id;
}

/** Tags and groups that are chosen from those known, each with a button that removes it. */
function whoField(label, everybody, chosen = []) {
  const values = new Set(chosen);
  const tags = new Set([...live.sorted.map(({ name }) => name), ...state.assets.keys()]);
  const all = [...[...allGroups().keys()].map((name) => `group:${name}`), ...tags];
  const list = options({}, [], (who) => (values.add(who), show()));
  const chips = h("span", { class: "chips" });
  const chip = (who) => {
    const remove = () => (values.delete(who), show(), list.focus());
    return button(`${whoWords(who)} ✕`, remove, { "aria-label": `Remove ${whoWords(who)}` });
  };
  const show = () => {
    chips.replaceChildren(...[...values].map(chip));
    const free = all.filter((who) => !values.has(who)).map((who) => [who, whoWords(who)]);
    offer(list, [["", values.size ? "Add …" : everybody], ...free], "");
  };
  show();
  const element = labelled(label, list);
  element.append(chips);
  return { element, values: () => [...values] };
}
