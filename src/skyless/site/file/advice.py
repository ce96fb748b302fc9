"""Soft problems of a valid site: geometry and distances that reduce accuracy or prevent a fix."""

from collections.abc import Iterator
from itertools import chain
from typing import Final

import numpy as np

from skyless.core.air.almanac import OFFERED_HZ, suitable_period_s
from skyless.core.arrays import Array
from skyless.core.geometry import (
    OUTSIDE_M,
    RADIO_REACH_M,
    anchor_positions,
    anchors_in_reach,
    distance_outside,
    inside,
    links_in_reach,
    outline_of,
)
from skyless.core.site import ScheduleSite, Site

_MAX_OVERLOAD: Final = 2.0  # multiple of the best beacon rate in reach; half or double costs a tag less than 8 %
_MAX_NAMED: Final = 8

_ONLY_IN: Final = {"rate_hz": "free", "carrier_phase": "free", "slots": "master", "frames_per_node": "master"}
"""Keys of the schedule that have an effect in one mode only."""

_SHORTEST_GUARD_S: Final = 0.35e-3
"""Shortest turn-around of a host that reads one frame and prepares the next (firmware in C)."""

_FLATTEST: Final = 0.05
"""Anchors count as in one plane (or line) if their extent across it is a smaller share of the whole extent."""


def warnings_of(site: Site) -> list[str]:
    """Sentences on the soft problems of a valid site."""
    checks = [_count, _geometry, _height, _outline, _guard, _accuracy, _without_effect]
    if not site.schedule.needs_master:
        checks += [_neighbours, _load]
    return list(chain.from_iterable(check(site) for check in checks))


def too_few_anchors(site: Site) -> str | None:
    """Say that the placed anchors are too few for a position; None if they are enough."""
    needed, what = anchors_needed(site)
    count = len(site.anchors)
    if count >= needed:
        return None
    if site.unplaced:
        without = f"{len(site.unplaced)} of {len(site.all_anchors)} anchors have no position yet"
        return f"{without}: a tag's position {what} needs {needed} that have"
    return f"{count} anchor{'s give' if count > 1 else ' gives'} no position: one {what} needs {needed}"


def anchors_needed(site: Site) -> tuple[int, str]:
    """Number of anchors that a position at this site needs, and the kind of position."""
    return (4, "with its height") if site.tags.height_m is None else (3, "at a known height")


def _count(site: Site) -> Iterator[str]:
    needed, what = anchors_needed(site)
    if too_few := too_few_anchors(site):
        yield too_few
    elif len(site.anchors) == needed:
        yield f"{needed} anchors are the fewest for a position {what}: none may fail, and no outlier can be detected"


def _geometry(site: Site) -> Iterator[str]:
    """Anchors in one line (2-D) or one plane (3-D) leave two mirror positions (``docs/maths.md`` section 5)."""
    flat = site.tags.height_m is not None
    dimensions = 2 if flat else 3
    points = anchor_positions(site)[:, :dimensions]
    if len(points) < dimensions + 1:
        return
    which = _flat_everywhere(points) if site.schedule.needs_master else _flat_in_reach(site, points)
    mirror = "the mirror image of a tag's position fits its beacons as well"
    if which and flat:
        yield f"{which} lie nearly in one line: {mirror}; hang one anchor away from it"
    elif which:
        yield (
            f"{which} lie nearly in one plane: {mirror}, "
            "and the direction across is poor; alternate the anchors' heights, or set tags.height_m if it is known"
        )


