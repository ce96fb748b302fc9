"""Figure 7: three tags in their positioning phases (fig:Picoscope)."""

import time
from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from msgspec import Struct

from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.receiver import Receiver
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.paper.plan import RADIO_PS, Panel, Plan, Results, Section, Verdict
from skyless.research.studies.runner import Cell
from skyless.sim.impairments import Outage, lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import Broadcast, World
from skyless.site.report import GREEN, GRID, INK, METHOD_COLOURS, MUTED, RED, panel

_POSITIONS_M: Final = ((3.0, 4.0), (1.2, 1.6), (4.6, 6.3))
_SWITCHED_ON_S: Final = (0.5, 0.512, 0.512)
"""The first receiver begins before the other two, which begin together."""
_MEASURED_S: Final = 2.5
"""Phases after this true time are timed: kernels are loaded and caches warm."""
_SHOWN_S: Final = 0.16
_METHOD: Final = "literal"
_LAST_ANCHOR: Final = 6
"""Its message completes a superframe."""


class TimedReception(Struct, frozen=True):
    """One reception of one receiver."""

    tag: int
    anchor: int
    arrival_s: float
    """True time at which the frame's RMARKER arrived."""
    end_s: float
    """True time at which the frame ended."""
    fixed: bool
    processing_s: float
    """What the reception cost on this machine, measured."""


class Phase(Struct, frozen=True):
    """From a receiver's first message of a superframe to its fix."""

    tag: int
    begin_s: float
    last_s: float
    """Arrival of the last message."""
    end_s: float
    """End of that message's frame: from here the position is computed."""
    processing_s: float


def cells(plan: Plan) -> list[Cell]:
    """Three receivers for a few seconds."""
    return [Cell("timeline", partial(run_world, seed=plan.seed, until_s=4.0 if plan.quick else 12.0), 6.0)]


def run_world(seed: int, until_s: float) -> list[TimedReception]:
    """All receptions of the receivers, and which gave a fix."""
    site = paper_lab_site(RADIO_PS)
    specs = [
        TagSpec(Static(*position_m), outages=(Outage(0.0, on_s),))
        for position_m, on_s in zip(_POSITIONS_M, _SWITCHED_ON_S, strict=True)
    ]
    world = World(site, lambda anchor: Anchor(site, anchor), specs, lab_impairments(RADIO_PS), seed)
    receivers = [Receiver(_METHOD) for _ in specs]
    anchors_m = {anchor.id: np.array((anchor.x_m, anchor.y_m, anchor.z_m)) for anchor in site.anchors}
    heard: list[TimedReception] = []
    for broadcast in world.run(until_s):
        heard.extend(_receive(broadcast, receivers, anchors_m))
    return heard


def _receive(
    broadcast: Broadcast, receivers: list[Receiver], anchors_m: dict[int, np.ndarray]
) -> Iterator[TimedReception]:
    for tag, reception, truth_m in broadcast.receptions():
        begun_s = time.perf_counter()
        fix = receivers[tag].hear(reception)
        processing_s = time.perf_counter() - begun_s
        flight_s = float(np.linalg.norm(truth_m - anchors_m[broadcast.anchor])) / SPEED_OF_LIGHT_MPS
        arrival_s = broadcast.emission_s + flight_s
        yield TimedReception(tag, broadcast.anchor, arrival_s, broadcast.end_s, fix is not None, processing_s)


def phases_of(heard: list[TimedReception]) -> list[Phase]:
    """Phases that ended in a fix: each begins with the first message after the last fix."""
    phases: list[Phase] = []
    begun: dict[int, float] = {}
    for one in heard:
        begin_s = begun.setdefault(one.tag, one.arrival_s)
        if one.fixed:
            phases.append(Phase(one.tag, begin_s, one.arrival_s, one.end_s, one.processing_s))
            del begun[one.tag]
    return phases


