"""The study ``integrity``: whether ``joint``'s protection levels hold while one anchor's packets are late.

Matched episodes of the filter itself, as in ``efficiency``. In the middle of each, the tag's receptions of one anchor
drawn by chance become late, at once or more and more, or go wrong in other ways (``integrity_faults``). Every fix from
then on is an epoch.
Misleading is an epoch whose error exceeds the level that the fix gives; available is one that gives a level.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from skyless.errors import SkylessError
from skyless.evaluation.lab_bound import SPEED_STD_MPS
from skyless.kernels.arrays import Array
from skyless.positioning.estimator.estimator import ACCEPTED, JOINED, Estimator, Packets
from skyless.positioning.estimator.levels import LEVELS
from skyless.positioning.integrity import CONTRADICTED, HPL, VPL
from skyless.site.lab import ideal_lab_site
from skyless.studies.clustered_intervals import rare_interval
from skyless.studies.episodes import Case, draw_episode, settings_of
from skyless.studies.integrity_faults import FAULTS, Fault, faulty
from skyless.studies.plan import Cell, Plan, Row

SUPERFRAMES: Final = 134
ONSETS: Final = (40, 67)
"""Superframes between which the fault begins; the filter has settled long before."""

START_STD_M: Final = 0.3
CHUNK: Final = 50
EPISODE_S: Final = 0.008
"""About what an episode takes."""

TOP: Final = 100
"""So many of the largest errors a chunk tells at least, and ten times the share of its epochs that the risk is."""

OUTCOME, SOUNDNESS = LEVELS, LEVELS + 1
"""What became of a packet and what can be said of the position, behind its levels."""

MOST_RATIO: Final = 1.5
ALL: Final = "all faults"

_CORNERS_M: Final = ((0, 0), (4, 0), (8, 0), (8, 3), (8, 6), (4, 6), (0, 6), (0, 3))


class Setting(Struct, frozen=True):
    """What all episodes of a row have in common."""

    case: Case
    fault: Fault
    risk: float
    alert_limit_m: float | None = None
    """Fixes with a higher level count as not available."""


class Chunk(Struct, frozen=True):
    """What the episodes of a chunk came to."""

    counts: Array
    """Of each episode the fixes, those with a level, misleading ones (horizontal, vertical), shape (episodes, 4)."""
    squared_m2: float
    """Sum of the squared horizontal errors."""
    medians_m: tuple[float, float] | None
    """Of both levels; None where no fix has one."""
    top: Array
    """The largest horizontal errors over their levels."""
    errors_m: Array
    """The largest horizontal errors."""


def anchors_of(place: str) -> Array:
    """Positions, shape (n, 3), in a frame in which tags walk at height 0."""
    if place == "lab":
        return np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in ideal_lab_site().anchors])
    return np.array([(x, y, 1.3 if k % 2 else -0.7) for k, (x, y) in enumerate(_CORNERS_M)], float)


def cells(plan: Plan) -> list[Cell]:
    """Episodes in chunks.

    Raises:
        SkylessError: the method gives no protection levels.
    """
    if plan.method != "joint":
        raise SkylessError(f"--method is {plan.method!r}; protection levels are given by joint")
    case = Case(plan.noise_ps, qa=plan.qa, mesh=plan.mesh)
    seeds = SeedSequence(plan.seed).spawn(len(FAULTS))
    found = []
    for fault, seed in zip(FAULTS, seeds, strict=True):
        setting = Setting(case, fault, plan.integrity_risk, plan.alert_limit_m)
        own = tuple(seed.spawn(plan.episodes))
        parts = [own[first : first + CHUNK] for first in range(0, plan.episodes, CHUNK)]
        found += [Cell(fault.name, run_chunk, (setting, part), EPISODE_S * len(part)) for part in parts]
    return found


def run_chunk(argument: tuple[Setting, tuple[SeedSequence, ...]]) -> Chunk:
    """Run some episodes."""
    setting, seeds = argument
    episodes = [_run(setting, default_rng(seed)) for seed in seeds]
    counts = [
        (len(across), promised.sum(), (promised & (across > hpl)).sum(), (promised & (above > vpl)).sum())
        for across, above, hpl, vpl, promised in episodes
    ]
    across, _, hpl, vpl, promised = (np.concatenate(part) for part in zip(*episodes, strict=True))
    most = max(TOP, int(10.0 * setting.risk * len(across)))
    return Chunk(
        counts=np.array(counts, float),
        squared_m2=float(across @ across),
        medians_m=(float(np.median(hpl[promised])), float(np.median(vpl[promised]))) if promised.any() else None,
        top=np.sort(across[promised] / hpl[promised])[-most:],
        errors_m=np.sort(across)[-most:],
    )


def _run(setting: Setting, draw: Generator) -> tuple[NDArray[Any], ...]:
    """Horizontal and vertical errors, both levels, and whether they are promised, of all fixes since the onset."""
    anchors_m, slot_s = anchors_of(setting.fault.place), ideal_lab_site().schedule.slot_s
    episode = draw_episode(draw, anchors_m, slot_s, setting.case, SUPERFRAMES)
    onset = int(draw.integers(*ONSETS)) * len(anchors_m)
    packets = faulty(episode, setting.fault, int(draw.integers(len(anchors_m))), onset, slot_s)
    motions, levels = _filtered(setting, anchors_m, packets, episode.path_m[0] + draw.normal(0.0, START_STD_M, 3))
    fixes = np.flatnonzero(np.isin(levels[onset:, OUTCOME], (ACCEPTED, JOINED))) + onset
    errors, told = np.zeros((len(fixes), 3)), levels[fixes]
    dim = motions.shape[1] // 2
    errors[:, :dim] = motions[fixes, :dim] - episode.path_m[fixes, :dim]
    vpl = told[:, VPL] if dim == 3 else np.full(len(fixes), np.inf)
    promised = told[:, SOUNDNESS] < CONTRADICTED
    if setting.alert_limit_m is not None:
        promised &= told[:, HPL] <= setting.alert_limit_m
    return np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2]), told[:, HPL], vpl, promised


def _filtered(setting: Setting, anchors_m: Array, packets: Packets, start_m: Array) -> tuple[Array, Array]:
    """Motions and levels after every packet."""
    height_m = 0.0 if setting.fault.place == "lab" else None
    settings = replace(settings_of(setting.case, height_m), integrity_risk=setting.risk)
    estimator = Estimator(settings, anchors_m)
    dim, n = estimator.dim, len(packets.anchors)
    estimator.start(int(packets.rx_ticks[0]), start_m[:dim], START_STD_M**2 * np.eye(dim), SPEED_STD_MPS**2)
    motions, levels = np.empty((n, 2 * dim)), np.zeros((n, LEVELS + 2))
    estimator.track(packets, motions, levels=levels)
    return motions, levels


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each fault, and one for all together; the results stand in the order of ``cells``."""
    each = -(-plan.episodes // CHUNK)
    parts = [results[each * number : each * (number + 1)] for number in range(len(FAULTS))]
    single = [_row(plan, fault, chunks) for fault, chunks in zip(FAULTS, parts, strict=True)]
    wrong = [chunk for fault, chunks in zip(FAULTS, parts, strict=True) if fault.size_m > 0.0 for chunk in chunks]
    return [*single, _pooled(plan, ALL, ALL, None, wrong)]


def _row(plan: Plan, fault: Fault, chunks: Sequence[Chunk]) -> Row:
    row = _pooled(plan, fault.name, fault.series, fault.size_m, chunks, vertical=fault.place == "room")
    if fault.size_m > 0.0:
        return row
    ratio = 1.0 / _quantile([chunk.top for chunk in chunks], plan.integrity_risk, row.fixes)
    passed = bool(row.passed) and ratio <= MOST_RATIO
    return replace(row, ratio=ratio, limit=MOST_RATIO, passed=passed)


def _pooled(
    plan: Plan, case: str, series: str, x: float | None, chunks: Sequence[Chunk], *, vertical: bool = False
) -> Row:
    """What some chunks came to; it passes unless the risk lies below the interval."""
    counts = np.concatenate([chunk.counts for chunk in chunks])
    epochs, promised = int(counts[:, 0].sum()), float(counts[:, 1].sum())
    intervals = [rare_interval(counts[:, column], epochs) for column in (2, 3)]
    medians = np.array([chunk.medians_m for chunk in chunks if chunk.medians_m is not None])
    hpl_m, vpl_m = medians.mean(axis=0).tolist() if len(medians) else (None, None)
    return Row(
        study="integrity",
        method=plan.method,
        case=case,
        series=series,
        x=x,
        mesh=plan.mesh,
        noise_ps=plan.noise_ps,
        runs=len(counts),
        fixes=epochs,
        rmse_m=float(np.sqrt(sum(chunk.squared_m2 for chunk in chunks) / epochs)),
        max_m=float(max(chunk.errors_m[-1] for chunk in chunks)),
        available=promised / epochs,
        passed=all(low <= plan.integrity_risk for low, _ in intervals),
        risk=plan.integrity_risk,
        hmi=float(counts[:, 2].sum()) / epochs,
        hmi_interval=intervals[0],
        hmi_vertical=float(counts[:, 3].sum()) / epochs if vertical else None,
        hmi_vertical_interval=intervals[1] if vertical else None,
        hpl_m=hpl_m,
        vpl_m=vpl_m if vertical else None,
        smallest_m=_quantile([chunk.errors_m for chunk in chunks], plan.integrity_risk, epochs),
    )


def _quantile(largest: Sequence[Array], risk: float, count: float) -> float:
    """What the share ``risk`` of so many values exceeds, from the largest of each chunk."""
    values = np.sort(np.concatenate(largest))
    return float(values[-max(int(np.ceil(risk * count)), 1)])
