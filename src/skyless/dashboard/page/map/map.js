/** The map: three canvases, each drawn only when something in it has changed. */

import { on, state } from "../store.js";
import { byId } from "../dom.js";
import { surveyShown } from "../survey/model.js";
import { drawAnchors } from "./anchors.js";
import { drawFindings } from "./findings.js";
import { drawFloor, drawGrid, drawOverlay, drawScale, drawWalls, floorCorners, loadFloor } from "./floor.js";
import { listen } from "./input.js";
import { drawSurvey, surveyCorners, surveyOutOfSight } from "./survey.js";
import { drawTags, visibleTags } from "./tags.js";
import { drawTrails, due } from "./trails.js";
import { fit, prepare, view } from "./view.js";
import { drawDraft, drawZones, flash } from "./zones.js";

/** Frames drawn so far, for tests and measurements. */
export const drawnFrames = { still: 0, moving: 0 };

let stillDirty = true;
let movingDirty = true;
let scheduled = false;
let trailsDrawn = 0;
let later = 0;
let lastEvent = null;

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
  const still = stillDirty;
  if (stillDirty) {
    stillDirty = false;
    drawnFrames.still++;
    if (drawStill()) setTimeout(redraw, 1600);
  }
  if (movingDirty) {
    movingDirty = false;
    drawnFrames.moving++;
    const now = visibleTags();
    if (still || due(performance.now() - trailsDrawn, now.seen.length)) {
      trailsDrawn = performance.now();
      const context = prepare(byId("trails"));
      if (state.options.trails) drawTrails(context, now.seen, now.shown, state.options.trails);
    }
    const context = prepare(byId("moving"));
    drawTags(context, now);
    drawDraft(context);
    clearTimeout(later);
    if (now.moving) redraw(false);
    else if (now.ageing) later = setTimeout(redraw, 250, false);
  }
}

function drawStill() {
  const context = prepare(byId("still"));
  drawFloor(context);
  drawOverlay(context);
  drawGrid(context);
  const flashes = drawZones(context);
  drawWalls(context);
  drawAnchors(context);
  drawSurvey(context);
  drawFindings(context);
  drawScale(context);
  byId("waiting").hidden = state.site !== null || (surveyShown() && state.survey.anchors.length > 0);
  return flashes;
}

/** Show the whole site. */
export function fitAll() {
  fit(state.site, state.zones, [...floorCorners(), ...surveyCorners()]);
  redraw();
}

/** Start drawing. */
export function start() {
  const box = byId("map");
  new ResizeObserver(() => {
    view.width = box.clientWidth;
    view.height = box.clientHeight;
    view.ratio = Math.min(devicePixelRatio, 2);
    if (view.touched) redraw();
    else fitAll();
  }).observe(box);
  listen(byId("canvas"), redraw, fitAll);
  let shown = null;
  on(["site", "mode"], () => {
    loadFloor(() => (view.touched ? redraw() : fitAll()));
    const key = JSON.stringify([state.mode, state.site?.name, state.site?.anchors]);
    if (key !== shown) fitAll();
    shown = key;
  });
  let surveyed = "";
  on(["survey", "setup"], () => {
    const box = surveyCorners().map(([x, y]) => [Math.round(x), Math.round(y)]);
    const key = JSON.stringify([state.setup.open, box]);
    if (key !== surveyed && (!view.touched || surveyOutOfSight())) fitAll();
    surveyed = key;
  });
  on(["events"], () => {
    const newest = state.events[0];
    if (newest && newest !== lastEvent && lastEvent !== null) flash(newest.zone);
    lastEvent = newest ?? 0;
  });
  const still = ["site", "zones", "events", "health", "overlay", "theme", "options", "selection", "mode"];
  on([...still, "survey", "watch", "setup", "plan"], () => redraw(true));
  on(["tags", "editor", "player"], () => redraw(false));
}
