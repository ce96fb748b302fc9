"""The study ``integrity``: whether ``joint``'s protection levels hold while one anchor's packets are late.

Matched episodes of the filter itself, as in ``efficiency``. In the middle of each, the tag's receptions of one anchor
drawn by chance become late, at once or more and more, or wrong in other ways (``Fault``). Every fix from then on is an
epoch. Misleading is an epoch whose error exceeds the level that the fix gives; available is one that gives a level.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.estimator.estimator import Packets
from skyless.core.estimator.process import ACCEPTED, JOINED
from skyless.core.geometry import anchor_positions
from skyless.core.integrity import CONTRADICTED, HPL, VPL
from skyless.core.ticks import TICK_M
from skyless.research.studies.efficiency import (
    START_STD_M,
    Case,
    Episode,
    draw_episode,
    episode_cells,
    settings_of,
    tracked,
)
from skyless.research.studies.picture import clustered_interval
from skyless.research.studies.runner import Cell, Limit, Plan, Row, of_cases, with_limits
from skyless.sim.evaluation.scenarios import ROOM_QA_M2PS3
from skyless.sim.lab import paper_lab_site

_ONSETS: Final = (40, 67)
"""Superframes between which the fault begins; the filter has settled long before."""

_EPISODE_COST_S: Final = 0.008
"""Approximate CPU time of an episode."""

_MIN_LARGEST: Final = 100
"""A chunk returns at least this number of its largest errors, and ten times its epochs times the risk."""

MAX_LEVEL_RATIO: Final = 1.5
ALL_FAULTS: Final = "all faults"

_CORNERS_M: Final = ((0, 0), (4, 0), (8, 0), (8, 3), (8, 6), (4, 6), (0, 6), (0, 3))

Kind = Literal["step", "ramp", "early", "bursts", "delay"]

_SIZES_M: Final = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
_FEW_SIZES_M: Final = (0.1, 0.3, 1.5)

_RAMP_S: Final = 1.0
FAULT_BURST_S: Final = 0.25

_WORDS: Final[dict[Kind, str]] = {
    "step": "step",
    "ramp": "ramp to",
    "early": "early by",
    "bursts": "bursts of",
    "delay": "TX delay",
}


class IntegrityRow(Row, frozen=True, kw_only=True):
    """Results of the episodes of a fault."""

    risk: float
    """Stated probability that a fix's error exceeds its protection level."""
    hmi: float
    """Share of fixes with a level whose horizontal error exceeds it."""
    hmi_interval: tuple[float, float]
    """99 % confidence interval of that share."""
    hmi_vertical: float | None = None
    hmi_vertical_interval: tuple[float, float] | None = None
    hpl_m: float | None = None
    """Horizontal level of the fixes with one: mean of the chunks' medians."""
    vpl_m: float | None = None
    smallest_m: float
    """Horizontal error that the share ``risk`` of fixes exceeds, with or without a level."""


class Fault(Struct, frozen=True):
    """The fault of one anchor in all episodes of a case: late or early messages, or wrong delays."""

    scene: str
    """``lab``, with the height given, or ``room``, where it is a state."""
    size_m: float = 0.0
    kind: Kind = "step"
    """From the onset on the tag's receptions are late (step), more and more for a second (ramp), early, or late every
    other quarter of a second (bursts); or all receptions of the anchor are, as its antenna delay is wrong (delay)."""

    @property
    def name(self) -> str:
        """The name of its row."""
        return f"{self.scene}, clean" if self.size_m == 0.0 else f"{self.scene}, {_WORDS[self.kind]} {self.size_m:g} m"

    @property
    def series(self) -> str:
        """Faults that differ by nothing but their size."""
        return f"{self.scene}, {_WORDS[self.kind].split()[0] if self.kind != 'delay' else 'TX delay'}"