def judge(tags_with_fixes: int, tags: int, fixes: int, possible: int) -> tuple[Verdict, str]:
    """Whether every receiver had a fix in every superframe, independently of the others."""
    counts = f"{fixes} fixes of {possible} possible, {tags_with_fixes} of {tags} receivers"
    if tags_with_fixes == tags and fixes >= 0.99 * possible:
        return Verdict.HOLDS, (
            "Each receiver completes every superframe with a fix of its own, at the same time as the others "
            f"({counts}). Nothing that a receiver does reaches another one; figure 10 takes this to ten thousand."
        )
    return Verdict.FAILS, f"Receivers miss fixes although they hear everything ({counts})."


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    heard: list[TimedReception] = results["timeline"]
    phases = phases_of(heard)
    superframe_s = 1.0 / schedule_of(paper_lab_site()).superframe_rate_hz
    firsts_s = [min(p.end_s for p in phases if p.tag == tag) for tag in range(len(_POSITIONS_M))]
    until_s = heard[-1].end_s
    settled = [phase for phase in phases if phase.end_s > _MEASURED_S]
    possible = sum(one.anchor == _LAST_ANCHOR and one.end_s > _MEASURED_S for one in heard)
    verdict, reason = judge(len({phase.tag for phase in settled}), len(_POSITIONS_M), len(settled), possible)
    length_s = float(np.median([phase.end_s - phase.begin_s for phase in settled]))
    processing_s = np.array([phase.processing_s for phase in settled])
    arrival_difference_s = _arrival_difference_s(settled)
    rows = [("receiver", "switched on at s", "first fix at s", "fixes per s", "processing in µs, median (95 %)")]
    for tag, first_s in enumerate(firsts_s):
        own = [phase for phase in settled if phase.tag == tag]
        cost = 1e6 * np.array([phase.processing_s for phase in own])
        rate = len(own) / (until_s - _MEASURED_S)
        rows.append(
            (
                str(tag + 1),
                f"{_SWITCHED_ON_S[tag]:.3f}",
                f"{first_s:.3f}",
                f"{rate:.1f}",
                f"{np.median(cost):.0f} ({np.percentile(cost, 95):.0f}), measured here",
            )
        )
    return Section(
        key="three-receivers",
        title="Three receivers in their positioning phases",
        label="fig:Picoscope",
        claim=(
            "Three receivers complete their positioning phases independently: the first before the others, the "
            "second and third at once. The paper takes this as evidence that the number of receivers has no limit."
        ),
        simulated=(
            f"Three receivers at rest ({_METHOD}, {RADIO_PS:g} ps); the first is switched on 12 ms before the other "
            "two, all begin without data and gather the almanac from the air. Arrivals are those of the simulated "
            "world; the time to compute a fix is measured on the machine that made this report."
        ),
        verdict=verdict,
        reason=reason,
        panels=(_cold_start(heard, phases), _one_phase(heard, settled, superframe_s)),
        table=tuple(rows),
        numbers={
            "first_fix_s": firsts_s,
            "phase_s": length_s,
            "fixes": len(settled),
            "possible_fixes": possible,
            "arrival_spread_s": arrival_difference_s,
            "measured": {
                "processing_median_s": float(np.median(processing_s)),
                "processing_p95_s": float(np.percentile(processing_s, 95)),
            },
        },
        command=f"skyless paper --out DIR --seed {plan.seed}",
    )


def _arrival_difference_s(phases: list[Phase]) -> float:
    """Median time between the first and the last receiver's arrival of the same last message."""
    by_message: dict[float, list[float]] = {}
    for phase in phases:
        by_message.setdefault(phase.end_s, []).append(phase.last_s)
    return float(np.median([max(times) - min(times) for times in by_message.values()]))


def _cold_start(heard: list[TimedReception], phases: list[Phase]) -> Panel:
    figure, axes = panel("From switching on to a fix in every superframe", 3.4)
    begin_s, end_s = _SWITCHED_ON_S[0] - 0.004, _SWITCHED_ON_S[0] + _SHOWN_S
    for tag, on_s in enumerate(_SWITCHED_ON_S):
        row = _row(tag)
        own = [phase for phase in phases if phase.tag == tag and phase.end_s < end_s]
        for number, phase in enumerate(own):
            _bar(axes, phase, begin_s, METHOD_COLOURS[_METHOD] if number else GRID)
            axes.plot(1e3 * (phase.end_s - begin_s), row, "|", color=INK, markersize=17, markeredgewidth=2.0)
        arrivals = [1e3 * (one.arrival_s - begin_s) for one in heard if one.tag == tag and one.end_s < end_s]
        axes.plot(arrivals, [row - 0.3] * len(arrivals), ".", color=MUTED, markersize=2.5)
        axes.plot(1e3 * (on_s - begin_s), row + 0.32, "v", color=GREEN, markersize=6)
    _finish(axes, end_s - begin_s)
    caption = (
        "Green: switched on. Grey: gathering the almanac and the first two rounds. Orange: a positioning phase, "
        "from the first message of a superframe to the fix (black). Dots: messages heard."
    )
    return Panel("07-cold-start", caption, figure)


def _one_phase(heard: list[TimedReception], settled: list[Phase], superframe_s: float) -> Panel:
    figure, axes = panel("One superframe, three fixes", 3.4)
    begin_s = settled[0].begin_s - 1e-3
    for phase in settled:
        if phase.begin_s < begin_s + 2.0 * superframe_s:
            _bar(axes, phase, begin_s, METHOD_COLOURS[_METHOD])
    for one in heard:
        if begin_s <= one.arrival_s < begin_s + 2.0 * superframe_s + 1e-3:
            when = 1e3 * (one.arrival_s - begin_s)
            axes.plot(when, _row(one.tag), "|", color=INK, markersize=9)
            colour = RED if one.anchor == 1 else INK
            axes.annotate(str(one.anchor), (when, _row(one.tag) + 0.24), ha="center", fontsize=8.0, color=colour)
    _finish(axes, 2.0 * superframe_s + 1e-3)
    caption = "Two superframes: the numbers are the senders (1 is the master). The phase ends with the sixth one."
    return Panel("07-one-superframe", caption, figure)


def _row(tag: int) -> int:
    """The first receiver is on top."""
    return len(_POSITIONS_M) - 1 - tag


def _bar(axes: Axes, phase: Phase, begin_s: float, colour: str) -> None:
    span = (1e3 * (phase.begin_s - begin_s), 1e3 * (phase.end_s - phase.begin_s))
    across = (_row(phase.tag) - 0.18, 0.36)
    axes.broken_barh([span], across, facecolors=colour, edgecolors=MUTED, linewidth=0.5)


def _finish(axes: Axes, seconds: float) -> None:
    count = len(_POSITIONS_M)
    axes.set_yticks(range(count), [f"receiver {count - k}" for k in range(count)])
    axes.set(xlabel="time in ms", xlim=(0, 1e3 * seconds), ylim=(-0.5, count - 0.4))
    axes.grid(visible=False, axis="y")
