/** Floors of the site: those of the site file, else from its anchors' `floor`, or heights that the user gives; and the chosen one. */

import { changed, saveSetting, savedSetting, state } from "../store.js";

const KEY = "skyless-floors";

/** Floors from the lowest up, with the height of each floor's ground; fewer than two are none. */
export function floors() {
  const given = givenHeights();
  if (state.site?.floors?.length > 1) return state.site.floors.map((floor) => ({ ...floor, name: floor.name || `floor ${floor.number}` }));
  if (given.length > 1) return given.map((low_m, index) => ({ name: `floor ${index} (from ${low_m} m)`, low_m }));
  const numbers = [...new Set((state.site?.anchors ?? []).map((anchor) => anchor.floor ?? 0))].sort((a, b) => a - b);
  if (numbers.length < 2) return [];
  const mean = (number) => {
    const heights = state.site.anchors.filter((anchor) => (anchor.floor ?? 0) === number).map(({ z_m }) => z_m);
    return heights.reduce((sum, z_m) => sum + z_m, 0) / heights.length;
  };
  // The ground of floor 0, or else of the lowest, is at height 0; the others are as far apart as their anchors.
  const ground = mean(numbers.includes(0) ? 0 : numbers[0]);
  return numbers.map((number) => ({ name: `floor ${number}`, low_m: mean(number) - ground, number }));
}

/** Heights that the user has given for this site, ascending, metres. */
export function givenHeights() {
  try {
    const stored = JSON.parse(savedSetting(key()) ?? "[]");
    return Array.isArray(stored) ? stored.filter(Number.isFinite) : [];
  } catch {
    return [];
  }
}

/** Keep the heights of the floors, text such as "0, 3.2"; throws an Error for text that is none. */
export function giveHeights(words) {
  const heights = words.split(/[,;\s]+/).filter(Boolean).map(Number);
  if (heights.some((value) => !Number.isFinite(value))) throw new Error(`${words} is no list of heights such as 0, 3.2`);
  saveSetting(key(), JSON.stringify([...new Set(heights)].sort((a, b) => a - b)));
  chooseFloor(null);
}

function key() {
  return `${KEY}-${state.site?.id ?? ""}-${state.site?.name ?? ""}`;
}

/** Show one floor, the others dimmed; null shows all alike. */
export function chooseFloor(index) {
  state.options.floor = index;
  changed("options");
}

/** The chosen floor, with its number and plan where the site file has them; undefined while all are shown. */
export function chosenFloor() {
  return state.options.floor === null ? undefined : floors()[state.options.floor];
}

/** Name of the floor at a height; empty at a site without floors. */
export function floorNameAt(z_m) {
  const list = floors();
  return list[Math.max(indexAt(list, z_m), 0)]?.name ?? "";
}

function indexAt(list, z_m) {
  return list.findLastIndex(({ low_m }) => (z_m || 0) >= low_m - 0.1);
}

/** Height of the chosen floor's ground; 0 while all are shown. */
export function groundHeight() {
  return chosenFloor()?.low_m ?? 0;
}

/** A test whether something at a height, or an anchor with its floor, belongs to another floor than the chosen one. */
export function otherFloor() {
  const chosen = state.options.floor;
  const list = chosen === null ? [] : floors();
  if (!list[chosen]) return () => false;
  return (z_m, number) => {
    if (number !== undefined && list[chosen].number !== undefined) return number !== list[chosen].number;
    return Math.max(indexAt(list, z_m), 0) !== chosen;
  };
}
