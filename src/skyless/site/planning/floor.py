"""The floor of a site: its outline, points inside it, and the walls on which anchors may hang."""

from pathlib import Path

import numpy as np
from msgspec import UNSET, Struct

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.errors import ConfigurationError
from skyless.core.geometry import OUTSIDE_M, Box, anchor_positions, area, distance_outside, inside, outline_of
from skyless.core.site import Site
from skyless.site.file.advice import anchors_needed
from skyless.site.file.check import image_size


class Floor(Struct, frozen=True):
    """Outline of the floor and region of interest."""

    outline_m: Matrix
    """Corners in order, shape (k, 2)."""
    region_m: Box
    """x1, y1, x2, y2 of the region; of it, what lies inside the outline counts."""


def floor_plan_box(site: Site, file: Path) -> Box | None:
    """Where the floor plan's image lies, from the width that the site gives and the image's shape."""
    plan = site.floor_plan
    if plan is None:
        return None
    size = image_size((file.parent / plan.image).read_bytes())
    if size is None:
        return None
    return plan.x_m, plan.y_m, plan.x_m + plan.width_m, plan.y_m + plan.width_m * size[1] / size[0]


def floor_of(site: Site, file: Path, outline_m: Matrix | None, region_m: Box | None) -> Floor:
    """The floor: the given outline, or the site's, or the floor plan, or the box around the anchors.

    Raises:
        ConfigurationError: an anchor lies outside the floor, or the floor has no area. Anchors outside the site's own
            outline are accepted, as ``skyless site check`` warns of them.
    """
    floor_m = outline_of(site) if outline_m is None else outline_m
    if floor_m is None:
        floor_m = _guessed(site, file)
    if abs(area(floor_m)) < 1e-6:
        right = "anchors that are not all in one line, or a floor plan; outline_m or --outline gives the room else"
        raise ConfigurationError(file, "anchors", f"{len(site.anchors)} in one line", right)
    if outline_m is not None or site.outline_m is UNSET:
        _check_inside(site, file, floor_m)
    low, high = floor_m.min(axis=0), floor_m.max(axis=0)
    return Floor(floor_m, region_m or (*low.tolist(), *high.tolist()))


def _guessed(site: Site, file: Path) -> Matrix:
    """The floor plan, or the box around the anchors."""
    anchors = anchor_positions(site)[:, :2]
    low, high = anchors.min(axis=0), anchors.max(axis=0)
    x1, y1, x2, y2 = floor_plan_box(site, file) or (*low.tolist(), *high.tolist())
    return np.array([(x1, y1), (x2, y1), (x2, y2), (x1, y2)])


def _check_inside(site: Site, file: Path, outline_m: Matrix) -> None:
    anchors = anchor_positions(site)[:, :2]
    for index in np.flatnonzero(~inside(anchors, outline_m)).tolist():
        if distance_outside(anchors[index], outline_m) > OUTSIDE_M:
            raise _outside(site, file, index, outline_m)


def _outside(site: Site, file: Path, index: int, outline_m: Matrix) -> ConfigurationError:
    anchor = site.anchors[index]
    (x1, y1), (x2, y2) = outline_m.min(axis=0).tolist(), outline_m.max(axis=0).tolist()
    key = f"anchors[{index}] (anchor {anchor.id})"
    right = f"on the floor, which reaches from ({x1:g}, {y1:g}) to ({x2:g}, {y2:g}) m"
    return ConfigurationError(file, key, f"at ({anchor.x_m:g}, {anchor.y_m:g})", right)


def sides(outline_m: Matrix) -> Matrix:
    """Sides of a polygon as segments, shape (k, 4)."""
    return np.hstack([outline_m, np.roll(outline_m, -1, axis=0)])