FAULTS: Final = tuple(
    fault
    for scene in ("lab", "room")
    for fault in (
        Fault(scene),
        *(Fault(scene, size_m, kind) for kind in ("step", "ramp") for size_m in _SIZES_M),
        *(Fault(scene, size_m, kind) for kind in ("early", "bursts", "delay") for size_m in _FEW_SIZES_M),
    )
)


def faulty(episode: Episode, fault: Fault, anchor: int, onset: int, slot_s: float) -> Packets:
    """The episode's packets with the anchor's fault, from the packet ``onset`` on."""
    packets = episode.packets
    size = fault.size_m / TICK_M
    share = _share((np.arange(len(packets.anchors)) - onset) * slot_s, fault.kind)
    late = np.where(packets.anchors == anchor, np.rint(size * share), 0.0).astype(np.int64)
    relays = packets.relays
    if fault.kind == "delay":
        begun = packets.sequences[onset]  # an episode is shorter than sequence numbers take to come around
        heard_late = (relays[:, 1] == anchor) & (relays[:, 2] >= begun)
        relays = relays.copy()
        relays[heard_late, 3] += round(size)
    return replace(packets, rx_ticks=packets.rx_ticks + late, relays=relays)


def _share(since_s: NDArray[np.floating[Any]], kind: Kind) -> Array:
    """Share of the fault at each time, from −1 to 1."""
    if kind == "ramp":
        return np.asarray(np.clip(since_s / _RAMP_S, 0.0, 1.0), np.float64)
    on = since_s >= 0.0
    if kind == "bursts":
        on &= since_s % (2.0 * FAULT_BURST_S) < FAULT_BURST_S
    return np.where(on, -1.0 if kind == "early" else 1.0, 0.0)


class Chunk(Struct, frozen=True):
    """Results of the episodes of a chunk."""

    counts: Array
    """Fixes of each episode, fixes with a level, misleading ones (horizontal, vertical), shape (episodes, 4)."""
    squared_m2: float
    """Sum of the squared horizontal errors."""
    medians_m: tuple[float, float] | None
    """Medians of both levels; None where no fix has one."""
    top: Array
    """The largest horizontal errors over their levels."""
    errors_m: Array
    """The largest horizontal errors."""


def anchors_of(scene: str) -> Array:
    """Positions, shape (n, 3), in a frame in which tags walk at height 0."""
    if scene == "lab":
        return anchor_positions(paper_lab_site())
    return np.array([(x, y, 1.3 if k % 2 else -0.7) for k, (x, y) in enumerate(_CORNERS_M)], float)


def cells(plan: Plan) -> list[Cell]:
    """Episodes in chunks. Raises SkylessError if the method gives no protection levels."""
    if plan.method != "joint":
        raise SkylessError(f"--method is {plan.method!r}; protection levels are given by joint")
    return [
        cell
        for fault, seed in zip(FAULTS, SeedSequence(plan.seed).spawn(len(FAULTS)), strict=True)
        for cell in episode_cells(fault.name, partial(run_chunk, plan, fault), seed, plan, _EPISODE_COST_S)
    ]


def run_chunk(plan: Plan, fault: Fault, seeds: Sequence[SeedSequence]) -> Chunk:
    """Run some episodes."""
    episodes = [_run(plan, fault, default_rng(seed)) for seed in seeds]
    counts = [
        (len(across), available.sum(), (available & (across > hpl)).sum(), (available & (above > vpl)).sum())
        for across, above, hpl, vpl, available in episodes
    ]
    across, _, hpl, vpl, available = (np.concatenate(part) for part in zip(*episodes, strict=True))
    most = max(_MIN_LARGEST, int(10.0 * plan.integrity_risk * len(across)))
    return Chunk(
        counts=np.array(counts, float),
        squared_m2=float(across @ across),
        medians_m=(float(np.median(hpl[available])), float(np.median(vpl[available]))) if available.any() else None,
        top=np.sort(across[available] / hpl[available])[-most:],
        errors_m=np.sort(across)[-most:],
    )


