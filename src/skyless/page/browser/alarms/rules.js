/** The rules that raise alarms: those of the site file, which only it changes, and those of the page, with a form. */

import { changed, state } from "../store.js";
import { alarmRules, putAlarmRules } from "../api.js";
import { allGroups, shownName } from "../assets/model.js";
import { live } from "../clock.js";
import { Rows, button, h, options, text, toast } from "../dom.js";

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
    const form = place.firstElementChild;
    form.querySelector("input, select").focus();
    form.scrollIntoView({ block: "nearest" });
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
  const change = button("Edit", () => edit(rule), { class: "quiet", "aria-label": `Edit ${name}` });
  const del = button("Delete", () => remove(rule), { class: "quiet", "aria-label": `Delete ${name}` });
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
  const rules = apply(await alarmRules());
  if (!rules) return false;
  await putAlarmRules(rules, state.site?.name ?? "");
  state.rules = rules;
  changed("rules");
  return true;
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

function field(value, type = "text") {
  return h("input", { type, value: String(value ?? ""), autocomplete: "off", ...(type === "number" && { step: "any" }) });
}

function choice(value, pairs, choose = () => {}) {
  const list = options({}, pairs, choose);
  list.value = value;
  return list;
}

/** The form of a rule, or with null of a new one. `close` removes it. */
function ruleForm(rule, close) {
  const kinds = Object.entries(KINDS).map(([key, { words }]) => [key, words]);
  const kind = choice(rule?.kind ?? "inside", kinds, () => fill());
  const factor = () => KINDS[kind.value].factor ?? 1;
  const scaled = (value) => (value == null ? "" : Number((value * factor()).toFixed(6)));
  const name = field(rule?.name || rule?.id);
  const zone = choice(rule?.zone ?? "", [["", "Choose a zone"], ...state.zones.map((one) => [one.id, one.name])]);
  const tags = whoField("Tags and groups", "all tags", rule?.tags);
  const others = whoField("Not near to", "any other tag", rule?.others);
  const limit = field(scaled(rule?.limit), "number");
  const back = field(scaled(rule?.hysteresis ?? 0), "number");
  const after = field(rule?.after_s ?? 0, "number");
  const clear = field(rule?.clear_after_s ?? 1, "number");
  const hours = field(rule?.hours);
  const severity = choice(rule?.severity ?? "warning", ["info", "warning", "critical"].map((one) => [one, one]));
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const boxes = { zone: labelled("Zone", zone), tags: tags.element, others: others.element };
  const limits = h("div", { class: "fields" }, labelled("Limit", limit), labelled("Ends when back by", back));
  const fill = () => {
    const { fields, limit: words, unit, after: usual } = KINDS[kind.value];
    for (const [key, box] of Object.entries(boxes)) box.hidden = !fields.includes(key);
    limits.hidden = !fields.includes("limit");
    text(limits.querySelector("label"), `${words} (${unit})`);
    if (!rule) after.value = String(usual ?? 0);
  };
  const fail = (words, element = null) => {
    text(fault, words);
    fault.hidden = !words;
    for (const one of form.querySelectorAll("[aria-invalid]")) one.removeAttribute("aria-invalid");
    element?.setAttribute("aria-invalid", "true");
    element?.focus();
    return null;
  };
  /** The rule as it is typed; null where something is wrong, which is then said. */
  const read = () => {
    const { fields, limit: words } = KINDS[kind.value];
    if (!name.value.trim()) return fail("A name is missing: people read it in the alarm.", name);
    if (fields.includes("zone") && !zone.value) return fail("Choose a zone; zones are drawn in the tab Zones.", zone);
    const numbers = new Map([[after, "After"], [clear, "Ends after"]]);
    if (fields.includes("limit")) numbers.set(limit, words).set(back, "Ends when back by");
    for (const [one, what] of numbers) {
      if (one.value === "" || !(Number(one.value) >= 0)) return fail(`${what} is a number of at least 0.`, one);
    }
    for (const { input, take } of [tags, others]) {
      if (!take()) return fail(`No tag or group is called "${input.value}"; choose one of the list.`, input);
    }
    const known = { zone: zone.value, tags: tags.values(), others: others.values(), limit: limit.value / factor() };
    const own = Object.fromEntries(fields.map((key) => [key, known[key]]));
    if ("limit" in own) own.hysteresis = back.value / factor();
    const times = { after_s: Number(after.value), clear_after_s: Number(clear.value), hours: hours.value.trim() };
    const what = { id: rule?.id ?? freshId(name.value), kind: kind.value, name: name.value.trim() };
    return { ...what, ...own, ...times, severity: severity.value };
  };
  let loaded = rule && JSON.stringify(rule);
  /** The page's rules with this one; null where another page has changed it since it was loaded, which is then said. */
  const insert = (made) => (now) => {
    const theirs = now.find(({ id }) => id === made.id);
    if (loaded && JSON.stringify(theirs) !== loaded) {
      loaded = theirs ? JSON.stringify(theirs) : null;
      const what = theirs ? `changed this rule: ${ruleWords(theirs)}` : "deleted this rule";
      return fail(`Meanwhile another page has ${what}. Save again to store what stands here.`);
    }
    return theirs ? now.map((one) => (one.id === made.id ? made : one)) : [...now, made];
  };
  const save = async (event) => {
    event.preventDefault();
    fail("");
    const made = read();
    try {
      if (!made || !(await store(insert(made)))) return;
      close();
      toast(`${made.name} saved.`);
    } catch ({ message }) {
      fail(`Not saved: ${message}`, message.includes("hours") ? hours : message.includes("limit") ? limit : null);
    }
  };
  const form = h(
    "form",
    { class: "rule-form", noValidate: true, "aria-label": rule ? `Rule ${name.value}` : "New rule", onsubmit: save },
    labelled("Raised when", kind),
    labelled("Name", name),
    ...Object.values(boxes),
    limits,
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
  const input = field();
  const element = labelled(label, input);
  const list = h("datalist", { id: `${input.id}-list` }, ...all.map((value) => h("option", { value }, whoWords(value))));
  input.setAttribute("list", list.id);
  const chips = h("span", { class: "chips" });
  const show = () => {
    const chip = (who) => {
      const made = button(`${whoWords(who)} ✕`, () => (values.delete(who), show(), input.focus()));
      made.setAttribute("aria-label", `Remove ${whoWords(who)}`);
      return made;
    };
    chips.replaceChildren(...(values.size ? [...values].map(chip) : [h("span", { class: "fine" }, everybody)]));
  };
  /** Take over what is typed, a name in use at the site; false where nothing is called so. */
  const take = () => {
    const typed = input.value.trim();
    const who = all.find((one) => one === typed) ?? all.find((one) => whoWords(one) === typed) ?? (state.part && typed);
    if (who) values.add(who);
    if (typed && !who) return false;
    input.value = "";
    show();
    return true;
  };
  input.addEventListener("change", take);
  input.addEventListener("keydown", (event) => event.key === "Enter" && input.value && (event.preventDefault(), take()));
  show();
  element.append(chips, list);
  return { element, input, take, values: () => [...values] };
}
