"""One room with errors that are drawn, and the site files that different people would write for it.

In the air are: antenna delays that are off, errors of the pairs of anchors, and the errors of the ranges at tags that
the scenario ``room`` has. The truth of a room does not depend on who writes its file.

A file's positions are moved to the true frame by the best rigid alignment of all anchors: which way the axes point is
no error of the site's shape, and tags then walk the same ways for every file.
"""

from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.geometry import anchor_positions
from skyless.core.site import EXACT, AccuracySite, AnchorSite, Site, TagsSite
from skyless.core.ticks import TICK_M
from skyless.research.surveys._anchor_stamps import stamps_of
from skyless.research.surveys.air import free_axes
from skyless.research.surveys.judge import aligned
from skyless.research.surveys.layouts import SurveyLayout
from skyless.sim.evaluation.scenarios import Room
from skyless.sim.impairments import (
    AnchorDisplacement,
    DelayError,
    Impairments,
    PairError,
    RangeErrorModel,
    lab_impairments,
)
from skyless.sim.world import lab_site
from skyless.site.survey.facts import Facts, PairRanges, Point, Survey, Tape
from skyless.site.survey.solve import run_survey, surveyed_site

HAND_STD_M: Final = 0.02
"""Error of positions measured by hand, per axis."""
SKETCH_STD_M: Final = 0.3
ROOM_RANGES: Final = Room().ranges
"""Errors of ranges at tags in the scenario ``room``."""
TAPE_STD_M: Final = 0.005


class RoomErrors(Struct, frozen=True):
    """How the errors of a room are drawn."""

    delay_std_m: float = 0.0
    """Standard deviation of h, half of the sum of an anchor's TX and RX delay errors, and of half their difference."""
    pair_std_m: float = 0.0
    """Constant error of each pair of anchors."""
    ranges: RangeErrorModel = RangeErrorModel()
    """At tags."""


class DrawnRoom(Struct, frozen=True, eq=False):
    """One room. Arrays are in the order of the layout's anchors."""

    layout: SurveyLayout
    tx_delay_m: Array
    """True delay less the usual one, shape (n,)."""
    rx_delay_m: Array
    pairs: tuple[PairError, ...]
    ranges: RangeErrorModel
    hand_m: Array
    """Errors of positions measured by hand, shape (n, 3)."""
    sketch_m: Array
    """Errors of a sketch, shape (n, 3)."""
    tape_m: float
    """Error of a taped distance."""
    noise_ps: float
    seed: int
    """Seed of the air."""


def drawn_room(layout: SurveyLayout, errors: RoomErrors, noise_ps: float, seed: int) -> DrawnRoom:
    """A room with its own errors."""
    draw = np.random.default_rng(seed)
    n, anchors = len(layout.anchors), layout.anchors
    common_m, half_m = errors.delay_std_m * draw.standard_normal((2, n))
    late_m = errors.pair_std_m * draw.standard_normal((n, n))
    return DrawnRoom(
        layout=layout,
        tx_delay_m=common_m + half_m,
        rx_delay_m=common_m - half_m,
        pairs=tuple(
            PairError(anchors[a], anchors[b], late_m=float(late_m[a, b])) for a in range(n) for b in range(a + 1, n)
        ),
        ranges=errors.ranges,
        hand_m=HAND_STD_M * draw.standard_normal((n, 3)) * free_axes(layout),
        sketch_m=SKETCH_STD_M * draw.standard_normal((n, 3)) * free_axes(layout),
        tape_m=float(TAPE_STD_M * draw.standard_normal()),
        noise_ps=noise_ps,
        seed=int(draw.integers(1 << 60)),
    )


def site_at(layout: SurveyLayout, position_m: Array, noise_ps: float) -> Site:
    """A site whose file states these positions, shape (n, 3), with the usual delays and accuracy."""
    anchors = tuple(
        AnchorSite(anchor, x_m, y_m, z_m)
        for anchor, (x_m, y_m, z_m) in zip(layout.anchors, position_m.tolist(), strict=True)
    )
    tags = TagsSite(layout.tag_height_m if layout.dimensions == 2 else None)
    return replace(lab_site(noise_ps), name=layout.name, anchors=anchors, tags=tags)


