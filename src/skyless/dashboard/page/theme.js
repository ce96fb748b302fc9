/** Dark or light: as the system says, until somebody chooses; and the colours that canvases need. */

import { remember, remembered } from "./browser.js";
import { changed } from "./store.js";
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

/** Colours by their names in tokens.css, and `tags`, a few hues that can be told apart. @type {any} */
export const palette = { tags: [] };

/** Whether the page is dark now. */
export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : system.matches;
}

/** Read the colours, and follow the system and the button. */
export function start() {
  const chosen = remembered(KEY);
  if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
  system.addEventListener("change", refresh);
  byId("theme").addEventListener("click", () => {
    const next = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    remember(KEY, next);
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

/** A site with few tags gives each its hue; in a crowd hues say nothing, and all have the same. */
export function tagColour(index, count) {
  return count <= TAGS ? palette.tags[index] : palette.accent;
}

/** The same colour, fainter. */
export function faint(colour, alpha) {
  const parts = colour.match(/[\d.]+/g);
  return parts ? `rgba(${parts[0]}, ${parts[1]}, ${parts[2]}, ${alpha})` : colour;
}
