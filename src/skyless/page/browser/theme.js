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
/** Colours of groups: each differs from the others, from grey and from the background, and has one hue in both themes. */
const GROUPS = {
  light:
    "#036de2 #1d5e15 #440063 #907fc0 #e61796 #0c85a1 #045f82 #f64125 #a947fe #c66f0f #ba6a7d #84486a " +
    "#2b3ca5 #ae2492 #7c058d #c41e0e #8a0700 #6661a6 #6f0648 #c961c4 #8c8a22 #7727e9 #248945 #7f4e17",
  dark:
    "#6999dd #2e8124 #b100f9 #b295ff #fea8cf #2fc7ee #3781a6 #ca7b6c #ac64f3 #f9ba88 #fc779b #fe34b9 " +
    "#4d69fe #be66a7 #e43fff #f82510 #a45c50 #c0beff #d3118d #fa7ef4 #c5c343 #7e68bf #4cbd6c #f59416",
};
/** A colour that somebody has chosen differs from the map's by at least this in its lightness, of 255. */
const LIGHTER = 40;
/** With more tags than this all have one colour and one mark; `map/marks.js` has the marks. */
export const DISTINCT = 56;

/** Colours by their names in tokens.css, `tags`, a few distinct hues, and `groups`, the colours of groups. @type {any} */
export const palette = { tags: [], groups: [] };

let brush = null;

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
  palette.groups = GROUPS[isDark() ? "dark" : "light"].split(" ").map(rgb);
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

/** Any opaque colour of CSS as `#rrggbb`, as an input takes it. */
export function hexOf(colour) {
  brush ??= document.createElement("canvas").getContext("2d");
  brush.fillStyle = colour;
  return brush.fillStyle;
}

/** A colour `#rrggbb` as the browser writes it. */
function rgb(hex) {
  return `rgb(${[1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)).join(", ")})`;
}

/** A colour `#rrggbb` as the browser writes it; one that is almost as light as the map is moved towards the text's. */
export function visible(hex) {
  if (!/^#[0-9a-f]{6}$/i.test(hex)) return "";
  const [colour, ground, text] = [rgb(hex), palette.bg, palette.text].map((one) => one.match(/\d+/g).map(Number));
  const light = ([red, green, blue]) => 0.3 * red + 0.59 * green + 0.11 * blue;
  if (Math.abs(light(colour) - light(ground)) > LIGHTER) return rgb(hex);
  return `rgb(${colour.map((part, n) => Math.round((part + text[n]) / 2)).join(", ")})`;
}