class Mounts(Struct, frozen=True):
    """Walls and heights at which anchors may hang."""

    segments_m: Matrix
    """Shape (k, 4): x1, y1, x2, y2."""
    heights_m: tuple[float, ...]

    @property
    def length_m(self) -> float:
        """Length of all walls together."""
        return float(np.linalg.norm(self.segments_m[:, 2:] - self.segments_m[:, :2], axis=1).sum())

    def at(self, along_m: Vector, levels: Integers) -> Matrix:
        """Points at distances along the walls and at heights by their index, to the millimetre; shape (m, 3)."""
        points = np.column_stack([points_along(self.segments_m, along_m), np.array(self.heights_m)[levels]])
        rounded: Matrix = np.round(points, 3)
        return rounded


def lowest_and_highest(site: Site) -> tuple[float, float]:
    """Heights of the lowest and of the highest anchor, metres."""
    levels_m = [anchor.z_m for anchor in site.anchors]
    return min(levels_m), max(levels_m)


def usual_tag_heights(site: Site) -> tuple[float, ...]:
    """Heights of the maps where none are asked for: the known one, or three between the lowest and highest anchor."""
    if site.tags.height_m is not None:
        return (site.tags.height_m,)
    low, high = lowest_and_highest(site)
    return tuple(round(low + share * (high - low), 2) for share in (1 / 6, 1 / 2, 5 / 6))[: 3 if high > low else 1]


def mounts_of(site: Site, floor: Floor, walls_m: Matrix | None, heights_m: tuple[float, ...] | None) -> Mounts:
    """Where anchors may hang: on the walls, shape (k, 4), by default the floor's sides; at which heights.

    By default the heights are those of the lowest and highest anchor.
    """
    levels_m = lowest_and_highest(site) if heights_m is None else heights_m
    return Mounts(sides(floor.outline_m) if walls_m is None else walls_m, tuple(dict.fromkeys(levels_m)))


def check_anchor_count(site: Site, file: Path) -> None:
    """See that the site has anchors enough for a position. Raises ConfigurationError."""
    needed, what = anchors_needed(site)
    if len(site.anchors) < needed:
        right = f"at least {needed}, which a position {what} needs"
        raise ConfigurationError(file, "anchors", f"a list of {len(site.anchors)}", right)


def points_along(segments_m: Matrix, along_m: Vector) -> Matrix:
    """Points, shape (m, 2), at distances along segments, shape (k, 4), one after the other and round again."""
    lengths = np.linalg.norm(segments_m[:, 2:] - segments_m[:, :2], axis=1)
    ends = np.cumsum(lengths)
    distances = np.mod(along_m, ends[-1])
    index = np.minimum(np.searchsorted(ends, distances, side="right"), len(lengths) - 1)
    share = (distances - (ends[index] - lengths[index])) / np.maximum(lengths[index], 1e-12)
    points: Matrix = segments_m[index, :2] + share[:, None] * (segments_m[index, 2:] - segments_m[index, :2])
    return points


def sample_points(floor: Floor, heights_m: tuple[float, ...], most: int) -> tuple[Matrix, Vector]:
    """About ``most`` points all over the region, up to 10 cm from its edges; shape (m, 3).

    With them their weights in a mean over the area, shape (m,), of sum 1: half on edges, a quarter in corners.
    """
    x1, y1, x2, y2 = floor.region_m
    width, depth = x2 - x1, y2 - y1
    per_slice = max(most / len(heights_m), 4.0)
    nx = max(2, round(np.sqrt(per_slice * width / depth)))
    ny = max(2, round(per_slice / nx))
    inset = min(0.1, 0.02 * min(width, depth))
    xs, ys = np.linspace(x1 + inset, x2 - inset, nx), np.linspace(y1 + inset, y2 - inset, ny)
    flat = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    weights = np.outer(_trapezoid(ny), _trapezoid(nx)).ravel()
    within = inside(flat, floor.outline_m)
    flat, weights = flat[within], np.tile(weights[within], len(heights_m))
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in heights_m])
    return points, weights / weights.sum()


def _trapezoid(count: int) -> Vector:
    weights = np.ones(count)
    weights[[0, -1]] = 0.5
    return weights
