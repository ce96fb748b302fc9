/** The outline of a place that somebody has walked around: the convex hull of the positions, with a margin. */

/** With fewer positions, or where they span a smaller area, nobody has walked around a place. */
const LEAST_POSITIONS = 10;
const LEAST_M2 = 0.25;
/** The server takes no more corners. An edge is left out where the next ones, made longer, meet within this of it. */
const MOST_CORNERS = 100;
const FLAT_M = 0.05;
/** An octagon whose sides are at 1 from its middle. */
const OCTAGON = Array.from({ length: 8 }, (_, n) => {
  const angle = ((2 * n + 1) * Math.PI) / 8;
  return [Math.cos(angle), Math.sin(angle)].map((part) => part / Math.cos(Math.PI / 8));
});

/** Corners of a zone, [x, y] in m, around positions that were walked. Throws an Error that says why there is none. */
export function outlineOf(positions, margin_m) {
  const walked = hull(positions);
  const area_m2 = walked.reduce((sum, corner, n) => sum + cross(walked[0], corner, walked[(n + 1) % walked.length]) / 2, 0);
  if (positions.length < LEAST_POSITIONS) throw new Error(`The tag had ${positions.length} good positions; an outline needs ${LEAST_POSITIONS}.`);
  if (area_m2 < LEAST_M2) throw new Error(`The walk spans ${area_m2.toFixed(2)} m²; an outline needs ${LEAST_M2} m²: walk around the place.`);
  const corners = hull(walked.flatMap(([x, y]) => OCTAGON.map(([dx, dy]) => [x + margin_m * dx, y + margin_m * dy])));
  while (corners.length > 3) {
    const found = corners.map((_, n) => withoutEdge(corners, n)).reduce((one, other) => (other.out_m < one.out_m ? other : one));
    if (found.out_m > FLAT_M && corners.length <= MOST_CORNERS) break;
    corners[found.n] = found.corner;
    corners.splice((found.n + 1) % corners.length, 1);
  }
  return corners.map((corner) => corner.map((value) => Number(value.toFixed(2))));
}

/** The corner in which the edges before and after the n-th one meet, and how far out of it that is. */
function withoutEdge(corners, n) {
  const [a, b, c, d] = [-1, 0, 1, 2].map((step) => corners.at((n + step) % corners.length));
  const [ahead, back] = [[d[0] - c[0], d[1] - c[1]], [b[0] - a[0], b[1] - a[1]]]; // prettier-ignore
  const turn = back[0] * ahead[1] - back[1] * ahead[0];
  const share = ((c[0] - a[0]) * ahead[1] - (c[1] - a[1]) * ahead[0]) / turn;
  const corner = [a[0] + share * back[0], a[1] + share * back[1]];
  return { n, corner, out_m: turn > 0 ? cross(b, corner, c) / Math.hypot(c[0] - b[0], c[1] - b[1]) : Infinity };
}

/** The convex hull of points, anticlockwise: first its lower side from left to right, then its upper one. */
function hull(points) {
  const sorted = points.toSorted(([x1, y1], [x2, y2]) => x1 - x2 || y1 - y2);
  const side = (from) => {
    const corners = [];
    for (const point of from) {
      while (corners.length > 1 && cross(corners.at(-2), corners.at(-1), point) <= 0) corners.pop();
      corners.push(point);
    }
    return corners.slice(0, -1);
  };
  return [...side(sorted), ...side(sorted.toReversed())];
}

/** Twice the area of a triangle, positive where its corners are in the order of a left turn. */
function cross([x0, y0], [x1, y1], [x2, y2]) {
  return (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0);
}
