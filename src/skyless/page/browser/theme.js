/** Dark or light: the system's choice until the user's; and the colours for canvases. */

import { changed, saveSetting, savedSetting } from "./store.js";
import { byId } from "./dom.js";

const KEY = "skyless-theme";
const system = matchMedia("(prefers-color-scheme: dark)");
const NAMES = [
  "bg",
  "surface",
  "line",
  "grid",
  "grid-strong",
  "text",
  "muted",
  "accent",
  "good",
  "warn",
  "bad",
  "wall",
];
const TAGS = 8;
/** With more tags than this all have one colour and one mark; `map/marks.js` has the marks. */
export const DISTINCT = 56;

/** Colours by their names in tokens.css, and `tags`, a few distinct hues. @type {any} */
export const palette = { tags: [] };

/** Whether the page is dark. */
export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : system.matches;
}

/** Read the colours, again when the system or the button changes them. */
export function start() {
  const chosen = savedSetting(KEY);
  if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
  system.addEventListener("change", refresh);
  byId("theme").addEventListener("click", () => {
    const next = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    saveSetting(KEY, next);
    refresh();
  });
  refresh();
}

function refresh() {
  const probe = byId("probe");
  const resolve = (name) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  for (const name of NAMES) palette[name] = resolve(name);
  palette.tags = Array.from({ length: TAGS }, (_, index) => resolve(`tag-${index}`));
  byId("theme").setAttribute("aria-label", isDark() ? "Switch to light colours" : "Switch to dark colours");
  changed("theme");
}

/** Colour of a tag by its position among all tags in the order of their names; one for all where there are many. */
export function tagColour(index, count) {
  return count <= DISTINCT ? palette.tags[index % TAGS] : palette.accent;
}

/** The same colour, more transparent. */
export function faint(colour, alpha) {
  const parts = colour.match(/[\d.]+/g);
  return parts ? `rgba(${parts[0]}, ${parts[1]}, ${parts[2]}, ${alpha})` : colour;
}
