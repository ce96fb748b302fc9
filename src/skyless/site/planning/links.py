"""Predicted reception of anchors, from the simulated channel's formulas without randomness; columns of predictions.

Also the floor of a site and the places where anchors may be mounted.
"""

import math
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from msgspec import UNSET, Struct

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.errors import ConfigurationError
from skyless.core.geometry import OUTSIDE_M, Box, anchor_positions, area, distance_outside, dops_at, inside, outline_of
from skyless.core.native.arithmetic import square
from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.records import Array, Reals
from skyless.core.site import Site
from skyless.site.channel import (
    FREE_SPACE_LOSS_1_M_DB,
    Barrier,
    Barriers,
    ChannelModel,
    cross_walls,
    delivery_probability,
    received_power_dbm,
)
from skyless.site.file.advice import anchors_needed
from skyless.site.file.check import image_size

PLAN_COLUMNS: Final = (
    "anchors",  # in view
    "gdop",
    "pdop",
    "hdop",
    "vdop",
    "tdop",
    "sigma_m",  # standard deviation of the position, all axes together
    "sigma_x_m",
    "sigma_y_m",
    "sigma_z_m",
    "bias_m",  # length of the mean error due to walls
    "rmse_m",  # standard deviation and bias together
    "fix_share",  # of the messages of the anchors that a tag uses, those that give a fix
    "claimed_m",  # standard deviation that the fixes themselves will report
)
"""Columns of a prediction, metres; infinite where there is no fix."""

ANCHORS_IN_VIEW, GDOP, PDOP, HDOP, VDOP, TDOP, SIGMA, SIGMA_X, SIGMA_Y, SIGMA_Z, BIAS, RMSE, FIX_SHARE, CLAIMED = range(
    14
)

IN_VIEW: Final = 0.5
"""An anchor is in view where at least this share of its frames arrives."""

_NEGLIGIBLE_SHARE: Final = 1e-4  # a smaller share of received frames, in free space, counts as none
_NEGLIGIBLE_LOSS: Final = 1e-7  # a smaller share of lost frames, in free space, counts as none
MIN_SYNC: Final = 0.01
"""An anchor that receives less than this share of the master's frames is assumed to stay silent."""


def range_of(channel: ChannelModel, exponent: float = 2.0) -> float:
    """Distance in metres at which half of the frames arrive without obstacles, for a path loss exponent."""
    budget_db = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - channel.sensitivity_dbm
    return float(10.0 ** (budget_db / (10.0 * exponent)))


def with_range(channel: ChannelModel, range_m: float, exponent: float = 2.0) -> ChannelModel:
    """The channel with its sensitivity changed to give this range."""
    sensitivity_dbm = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - 10.0 * exponent * math.log10(range_m)
    return channel.changed(sensitivity_dbm=sensitivity_dbm)


def link_budget(channel: ChannelModel) -> Vector:
    """A channel's parameters for ``link``.

    Transmit power, sensitivity, its width, share lost at random, and the squared distances, m², beyond which nothing
    and within which everything arrives.
    """
    farthest_db = math.log(1.0 / _NEGLIGIBLE_SHARE) * channel.sensitivity_width_db
    farthest_m = range_of(channel) * 10.0 ** (farthest_db / 20.0)
    certain_m = range_of(channel) * 10.0 ** (math.log(_NEGLIGIBLE_LOSS) * channel.sensitivity_width_db / 20.0)
    return np.array(
        [
            channel.tx_power_dbm,
            channel.sensitivity_dbm,
            channel.sensitivity_width_db,
            channel.loss_probability,
            farthest_m**2,
            certain_m**2,
        ]
    )


def fill_links(
    senders_m: Reals,
    senders: int,
    listeners_m: Reals,
    listeners: int,
    budget: Reals,
    barriers: Array[Barrier],
    count: int,
    share: Reals,
    delays_m: Reals,
) -> None:
    """Fill the results of ``links``, listener by listener; points are x, y and z one after the other."""
    for i in range(listeners):
        x_m, y_m, z_m = listeners_m[3 * i], listeners_m[3 * i + 1], listeners_m[3 * i + 2]
        for j in range(senders):
            k = i * senders + j
            share[k], delays_m[k] = 0.0, 0.0
            from_x_m, from_y_m, from_z_m = senders_m[3 * j], senders_m[3 * j + 1], senders_m[3 * j + 2]
            squared_m2 = square(x_m - from_x_m) + square(y_m - from_y_m) + square(z_m - from_z_m)
            if squared_m2 > budget[4]:
                continue
            loss_db, delay_m = cross_walls(barriers, count, from_x_m, from_y_m, from_z_m, x_m, y_m, z_m)
            delays_m[k] = delay_m
            if loss_db == 0.0 and squared_m2 < budget[5]:
                share[k] = 1.0 - budget[3]
                continue
            power_dbm = received_power_dbm(budget[0], sqrt(squared_m2), loss_db)
            share[k] = (1.0 - budget[3]) * delivery_probability(power_dbm, budget[1], budget[2])


