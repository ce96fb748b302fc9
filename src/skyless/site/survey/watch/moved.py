"""Whether an anchor was moved while its ranges were gathered: ranges from before and after it cannot be used together.

All splits of the time are compared. Ranges that differ by more than their own scatter explains, for two pairs of one
anchor or more, are explained as the watch of the anchors does: a link that was blocked for a while is no motion.
"""

import warnings
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.special import ndtri

from skyless.core.arrays import Array
from skyless.site.survey.facts import Facts, PairRange, PairRanges
from skyless.site.survey.result import Survey
from skyless.site.survey.stamps.pair_ranger import PairRanger, StepTable
from skyless.site.survey.stamps.repeats import STD_OVER_MAD
from skyless.site.survey.watch.explain import Pairs, Part, explain, sentence_of, weight_of

_MIN_STEPS: Final = 4  # in fewer, a change and the scatter of ranges look the same
_FALSE_ALARM: Final = 1e-3
"""Probability that the scatter of all ranges and splits alone makes one of them differ, where several have to."""

_MIN_PAIRS: Final = 2  # pairs of one anchor whose ranges differ
_DRIFT_FLOOR_M: Final = 0.02  # ranges of rooms wander by this much, and more slowly than steps follow one another

Solve = Callable[[PairRanges, Facts], Survey]


class Change(Struct, frozen=True):
    """Something at the anchors has changed."""

    sentence: str
    since_s: float
    """From this time on ranges agree."""


def change_of(table: StepTable, facts: Facts, solve: Solve) -> Change | None:
    """The largest change of anchors between earlier and later ranges; None where there is none."""
    steps = len(table.start_s)
    if steps < _MIN_STEPS:
        return None
    before_m, after_m, left_m = _splits(table.range_m)
    white_m2, drift_m2 = _scatter(table)
    std_m = np.sqrt(2.0 * (white_m2 + drift_m2))
    differs = np.abs(after_m - before_m) > -ndtri(_FALSE_ALARM / (2.0 * before_m.size)) * std_m
    anchors = sorted({anchor for pair in table.pairs for anchor in pair})
    ends = np.array([[anchor in pair for anchor in anchors] for pair in table.pairs])
    is_changed = (differs @ ends.astype(np.int64) >= _MIN_PAIRS).any(axis=1)
    if not is_changed.any():
        return None
    split = int(np.argmin(np.where(is_changed, left_m, np.inf)))
    part = _explained(table, before_m[split], after_m[split], white_m2, drift_m2, facts, solve)
    if part is None:
        return None
    # An anchor is on its way for a moment: the first step after the split is left out, if there is another one.
    since_s = float(table.start_s[min(split + 2, steps - 1)])
    return Change(sentence_of(part.kind, part.anchors, part.size_m, or_else=part.or_else), since_s)


def drop_moved(ranger: PairRanger, facts: Facts, solve: Solve) -> tuple[Change, ...]:
    """Drop the ranges from before each change until the rest agree. Returns the changes."""
    found: list[Change] = []
    while (change := change_of(ranger.steps.table(), facts, solve)) is not None:
        ranger.drop_before(change.since_s)
        found.append(change)
    return tuple(found)


def with_changes(survey: Survey, changes: tuple[Change, ...], duration_s: float) -> Survey:
    """The survey with what has changed while its ranges were gathered, of which ``duration_s`` are left."""
    left = f"only the {duration_s:.0f} s of ranges since then are used"
    notes = tuple(f"during the survey {one.sentence}; {left}" for one in changes)
    return replace(survey, notes=(*notes, *survey.notes))


def _splits(range_m: Array) -> tuple[Array, Array, Array]:
    """Medians before and since every split, shape (k - 1, m), and what they leave of the ranges, shape (k - 1,)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a pair may have no range on one side
        before = np.array([np.nanmedian(range_m[:split], axis=0) for split in range(1, len(range_m))])
        after = np.array([np.nanmedian(range_m[split:], axis=0) for split in range(1, len(range_m))])
    left = [
        np.nansum(np.abs(range_m[: index + 1] - before[index])) + np.nansum(np.abs(range_m[index + 1 :] - after[index]))
        for index in range(len(before))
    ]
    return before, after, np.array(left)


def _scatter(table: StepTable) -> tuple[Array, Array]:
    """Variance of a step's range from noise and from drift, shape (m,) each; a change makes few steps differ."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        white_m2 = np.nanmedian(table.variance_m2, axis=0)
        apart_m = np.nanmedian(np.abs(np.diff(table.range_m, axis=0)), axis=0)
    drift_m2 = np.maximum(np.nan_to_num(STD_OVER_MAD * apart_m) ** 2 / 2.0, _DRIFT_FLOOR_M**2)
    return np.maximum(white_m2, 1e-8), drift_m2


def _explained(
    table: StepTable, before_m: Array, after_m: Array, white_m2: Array, drift_m2: Array, facts: Facts, solve: Solve
) -> Part | None:
    """What has changed most, with identifiers of anchors; None where links alone were late."""
    in_both = np.flatnonzero(np.isfinite(after_m - before_m))
    pairs = [table.pairs[row] for row in in_both]
    stds_m = np.sqrt(white_m2 + drift_m2)[in_both]
    ranges = tuple(
        PairRange(a, b, range_m, std_m, 1)
        for (a, b), range_m, std_m in zip(pairs, before_m[in_both].tolist(), stds_m.tolist(), strict=True)
    )
    everybody = tuple(sorted({anchor for pair in pairs for anchor in pair}))
    found = solve(PairRanges(ranges, everybody), replace(facts, tags=()))
    placed = {one.id: (one.x_m, one.y_m, one.z_m) for one in found.anchors if one.determined}
    ids = sorted(placed)
    rows = np.array([row for row, (a, b) in zip(in_both.tolist(), pairs, strict=True) if {a, b} <= placed.keys()])
    if len(ids) < 3 or not len(rows):
        return None
    first, second = (np.array([ids.index(table.pairs[row][end]) for row in rows]) for end in (0, 1))
    both_sides = np.sqrt(2.0)
    weight = weight_of(
        first, second, len(ids), both_sides * np.sqrt(white_m2[rows]), both_sides * np.sqrt(drift_m2[rows])
    )
    position_m = np.array([placed[anchor] for anchor in ids], np.float64)
    parts = explain(Pairs(position_m, first, second, facts.dimensions, weight), (after_m - before_m)[rows]).parts
    causes = [part for part in parts if part.kind != "link"]
    if not causes:
        return None
    largest = max(causes, key=lambda part: abs(part.size_m))
    return replace(largest, anchors=tuple(ids[index] for index in largest.anchors))
