/** The map: three canvases, each drawn only when something in it has changed. */

import { changed, on, state } from "../store.js";
import { byId } from "../dom.js";
import { surveyShown } from "../survey/model.js";
import { drawAlarms } from "./alarms.js";
import { drawAnchors } from "./anchors.js";
import { drawFindings } from "./findings.js";
import { drawFloor, drawGrid, drawOverlay, drawScale, drawWalls, floorCorners, loadFloor } from "./floor.js";
import { groundHeight } from "./floors.js";
import { centre } from "./follow.js";
import { listen } from "./input.js";
import { drawHeat, drawMoment, drawWay } from "./past.js";
import { drawMany, manyShown, start as startMany } from "./many.js";
import { drawRoom, fillRoom, nameRoom } from "./room.js";
import { drawGround, spaceCorners } from "./space.js";
import { drawSurvey, surveyCorners, surveyOutOfSight } from "./survey.js";
import { RICH, drawTags, visibleTags } from "./tags.js";
import { drawTrails, due } from "./trails.js";
import { fit, prepare, seenBox, setSpatial, view } from "./view.js";
import { drawDraft, drawZones, flash, nameZones } from "./zones.js";

/** Frames drawn so far, for tests and measurements. */
export const drawnFrames = { still: 0, moving: 0 };

let stillDirty = true;
let movingDirty = true;
let scheduled = false;
let trailsDrawn = 0;
let later = 0;
let flashedMs = 0;
let pastDrawn = false;

/** Draw in the next frame: everything, or only what moves. */
export function redraw(still = true) {
  stillDirty ||= still;
  movingDirty = true;
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(frame);
}

function frame() {
  scheduled = false;
  const now = visibleTags();
  if (centre(now.seen)) stillDirty = true;
  const still = stillDirty;
  if (stillDirty) {
    stillDirty = false;
    drawnFrames.still++;
    if (drawStill()) setTimeout(redraw, 1600);
  }
  if (movingDirty) {
    movingDirty = false;
    drawnFrames.moving++;
    if (still || due(performance.now() - trailsDrawn, now.seen.length)) {
      trailsDrawn = performance.now();
      const context = prepare(byId("trails"));
      if (state.options.trails) drawTrails(context, richOf(now.seen), now.shown, state.options.trails);
    }
    const context = prepare(byId("moving"));
    drawMany(context);
    drawTags(context, now);
    drawAlarms(context, false);
    drawDraft(context);
    if (state.past || pastDrawn) drawMoment(prepare(byId("moment")));
    pastDrawn = state.past !== null;
    clearTimeout(later);
    if (now.moving) redraw(false);
    else if (now.ageing) later = setTimeout(redraw, 250, false);
  }
}

function richOf(seen) {
  return seen.length <= RICH && !manyShown() ? seen : seen.filter(({ selected }) => selected);
}

function drawStill() {
  const context = prepare(byId("still"));
  const ground_m = groundHeight();
  drawFloor(context);
  fillRoom(context, floorCorners(), ground_m);
  drawOverlay(context);
  drawHeat(context);
  if (view.spatial) drawGround(context, floorCorners());
  else drawGrid(context);
  const flashes = drawZones(context);
  drawWalls(context, ground_m);
  drawRoom(context, floorCorners(), ground_m);
  drawAnchors(context);
  nameZones(context);
  nameRoom(context, floorCorners());
  drawSurvey(context);
  drawFindings(context);
  drawAlarms(context, true);
  drawWay(context);
  drawScale(context);
  const surveyed = surveyShown() && state.survey.anchors.length > 0;
  byId("waiting").hidden = state.mode === "replay" || state.site !== null || surveyed;
  return flashes;
}

/** Show the whole site. */
export function fitAll() {
  const corners = [...floorCorners(), ...surveyCorners()];
  const further = view.spatial ? [...corners, ...spaceCorners(floorCorners())] : corners;
  fit(state.site, state.zones, further, state.options.overlay !== "none", state.mode === "replay" || state.past !== null);
  redraw();
}

/** Show the site in 3-D, or from above; the survey's picture is seen from above only. */
export function showSpatial(spatial) {
  setSpatial(spatial && !surveyShown());
  byId("spatial").setAttribute("aria-pressed", String(view.spatial));
  byId("draw").disabled = view.spatial || state.mode === "replay";
  changed("tags"); // very many are not drawn in 3-D
  fitAll();
}

/** Start drawing. */
export function start() {
  const box = byId("map");
  state.seenBox = seenBox;
  startMany();
  new ResizeObserver(() => {
    view.width = box.clientWidth;
    view.height = box.clientHeight;
    view.ratio = Math.min(devicePixelRatio, 2);
    if (view.touched) redraw();
    else fitAll();
  }).observe(box);
  listen(byId("canvas"), redraw, fitAll, () => showSpatial(!view.spatial));
  let shown = null;
  on(["site", "mode"], () => {
    loadFloor(() => (view.touched ? redraw() : fitAll()));
    const key = JSON.stringify([state.mode, state.site?.name, state.site?.anchors, state.site?.outline_m]);
    if (key === shown || (state.mode === "live" && !state.site)) return; // no site yet: after a reconnect the same may come
    shown = key;
    fitAll();
  });
  let overlay = "none";
  on(["options"], () => {
    loadFloor(redraw);
    if (overlay !== state.options.overlay && !view.touched) fitAll();
    overlay = state.options.overlay;
  });
  on(["mode"], () => !view.touched && fitAll());
  let surveyed = "";
  on(["survey", "setup"], () => {
    if (view.spatial && surveyShown()) showSpatial(false);
    const box = surveyCorners().map(([x, y]) => [Math.round(x), Math.round(y)]);
    const key = JSON.stringify([state.setup.open, box]);
    if (key !== surveyed && (!view.touched || surveyOutOfSight())) fitAll();
    surveyed = key;
  });
  on(["events"], () => {
    const fresh = state.events.filter(({ cameMs }) => cameMs > flashedMs);
    if (state.mode === "live" && !state.past) for (const { zone } of fresh) flash(zone);
    flashedMs = performance.now();
  });
  const still = ["site", "zones", "events", "health", "overlay", "theme", "options", "selection", "mode", "connection"];
  on([...still, "survey", "watch", "setup", "plan", "placing", "alarms"], () => redraw(true));
  on(["tags", "editor", "player"], () => redraw(false));
}
