"""Where anchors may hang, and layouts of anchors there as sites."""

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.planning.floor import Floor, along, inside, total_length
from skyless.planning.links import links
from skyless.site.model import AnchorSite, Site


class Mounts(Struct, frozen=True):
    """Walls and heights at which anchors may hang."""

    segments_m: Matrix
    """Shape (k, 4): x1, y1, x2, y2."""
    heights_m: tuple[float, ...]

    @property
    def length_m(self) -> float:
        """Length of all walls together."""
        return total_length(self.segments_m)

    def at(self, ways_m: Vector, levels: Integers) -> Matrix:
        """Points so far along the walls at heights by their number, to the millimetre; shape (m, 3)."""
        places = np.column_stack([along(self.segments_m, ways_m), np.array(self.heights_m)[levels]])
        rounded: Matrix = np.round(places, 3)
        return rounded


class Layout(Struct, frozen=True):
    """Anchors on mounts."""

    ways_m: Vector
    levels: Integers
    """Number of each one's height."""


def even_layout(mounts: Mounts, anchors: int) -> Layout:
    """The layout without a thought: evenly along the walls from their begin, heights in turn."""
    ways = np.arange(anchors) * mounts.length_m / anchors
    return Layout(ways, np.arange(anchors) % len(mounts.heights_m))


def site_with(site: Site, places_m: Matrix, master: int) -> Site:
    """The site with other anchors, shape (n, 3), numbered from 1; ``master`` is a row."""
    anchors = tuple(AnchorSite(k + 1, *place) for k, place in enumerate(places_m.tolist()))
    schedule = replace(site.schedule, slots=None)
    return replace(site, anchors=anchors, master=master + 1, schedule=schedule)


def site_with_one_more(site: Site, place_m: Vector) -> Site:
    """The site with one more anchor; its superframe grows by one slot for each frame of the anchor."""
    number = max(anchor.id for anchor in site.anchors) + 1
    slots, schedule = site.schedule.slots, site.schedule
    if slots is not None and slots < (len(site.anchors) + 1) * schedule.frames_per_node:
        schedule = replace(schedule, slots=None)
    x, y, z = place_m.tolist()
    return replace(site, anchors=(*site.anchors, AnchorSite(number, x, y, z)), schedule=schedule)


def masters_by_links(places_m: Matrix, budget: Vector, walls: Matrix) -> Integers:
    """Rows of anchors, those first that all others hear best; equals by their distance from the middle."""
    heard, _ = links(places_m, places_m, budget, walls)
    total = np.round(np.minimum(heard, 0.99).sum(axis=0), 3)
    middle = np.linalg.norm(places_m[:, :2] - places_m[:, :2].mean(axis=0), axis=1)
    return np.lexsort((middle, -total))


def sample_points(floor: Floor, heights_m: tuple[float, ...], most: int) -> tuple[Matrix, Vector]:
    """About so many points all over the region, its edges included up to a hand's breadth; shape (m, 3).

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
