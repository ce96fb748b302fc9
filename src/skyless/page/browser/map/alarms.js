/** Marks of active alarms on the map, at the tag, anchor or zone that each is about. */

import { state } from "../store.js";
import { SEVERITIES, isActive, subjectOf } from "../alarms/model.js";
import { palette } from "../theme.js";
import { drawnAnchors } from "./anchors.js";
import { groundHeight } from "./floors.js";
import { drawn } from "./tags.js";
import { toX, toY } from "./view.js";
import { isOnFloor, middle } from "./zones.js";

const RADIUS = 12;

/** Mark the anchors and zones, or the tags. */
export function drawAlarms(context, still) {
  if (state.mode !== "live") return;
  const marked = new Map();
  for (const alarm of state.alarms.filter(isActive)) {
    const { kind, ids } = subjectOf(alarm);
    if ((kind !== "tag") !== still) continue;
    for (const id of ids) if (!marked.has(`${kind} ${id}`)) marked.set(`${kind} ${id}`, { alarm, kind, id });
  }
  if (!marked.size) return;
  const tags = still ? null : new Map(drawn.map((one) => [one.name, one]));
  for (const { alarm, kind, id } of marked.values()) {
    const at = kind === "tag" ? (tags.get(id) ?? lastPlace(alarm)) : kind === "anchor" ? anchorAt(id) : zoneAt(id);
    if (at) mark(context, at, SEVERITIES[alarm.severity]);
  }
}

/** Where the alarm was raised, for a tag that is no longer on the map. */
function lastPlace({ position_m }) {
  return position_m ? { x: toX(position_m[0], position_m[1]), y: toY(...position_m) } : null;
}

function anchorAt(id) {
  return drawnAnchors.find((one) => one.id === id) ?? null;
}

function zoneAt(id) {
  const zone = state.zones.find((one) => one.id === id && isOnFloor(one));
  if (!zone) return null;
  const [x_m, y_m] = middle(zone.polygon_m);
  return { x: toX(x_m, y_m), y: toY(x_m, y_m, groundHeight()) - 20 };
}

/** A ring, and a small shield with the severity's mark at its upper left: names stand at the right. */
function mark(context, { x, y }, { colour, mark: words }) {
  context.strokeStyle = palette[colour];
  context.lineWidth = 2.5;
  context.beginPath();
  context.arc(x, y, RADIUS, 0, 2 * Math.PI);
  context.stroke();
  context.beginPath();
  context.arc(x - RADIUS * 0.75, y - RADIUS * 0.75, 7, 0, 2 * Math.PI);
  context.fillStyle = palette[colour];
  context.fill();
  context.fillStyle = palette.surface;
  context.font = "700 9px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(words, x - RADIUS * 0.75, y - RADIUS * 0.75 + 0.5);
}
