/** The layers below the tags: floor plan, overlay, grid, walls, scale bar. */

import { floorPlanOf } from "../api.js";
import { faint, palette } from "../theme.js";
import { state } from "../store.js";
import { metres } from "../format.js";
import { surveyShown } from "../survey/model.js";
import { height_m, moving, plan } from "../survey/plan.js";
import { chosenFloor, groundHeight } from "./floors.js";
import { drawInMetres, isNarrow, px, py, roundLength, toSite, toX, toY, view } from "./view.js";

/** @type {{image: HTMLImageElement, x_m: number, y_m: number, width_m: number, height_m: number}|null} */
export let floor = null;
let floorOf = null;
/** An image that could not be loaded is asked for again after this time, or earlier with the next site or mode. */
const RETRY_MS = 60e3;
let retryTimer = 0;
/** Over a floor plan an overlay is transparent, as in the planner's pictures; elsewhere its colours are those of its scale. */
const OVER_PLAN = 0.75;

/**
 * Load the plan of the chosen floor if it has one, else of the live site or of the recording, and call `done` when it is
 * loaded.
 */
export function loadFloor(done) {
  const chosen = state.mode === "replay" ? undefined : chosenFloor();
  const own = chosen?.image ? chosen : null;
  const stated = own ?? state.site?.floor_plan ?? null;
  const digest = own ? state.floorDigests[own.number] : state.floorDigest;
  const address = floorPlanOf(state.player?.name ?? null, digest, own ? own.number : null);
  const key = JSON.stringify([stated, stated && address]);
  if (key === floorOf) return;
  clearTimeout(retryTimer);
  floorOf = key;
  floor = null;
  if (!stated) return;
  const image = new Image();
  image.onload = () => {
    if (key !== floorOf) return;
    const { x_m, y_m, width_m } = stated;
    floor = { image, x_m, y_m, width_m, height_m: height_m({ image, width_m }) };
    done();
  };
  image.onerror = () => {
    if (key !== floorOf) return;
    floorOf = null;
    retryTimer = setTimeout(loadFloor, RETRY_MS, done);
  };
  image.src = address;
}

/** Draw the floor plan's image. */
export function drawFloor(context) {
  const shown = laid();
  if (!shown) return;
  context.globalAlpha = surveyShown() ? 0.5 : 0.75; // thin lines of the survey's picture lie over it
  drawPicture(context, shown.image, shown.x_m, shown.y_m, shown.width_m, shown.height_m);
  context.globalAlpha = 1;
  if (!moving) return;
  const [left, top] = [px(shown.x_m), py(shown.y_m + shown.height_m)];
  const [width, height] = [shown.width_m * view.scale, shown.height_m * view.scale];
  context.setLineDash([6, 4]);
  context.strokeStyle = palette.accent;
  context.lineWidth = 2;
  context.strokeRect(left, top, width, height);
  context.setLineDash([]);
}

/** Lay a picture on the ground of the chosen floor, its lower left corner at a position. */
export function drawPicture(context, picture, x_m, y_m, width_m, height_m) {
  drawInMetres(context, groundHeight());
  context.scale(1, -1); // pictures count downwards
  context.drawImage(picture, x_m, -(y_m + height_m), width_m, height_m);
  context.restore();
}

/** The plan that the set-up lays under the picture, or else the site's. */
function laid() {
  return plan ? { ...plan, height_m: height_m() } : floor;
}

/** Corners of the floor plan in metres, where there is one. */
export function floorCorners() {
  const shown = laid();
  if (!shown) return [];
  return [
    [shown.x_m, shown.y_m],
    [shown.x_m + shown.width_m, shown.y_m + shown.height_m],
  ];
}

/** Draw the overlay's picture. */
export function drawOverlay(context) {
  const { data, picture } = state.overlay;
  if (!data || !picture) return;
  const half = data.step_m / 2;
  const [x1, x2] = [data.x_m[0] - half, data.x_m[1] + half];
  const [y1, y2] = [data.y_m[0] - half, data.y_m[1] + half];
  context.globalAlpha = laid() ? OVER_PLAN : 1;
  context.imageSmoothingEnabled = true;
  drawPicture(context, picture, x1, y1, x2 - x1, y2 - y1);
  context.globalAlpha = 1;
}

/** Draw the grid with its coordinates along the left and the lower edge. */
export function drawGrid(context) {
  const step = roundLength(64);
  const [left, top] = toSite(0, 0);
  const [right, bottom] = toSite(view.width, view.height);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  context.lineWidth = 1;
  context.font = "10px system-ui, sans-serif";
  const lines = (from, to, draw) => {
    for (let n = Math.ceil(from / step); n * step <= to; n++) draw(n * step || 0, n % 5 === 0);
  };
  lines(left, right, (x_m, strong) => {
    const x = Math.round(px(x_m)) + 0.5;
    line(context, x, 0, x, view.height, strong ? palette["grid-strong"] : palette.grid);
  });
  lines(bottom, top, (y_m, strong) => {
    const y = Math.round(py(y_m)) + 0.5;
    line(context, 0, y, view.width, y, strong ? palette["grid-strong"] : palette.grid);
  });
  context.fillStyle = palette.muted;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  lines(left, right, (x_m) => {
    const x = px(x_m);
    if (x > 40 && x < view.width - 62) context.fillText(metres(x_m, digits), x, view.height - 4);
  });
  context.textAlign = "left";
  context.textBaseline = "middle";
  lines(bottom, top, (y_m) => {
    const y = py(y_m);
    if (y > 26 && y < view.height - 24) context.fillText(metres(y_m, digits), 5, y);
  });
  context.fillStyle = palette.text;
  context.fillText("y in m", 5, 12);
  context.textAlign = "right";
  context.textBaseline = "bottom";
  context.fillText("x in m", view.width - 16, view.height - 4);
}

function line(context, x1, y1, x2, y2, colour) {
  context.strokeStyle = colour;
  context.beginPath();
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  context.stroke();
}

/** Draw the walls. */
export function drawWalls(context, ground_m) {
  context.strokeStyle = palette.wall;
  context.lineWidth = 3;
  context.lineCap = "round";
  context.beginPath();
  for (const wall of state.site?.walls ?? []) {
    context.moveTo(toX(wall.x1_m, wall.y1_m), toY(wall.x1_m, wall.y1_m, ground_m));
    context.lineTo(toX(wall.x2_m, wall.y2_m), toY(wall.x2_m, wall.y2_m, ground_m));
  }
  context.stroke();
  context.lineCap = "butt";
}

/** The box of the scale bar, lower right. */
export function scaleBox() {
  const width = roundLength(isNarrow() ? 100 : 130) * view.scale + 20;
  return { left: view.width - 6 - width, top: view.height - 48, width, height: 32 };
}

/** Draw the scale bar. */
export function drawScale(context) {
  const box = scaleBox();
  const width = box.width - 20;
  const length_m = width / view.scale;
  const right = view.width - 16;
  const y = view.height - 26;
  const label = length_m >= 1 ? `${Math.round(length_m)} m` : `${Math.round(length_m * 100)} cm`;
  context.fillStyle = faint(palette.surface, 0.85);
  context.fillRect(box.left, box.top, box.width, box.height);
  context.strokeStyle = palette.text;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(right - width, y - 5);
  context.lineTo(right - width, y);
  context.lineTo(right, y);
  context.lineTo(right, y - 5);
  context.stroke();
  context.fillStyle = palette.text;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.fillText(label, right - width / 2, y - 5);
}
