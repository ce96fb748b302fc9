"""The study ``claims``: how many superframes anchors of protocol 2 need until one claim on the slot time is left.

Two sites, hall and corridor, after a cold start, the death of the root, a cut in half and its repair, the meeting of
three islands, and the death of a fifth of all anchors; and how often a claim changes afterwards.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.evaluation.claim_graphs import (
    SUPERFRAME_TICKS,
    ClaimGraph,
    components,
    grid_m,
    hops_between,
    links_within,
)
from skyless.kernels.arrays import Array
from skyless.slot_claims import SlotClaim
from skyless.studies.common.plan import Cell, Limit, Plan, Row, seed_of


class ClaimSite(Struct, frozen=True):
    """A site as a graph."""

    name: str
    length_m: float
    width_m: float
    step_m: float
    reach_m: float
    slots: int
    most: int
    """Superframes within which one claim should be left after an event, where four of five frames are received."""
    receptions: tuple[float, ...]
    """Shares of frames that are received."""
    afterwards: int
    """Superframes after all events, in one run of several, in which no claim should change."""


CLAIM_HALL: Final = ClaimSite("hall", 300.0, 167.0, 7.0, 28.2, 93, 10, (1.0, 0.8, 0.15), 2_000)
CLAIM_CORRIDOR: Final = ClaimSite("corridor", 1000.0, 60.0, 15.0, 22.0, 17, 40, (1.0, 0.8, 0.5, 0.3, 0.15), 10_000)
SITES: Final = (CLAIM_HALL, CLAIM_CORRIDOR)

EVENTS: Final = ("cold start", "root killed", "cut in half", "joined", "three islands", "a fifth dead")
JUDGED_RECEPTION: Final = 0.8

_PATIENCE: Final = 1_500
_LEARNING: Final = 100
"""Superframes between events, in which anchors learn how regularly news comes."""
_AFTERWARDS: Final = 200
_ISLAND_TERMS: Final = (0, 100, 200)


class ClaimRun(Struct, frozen=True):
    """One run of all events on one site."""

    site: ClaimSite
    reception: float
    seed: int
    afterwards: int
    """Superframes after the last event, in which no claim should change."""


class ClaimResult(Struct, frozen=True):
    """What came of it."""

    hops: int
    """Of the site, from its first anchor."""
    superframes: tuple[int | None, ...]
    """Until one claim, by event; None for more than were waited for."""
    silences: int
    """Changes of phase, each of which costs an anchor's frame or two."""
    changes_afterwards: int
    afterwards: int


def cells(plan: Plan) -> list[Cell]:
    """One cell for each site, reception and seed."""
    return [Cell(case, run_claims, run, _weight_s(run)) for case, run in _runs(plan)]


