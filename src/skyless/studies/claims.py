"""The study ``claims``: how many superframes anchors of protocol 2 need until one claim on the slot time is left.

Two sites, hall and corridor, after a cold start, the death of the root, a cut in half and its repair, the meeting of
three islands, and the death of a fifth of all anchors; and how often a claim changes afterwards.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.slot_claims import MOST_TERM, SlotClaim
from skyless.studies.claim_graphs import (
    SUPERFRAME_TICKS,
    ClaimGraph,
    components,
    grid_m,
    hops_between,
    links_within,
)
from skyless.studies.plan import Cell, Plan, Row, seed_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


HALL: Final = ClaimSite("hall", 300.0, 167.0, 7.0, 28.2, 93, 10)
CORRIDOR: Final = ClaimSite("corridor", 1000.0, 60.0, 15.0, 22.0, 17, 40)
SITES: Final = (HALL, CORRIDOR)

EVENTS: Final = ("cold start", "root killed", "cut in half", "joined", "three islands", "a fifth dead")
RECEPTIONS: Final = (1.0, 0.8, 0.5, 0.3, 0.15)
JUDGED_RECEPTION: Final = 0.8

_PATIENCE: Final = 1_500
_LEARNING: Final = 100
"""Superframes between events, in which anchors learn how regularly news comes."""
_AFTERWARDS: Final = 200
_LONG: Final = 10_000
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
    worlds = plan.worlds or (2 if plan.quick else 5)
    found = []
    for site in SITES:
        for reception in (JUDGED_RECEPTION,) if plan.quick else RECEPTIONS:
            for world in range(worlds):
                long = reception == JUDGED_RECEPTION and world == 0 and not plan.quick
                run = ClaimRun(site, reception, seed_of(plan.seed, world), _LONG if long else _AFTERWARDS)
                found.append((f"{site.name} {100 * reception:.0f} %", run))
    return found


def _weight_s(run: ClaimRun) -> float:
    return (1_000 + run.afterwards) * (0.05 if run.site is HALL else 0.008) * run.reception


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
            graph.switch_on(node, SlotClaim(min(term, MOST_TERM), root) if node == root else None)
    graph.run_until_one(_PATIENCE, [np.flatnonzero(third == island).tolist() for island in range(3)])
    graph.run(_LEARNING)
    graph.join(links)
    return graph


def _root(graph: ClaimGraph) -> int:
    """The root that most anchors follow."""
    roots = [machine.claim.root for machine in graph.machines if machine is not None and machine.claim is not None]
    return max(set(roots), key=roots.count)


def rows(plan: Plan, results: Sequence[ClaimResult]) -> list[Row]:
    """A row for each site, reception and event; the limit holds where four of five frames are received."""
    found = []
    named = list(zip(_runs(plan), results, strict=True))
    for case in dict.fromkeys(case for (case, _), _ in named):
        runs = [(run, result) for (name, run), result in named if name == case]
        site, reception = runs[0][0].site, runs[0][0].reception
        for index, event in enumerate(EVENTS):
            passed = [result.superframes[index] for _, result in runs]
            most = None if None in passed else max(one for one in passed if one is not None)
            limit = _limit(site, event) if reception >= JUDGED_RECEPTION else None
            found.append(_row(plan, f"{case}, {event}", event, reception, runs, passed, most, limit))
    return found


def _limit(site: ClaimSite, event: str) -> int:
    """A half without a root has to wait for the hops that it was away from it."""
    return (2 if event == "cut in half" else 1) * site.most


def _row(
    plan: Plan,
    case: str,
    event: str,
    reception: float,
    runs: Sequence[tuple[ClaimRun, ClaimResult]],
    passed: Sequence[int | None],
    most: int | None,
    limit: int | None,
) -> Row:
    raise NotImplementedError
