"""The study ``sitetime``: one timeline over many hops, its errors, and what anchors state of them."""

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct
from msgspec.structs import replace

from skyless.kernels.arrays import Matrix
from skyless.simulation.oscillator import OscillatorModel
from skyless.simulation.site_time import Errors, Network, network, simulate
from skyless.studies.common.plan import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.studies.common.sides import Sides, shade_sides

_SLOT_S: Final = 1e-3
_SETTLING_S: Final = 5.0
_HOP_S: Final = 4.0
"""Superframes in which the timeline passes a hop at the start, with half of all beacons lost."""
_SAMPLE_S: Final = 0.1
_HOPS: Final = (1, 2, 5, 10, 13, 20, 40, 60, 66)

_HONEST: Final = Limit("ratio", 0.7, 1.5)
_STATED: Final = Sides("σ smaller than the error: too confident", "σ larger than the error: safe side", "above")
_NEIGHBOURS_M: Final = 0.025
"""Of the corridor with all beacons received, over eleven hops: single pairs have slots that suit them or not."""
_SLOTS_M: Final = 15.0
"""50 ns."""


class Site(Struct, frozen=True):
    """Anchors on a grid, and a superframe of slots of 1 ms."""

    name: str
    length_m: float
    width_m: float
    apart_m: float
    range_m: float
    slots: int

    def positions_m(self) -> Matrix:
        """Positions, shape (anchors, 2); the first is the root's, in a corner."""
        x, y = (np.arange(0.0, side + 0.01, self.apart_m) for side in (self.length_m, self.width_m))
        return np.array([(along, across) for along in x for across in y])


CORRIDORS: Final = tuple(Site(f"corridor, {slots} ms", 1000.0, 60.0, 15.0, 22.0, slots) for slots in (17, 27, 38))
HALL: Final = Site("dense hall, 92 ms", 300.0, 167.0, 7.0, 25.0, 92)
_LOST: Final = (0.0, 0.2, 0.5)


class World(Struct, frozen=True):
    """One simulated site."""

    site: Site
    lost: float
    site_time: bool
    seconds: float
    noise_ps: float
    seed: int


class ByHop(Struct, frozen=True):
    """Mean squares over the anchors of each hop, in m²; shape (hops,), the root first."""

    error: Sequence[float]
    stated: Sequence[float]
    neighbours: Sequence[float]
    """Of the difference of two anchors in range, by the farther one's hop."""
    largest_m: float
    """Largest difference of two anchors in range."""
    samples: int


def net_of(world: World) -> Network:
    """The anchors' network, with random slots."""
    site = world.site
    return network(site.positions_m(), site.range_m, site.slots, _SLOT_S, np.random.default_rng(world.seed))


def run(world: World) -> ByHop:
    """Simulate one site."""
    net = net_of(world)
    errors = simulate(
        net,
        OscillatorModel(),
        world.noise_ps * 1e-12,
        lost=world.lost,
        seconds=world.seconds,
        settling_s=_SETTLING_S + _HOP_S * world.site.slots * _SLOT_S * float(net.hops.max()),
        sample_s=_SAMPLE_S,
        site_time=world.site_time,
        seed=world.seed,
    )
    return by_hop(net, errors)


def by_hop(net: Network, errors: Errors) -> ByHop:
    """Mean squares by hop."""
    a, b = net.neighbours.T
    apart = errors.error_m[:, a] - errors.error_m[:, b]
    farther = np.maximum(net.hops[a], net.hops[b])
    hops = range(int(net.hops.max()) + 1)

    def mean(values: Matrix, where: np.ndarray) -> list[float]:
        return [float(np.mean(values[:, where == hop] ** 2)) if (where == hop).any() else 0.0 for hop in hops]

    return ByHop(
        mean(errors.error_m, net.hops),
        mean(errors.std_m, net.hops),
        mean(apart, farther),
        float(np.abs(apart).max()),
        len(errors.error_m),
    )


