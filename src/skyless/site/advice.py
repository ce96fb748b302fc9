"""Soft problems of a valid site: geometry and distances that reduce accuracy or prevent a fix."""

from math import dist
from typing import Final

import numpy as np

from skyless.kernels.arrays import Array
from skyless.site.model import Site

_FLATTEST: Final = 0.05
"""Extent across the best plane (or line) over the whole extent, below which anchors count as in it."""
_REACH_M: Final = 100.0
"""Range of a DW1000 in the open at 6.8 Mbit/s, at best; walls shorten it."""
_SHORTEST_GUARD_S: Final = 0.35e-3
"""Shortest turn-around of a host that reads one frame and prepares the next (firmware in C)."""


def warnings_of(site: Site) -> list[str]:
    """Soft problems of a valid site, each a sentence; empty when there is none."""
    return [*_count(site), *_geometry(site), *_reach(site), *_guard(site), *_accuracy(site)]


def _count(site: Site) -> list[str]:
    flat = site.tags.height_m is not None
    needed = 3 if flat else 4
    count = len(site.anchors)
    what = "at a known height" if flat else "with its height"
    if count < needed:
        return [f"{count} anchors give no position: one {what} needs {needed}"]
    if count == needed:
        return [f"{count} anchors are the fewest for a position {what}: none may fail, and no outlier can be detected"]
    return []


def _geometry(site: Site) -> list[str]:
    """Anchors in one line (2-D) or one plane (3-D) leave two mirror positions (``docs/maths.md`` section 5)."""
    flat = site.tags.height_m is not None
    dimensions = 2 if flat else 3
    points = _points(site)[:, :dimensions]
    if len(points) < dimensions + 1:
        return []
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[-1] >= _FLATTEST * extents[0]:
        return []
    if flat:
        return ["all anchors lie nearly in one line: the mirror image of a tag's position fits its beacons as well"]
    return [
        "all anchors lie nearly in one plane: the mirror image of a tag's position fits its beacons as well, "
        "and the direction across is poor; alternate the anchors' heights, or set tags.height_m if it is known"
    ]


def _reach(site: Site) -> list[str]:
    points = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    distances = {number: dist(point, points[site.master]) for number, point in points.items()}
    return [
        f"anchor {number} is {distance:.0f} m from the master, which it must hear: over {_REACH_M:.0f} m may be too far"
        for number, distance in distances.items()
        if distance > _REACH_M
    ]


def _guard(site: Site) -> list[str]:
    guard_s = site.schedule.guard_s
    if guard_s >= _SHORTEST_GUARD_S:
        return []
    return [
        f"a guard of {guard_s * 1e6:.0f} µs is shorter than a radio's host needs between two frames "
        f"({_SHORTEST_GUARD_S * 1e6:.0f} µs)"
    ]


def _accuracy(site: Site) -> list[str]:
    if site.accuracy.survey_std_m > 0.0 or site.accuracy.range_std_m > 0.0:
        return []
    return [
        "[accuracy] states that survey and ranges are exact; no real site is: the standard deviations that tags report "
        "will be too small; set survey_std_m and range_std_m"
    ]


def _points(site: Site) -> Array:
    return np.array([[anchor.x_m, anchor.y_m, anchor.z_m] for anchor in site.anchors])
