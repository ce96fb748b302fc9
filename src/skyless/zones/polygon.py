"""Plane geometry of simple polygons, corners in order, metres."""

import math
from itertools import pairwise

Point = tuple[float, float]
Polygon = tuple[Point, ...]


def area_m2(polygon: Polygon) -> float:
    """Area, never negative; the polygon must not cross itself."""
    return abs(0.5 * sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in sides(polygon)))


def perimeter_m(polygon: Polygon) -> float:
    """Length of all sides."""
    return sum(math.dist(a, b) for a, b in sides(polygon))


def sides(polygon: Polygon) -> list[tuple[Point, Point]]:
    """Sides in order, the last one back to the first corner."""
    return [*pairwise(polygon), (polygon[-1], polygon[0])]


def depth_m(point: Point, polygon: Polygon) -> float:
    """Distance to the nearest side, positive inside and negative outside (even-odd rule)."""
    x, y = point
    inside, least = False, math.inf
    for (x1, y1), (x2, y2) in sides(polygon):
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            inside = not inside
        along_x, along_y = x2 - x1, y2 - y1
        length2 = along_x * along_x + along_y * along_y
        share = ((x - x1) * along_x + (y - y1) * along_y) / length2 if length2 > 0.0 else 0.0
        share = min(max(share, 0.0), 1.0)
        away_x, away_y = x1 + share * along_x - x, y1 + share * along_y - y
        least = min(least, away_x * away_x + away_y * away_y)
    return math.sqrt(least) if inside else -math.sqrt(least)


def is_simple(polygon: Polygon) -> bool:
    """Whether no two sides touch or cross, except neighbours in their common corner."""
    segments = sides(polygon)
    last = len(segments) - 1
    for i, (a, b) in enumerate(segments):
        if a == b or _folds_back(a, b, segments[(i + 1) % len(segments)][1]):
            return False
        for j in range(i + 2, len(segments)):
            if (i, j) != (0, last) and _touch(a, b, *segments[j]):
                return False
    return True


def _folds_back(a: Point, b: Point, c: Point) -> bool:
    """Whether the side b–c runs back along a–b."""
    towards = (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1])
    return _turn(a, b, c) == 0.0 and towards > 0.0


def _touch(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a–b and c–d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0


def _turn(a: Point, b: Point, c: Point) -> float:
    """Positive where a–b–c turns left, 0 where the three are in one line."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
