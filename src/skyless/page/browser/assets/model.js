/** What the tags are attached to: names, colours and searches of assets. */

import { changed, on, state } from "../store.js";
import { palette, visible } from "../theme.js";

/** Searched words and looks of tags, and groups; made again with the assets and the theme. */
let words = new Map();
let looks = new Map();
let groups = new Map();

/** Keep the site's assets. @param {any[]} assets */
export function receiveAssets(assets) {
  state.assets = new Map(assets.map((asset) => [asset.tag, asset]));
  words = new Map(assets.map(({ tag, name, group, owner }) => [tag, [tag, name, group, owner].join("\n").toLowerCase()]));
  placeGroups();
  if (state.filter.group && !groups.has(state.filter.group)) state.filter.group = "";
  changed("assets", "tags");
}

/**
 * Give each group a colour: the name chooses it, and of groups that choose the same one the later in the alphabet gets
 * the next that is free, so that no two share a colour before all are in use.
 */
function placeGroups() {
  const names = new Set([...state.assets.values()].map(({ group }) => group).filter(Boolean));
  const taken = new Set();
  const count = palette.groups.length;
  groups = new Map();
  for (const name of [...names].sort()) {
    let number = hash(name) % count;
    while (taken.has(number) && taken.size < count) number = (number + 1) % count;
    taken.add(number);
    groups.set(name, { number, colour: palette.groups[number] });
  }
  looks = new Map([...state.assets.values()].map((asset) => [asset.tag, lookOf(asset)]));
}

function lookOf(asset) {
  const group = groups.get(asset.group);
  const colour = visible(asset.colour) || group?.colour;
  return colour ? { colour, number: group?.number ?? 0 } : null;
}

/** A number that only the name decides. */
function hash(name) {
  return [...name].reduce((sum, letter) => (31 * sum + letter.codePointAt(0)) % 65_521, 0);
}

on(["theme"], () => {
  placeGroups();
  changed("tags", "assets");
});

/** Groups in the order of their names, each with its colour. @returns {Map<string, {number: number, colour: string}>} */
export function allGroups() {
  return groups;
}

/** Colour of a tag by its asset or its group, and the group's number; null where the assets say nothing. */
export function assetLook(tag) {
  return looks.get(tag) ?? null;
}

/** What people call a tag: its asset's name, or its own. */
export function shownName(tag) {
  return state.assets.get(tag)?.name || tag;
}

/** The name with the asset's icon before it. */
export function labelOf(tag) {
  const icon = state.assets.get(tag)?.icon;
  return icon ? `${icon} ${shownName(tag)}` : shownName(tag);
}

/** Whether a tag is in the chosen group and has the searched text in its name, its asset's name, group or owner. */
export function isFound(tag) {
  const { group } = state.filter;
  if (group && state.assets.get(tag)?.group !== group) return false;
  return !state.find || (words.get(tag) ?? tag.toLowerCase()).includes(state.find);
}

/** Tags with assets that the filter leaves, for a server that sends a part of the tags and knows their own names only. */
export function foundByAsset() {
  return [...state.assets.keys()].filter(isFound);
}
