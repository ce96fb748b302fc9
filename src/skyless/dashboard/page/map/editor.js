/** Drawing and changing zones; every change is stored at the server, which has the last word. */

import { changed, select, state } from "../store.js";
import { putZones } from "../api.js";
import { stored } from "../live.js";
import { toast } from "../dom.js";

const SNAP_M = 0.05;
const COLOURS = ["#3b8ed0", "#c2763a", "#3f9b6c", "#a05fc4", "#b3a02e", "#c65b78"];

/** @type {{drawing: boolean, points: number[][], cursor: number[]|null, moving: any}} */
export const editor = { drawing: false, points: [], cursor: null, moving: null };

function snap([x, y]) {
  return [x, y].map((value) => Number((Math.round(value / SNAP_M) * SNAP_M).toFixed(3)));
}

/** Begin a new zone; with `at`, the keyboard's cursor stands there. */
export function begin(at = null) {
  if (state.mode !== "live") return toast("Zones are drawn on the live site, not on a recording.");
  select(null);
  Object.assign(editor, { drawing: true, points: [], cursor: at ? snap(at) : null, moving: null });
  changed("editor");
}

/** Give the new zone up. */
export function cancel() {
  Object.assign(editor, { drawing: false, points: [], cursor: null });
  changed("editor");
}

/** Add a corner; the same one twice counts once. */
export function addPoint(at) {
  const point = snap(at);
  const last = editor.points.at(-1);
  if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > SNAP_M / 2) editor.points.push(point);
  changed("editor");
}

/** Take the last corner away. */
export function undoPoint() {
  editor.points.pop();
  changed("editor");
}

/** Where the next corner would be. */
export function setCursor(at) {
  editor.cursor = at && snap(at);
  changed("editor");
}

/** Close the polygon and store it. */
export async function finish() {
  if (editor.points.length < 3) return toast("A zone needs three corners or more.");
  const zone = {
    id: freshId(),
    name: freshName(),
    polygon_m: editor.points,
    colour: COLOURS.find((colour) => !state.zones.some((one) => one.colour === colour)) ?? COLOURS[0],
  };
  cancel();
  if (await store([...state.zones, zone], `${zone.name} is stored.`)) select("zone", zone.id);
}

/** Change one zone. */
export function change(id, values) {
  return store(state.zones.map((zone) => (zone.id === id ? { ...zone, ...values } : zone)));
}

/** Delete a zone; it can be taken back for a while. */
export async function remove(id) {
  const zone = state.zones.find((one) => one.id === id);
  if (!zone || !(await store(state.zones.filter((one) => one.id !== id)))) return;
  const bringBack = () => store([...state.zones, zone]);
  toast(`${zone.name} is deleted.`, "note", { name: "Undo", run: bringBack });
}

/** Show a corner at another place while it is dragged; stored when it is let go. */
export function moveCorner(id, index, at) {
  state.zones = state.zones.map((zone) => {
    if (zone.id !== id) return zone;
    return { ...zone, polygon_m: zone.polygon_m.map((corner, n) => (n === index ? snap(at) : corner)) };
  });
  changed("zones");
}

/** Store zones that are shown already. */
export function storeShown(before) {
  return store(state.zones, "", before);
}

async function store(zones, words = "", before = state.zones) {
  state.zones = zones;
  changed("zones");
  try {
    stored((await putZones(zones)) ?? zones);
    if (words) toast(words);
    return true;
  } catch (error) {
    state.zones = before;
    changed("zones");
    toast(`Not stored: ${error.message}`, "bad");
    return false;
  }
}

function freshId() {
  const random = crypto.getRandomValues(new Uint32Array(1))[0];
  return `zone-${random.toString(16).padStart(8, "0")}`;
}

function freshName() {
  const names = new Set(state.zones.map((zone) => zone.name));
  let number = state.zones.length + 1;
  while (names.has(`Zone ${number}`)) number++;
  return `Zone ${number}`;
}
