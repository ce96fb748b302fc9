"""The Cramér–Rao bound of the study ``room``: what the best receiver could make of the worlds of a case.

It is that of all that is on the air, for errors of survey and ranges with the variances with which the worlds draw
them, whatever a site file says of them. It is defined where these errors are all that is wrong and tags accelerate at
random; that these are also held in the room by a spring and damping is left out, as no receiver is told.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.evaluation.room_world import QA_M2PS3, Room
from skyless.kernels.arrays import Array
from skyless.studies.plan import Cell, Row
from skyless.studies.summary import Case, jackknife
from skyless.studies.worlds import Run, RunResult
from skyless.uncertainty.bounds import Biases, biased_bound, bound_settings

SPEED_STD_MPS: Final = 1.0
"""Before the first frame; after the second and a half for which nothing is judged nothing of it is left."""

UPDATE_S: Final = 1e-6
"""About what the bound takes for one measurement."""


class BoundRun(Struct, frozen=True):
    """A world, and what is drawn in it."""

    run: Run
    biases: Biases


def biases_of(room: Room | None) -> Biases:
    """What a room's survey and ranges are off by, as standard deviations; its slope is as large as one of them."""
    if room is None:
        return Biases()
    ranges = room.ranges
    return Biases(
        survey_std_m=room.axis_std_m,
        constant_std_m=ranges.constant_m / math.sqrt(3.0),
        changing_std_m=ranges.changing_m,
        slope_std_m=ranges.slope_m,
        correlation_s=ranges.correlation_s or math.inf,
        correlation_m=ranges.correlation_m or math.inf,
    )


def bound_cells(cases: Sequence[Case]) -> list[Cell]:
    """One cell for each world of the cases that have a bound."""
    return [
        Cell(case.name, bound_variance_m2, BoundRun(run, case.biases), _weight_s(run))
        for case in cases
        if case.biases is not None
        for run in case.runs
    ]


def _weight_s(run: Run) -> float:
    return UPDATE_S * 2.0 * len(run.trajectories) * len(run.site.anchors) * run.until_s / run.site.schedule.slot_s


def bound_variance_m2(told: BoundRun) -> float:
    """Trace of the bound, its mean over all tags of a world and the superframes in which fixes are judged."""
    run = told.run
    site, noise = run.site, run.impairments
    off_m = {one.anchor: (one.x_m, one.y_m, one.z_m) for one in noise.anchor_displacements}
    anchors_m = np.array(
        [np.add((one.x_m, one.y_m, one.z_m), off_m.get(one.id, (0.0, 0.0, 0.0))) for one in site.anchors]
    )
    superframe_s = len(anchors_m) * site.schedule.slot_s
    settings = bound_settings(
        noise.rx_stamp_ps * 1e-12,
        white_fm=noise.oscillator.white_fm,
        random_walk_fm=noise.oscillator.random_walk_fm,
        qa=QA_M2PS3,
        slot_s=site.schedule.slot_s,
        speed_std_mps=SPEED_STD_MPS,
        mesh=run.mesh,
        height_known=site.tags.height_m is not None,
        at_once=False,
    )
    frames = int(run.until_s / superframe_s) * len(anchors_m)
    first = int(run.warmup_s / superframe_s)
    means = []
    for tag in run.trajectories:
        path_m = np.array([tag.position(frame * site.schedule.slot_s) for frame in range(frames)])
        bound = biased_bound(anchors_m, path_m, settings, told.biases)[first:]
        means.append(np.trace(bound, axis1=1, axis2=2).mean())
    return float(np.mean(means))


def with_bound(row: Row, worlds: Sequence[RunResult], variances_m2: Sequence[float]) -> Row:
    """The row with the bound of its worlds, and the RMSE over it."""
    sums = np.array(
        [(a.fixes, a.squared_m2, variance) for a, variance in zip(worlds, variances_m2, strict=True)], np.float64
    )
    row = replace(row, bound_m=float(np.sqrt(np.mean(variances_m2))))
    if row.fixes == 0:
        return row
    ratio, ratio_error = jackknife(sums, _ratio)
    passed = None if row.limit is None else ratio <= row.limit
    return replace(row, ratio=ratio, ratio_error=ratio_error, passed=passed)


def _ratio(sums: Array) -> float:
    fixes = sums[:, 0].sum()
    return float(np.sqrt(sums[:, 1].sum() / fixes / sums[:, 2].mean())) if fixes else np.nan
