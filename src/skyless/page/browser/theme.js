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
/** Colours of groups: each differs from the others, from grey and from the background. */
const GROUPS = {
  light:
    "#f208f2 #08082c #f20808 #0808f2 #089808 #620808 #8608bc #5086f2 #083e08 #bc7498 #2c0886 #aa1a62 " +
    "#aa861a #089898 #985008 #f22c98 #0850aa #aa62f2 #620862 #3e6208 #623ef2 #083e62 #865098 #bc08aa",
  dark:
    "#f2f208 #9808f2 #ce0808 #3e7408 #08ce08 #f250bc #98f2f2 #0874e0 #f28608 #f2aaf2 #866286 #aa74f2 " +
    "#989808 #aace74 #986208 #bc1a98 #2c8686 #08cef2 #ce6274 #08bc98 #f2bc98 #86f208 #e008f2 #6298f2",
};
/** A colour that somebody has chosen has at least this contrast to the map. */
const CONTRAST = 2;
/** With more tags than this all have one colour and one mark; `map/marks.js` has the marks. */
export const DISTINCT = 56;

/** Colours by their names in tokens.css, `tags`, a few distinct hues, and `groups`, the colours of groups. @type {any} */
export const palette = { tags: [], groups: [] };

/** Whether the page is dark. */
function isDark() {
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

/** A colour `#rrggbb` as the browser writes it. */
function rgb(hex) {
  return `rgb(${[1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)).join(", ")})`;
}

/** A colour `#rrggbb`, changed towards the colour of text as far as it needs to be seen on the map. */
export function visible(hex) {
  if (!/^#[0-9a-f]{6}$/i.test(hex)) return "";
  const wanted = partsOf(rgb(hex));
  const ground = luminance(partsOf(palette.bg));
  const text = partsOf(palette.text);
  for (let share = 0; share < 1; share += 0.1) {
    const mixed = wanted.map((part, n) => Math.round(part + share * (text[n] - part)));
    const [dark, light] = [luminance(mixed), ground].sort((a, b) => a - b);
    if ((light + 0.05) / (dark + 0.05) >= CONTRAST) return `rgb(${mixed.join(", ")})`;
  }
  return palette.text;
}

function partsOf(colour) {
  return colour.match(/[\d.]+/g).slice(0, 3).map(Number);
}

/** Relative luminance, as in WCAG. */
function luminance(parts) {
  const [red, green, blue] = parts.map((part) => (part <= 10 ? part / 3294 : ((part / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}
