"""The study ``loss``: how the error grows with the share of lost messages, at the tags or between anchors as well."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from skyless.research.studies.common.plan import Cell, Plan, Row, seed_of
from skyless.research.studies.common.summary import RAW_METHODS, Case, world_cells, world_rows
from skyless.research.studies.common.worlds import Run, walking
from skyless.research.uncertainty.bounds import BoundSettings, known_receptions, received_bound

_SHARES: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_QUICK_SHARES: Final = (0.3, 0.5, 0.7, 0.9)
MAX_RATIOS: Final = {0.5: 1.3, 0.9: 2.5}
_NOTHING_LOST: Final = "nothing lost"

AT_TAGS: Final = "lost at tags"
EVERYWHERE: Final = "lost everywhere"


def cases(plan: Plan) -> list[Case]:
    """Both kinds of loss, one case for each share."""
    nothing_lost = walking(plan)
    shares = _QUICK_SHARES if plan.quick else _SHARES
    return [
        Case(_NOTHING_LOST, AT_TAGS, 0.0, nothing_lost, _NOTHING_LOST),
        *(
            Case(_name(s, AT_TAGS), AT_TAGS, s, walking(plan, lost_at_tags=s), _NOTHING_LOST, MAX_RATIOS.get(s))
            for s in shares
        ),
        *(
            Case(_name(s, EVERYWHERE), EVERYWHERE, s, walking(plan, loss=s), _NOTHING_LOST, MAX_RATIOS.get(s))
            for s in shares
        ),
    ]


def _name(share: float, kind: str) -> str:
    return f"{100 * share:.0f} % {kind}"


_BOUND_S: Final = 9.0
_BOUND_FROM_S: Final = 3.0
_BOUND_EPISODES: Final = 24
"""Episodes from which the bound is computed."""
_BOUND_COST_S: Final = 1.0
"""About what the bound of a case takes to compute."""

_SPEED_STD_MPS: Final = 1.0
_BOUND_KEY: Final = 17
"""Key of the stream of random numbers that decides what is lost."""


def cells(plan: Plan) -> list[Cell]:
    """The worlds of all cases, then the bound of each case."""
    each = cases(plan)
    bounds = [Cell(case.name, partial(bound_m, case.runs, plan), _BOUND_COST_S) for case in each]
    return [*world_cells(each), *bounds]


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each case, with the bound of all receptions in such worlds."""
    each = cases(plan)
    worlds = world_rows("loss", plan, each, results[: -len(each)])
    return [replace(row, bound_m=bound) for row, bound in zip(worlds, results[-len(each) :], strict=True)]


def bound_m(runs: Sequence[Run], plan: Plan) -> float | None:
    """Root mean square of the posterior bound when the tags make the fixes that are judged.

    Of tags that accelerate at random with the process noise that filters assume, at the positions where tags of the
    worlds walk: these themselves keep their speed, which filters do not know.
    """
    variances = [_variances(runs[number % len(runs)], plan, number) for number in range(_BOUND_EPISODES)]
    judged = np.concatenate(variances)
    return float(np.sqrt(judged.mean())) if len(judged) else None


def _variances(run: Run, plan: Plan, number: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Traces of the bound at the first frame of each superframe that the tag receives."""
    site, noise = run.site, run.site.noise
    anchors_m = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    n, slot_s = len(anchors_m), site.schedule.slot_s
    superframes = int(_BOUND_S / (n * slot_s))
    tag = run.trajectories[number % len(run.trajectories)]
    times = run.warmup_s + slot_s * np.arange(n * superframes)
    path_m = np.array([tag.position(float(t)) for t in times])
    everywhere = run.impairments.channel.loss_probability
    known = known_receptions(
        np.random.default_rng(seed_of(plan.seed, number, _BOUND_KEY)),
        len(times),
        n,
        lost_at_tags=1.0 - (1.0 - run.lost_at_tags) * (1.0 - everywhere),
        lost_at_anchors=everywhere,
        mesh=run.method in RAW_METHODS,
    )
    settings = BoundSettings(
        noise.rx_stamp_ps * 1e-12,
        white_fm=noise.white_fm,
        random_walk_fm=noise.random_walk_fm,
        qa=run.qa,
        slot_s=slot_s,
        speed_std_mps=_SPEED_STD_MPS,
        mesh=True,
        height_known=site.tags.height_m is not None,
    )
    traces = np.trace(received_bound(anchors_m, path_m, settings, known), axis1=1, axis2=2).reshape(superframes, n)
    heard = known[:, -1].reshape(superframes, n)
    begin = int(_BOUND_FROM_S / (n * slot_s))
    firsts = traces[np.arange(superframes), heard.argmax(axis=1)]
    judged: np.ndarray[Any, np.dtype[np.float64]] = firsts[begin:][heard[begin:].any(axis=1)]
    return judged
