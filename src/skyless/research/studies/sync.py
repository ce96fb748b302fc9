"""The study ``sync``: synchronisation when masters die, with long superframes, bad crystals and temperature."""

from functools import partial
from typing import Final

from msgspec.structs import replace

from skyless.core.site import Site
from skyless.research.studies.common.plan import Plan
from skyless.research.studies.common.summary import Case
from skyless.research.studies.common.worlds import LAB_WARMUP_S, Run, walking
from skyless.sim.impairments import AnchorOutage, Impairments, Outage
from skyless.sim.oscillator import Temperature
from skyless.sim.world import paper_lab_site

_STEADY: Final = "steady"
_SUPERFRAMES_MS: Final = (15.0, 30.0, 60.0, 120.0, 300.0, 1000.0)
_LONGEST_SLOT_S: Final = 0.06
"""A site file may say 67 ms."""


def cases(plan: Plan) -> list[Case]:
    """Outages, superframes, crystals, temperatures: each against the steady lab."""
    return [*_outages(plan), *_crystals(plan), *_superframes(plan)]


def _outages(plan: Plan) -> list[Case]:
    every_s = 5.0
    lab = paper_lab_site(plan.noise_ps)
    rounds = int(plan.seconds / every_s)
    masters = tuple(_off(lab, number, LAB_WARMUP_S + 1.0 + every_s * number, 2.0) for number in range(rounds or 1))
    last = tuple(_off(lab, 5, LAB_WARMUP_S + 1.0 + every_s * number, 2.0) for number in range(rounds or 1))
    return [
        Case(_STEADY, "outages", None, walking(plan), _STEADY),
        Case("an anchor gone for 2 s of every 5 s", "outages", None, walking(plan, outages=last), _STEADY),
        Case("the master gone for 2 s of every 5 s", "outages", None, walking(plan, outages=masters), _STEADY),
    ]


def _off(site: Site, number: int, off_s: float, length_s: float) -> AnchorOutage:
    """In the order of the file, in which anchors become masters."""
    return AnchorOutage(site.anchors[number % len(site.anchors)].id, Outage(off_s, off_s + length_s))


def _crystals(plan: Plan) -> list[Case]:
    lab = paper_lab_site(plan.noise_ps)

    def wander(walk: float) -> Site:
        return replace(lab, noise=replace(lab.noise, random_walk_fm=walk))

    runs: dict[str, tuple[Run, ...]] = {
        "random walk 1e-10": walking(plan, wander(1e-10)),
        "random walk 1e-8": walking(plan, wander(1e-8)),
        "random walk 1e-10, filters assume 1e-9": walking(plan, wander(1e-10), assumed=lab),
        "random walk 1e-8, filters assume 1e-9": walking(plan, wander(1e-8), assumed=lab),
        "warming up, 1 ppm in 60 s": walking(plan, temperature=True),
        "draughts, ±0.1 ppm in 60 s": walking(plan, change=partial(_draughty, 1.0)),
        "draughts, ±0.5 ppm in 60 s": walking(plan, change=partial(_draughty, 5.0)),
    }
    return [Case(name, "crystals", None, worlds, _STEADY) for name, worlds in runs.items()]


def _draughty(swing_k: float, impairments: Impairments) -> Impairments:
    """Temperatures that swing, each node's in a phase of its own."""
    temperature = Temperature(warm_up_k=0.0, swing_k=swing_k, swing_period_s=60.0)
    return replace(impairments, oscillator=replace(impairments.oscillator, temperature=temperature))


def _superframes(plan: Plan) -> list[Case]:
    lengths_ms = _SUPERFRAMES_MS[::2] if plan.quick else _SUPERFRAMES_MS[1:]
    return [
        Case(f"superframe of {ms:.0f} ms", "superframes", ms, walking(plan, _slow(plan, ms * 1e-3)), _STEADY)
        for ms in lengths_ms
    ]


def _slow(plan: Plan, superframe_s: float) -> Site:
    """The lab with its anchors evenly spread over a superframe."""
    lab = paper_lab_site(plan.noise_ps)
    apart = 1
    while superframe_s / (apart * len(lab.anchors)) > _LONGEST_SLOT_S:
        apart += 1
    slots = apart * len(lab.anchors)
    anchors = tuple(replace(anchor, slot=apart * number) for number, anchor in enumerate(lab.anchors))
    schedule = replace(lab.schedule, slots=slots, slot_s=superframe_s / slots)
    return replace(lab, anchors=anchors, schedule=schedule)
