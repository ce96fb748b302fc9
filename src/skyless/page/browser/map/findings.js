/** What the watch of the anchors finds, at the anchors and links that it concerns. */

import { palette } from "../theme.js";
import { findings, markWords } from "../survey/watch.js";
import { label } from "./names.js";
import { pixelOf } from "./survey.js";

const RADIUS = 16;

/** Draw a ring and a word at each anchor, and a line along each link, that the watch reports. */
export function drawFindings(context) {
  for (const finding of findings()) {
    const ends = finding.anchors.map(pixelOf).filter((at) => at !== null);
    const colour = finding.kind === "check" ? palette.warn : palette.bad;
    context.setLineDash([5, 3]);
    context.lineWidth = 2;
    context.strokeStyle = colour;
    context.beginPath();
    if (finding.kind === "link" && ends.length === 2) {
      context.moveTo(ends[0].x, ends[0].y);
      context.lineTo(ends[1].x, ends[1].y);
    } else {
      for (const { x, y } of ends) {
        context.moveTo(x + RADIUS, y);
        context.arc(x, y, RADIUS, 0, 2 * Math.PI);
      }
    }
    context.stroke();
    context.setLineDash([]);
    if (!ends.length) continue;
    const x = finding.kind === "link" ? mean(ends, "x") : ends[0].x;
    const y = finding.kind === "link" ? mean(ends, "y") : ends[0].y - RADIUS - 5;
    context.font = "600 11px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "bottom";
    label(context, markWords(finding), x, y, colour);
  }
}

function mean(ends, key) {
  return ends.reduce((sum, end) => sum + end[key], 0) / ends.length;
}