def cases(plan: Plan) -> list[World]:
    """One world of each case; the others differ in the seed alone."""
    sites = (CORRIDORS[0], HALL) if plan.quick else (*CORRIDORS, HALL)
    usual = partial(World, seconds=plan.seconds, noise_ps=plan.noise_ps, seed=plan.seed)
    worlds = [usual(site=site, lost=lost, site_time=True) for site in sites for lost in _LOST]
    return worlds + [usual(site=site, lost=lost, site_time=False) for site in sites[:1] for lost in _LOST]


def cells(plan: Plan) -> list[Cell]:
    """Every world by itself."""
    return [
        Cell(_name(world), run, replace(world, seed=seed_of(plan.seed, number, copy)), plan.seconds / 50.0)
        for number, world in enumerate(cases(plan))
        for copy in range(plan.worlds)
    ]


def rows(plan: Plan, results: Sequence[ByHop]) -> list[Row]:
    """Of each case the error by hop, and the difference of neighbours."""
    made: list[Row] = []
    for number, world in enumerate(cases(plan)):
        mine = results[number * plan.worlds : (number + 1) * plan.worlds]
        error, stated, neighbours = (
            np.sqrt(np.mean([getattr(one, name) for one in mine], axis=0)) for name in ("error", "stated", "neighbours")
        )
        ratio = stated[1:] / error[1:]
        farthest = len(error) - 1
        series = "site time" if world.site_time else "slots"
        row = Row(
            "sitetime",
            plan.method,
            "",
            series,
            None,
            None,
            plan.noise_ps,
            plan.worlds,
            plan.worlds * mine[0].samples,
            None,
        )
        for hop in (hop for hop in _HOPS if hop <= farthest):
            of_hop = replace(row, case=f"{_name(world)}: hop {hop}", x=float(hop), rmse_m=float(error[hop]))
            if world.site_time:
                of_hop = replace(of_hop, said_m=float(stated[hop]), ratio=float(ratio[hop - 1]))
            made.append(with_limits(of_hop, (_HONEST,) if world.site_time else ()))
        if world.site_time:
            for extreme, word in ((np.argmin(ratio), "least"), (np.argmax(ratio), "largest")):
                found = replace(
                    row, case=f"{_name(world)}: {word} ratio, hop {extreme + 1}", ratio=float(ratio[extreme])
                )
                made.append(with_limits(found, (_HONEST,)))
        first, last = min(55, farthest - 5), min(65, farthest)
        near_m = float(np.sqrt(np.mean(neighbours[first : last + 1] ** 2)))
        limits: list[Limit] = [] if world.site_time else [Limit("max_m", most=_SLOTS_M)]
        if world.site_time and world.lost == 0.0 and world.site is CORRIDORS[0]:
            limits.append(Limit("rmse_m", most=_NEIGHBOURS_M))
        largest_m = max(one.largest_m for one in mine)
        case = f"{_name(world)}: neighbours at hops {first} to {last}"
        near = replace(row, case=case, rmse_m=near_m, max_m=largest_m)
        made.append(with_limits(near, limits))
    return made


def _name(world: World) -> str:
    kind = "" if world.site_time else ", slots alone"
    lost = f", {100 * world.lost:.0f} % lost" if world.lost else ""
    return f"{world.site.name}{lost}{kind}"


def draw(rows: Sequence[Row]) -> Figure:
    """Error by hop, and what anchors state over it."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    error, ratio = figure.subplots(1, 2)
    names = dict.fromkeys(row.case.partition(":")[0] for row in rows if row.series == "site time")
    for name in names:
        mine = [row for row in rows if row.case.startswith(f"{name}: hop ")]
        error.plot([row.x for row in mine], [100.0 * (row.rmse_m or 0.0) for row in mine], label=name)
        ratio.plot([row.x for row in mine], [row.ratio for row in mine])
    error.set(xlabel="hops from the root", ylabel="error of site time in cm", yscale="log")
    ratio.set(xlabel="hops from the root", ylabel="stated σ over error", ylim=(0.5, 1.7))
    error.yaxis.set_major_formatter("{x:g}")
    error.yaxis.set_minor_formatter("{x:g}")
    error.legend(fontsize=6)
    shade_sides(ratio, _STATED, 1.0, along="y")
    return figure
