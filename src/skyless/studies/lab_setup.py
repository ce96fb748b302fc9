"""Where most studies take place: the lab, and tags that walk about in it."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from skyless.evaluation.scenarios import WALL_MARGIN_M, Request, impairments_of, trajectories_of
from skyless.kernels.arrays import Array
from skyless.positioning.integrity import IntegrityRequirement
from skyless.simulation.impairments import Impairments
from skyless.simulation.trajectory import Trajectory
from skyless.site.lab import ideal_lab_site
from skyless.site.model import AnchorSite, Site
from skyless.studies.plan import Plan, seed_of
from skyless.studies.worlds import Run

WARMUP_S: Final = 4.0
"""No fix is judged before; cold starts of the lab take a tenth of a second, those with 90 % loss some seconds."""

HALL_SCALE: Final = 2.5


def hall_site(noise_ps: float) -> Site:
    """The lab at 15 m × 20 m: room for 5 m/s, and the same dilution of precision at the corresponding places."""
    lab = ideal_lab_site(noise_ps)
    anchors = tuple(replace(one, x_m=HALL_SCALE * one.x_m, y_m=HALL_SCALE * one.y_m) for one in lab.anchors)
    return replace(lab, name="hall", anchors=anchors)


def walking(plan: Plan, site: Site | None = None, **options: Any) -> tuple[Run, ...]:  # noqa: ANN401 - of ``worlds``
    """Worlds of the lab, or another site, with tags that walk at 1 m/s from point to point."""
    place = site or ideal_lab_site(plan.noise_ps)

    def paths(seed: int) -> Sequence[Trajectory]:
        return trajectories_of(Request(place, seed=seed, tags=plan.tags))

    return worlds(plan, place, paths, **options)


def worlds(
    plan: Plan,
    site: Site,
    paths: Callable[[int], Sequence[Trajectory]],
    *,
    assumed: Site | None = None,
    change: Callable[[Impairments], Impairments] | None = None,
    warmup_s: float = WARMUP_S,
    seconds: float | None = None,
    count: int | None = None,
    lost_at_tags: float = 0.0,
    integrity: IntegrityRequirement = IntegrityRequirement(),  # noqa: B008 - a frozen value
    **faults: Any,  # noqa: ANN401 - of a Request
) -> tuple[Run, ...]:
    """Worlds of a case; those of the same number have the same seed in all cases of a study.

    ``paths`` is given a world's seed. The crystals and stamps are as ``site`` says; the filters assume what ``assumed``
    says, if that is given. ``faults`` are fields of a ``Request``, or functions of the world's number that give them;
    ``change`` does what a request cannot say.
    """
    runs = []
    for number in range(count or plan.worlds):
        seed = seed_of(plan.seed, number)
        own = {name: fault(number) if callable(fault) else fault for name, fault in faults.items()}
        impairments = impairments_of(Request(site, seed=seed, **own), site)
        runs.append(
            Run(
                site=assumed or site,
                trajectories=tuple(paths(seed)),
                impairments=impairments if change is None else change(impairments),
                seed=seed,
                method=plan.method,
                qa=plan.qa,
                mesh=plan.mesh,
                warmup_s=warmup_s,
                until_s=warmup_s + (seconds or plan.seconds),
                lost_at_tags=lost_at_tags,
                integrity=integrity,
            )
        )
    return tuple(runs)


def box(site: Site) -> tuple[Array, Array]:
    """Lowest and highest corner of the space in which tags move, shape (3,): half a metre within the anchors."""
    places = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    low_m, high_m = places.min(axis=0) + WALL_MARGIN_M, places.max(axis=0) - WALL_MARGIN_M
    low_m[2] = high_m[2] = site.tags.height_m or 0.0
    return low_m, high_m


def anchor_of(site: Site, number: int) -> AnchorSite:
    """Another anchor for each world in turn, the master among them."""
    return site.anchors[number % len(site.anchors)]