_fill_links = compiled(fill_links, KERNELS)


def links(senders_m: Matrix, listeners_m: Matrix, budget: Vector, barriers: Barriers) -> tuple[Matrix, Matrix]:
    """Share of each sender's frames that reach each listener, and delay in metres; shape (listeners, senders) each."""
    share, delay_m = np.empty((2, len(listeners_m), len(senders_m)))
    senders, listeners = (np.ascontiguousarray(one, np.float64).reshape(-1) for one in (senders_m, listeners_m))
    _fill_links(
        senders, len(senders_m), listeners, len(listeners_m), budget, *barriers, share.reshape(-1), delay_m.reshape(-1)
    )
    return share, delay_m


def master_links(anchors_m: Matrix, master: int, budget: Vector, barriers: Barriers) -> Vector:
    """Share of the frames of the anchor in row ``master`` that reaches each of the anchors; 1 for itself."""
    share, _ = links(anchors_m[master : master + 1], anchors_m, budget, barriers)
    share[master] = 1.0
    return share[:, 0]


def masters_by_links(anchors_m: Matrix, budget: Vector, barriers: Barriers) -> Integers:
    """Rows of anchors ordered by how well all others receive them, best first; equals by distance from the middle."""
    heard, _ = links(anchors_m, anchors_m, budget, barriers)
    total = np.round(np.minimum(heard, 0.99).sum(axis=0), 3)
    return np.lexsort((np.linalg.norm(anchors_m[:, :2] - anchors_m[:, :2].mean(axis=0), axis=1), -total))


