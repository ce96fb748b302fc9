"""The study ``scale``: what a tag costs and how accurate it is: one to ten thousand tags, four to sixty anchors."""

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.core.site import AnchorSite, Site
from skyless.research.studies.common.plan import Plan
from skyless.research.studies.common.summary import Case
from skyless.research.studies.common.worlds import box, worlds
from skyless.research.studies.motion import still
from skyless.sim.trajectory import Trajectory
from skyless.sim.world import paper_lab_site

_FLEET_WARMUP_S: Final = 1.0
_FLEET_S: Final = 0.5
"""Fleets of all sizes are judged in the same stretch of time, short enough for ten thousand tags."""

_FLEETS: Final = ((1, 48), (10, 24), (100, 12), (1_000, 4), (10_000, 2))
"""Numbers of tags, and of worlds with them."""
_QUICK_FLEETS: Final = ((1, 24), (10, 12), (100, 4), (1_000, 2))

_ANCHORS: Final = (4, 6, 8, 12, 20, 30, 45, 60)
_QUICK_ANCHORS: Final = (4, 8, 20, 60)
_RING_ROOM_M: Final = (12.0, 16.0)


def cases(plan: Plan) -> list[Case]:
    """Tags that lie still, in the lab, and in a room with anchors on a ring."""
    return [*_fleets(plan), *_rings(plan)]


def _fleets(plan: Plan) -> list[Case]:
    lab = paper_lab_site(plan.noise_ps)
    return [
        Case(
            f"{tags} tag{'s' if tags > 1 else ''}",
            "tags",
            float(tags),
            worlds(plan, lab, partial(_still_tags, lab, tags), warmup_s=_FLEET_WARMUP_S, seconds=_FLEET_S, count=count),
        )
        for tags, count in (_QUICK_FLEETS if plan.quick else _FLEETS)
    ]


def _rings(plan: Plan) -> list[Case]:
    seconds = min(plan.seconds, 10.0)
    return [
        Case(
            f"{count} anchors",
            "anchors in view",
            float(count),
            worlds(plan, ring(plan, count), partial(_still_tags, ring(plan, count), plan.tags), seconds=seconds),
        )
        for count in (_QUICK_ANCHORS if plan.quick else _ANCHORS)
    ]


def _still_tags(site: Site, tags: int, seed: int) -> Sequence[Trajectory]:
    draw = np.random.default_rng(seed)
    low_m, high_m = box(site)
    return [still(draw, low_m, high_m) for _ in range(tags)]


def ring(plan: Plan, count: int) -> Site:
    """A site of ``count`` anchors, all in radio range of each other, evenly spread on an ellipse."""
    lab = paper_lab_site(plan.noise_ps)
    angles = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    positions = ((1.0 + np.column_stack([np.cos(angles), np.sin(angles)])) * np.array(_RING_ROOM_M) / 2.0).tolist()
    anchors = tuple(AnchorSite(id=number, x_m=x, y_m=y) for number, (x, y) in enumerate(positions, start=1))
    return replace(lab, name=f"ring of {count}", anchors=anchors)