def air_of(room: DrawnRoom, site: Site) -> Impairments:
    """What is wrong in a room's air against what a site file states."""
    stated_m = anchor_positions(site)
    usual = AnchorSite(0, 0.0, 0.0)
    return replace(
        lab_impairments(room.noise_ps),
        delay_errors=tuple(
            DelayError(
                anchor.id,
                float(tx_m) / TICK_M + usual.tx_antenna_delay_ticks - anchor.tx_antenna_delay_ticks,
                float(rx_m) / TICK_M + usual.rx_antenna_delay_ticks - anchor.rx_antenna_delay_ticks,
            )
            for anchor, tx_m, rx_m in zip(site.anchors, room.tx_delay_m, room.rx_delay_m, strict=True)
        ),
        anchor_displacements=tuple(
            AnchorDisplacement(anchor.id, *off_m)
            for anchor, off_m in zip(site.anchors, (room.layout.position_m - stated_m).tolist(), strict=True)
        ),
        anchor_pair_errors=room.pairs,
        range_errors=room.ranges,
    )


def true_site(room: DrawnRoom) -> Site:
    """A file that states the truth, and that its positions are exact; delays are such that all h are 0."""
    site = site_at(room.layout, room.layout.position_m, room.noise_ps)
    delays = zip(site.anchors, room.tx_delay_m, room.rx_delay_m, strict=True)
    anchors = tuple(
        replace(anchor, tx_antenna_delay_ticks=anchor.tx_antenna_delay_ticks + round(float(tx_m + rx_m) / TICK_M))
        for anchor, tx_m, rx_m in delays
    )
    return replace(site, anchors=anchors, accuracy=replace(site.accuracy, survey_std_m=0.0))


def exact_site(room: DrawnRoom) -> Site:
    """The true site, which also states that ranges are right."""
    return replace(true_site(room), accuracy=EXACT)


def hand_site(room: DrawnRoom) -> Site:
    """A file with positions measured by hand and the usual delays."""
    return _aligned(room, site_at(room.layout, room.layout.position_m + room.hand_m, room.noise_ps))


def ranges_of(room: DrawnRoom, seconds: float) -> PairRanges:
    """What the anchors receive of one another, with the file of somebody who has a sketch."""
    site = site_at(room.layout, room.layout.position_m + room.sketch_m, room.noise_ps)
    return stamps_of(site, air_of(room, site), seconds, room.seed).ranges()


def kept_site(room: DrawnRoom, ranges: PairRanges) -> Site:
    """A file with positions measured by hand, and delays by ``--keep-positions``."""
    rough_m = room.layout.position_m + room.hand_m
    facts = replace(_facts(room, rough_m), sketch_std_m=HAND_STD_M, keep_positions=True)
    return _aligned(room, _written(room, rough_m, run_survey(ranges, facts), AccuracySite()))


def surveyed_room(room: DrawnRoom, ranges: PairRanges, *, with_tape: bool = False, is_exact: bool = False) -> Site:
    """A file of which positions, delays and their accuracy come from a survey that started from a sketch.

    ``with_tape``: the distance that the survey asks for has been measured. ``is_exact``: the survey knows that delays
    are right and pairs without errors, and the file states ranges without errors.
    """
    rough_m = room.layout.position_m + room.sketch_m
    facts = _facts(room, rough_m)
    if is_exact:
        facts = replace(facts, delay_std_m=0.0, pair_std_m=0.0)
    survey = run_survey(ranges, facts)
    if with_tape and survey.tapes:
        a, b = survey.tapes[0].a, survey.tapes[0].b
        at_m = dict(zip(room.layout.anchors, room.layout.position_m, strict=True))
        measured_m = float(np.linalg.norm(at_m[a] - at_m[b])) + room.tape_m
        survey = run_survey(ranges, replace(facts, tapes=(Tape(a, b, measured_m, TAPE_STD_M),)))
    return _aligned(room, _written(room, rough_m, survey, EXACT if is_exact else AccuracySite()))


def _facts(room: DrawnRoom, rough_m: Array) -> Facts:
    layout = room.layout
    sketch: dict[int, Point] = {
        anchor: (x, y, z) for anchor, (x, y, z) in zip(layout.anchors, rough_m.tolist(), strict=True)
    }
    return Facts(dimensions=layout.dimensions, heights_m=layout.heights_m, sketch_m=sketch, sketch_std_m=SKETCH_STD_M)


def _written(room: DrawnRoom, rough_m: Array, survey: Survey, accuracy: AccuracySite) -> Site:
    """``accuracy``: as the file stated it before."""
    return surveyed_site(replace(site_at(room.layout, rough_m, room.noise_ps), accuracy=accuracy), survey)


def _aligned(room: DrawnRoom, site: Site) -> Site:
    """The site with its positions moved to the frame of the truth."""
    stated_m = anchor_positions(site)
    moved_m = aligned(stated_m, room.layout.position_m, room.layout.dimensions)
    anchors = tuple(
        replace(anchor, x_m=x_m, y_m=y_m, z_m=z_m)
        for anchor, (x_m, y_m, z_m) in zip(site.anchors, moved_m.tolist(), strict=True)
    )
    return replace(site, anchors=anchors)
