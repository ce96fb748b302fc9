"""Figure 8: the update rate (sec:conclusion: 67 Hz)."""

from functools import partial
from typing import Final

import numpy as np
from msgspec import Struct, to_builtins
from msgspec.structs import replace

from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.receiver import Receiver
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.research.paper.plan import RADIO_PS, Panel, Plan, Results, Section, Verdict
from skyless.research.studies.runner import Cell
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.trajectory import Static
from skyless.site.report import INK, METHOD_COLOURS, panel

_METHODS: Final = ("literal", "joint")
_PAPER_HZ: Final = 67.0
_COUNTED_FROM_S: Final = 1.0
"""Updates count from this true time on."""


class Count(Struct, frozen=True):
    """Updates of one method at one site."""

    site: str
    method: str
    updates: int
    counted_s: float
    foreseen_hz: float
    longest_gap_s: float

    @property
    def rate_hz(self) -> float:
        """Updates per second."""
        return self.updates / self.counted_s


def sites() -> dict[str, Site]:
    """The lab with its six slots of 2.5 ms, and seven nodes in slots of 2²⁷ ticks (2.1 ms), as short as the paper's."""
    lab = paper_lab_site(RADIO_PS)
    seventh = AnchorSite(id=7, x_m=3.0, y_m=8.0)
    seven = replace(lab, anchors=(*lab.anchors, seventh), schedule=ScheduleSite())
    return {"six nodes, 2.5 ms": lab, "seven nodes, 2.1 ms": seven}


def cells(plan: Plan) -> list[Cell]:
    """One world for each site."""
    return [
        Cell(f"rate/{name}", partial(run_world, name=name, seed=plan.seed, seconds=plan.rate_s), plan.rate_s * 0.05)
        for name in sites()
    ]


def run_world(name: str, seed: int, seconds: float) -> list[Count]:
    """Count the updates of one tag."""
    site = sites()[name]
    world = world_of(site, [Static(3.0, 4.0)], lab_impairments(RADIO_PS), seed)
    receivers = {method: Receiver(method) for method in _METHODS}
    times_s: dict[str, list[float]] = {method: [] for method in _METHODS}
    until_s = _COUNTED_FROM_S + seconds
    for broadcast in world.run(until_s):
        for _, reception, _ in broadcast.receptions():
            for method, receiver in receivers.items():
                if receiver.hear(reception) is not None and broadcast.end_s >= _COUNTED_FROM_S:
                    times_s[method].append(broadcast.end_s)
    schedule, nodes = schedule_of(site), len(site.anchors)
    foreseen = {"literal": schedule.superframe_rate_hz, "joint": schedule.messages_per_s(nodes)}
    return [
        Count(name, method, len(times), seconds, foreseen[method], float(np.diff(times).max()))
        for method, times in times_s.items()
    ]


def judge(superframe_hz: float, message_hz: float) -> tuple[Verdict, str]:
    """Whether a fix per superframe comes at the paper's rate."""
    if superframe_hz >= _PAPER_HZ - 0.5:
        return Verdict.HOLDS, (
            f"One fix per superframe comes {superframe_hz:.1f} times a second. A filter that takes every message "
            f"has {message_hz:.0f}: the number of anchors, which the paper names as the limit, sets the superframe "
            "but not the rate."
        )
    return Verdict.FAILS, f"One fix per superframe comes only {superframe_hz:.1f} times a second."


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    counts: list[Count] = [count for name in sites() for count in results[f"rate/{name}"]]
    by = {(count.site, count.method): count for count in counts}
    lab, seven = sites()
    verdict, reason = judge(by[lab, "literal"].rate_hz, by[seven, "joint"].rate_hz)
    rows = [("site", "method", "updates per s", "foreseen", "longest gap in ms")]
    rows += [
        (
            count.site,
            count.method,
            f"{count.rate_hz:.1f}",
            f"{count.foreseen_hz:.2f}",
            f"{1e3 * count.longest_gap_s:.2f}",
        )
        for count in counts
    ]
    return Section(
        key="update-rate",
        title="The update rate",
        label="sec:conclusion",
        claim="The highest update rate reached is 67 Hz; the number of active anchors limits it.",
        simulated=(
            f"Updates of one tag counted over {plan.rate_s:g} s: six nodes in slots of 2.5 ms, and seven nodes in "
            "slots of 2.1 ms. The literal method makes one fix per superframe, joint one per message."
        ),
        verdict=verdict,
        reason=reason,
        panels=(_bars(counts),),
        table=tuple(rows),
        numbers={"counts": [{**to_builtins(count), "rate_hz": count.rate_hz} for count in counts]},
        command=f"skyless simulate --method joint --position 3,4 --duration 10 --seed {plan.seed}",
    )


def _bars(counts: list[Count]) -> Panel:
    figure, axes = panel("Updates per second of one tag", 2.6)
    for row, count in enumerate(reversed(counts)):
        axes.barh(row, count.rate_hz, color=METHOD_COLOURS[count.method], height=0.62)
        axes.annotate(f"{count.rate_hz:.1f}", (count.rate_hz, row), (5, 0), textcoords="offset points", va="center")
    axes.axvline(_PAPER_HZ, color=INK, linestyle="--", linewidth=1.0)
    labels = [f"{count.site.split(',')[0]},\n{count.method}" for count in reversed(counts)]
    axes.set_yticks(range(len(counts)), labels)
    axes.set(
        xlabel="updates per second (dashed: the paper's 67)", xlim=(0, 1.15 * max(count.rate_hz for count in counts))
    )
    axes.grid(visible=False, axis="y")
    return Panel("08-update-rate", "Counted updates: one per superframe (literal) and one per message (joint).", figure)
