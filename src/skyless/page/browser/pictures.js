/** Scales of colours, and pictures of values in a grid. */

import { h } from "./dom.js";

/** Red, green and blue, 0 to 255, at a position on a scale, 0 to 1; its stops are colours `#rrggbb`. */
export function colourAt(fraction, { stops }) {
  const at = Math.min(Math.max(fraction, 0), 1) * (stops.length - 1);
  const index = Math.min(Math.floor(at), stops.length - 2);
  const [one, other] = [parts(stops[index]), parts(stops[index + 1])];
  return one.map((value, part) => value + (at - index) * (other[part] - value));
}

function parts(stop) {
  return [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16));
}

/** A picture of values, row by row from the lowest; where `colourOf` returns null it is transparent. */
export function paintGrid({ columns, rows }, values, colourOf) {
  const picture = h("canvas", { width: columns, height: rows });
  const image = new ImageData(columns, rows);
  values.forEach((value, n) => {
    const colour = colourOf(value);
    const line = rows - 1 - Math.floor(n / columns);
    if (colour) image.data.set([...colour, 255], 4 * (line * columns + (n % columns)));
  });
  picture.getContext("2d").putImageData(image, 0, 0);
  return picture;
}

/** Paint a scale's colours from left to right, with marks below them: pairs of position and words. */
export function paintScale(canvas, scale, box, ticks) {
  const { width } = Object.assign(canvas, { width: 256, height: 1 });
  const at = Array.from({ length: width }, (_, x) => x / (width - 1));
  canvas.getContext("2d").drawImage(paintGrid({ columns: width, rows: 1 }, at, (share) => colourAt(share, scale)), 0, 0);
  const marks = ticks.map(([share, words]) => {
    const mark = h("span", {}, words);
    mark.style.left = `${100 * share}%`;
    return mark;
  });
  box.replaceChildren(...marks);
}