def _runs(plan: Plan) -> list[tuple[str, ClaimRun]]:
    found = []
    for site in SITES:
        for reception in (JUDGED_RECEPTION,) if plan.quick else site.receptions:
            for world in range(max(plan.worlds // 2, 1) if plan.quick else plan.worlds):
                long = reception == JUDGED_RECEPTION and world == 0 and not plan.quick
                run = ClaimRun(site, reception, seed_of(plan.seed, world), site.afterwards if long else _AFTERWARDS)
                found.append((f"{site.name} {100 * reception:.0f} %", run))
    return found


def _weight_s(run: ClaimRun) -> float:
    return (1_000 + run.afterwards) * (0.05 if run.site is CLAIM_HALL else 0.008) * run.reception


def run_claims(run: ClaimRun) -> ClaimResult:
    """All events one after the other; three islands begin again from dark."""
    draw = np.random.default_rng(run.seed)
    positions = grid_m(run.site.length_m, run.site.width_m, run.site.step_m)
    graph = _graph(run, positions, draw)
    for node in range(len(positions)):
        graph.switch_on(node)
    hops = max(hop for hop in hops_between(graph, 0) if hop is not None)
    passed = [graph.run_until_one(_PATIENCE)]
    graph.run(_LEARNING)
    graph.switch_off(_root(graph))
    passed.append(graph.run_until_one(_PATIENCE))
    graph.run(_LEARNING)
    side = positions[:, 0] < positions[:, 0].max() / 2
    links = graph.cut(side.tolist())
    passed.append(graph.run_until_one(_PATIENCE, components(graph)))
    graph.run(_LEARNING)
    graph.join(links)
    passed.append(graph.run_until_one(_PATIENCE))
    islands = _islands(run, positions, draw)
    passed.append(islands.run_until_one(_PATIENCE, components(islands)))
    graph.run(_LEARNING)
    alive = [node for node, machine in enumerate(graph.machines) if machine is not None]
    for node in draw.choice(alive, len(alive) // 5, replace=False).tolist():
        graph.switch_off(node)
    passed.append(graph.run_until_one(_PATIENCE, components(graph)))
    graph.run(_LEARNING)
    before = graph.changes
    graph.run(run.afterwards)
    return ClaimResult(
        hops, tuple(passed), graph.phase_changes + islands.phase_changes, graph.changes - before, run.afterwards
    )


def _graph(run: ClaimRun, positions_m: Array, draw: np.random.Generator) -> ClaimGraph:
    slots = draw.integers(0, run.site.slots, len(positions_m)) * (SUPERFRAME_TICKS // run.site.slots)
    links = links_within(positions_m, run.site.reach_m)
    return ClaimGraph(links, slots.tolist(), run.reception, int(draw.integers(1 << 60)))


def _islands(run: ClaimRun, positions_m: Array, draw: np.random.Generator) -> ClaimGraph:
    """Three parts of a site that have settled each for itself, with other terms and phases, at the moment they meet."""
    graph = _graph(run, positions_m, draw)
    third = np.minimum(positions_m[:, 0] * 3.0 // (positions_m[:, 0].max() + 1.0), 2).astype(int)
    links = graph.cut(third.tolist())
    for island, term in enumerate(draw.permutation(_ISLAND_TERMS).tolist()):
        members = np.flatnonzero(third == island).tolist()
        root = int(draw.choice(members))
        for node in members:
            graph.switch_on(node, SlotClaim(term, root) if node == root else None)
    graph.run_until_one(_PATIENCE, [np.flatnonzero(third == island).tolist() for island in range(3)])
    graph.run(_LEARNING)
    graph.join(links)
    return graph


def _root(graph: ClaimGraph) -> int:
    """The root that most anchors follow."""
    roots = [machine.claim.root for machine in graph.machines if machine is not None and machine.claim is not None]
    return max(set(roots), key=roots.count)


def rows(plan: Plan, results: Sequence[ClaimResult]) -> list[Row]:
    """A row for each site, reception and event; the limit holds where four of five frames are received or more."""
    found = []
    named = list(zip(_runs(plan), results, strict=True))
    for case in dict.fromkeys(case for (case, _), _ in named):
        runs = [run for (name, run), _ in named if name == case]
        of_case = [result for (name, _), result in named if name == case]
        found += [_row(plan, case, runs[0], index, of_case) for index in range(len(EVENTS))]
    return found


def _row(plan: Plan, case: str, run: ClaimRun, index: int, results: Sequence[ClaimResult]) -> Row:
    """Median and longest time of an event; after the last event also how often claims changed."""
    passed = [math.inf if (one := result.superframes[index]) is None else one for result in results]
    most = float(max(passed))
    changes = sum(result.changes_afterwards for result in results) if index + 1 == len(EVENTS) else None
    limit, limits, missed = _limit(run.site, EVENTS[index]), [], []
    if run.reception >= JUDGED_RECEPTION:
        limits.append(Limit("superframes_most", most=limit))
        missed += ["superframes_most"] if most > limit else []
        if changes is not None:
            limits.append(Limit("changes", most=0))
            missed += ["changes"] if changes else []
    return Row(
        study="claims",
        method=plan.method,
        case=f"{case}, {EVENTS[index]}",
        series=f"{run.site.name}, {results[0].hops} hops",
        x=None,
        mesh=None,
        noise_ps=plan.noise_ps,
        runs=len(results),
        fixes=0,
        rmse_m=None,
        superframes=_finite(float(np.median(passed))),
        superframes_most=_finite(most),
        changes=changes,
        limits=tuple(limits),
        missed=tuple(missed),
        passed=not missed if limits else None,
    )


def _finite(superframes: float) -> float | None:
    """None for runs that were given up."""
    return superframes if math.isfinite(superframes) else None


def _limit(site: ClaimSite, event: str) -> float:
    """What was cut off from its root must wait for all the hops that it was away from it, twice a hop."""
    return (2.5 if event in {"cut in half", "a fifth dead"} else 1.0) * site.most
