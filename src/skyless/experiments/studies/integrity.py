"""The study ``integrity``: whether ``joint``'s protection levels hold while one anchor's messages are late.

Matched episodes of the filter itself, as in ``efficiency``. In the middle of each, the tag's receptions of one anchor
drawn by chance become late: at once (step) or growing for a second (ramp). Every fix from then on is an epoch.
Misleading is an epoch whose error exceeds the level that the fix gives; available is one that gives a level.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.errors import SkylessError
from skyless.experiments.lab_bound import SPEED_STD_MPS, WHITE_FM
from skyless.experiments.studies.episodes import Case, Episode, draw_episode
from skyless.experiments.studies.plan import Cell, Plan, Row
from skyless.experiments.studies.summary import jackknife
from skyless.positioning.joint import JointFilter, JointSettings
from skyless.positioning.joint_hearing import REJECTED
from skyless.positioning.protection import RISK, limits_of, protected_track
from skyless.positioning.protection_levels import DETECTED, HPL, LEVELS, STATE, VPL
from skyless.site.lab import lab_site

Array = NDArray[np.float64]

SIZES_M: Final = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
RAMP_S: Final = 1.0
SUPERFRAMES: Final = 134
ONSETS: Final = (40, 67)
"""Superframes between which the fault begins; the filter has settled long before."""

START_STD_M: Final = 0.3
CHUNK: Final = 50
EPISODE_S: Final = 0.008
"""About what an episode takes."""

TOP: Final = 100
"""Largest errors over their levels that a chunk tells: far more than the share ``RISK`` of its epochs."""

MOST_RATIO: Final = 1.5
Z99: Final = 2.576

_CORNERS_M: Final = ((0, 0), (4, 0), (8, 0), (8, 3), (8, 6), (4, 6), (0, 6), (0, 3))


class Fault(Struct, frozen=True):
    """What is wrong in all episodes of a case."""

    place: str
    """``lab``, with the height given, or ``room``, where it is a state."""
    size_m: float = 0.0
    ramp: bool = False

    @property
    def name(self) -> str:
        """What rows call it."""
        if self.size_m == 0.0:
            return f"{self.place}, clean"
        return f"{self.place}, {'ramp to' if self.ramp else 'step'} {self.size_m:g} m"


FAULTS: Final = tuple(
    fault
    for place in ("lab", "room")
    for fault in (Fault(place), *(Fault(place, size_m, ramp) for ramp in (False, True) for size_m in SIZES_M))
)


class Chunk(Struct, frozen=True):
    """What the episodes of a chunk came to."""

    sums: Array
    """Fixes, those with a level, misleading ones (horizontal, vertical), squared errors, and medians of both levels."""
    top: Array
    """The largest horizontal errors over their levels, shape (TOP,)."""
    errors_m: Array
    """The largest horizontal errors."""


def anchors_of(place: str) -> Array:
    """Positions, shape (n, 3), in a frame in which tags walk at height 0."""
    if place == "lab":
        return np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in lab_site().anchors])
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
    return [
        Cell(fault.name, run_chunk, (case, fault, tuple(own[first : first + CHUNK])), EPISODE_S * CHUNK)
        for fault, seed in zip(FAULTS, seeds, strict=True)
        for own in [seed.spawn(plan.episodes)]
        for first in range(0, plan.episodes, CHUNK)
    ]


def run_chunk(argument: tuple[Case, Fault, tuple[SeedSequence, ...]]) -> Chunk:
    """Run some episodes."""
    case, fault, seeds = argument
    episodes = [_run(case, fault, default_rng(seed)) for seed in seeds]
    across, above, hpl, vpl, promised = (np.concatenate(part) for part in zip(*episodes, strict=True))
    some = bool(promised.any())
    sums = [
        len(across),
        promised.sum(),
        (promised & (across > hpl)).sum(),
        (promised & (above > vpl)).sum(),
        float(across @ across),
        1.0 if some else 0.0,
        float(np.median(hpl[promised])) if some else 0.0,
        float(np.median(vpl[promised])) if some else 0.0,
    ]
    return Chunk(np.array(sums, float), _largest(across[promised] / hpl[promised]), _largest(across))


def _largest(values: Array) -> Array:
    return np.sort(np.concatenate([values, np.zeros(TOP)]))[-TOP:]


def _run(case: Case, fault: Fault, draw: Generator) -> tuple[NDArray[Any], ...]:
    """Horizontal and vertical errors, both levels, and whether they are promised, of all fixes since the onset."""
    anchors_m = anchors_of(fault.place)
    slot_s = lab_site().schedule.slot_s
    episode = draw_episode(draw, anchors_m, slot_s, case, SUPERFRAMES)
    onset = int(draw.integers(*ONSETS)) * len(anchors_m)
    rx_ticks = _late(episode, fault, int(draw.integers(len(anchors_m))), onset, slot_s)
    motions, levels = _filtered(case, fault, anchors_m, episode, rx_ticks, draw)
    fixes = np.flatnonzero(levels[onset:, LEVELS] != REJECTED) + onset
    errors = np.zeros((len(fixes), 3))
    dim = motions.shape[1] // 2
    errors[:, :dim] = motions[fixes, :dim] - episode.path_m[fixes, :dim]
    across = np.hypot(errors[:, 0], errors[:, 1])
    told = levels[fixes]
    vpl = told[:, VPL] if dim == 3 else np.full(len(fixes), np.inf)
    return across, np.abs(errors[:, 2]), told[:, HPL], vpl, told[:, STATE] < DETECTED


def _late(episode: Episode, fault: Fault, anchor: int, onset: int, slot_s: float) -> NDArray[np.int64]:
    messages = episode.messages
    since_s = (np.arange(len(messages.sites)) - onset) * slot_s
    share = np.clip(since_s / RAMP_S, 0.0, 1.0) if fault.ramp else (since_s >= 0.0)
    late_m = np.where(messages.sites == anchor, fault.size_m * share, 0.0)
    return messages.rx_ticks + np.rint(late_m / TICK_M).astype(np.int64)


def _filtered(
    case: Case, fault: Fault, anchors_m: Array, episode: Episode, rx_ticks: NDArray[np.int64], draw: Generator
) -> tuple[Array, Array]:
    light2 = SPEED_OF_LIGHT_MPS**2
    stamp = light2 * (case.noise_ps * 1e-12) ** 2
    settings = JointSettings(
        qa=case.qa,
        white=light2 * WHITE_FM**2,
        walk=light2 * case.random_walk_fm**2,
        tx_variance_m2=stamp,
        rx_variance_m2=stamp + TICK_M**2 / 12.0,
        height_m=0.0 if fault.place == "lab" else None,
    )
    joint, messages = JointFilter(settings, anchors_m), episode.messages
    dim, n = joint.dim, len(rx_ticks)
    start = episode.path_m[0, :dim] + draw.normal(0.0, START_STD_M, dim)
    joint.start(int(rx_ticks[0]), start, START_STD_M**2 * np.eye(dim), SPEED_STD_MPS**2)
    motions, levels = np.empty((n, 2 * dim)), np.empty((n, LEVELS + 1))
    protected_track(
        joint.arrays,
        messages.sites,
        messages.sequences,
        rx_ticks,
        messages.tx_ticks,
        messages.relays,
        messages.ends,
        limits_of(RISK),
        np.empty(2 * dim),
        np.empty((2 * dim, 2 * dim)),
        motions,
        levels,
    )
    return motions, levels


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each fault; the results stand in the order of ``cells``."""
    each = -(-plan.episodes // CHUNK)
    return [_row(plan, fault, results[each * number : each * (number + 1)]) for number, fault in enumerate(FAULTS)]


def _row(plan: Plan, fault: Fault, chunks: Sequence[Chunk]) -> Row:
    sums = np.array([chunk.sums for chunk in chunks])
    epochs, promised, _, _, squared_m2, counted, hpl_m, vpl_m = sums.sum(axis=0).tolist()
    hmi, error = jackknife(sums, lambda rows: _share(rows, 2))
    beyond = Z99 * (error or 0.0)
    passed = bool(hmi <= RISK)
    ratio = None
    if fault.size_m == 0.0:
        ratio = 1.0 / _quantile([chunk.top for chunk in chunks], promised)
        passed = passed and ratio <= MOST_RATIO
    return Row(
        study="integrity",
        method=plan.method,
        case=fault.name,
        series=f"{fault.place}, {'ramp' if fault.ramp else 'step'}",
        x=fault.size_m,
        mesh=plan.mesh,
        noise_ps=plan.noise_ps,
        runs=plan.episodes,
        fixes=int(epochs),
        rmse_m=float(np.sqrt(squared_m2 / epochs)),
        max_m=float(max(chunk.errors_m[-1] for chunk in chunks)),
        available=promised / epochs,
        ratio=ratio,
        limit=None if ratio is None else MOST_RATIO,
        passed=passed,
        risk=RISK,
        hmi=hmi,
        hmi_interval=(max(hmi - beyond, 0.0), hmi + beyond),
        hmi_vertical=_share(sums, 3) if fault.place == "room" else None,
        hpl_m=hpl_m / counted if counted else None,
        vpl_m=vpl_m / counted if counted and fault.place == "room" else None,
        smallest_m=_quantile([chunk.errors_m for chunk in chunks], epochs),
    )


def _share(sums: Array, column: int) -> float:
    """Misleading epochs over all."""
    return float(sums[:, column].sum() / sums[:, 0].sum())


def _quantile(largest: Sequence[Array], count: float) -> float:
    """What the share ``RISK`` of so many values exceeds, from the largest of each chunk."""
    values = np.sort(np.concatenate(largest))
    return float(values[-max(int(np.ceil(RISK * count)), 1)])
