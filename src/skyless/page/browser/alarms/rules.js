/** The rules that raise alarms: those of the site file, which only it changes, and those of the page, with a form. */

import { changed, state } from "../store.js";
import { alarmRules, putAlarmRules } from "../api.js";
import { allGroups, shownName } from "../assets/model.js";
import { live } from "../clock.js";
import { Rows, h, options, text, toast } from "../dom.js";

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
  const add = h("button", { type: "button", id: "add-rule", onclick: () => edit(null) }, "Add a rule");
  const element = h("section", {}, h("div", { class: "above" }, h("h2", { class: "count" }, "Rules"), add), none, place, list);
  const edit = (rule) => {
    const form = ruleForm(rule, () => (place.replaceChildren(), add.focus()));
    place.replaceChildren(form);
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
  const change = h("button", { type: "button", class: "quiet", "aria-label": `Edit ${name}`, onclick: () => edit(rule) }, "Edit");
  const del = h("button", { type: "button", class: "quiet", "aria-label": `Delete ${name}`, onclick: () => remove(rule) }, "Delete");
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
  const answer = await putAlarmRules(rules, state.site?.name ?? "");
  state.rules = answer.rules ?? rules;
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

/** The form of a rule, or with null of a new one. */
function ruleForm(rule, close) {
  let loaded = rule && JSON.stringify(rule);
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const kind = options({}, Object.entries(KINDS).map(([key, { words }]) => [key, words]), () => fill());
  kind.value = rule?.kind ?? "inside";
  const input = (value, type = "text") => h("input", { type, value: String(value ?? ""), autocomplete: "off", ...(type === "number" && { step: "any" }) });
  const name = input(rule?.name || rule?.id);
  const zone = options({}, [["", "Choose a zone"], ...state.zones.map(({ id, name: words }) => [id, words])], () => {});
  zone.value = rule?.zone ?? "";
  const tags = whoField("Tags and groups", "all tags", rule?.tags);
  const others = whoField("Not near to", "any other tag", rule?.others);
  const factor = () => KINDS[kind.value].factor ?? 1;
  const scaled = (value) => (value === undefined || value === null ? "" : Number((value * factor()).toFixed(6)));
  const limit = input(scaled(rule?.limit), "number");
  const hysteresis = input(scaled(rule?.hysteresis ?? 0), "number");
  const after = input(rule?.after_s ?? "", "number");
  const clear = input(rule?.clear_after_s ?? 1, "number");
  const hours = input(rule?.hours);
  hours.placeholder = "always";
  const severity = options({}, ["info", "warning", "critical"].map((value) => [value, value]), () => {});
  severity.value = rule?.severity ?? "warning";
  const labelled = (words, element) => h("label", { class: "field" }, h("span", {}, words), element);
  const limitWords = h("span", {});
  const backWords = h("span", {});
  const boxes = { zone: labelled("Zone", zone), tags: tags.element, others: others.element, limit: h("label", { class: "field" }, limitWords, limit), hysteresis: h("label", { class: "field" }, backWords, hysteresis) }; // prettier-ignore
  const fill = () => {
    const { fields, limit: words, unit, after: usual } = KINDS[kind.value];
    for (const [key, box] of Object.entries(boxes)) box.hidden = !fields.includes(key === "hysteresis" ? "limit" : key);
    text(limitWords, `${words} (${unit})`);
    text(backWords, `Ends when back by (${unit})`);
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
    const numbers = [[after, "The time"], [clear, "The time until it ends"], ...(fields.includes("limit") ? [[limit, words], [hysteresis, "The way back"]] : [])]; // prettier-ignore
    for (const [one, what] of numbers) if (one.value === "" || !(Number(one.value) >= 0)) return fail(`${what} is a number of at least 0.`, one);
    for (const one of [tags, others]) if (!one.take()) return fail(`No tag or group is called "${one.input.value}"; choose one of the list.`, one.input);
    const known = { zone: zone.value, tags: tags.values(), others: others.values(), limit: Number(limit.value) / factor() };
    const own = Object.fromEntries(fields.map((key) => [key, known[key]]));
    if ("limit" in own) own.hysteresis = Number(hysteresis.value) / factor();
    const times = { after_s: Number(after.value), clear_after_s: Number(clear.value), hours: hours.value.trim() };
    return { id: rule?.id ?? freshId(name.value), kind: kind.value, name: name.value.trim(), ...own, ...times, severity: severity.value };
  };
  const save = async (event) => {
    event.preventDefault();
    fail("");
    const made = read();
    if (!made) return;
    try {
      const stored = await store((now) => {
        const theirs = now.find(({ id }) => id === made.id);
        if (loaded && JSON.stringify(theirs) !== loaded) {
          loaded = theirs ? JSON.stringify(theirs) : null;
          return fail(`Meanwhile another page has ${theirs ? `changed this rule: ${ruleWords(theirs)}` : "deleted this rule"}. Save again to store what stands here.`);
        }
        return theirs ? now.map((one) => (one.id === made.id ? made : one)) : [...now, made];
      });
      if (!stored) return;
      close();
      toast(`${made.name} saved.`);
    } catch (error) {
      fail(`Not saved: ${error.message}`, error.message.includes("hours") ? hours : error.message.includes("limit") ? limit : null);
    }
  };
  const buttons = h("div", { class: "above" }, h("button", { type: "submit", class: "primary" }, "Save"), h("button", { type: "button", onclick: close }, "Cancel"));
  const times = h("div", { class: "fields" }, labelled("After (s)", after), labelled("Ends after (s)", clear), labelled("Severity", severity));
  const form = h("form", { class: "rule-form", noValidate: true, "aria-label": rule ? `Rule ${rule.name || rule.id}` : "New rule", onsubmit: save },
    labelled("Raised when", kind), labelled("Name", name), boxes.zone, boxes.tags, boxes.others, h("div", { class: "fields" }, boxes.limit, boxes.hysteresis),
    times, labelled("Hours", hours), h("p", { class: "fine" }, HELP), fault, buttons); // prettier-ignore
  fill();
  return form;
}

/** An identifier from a name that no rule has yet. */
function freshId(name) {
  const taken = new Set([...state.rules, ...state.fileRules].map(({ id }) => id));
  const base = name.normalize("NFKD").toLowerCase().replaceAll(/[^a-z0-9]+/g, "-").replaceAll(/^-|-$/g, "").slice(0, 28) || "rule"; // prettier-ignore
  let id = base;
  for (let number = 2; taken.has(id); number++) id = `${base}-${number}`;
  return id;
}

let lists = 0;

/** Tags and groups that are chosen from those known, each with a button that removes it. */
function whoField(label, everybody, chosen = []) {
  let values = [...chosen];
  const known = new Map([
    ...[...allGroups().keys()].map((name) => [`group ${name}`, `group:${name}`]),
    ...[...new Set([...live.sorted.map(({ name }) => name), ...state.assets.keys()])].map((tag) => [tag, tag]),
  ]);
  const list = h("datalist", { id: `who-${++lists}` }, ...[...known].map(([value, tag]) => h("option", { value }, shownName(tag))));
  const input = h("input", { type: "text", placeholder: "Add one", autocomplete: "off" });
  input.setAttribute("list", list.id);
  const chips = h("span", { class: "chips" });
  const show = () => {
    const chip = (who) => {
      const words = whoWords(who);
      return h("button", { type: "button", "aria-label": `Remove ${words}`, onclick: () => ((values = values.filter((one) => one !== who)), show(), input.focus()) }, `${words} ✕`);
    };
    chips.replaceChildren(...(values.length ? values.map(chip) : [h("span", { class: "fine" }, everybody)]));
  };
  /** Take over what is typed; false where nobody is called so. */
  const take = () => {
    const typed = input.value.trim();
    const named = [...state.assets.values()].filter(({ name }) => name === typed);
    const who = known.get(typed) ?? (typed.startsWith("group:") ? known.get(`group ${typed.slice(6)}`) : null) ?? (named.length === 1 ? named[0].tag : state.part ? typed : null);
    if (!typed) return true;
    if (!who) return false;
    if (!values.includes(who)) values.push(who);
    input.value = "";
    show();
    return true;
  };
  input.addEventListener("change", take);
  input.addEventListener("keydown", (event) => event.key === "Enter" && input.value && (event.preventDefault(), take()));
  show();
  const element = h("div", { class: "field who" }, h("label", {}, label, " ", input), chips, list);
  return { element, input, take, values: () => values };
}
