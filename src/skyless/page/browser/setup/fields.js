/** Fields of the set-up: lengths that are checked as they are typed, and lists of anchors. */

import { h, text } from "../dom.js";
import { anchorIds } from "../survey/model.js";
import { lengthFault, readLength } from "../survey/values.js";

/** Limits in metres: of coordinates as on the air, of heights, of distances. */
export const COORDINATE = [-1e6, 1e6];
export const HEIGHT = [-100, 1000];
export const DISTANCE = [0.05, 10_000];

let serial = 0;

/**
 * A field for a length in metres. What is wrong is said below it, with what would be right.
 * @param {{label: string, limits: number[], unseen?: boolean, optional?: boolean, apply?: (value: number|null) => void}} how
 *   `apply` is called with the length, or with null where an optional field was emptied
 */
export function lengthField({ label, limits, unseen = false, optional = true, apply = null }) {
  const id = `length-${++serial}`;
  const attributes = { type: "text", inputMode: "decimal", autocomplete: "off", id, "aria-describedby": `${id}-fault` };
  const input = h("input", { ...attributes, class: "length", size: 7 });
  const fault = h("p", { class: "fault", id: `${id}-fault`, role: "alert", hidden: true });
  const name = h("label", { class: unseen ? "unseen" : "", htmlFor: id }, label);
  const element = h("span", { class: "field" }, name, h("span", { class: "with-unit" }, input, " m"), fault);
  let shown = null;

  /** The length; null where the field is empty, undefined where it is wrong, which is then shown. */
  const read = () => {
    const empty = input.value.trim() === "";
    const words = empty ? (optional ? "" : `${label}: a number of metres is missing.`) : lengthFault(input.value, ...limits);
    text(fault, words);
    fault.hidden = !words;
    input.setAttribute("aria-invalid", String(words !== ""));
    return words ? undefined : empty ? null : readLength(input.value);
  };
  const change = () => {
    const value = read();
    if (value === undefined || value === shown) return;
    shown = value;
    apply?.(value);
  };
  input.addEventListener("change", change);
  input.addEventListener("keydown", (event) => event.key === "Enter" && apply && input.blur());

  /** Show a value, unless somebody is typing or has typed something that is wrong. */
  const show = (value) => {
    shown = value ?? null;
    if (document.activeElement === input || !fault.hidden) return;
    input.value = value === null || value === undefined ? "" : String(Number(value.toFixed(4)));
  };
  const clear = () => {
    input.value = "";
    fault.hidden = true;
    input.setAttribute("aria-invalid", "false");
  };
  return { element, input, read, show, clear };
}

/** A list to choose an anchor from; `choose` is called with its identifier, or null for the first entry. */
export function anchorList(label, nobody, choose = null) {
  const list = h("select", { "aria-label": label });
  list.addEventListener("change", () => choose?.(read()));
  const read = () => (list.value === "" ? null : Number(list.value));
  let shown = "";
  const show = (value) => {
    const ids = anchorIds();
    const key = ids.join();
    if (key !== shown) {
      const before = list.value;
      list.replaceChildren(h("option", { value: "" }, nobody), ...ids.map((id) => h("option", { value: String(id) }, String(id))));
      list.value = before;
    }
    shown = key;
    if (value !== undefined && document.activeElement !== list) list.value = value === null ? "" : String(value);
  };
  const element = h("label", { class: "field" }, h("span", {}, label), list);
  return { element, list, read, show };
}

/** A list of things that were given, each with a button that removes it. */
export function givenItem(words, label, remove) {
  const button = h("button", { type: "button", class: "quiet", "aria-label": label, onclick: remove }, "Remove");
  return h("li", {}, h("span", {}, words), button);
}