class Scene(NamedTuple):
    """Anchors and walls, for the reception at points."""

    anchors: Matrix
    """Positions, shape (anchors, 3)."""
    sends: Vector
    """Share of each anchor's frames that is sent and not lost to collisions, shape (anchors,)."""
    budget: Vector
    """From ``link_budget``."""
    barriers: Barriers

    def heard_at(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Share of each anchor's frames that arrives at points, and the walls' delay in metres; shape (m, anchors)."""
        share, delay_m = links(self.anchors, points, self.budget, self.barriers)
        return share * self.sends, delay_m

    def strongest(self, point: Vector, rows: Integers, most: int) -> Integers:
        """The up to ``most`` of these rows of anchors that a point receives with the most power; ascending."""
        if len(rows) <= most:
            return rows
        power_dbm = [
            received_power_dbm(
                self.budget[0],
                float(np.linalg.norm(point - anchor_m)),
                cross_walls(*self.barriers, *anchor_m, *point)[0],
            )
            for anchor_m in self.anchors[rows]
        ]
        return np.sort(rows[np.argsort(power_dbm, kind="stable")[-most:]])


def fill_dops(scene: Scene, points: Matrix, share: Matrix, dim: int, table: Matrix) -> None:
    """Fill the columns of anchors in view and of their DOPs."""
    in_view = share >= IN_VIEW
    table[:, ANCHORS_IN_VIEW] = in_view.sum(axis=1)
    table[:, GDOP : TDOP + 1] = dops_at(scene.anchors, points, height_known=dim == 2, weights=in_view)


def weighted_pdop(scene: Scene, points: Matrix, share: Matrix, dim: int) -> Vector:
    """PDOP with anchors weighted by their shares of frames, so that it has no steps; may be infinite."""
    return dops_at(scene.anchors, points, height_known=dim == 2, weights=share)[:, PDOP - GDOP]


# The floor of a site: its outline, points inside it, and the walls on which anchors may be mounted.


class Floor(Struct, frozen=True):
    """Outline of the floor and region of interest."""

    outline_m: Matrix
    """Corners in order, shape (k, 2)."""
    region_m: Box
    """x1, y1, x2, y2 of the region; only its part inside the outline counts."""


def floor_plan_box(site: Site, file: Path) -> Box | None:
    """Position of the floor plan's image, from its width in the site and its aspect ratio; None without an image."""
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
        ConfigurationError: an anchor is outside the floor, or the floor has no area. Anchors outside the site's own
            outline are accepted, as ``skyless site check`` warns of them.
    """
    floor_m = outline_of(site) if outline_m is None else outline_m
    if floor_m is None:
        anchors = anchor_positions(site)[:, :2]
        low, high = anchors.min(axis=0), anchors.max(axis=0)
        x1, y1, x2, y2 = floor_plan_box(site, file) or (*low.tolist(), *high.tolist())
        floor_m = np.array([(x1, y1), (x2, y1), (x2, y2), (x1, y2)])
    if abs(area(floor_m)) < 1e-6:
        right = "anchors that are not all in one line, or a floor plan; outline_m or --outline gives the room else"
        raise ConfigurationError(file, "anchors", f"{len(site.anchors)} in one line", right)
    if outline_m is not None or site.outline_m is UNSET:
        _check_inside(site, file, floor_m)
    low, high = floor_m.min(axis=0), floor_m.max(axis=0)
    return Floor(floor_m, region_m or (*low.tolist(), *high.tolist()))


def _check_inside(site: Site, file: Path, outline_m: Matrix) -> None:
    anchors = anchor_positions(site)[:, :2]
    for index in np.flatnonzero(~inside(anchors, outline_m)).tolist():
        if distance_outside(anchors[index], outline_m) > OUTSIDE_M:
            anchor = site.anchors[index]
            (x1, y1), (x2, y2) = outline_m.min(axis=0).tolist(), outline_m.max(axis=0).tolist()
            key = f"anchors[{index}] (anchor {anchor.id})"
            right = f"on the floor, which reaches from ({x1:g}, {y1:g}) to ({x2:g}, {y2:g}) m"
            raise ConfigurationError(file, key, f"at ({anchor.x_m:g}, {anchor.y_m:g})", right)


def sides(outline_m: Matrix) -> Matrix:
    """Sides of a polygon as segments, shape (k, 4)."""
    return np.hstack([outline_m, np.roll(outline_m, -1, axis=0)])


class Mounts(Struct, frozen=True):
    """Walls and heights at which anchors may be mounted."""

    segments_m: Matrix
    """Shape (k, 4): x1, y1, x2, y2."""
    heights_m: tuple[float, ...]

    @property
    def length_m(self) -> float:
        """Length of all walls together."""
        return float(np.linalg.norm(self.segments_m[:, 2:] - self.segments_m[:, :2], axis=1).sum())

    def at(self, along_m: Vector, levels: Integers) -> Matrix:
        """Points at distances along the walls and at indexed heights, rounded to millimetres; shape (m, 3)."""
        points = np.column_stack([points_along(self.segments_m, along_m), np.array(self.heights_m)[levels]])
        rounded: Matrix = np.round(points, 3)
        return rounded


def lowest_and_highest(site: Site) -> tuple[float, float]:
    """Heights of the lowest and of the highest anchor, metres."""
    levels_m = [anchor.z_m for anchor in site.anchors]
    return min(levels_m), max(levels_m)


def usual_tag_heights(site: Site) -> tuple[float, ...]:
    """Default heights of maps: the known tag height, or three between the lowest and highest anchor."""
    if site.tags.height_m is not None:
        return (site.tags.height_m,)
    low, high = lowest_and_highest(site)
    return tuple(round(low + share * (high - low), 2) for share in (1 / 6, 1 / 2, 5 / 6))[: 3 if high > low else 1]


def mounts_of(site: Site, floor: Floor, walls_m: Matrix | None, heights_m: tuple[float, ...] | None) -> Mounts:
    """Mounts on walls, shape (k, 4), by default the floor's sides.

    By default the heights are those of the lowest and highest anchor.
    """
    levels_m = lowest_and_highest(site) if heights_m is None else heights_m
    return Mounts(sides(floor.outline_m) if walls_m is None else walls_m, tuple(dict.fromkeys(levels_m)))


def check_anchor_count(site: Site, file: Path) -> None:
    """Check that the site has enough anchors for a position. Raises ConfigurationError."""
    needed, what = anchors_needed(site)
    if len(site.anchors) < needed:
        right = f"at least {needed}, which a position {what} needs"
        raise ConfigurationError(file, "anchors", f"a list of {len(site.anchors)}", right)


def points_along(segments_m: Matrix, along_m: Vector) -> Matrix:
    """Points, shape (m, 2), at distances along joined segments, shape (k, 4), modulo their total length."""
    lengths = np.linalg.norm(segments_m[:, 2:] - segments_m[:, :2], axis=1)
    ends = np.cumsum(lengths)
    distances = np.mod(along_m, ends[-1])
    index = np.minimum(np.searchsorted(ends, distances, side="right"), len(lengths) - 1)
    share = (distances - (ends[index] - lengths[index])) / np.maximum(lengths[index], 1e-12)
    points: Matrix = segments_m[index, :2] + share[:, None] * (segments_m[index, 2:] - segments_m[index, :2])
    return points


def sample_points(floor: Floor, heights_m: tuple[float, ...], most: int) -> tuple[Matrix, Vector]:
    """About ``most`` points all over the region, up to 10 cm from its edges, shape (m, 3), and their weights.

    Weights are for a mean over the area, shape (m,), with sum 1: half on edges, a quarter in corners.
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