def _run(plan: Plan, fault: Fault, draw: Generator) -> tuple[NDArray[Any], ...]:
    """Horizontal and vertical errors, both levels, and whether they are available, of all fixes since the onset."""
    anchors_m, slot_s = anchors_of(fault.scene), paper_lab_site().schedule.slot_s
    case = Case(plan.noise_ps, qa=ROOM_QA_M2PS3, mesh=True)
    episode = draw_episode(draw, anchors_m, slot_s, case)
    onset = int(draw.integers(*_ONSETS)) * len(anchors_m)
    packets = faulty(episode, fault, int(draw.integers(len(anchors_m))), onset, slot_s)
    height_m = 0.0 if fault.scene == "lab" else None
    settings, dim = settings_of(case, height_m).changed(integrity_risk=plan.integrity_risk), 3 - (height_m is not None)
    rows = tracked(settings, anchors_m, packets, episode.path_m[0] + draw.normal(0.0, START_STD_M, 3), has_levels=True)
    fixes = np.flatnonzero(np.isin(rows["outcome"][onset:], (ACCEPTED, JOINED))) + onset
    errors, given = np.zeros((len(fixes), 3)), rows["levels"][fixes]
    errors[:, :dim] = rows["position_m"][fixes, :dim] - episode.path_m[fixes, :dim]
    vpl = given[:, VPL] if dim == 3 else np.full(len(fixes), np.inf)
    available = rows["integrity"][fixes] < CONTRADICTED
    if plan.alert_limit_m is not None:
        available &= given[:, HPL] <= plan.alert_limit_m
    return np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2]), given[:, HPL], vpl, available


def rows(plan: Plan, results: Sequence[Any]) -> list[IntegrityRow]:
    """A row for each fault, and one for all together; the results stand in the order of ``cells``."""
    of_faults = of_cases(FAULTS, results)
    single = [_row(plan, fault, chunks) for fault, chunks in of_faults]
    wrong = [chunk for fault, chunks in of_faults if fault.size_m > 0.0 for chunk in chunks]
    return [*single, _pooled(plan, ALL_FAULTS, ALL_FAULTS, None, wrong)]


def _row(plan: Plan, fault: Fault, chunks: Sequence[Chunk]) -> IntegrityRow:
    row = _pooled(plan, fault.name, fault.series, fault.size_m, chunks, vertical=fault.scene == "room")
    if fault.size_m > 0.0:
        return row
    ratio = 1.0 / _quantile([chunk.top for chunk in chunks], plan.integrity_risk, row.fixes)
    judged = with_limits(replace(row, ratio=ratio), (Limit("ratio", most=MAX_LEVEL_RATIO),))
    return replace(judged, passed=judged.passed and row.passed)


def _pooled(
    plan: Plan, case: str, series: str, x: float | None, chunks: Sequence[Chunk], *, vertical: bool = False
) -> IntegrityRow:
    """A row of some chunks; it passes unless the risk lies below the interval."""
    counts = np.concatenate([chunk.counts for chunk in chunks])
    epochs, available = int(counts[:, 0].sum()), float(counts[:, 1].sum())
    intervals = [clustered_interval(counts[:, column], epochs) for column in (2, 3)]
    medians = np.array([chunk.medians_m for chunk in chunks if chunk.medians_m is not None])
    hpl_m, vpl_m = medians.mean(axis=0).tolist() if len(medians) else (None, None)
    return IntegrityRow(
        study="integrity",
        method=plan.method,
        case=case,
        series=series,
        x=x,
        mesh=True,
        noise_ps=plan.noise_ps,
        runs=len(counts),
        fixes=epochs,
        rmse_m=float(np.sqrt(sum(chunk.squared_m2 for chunk in chunks) / epochs)),
        max_m=float(max(chunk.errors_m[-1] for chunk in chunks)),
        available=available / epochs,
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
    """The value that the share ``risk`` of ``count`` values exceeds, from the largest of each chunk."""
    values = np.sort(np.concatenate(largest))
    return float(values[-max(int(np.ceil(risk * count)), 1)])