def _flat_everywhere(points: Array) -> str | None:
    """Say that all anchors are in one line or plane; None if not."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return "all anchors" if extents[-1] < _FLATTEST * extents[0] else None


def _flat_in_reach(site: Site, points: Array) -> str | None:
    """Name the anchors around which all others in reach are in one line or plane, as tags there receive only these."""
    ones, others = links_in_reach(site)
    count, dimensions = points.shape
    pairs = np.concatenate([ones, others]), np.concatenate([others, ones])
    apart_m = points[pairs[1]] - points[pairs[0]]
    sums, squares = np.zeros((count, dimensions)), np.zeros((count, dimensions, dimensions))
    np.add.at(sums, pairs[0], apart_m)
    np.add.at(squares, pairs[0], apart_m[:, :, None] * apart_m[:, None, :])
    around = np.bincount(pairs[0], minlength=count) + 1  # with the anchor itself, at the origin
    means = sums / around[:, None]
    extents_2 = np.linalg.eigvalsh(squares / around[:, None, None] - means[:, :, None] * means[:, None, :])
    flat = (extents_2[:, 0] < _FLATTEST**2 * extents_2[:, -1]) & (around > dimensions)
    if not flat.any():
        return None
    if flat.all():
        return "all anchors"
    return f"{_named([site.anchors[row].id for row in np.flatnonzero(flat)])}: all anchors in reach"


def _height(site: Site) -> Iterator[str]:
    height_m, anchors = site.tags.height_m, site.anchors
    if height_m is not None and anchors and all(abs(one.z_m - height_m) > RADIO_REACH_M for one in anchors):
        reach = f"{RADIO_REACH_M:.0f} m, the range in the open"
        yield f"tags.height_m is {height_m:g}: no anchor is within {reach}, of that height"


def _outline(site: Site) -> Iterator[str]:
    outline_m = outline_of(site)
    if outline_m is None:
        return
    points = anchor_positions(site)[:, :2]
    far = {
        site.anchors[row].id: distance_m
        for row in np.flatnonzero(~inside(points, outline_m)).tolist()
        if (distance_m := distance_outside(points[row], outline_m)) > OUTSIDE_M
    }
    if far:
        distance = f"{'up to ' if len(far) > 1 else ''}{max(far.values()):.2f} m"
        yield f"{_named(list(far))}: {distance} outside the room that outline_m gives; see which of the two is wrong"


def _without_effect(site: Site) -> Iterator[str]:
    """Warn of keys that have no effect in the site's mode."""
    schedule, usual = site.schedule, ScheduleSite()
    for key, mode in _ONLY_IN.items():
        value = getattr(schedule, key)
        if schedule.mode != mode and value != getattr(usual, key):
            yield f"schedule.{key} is {str(value).lower()}, which has no effect in mode {schedule.mode}"
    if not schedule.needs_master:
        if slotted := [anchor.id for anchor in site.all_anchors if anchor.slot is not None]:
            yield f"{_named(slotted)}: slot has no effect in mode free"
        return
    for key in ("std_m", "floor", "zone"):
        if stated := [anchor.id for anchor in site.anchors if getattr(anchor, key)]:
            yield f"{_named(stated)}: {key} has no effect in mode master, whose beacons do not carry it"


def _neighbours(site: Site) -> Iterator[str]:
    """Warn of anchors without a neighbour in reach, and of groups of anchors without a link between them."""
    points = anchor_positions(site)
    if len(points) < 2:
        return
    ones, others = links_in_reach(site)
    lowest, before = np.arange(len(points)), None
    while before is None or (lowest != before).any():  # each anchor takes the lowest row among its neighbours'
        before = lowest.copy()
        np.minimum.at(lowest, ones, before[others])
        np.minimum.at(lowest, others, before[ones])
    rows, group = np.unique(lowest, return_inverse=True)
    count = len(rows)
    sizes = np.bincount(group)
    alone = [site.anchors[row].id for row in np.flatnonzero(sizes[group] == 1)]
    if alone:
        yield (
            f"{_named(alone)}: no other anchor within {RADIO_REACH_M:.0f} m, the range in the open; "
            "nothing ties its clock to others', so tags hardly gain from it"
        )
    if count - len(alone) > 1 or (alone and count > len(alone)):
        yield (
            f"the anchors form {count} groups with no link of {RADIO_REACH_M:.0f} m or less between them: "
            "a tag between two groups positions itself by one at a time"
        )


def _load(site: Site) -> Iterator[str]:
    """Warn of too high a rate: frames at random instants collide if too many are in reach."""
    rate_hz = site.schedule.rate_hz
    if rate_hz is None or not site.anchors:
        return
    in_reach = float(np.median(anchors_in_reach(site)))
    offered_hz = in_reach * rate_hz
    if offered_hz > _MAX_OVERLOAD * OFFERED_HZ:
        yield (
            f"schedule.rate_hz is {rate_hz:g}: the {in_reach:.0f} anchors in reach of one another send "
            f"{offered_hz:.0f} beacons/s, and most collide; without it each would choose the rate that "
            f"gives tags most, {1.0 / suitable_period_s(round(in_reach), None):.3g}"
        )


def _named(identifiers: list[int]) -> str:
    """Anchors by their identifiers, the first few of many."""
    shown = ", ".join(map(str, identifiers[:_MAX_NAMED]))
    more = f" and {len(identifiers) - _MAX_NAMED} more" if len(identifiers) > _MAX_NAMED else ""
    return f"anchor{'s' if len(identifiers) > 1 else ''} {shown}{more}"


def _guard(site: Site) -> Iterator[str]:
    guard_s = site.schedule.guard_s
    if guard_s < _SHORTEST_GUARD_S and site.schedule.needs_master:
        yield (
            f"a guard of {guard_s * 1e6:.0f} µs is shorter than a radio's host needs between two frames "
            f"({_SHORTEST_GUARD_S * 1e6:.0f} µs)"
        )


def _accuracy(site: Site) -> Iterator[str]:
    if site.accuracy.survey_std_m == site.accuracy.range_std_m == 0.0:
        yield (
            "[accuracy] states that survey and ranges are exact; no real site is: the standard deviations that tags "
            "report will be too small; set survey_std_m and range_std_m"
        )
