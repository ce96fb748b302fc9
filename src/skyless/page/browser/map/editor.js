/** Drawing and changing zones; every change is stored at the server, which may refuse it. */

import { changed, select, state } from "../store.js";
import { putZones } from "../api.js";
import { showStored } from "../live.js";
import { toast } from "../dom.js";
import { chosenFloor } from "./floors.js";

const SNAP_M = 0.05;
const COLOURS = ["#3b8ed0", "#c2763a", "#3f9b6c", "#a05fc4", "#b3a02e", "#c65b78"];

/** @type {{drawing: boolean, points: number[][], cursor: number[]|null, moving: any}} */
export const editor = { drawing: false, points: [], cursor: null, moving: null };

function snap([x, y]) {
  return [x, y].map((value) => Number((Math.round(value / SNAP_M) * SNAP_M).toFixed(3)));
}

/** Begin a new zone; with `at`, the keyboard's cursor starts there. */
export function begin(at = null) {
  if (state.hub) return toast("Zones are drawn on the site's own page.");
  if (state.mode !== "live") return toast("Zones can be drawn on the live site only.");
  select(null);
  Object.assign(editor, { drawing: true, points: [], cursor: at ? snap(at) : null, moving: null });
  changed("editor");
}

/** Cancel the new zone. */
export function cancel() {
  Object.assign(editor, { drawing: false, points: [], cursor: null });
  changed("editor");
}

/** Add a corner, unless it is the same as the last. */
export function addPoint(at) {
  const point = snap(at);
  const last = editor.points.at(-1);
  if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > SNAP_M / 2) editor.points.push(point);
  changed("editor");
}

/** Remove the last corner. */
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
  if (editor.points.length < 3) return toast("A zone needs at least three corners.");
  const corners = editor.points;
  cancel();
  await addZone(corners);
}

/** Store a new zone, and select it. */
export async function addZone(polygon_m) {
  const zone = {
    id: freshId(),
    name: freshName(),
    polygon_m,
    floor: chosenFloor()?.number ?? null,
    colour: COLOURS.find((colour) => !state.zones.some((one) => one.colour === colour)) ?? COLOURS[0],
  };
  if (await store([...state.zones, zone], `${zone.name} stored.`)) select("zone", zone.id);
}

/** Change one zone. */
export function change(id, values) {
  return store(state.zones.map((zone) => (zone.id === id ? { ...zone, ...values } : zone)));
}

/** Delete a zone; the message offers to undo it. */
export async function remove(id) {
  const zone = state.zones.find((one) => one.id === id);
  if (!zone || !(await store(state.zones.filter((one) => one.id !== id)))) return;
  const bringBack = () => store([...state.zones, zone]);
  toast(`${zone.name} deleted.`, "note", { name: "Undo", run: bringBack });
}

/** Add zones of elsewhere, as of a file; one whose identifier is in use gets another. */
export function add(zones, words) {
  const taken = new Set(state.zones.map((zone) => zone.id));
  const added = zones.map((zone) => (taken.has(zone.id) ? { ...zone, id: freshId() } : zone));
  return store([...state.zones, ...added], words);
}

/** Move a corner while it is dragged; it is stored when it is released. */
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
  if (state.mode !== "live") {
    toast("Zones can be changed on the live site only."); // a replay shows those of its recording
    return false;
  }
  state.zones = zones;
  changed("zones");
  try {
    showStored((await putZones(zones, state.site?.name ?? "")) ?? zones);
    if (words) toast(words);
    return true;
  } catch (error) {
    if (state.mode === "live") state.zones = before;
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
