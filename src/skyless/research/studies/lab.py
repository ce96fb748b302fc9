"""Cases of the study ``room`` in the paper's lab: ``loss``, ``nlos``, ``sync``, ``motion`` and ``scale``.

Ranges are right on average there, and tags walk, drive or lie still. A case's ratio is that to the RMSE of another
case, in worlds of the same seeds.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec.structs import replace
from numpy.random import Generator

from skyless.core.arrays import Array
from skyless.core.site import AnchorSite, Site
from skyless.research.studies.picture import Case
from skyless.research.studies.runner import Limit, Plan
from skyless.research.studies.worlds import LAB_WARMUP_S, Run, anchor_of, box, large_lab_site, walking, worlds
from skyless.sim.impairments import AnchorBias, AnchorOutage, Impairments, Outage
from skyless.sim.lab import paper_lab_site
from skyless.sim.oscillator import Temperature
from skyless.sim.trajectory import Static, Trajectory, Waypoints


def _within(most: float | None) -> tuple[Limit, ...]:
    return () if most is None else (Limit("ratio", most=most),)


# Condition ``loss``: messages that tags alone do not hear, or that anchors miss as well.

_SHARES: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
MAX_RATIOS: Final = {0.5: 1.3, 0.9: 2.5}
_NOTHING_LOST: Final = "nothing lost"

AT_TAGS: Final = "lost at tags"
EVERYWHERE: Final = "lost everywhere"


def loss_cases(plan: Plan) -> list[Case]:
    """Both kinds of loss, one case for each share."""
    clean = Case(_NOTHING_LOST, AT_TAGS, 0.0, walking(plan), _NOTHING_LOST)
    shares = _SHARES[::2] if plan.quick else _SHARES
    at_tags = [(AT_TAGS, share, walking(plan, lost_at_tags=share)) for share in shares]
    everywhere = [(EVERYWHERE, share, walking(plan, loss=share)) for share in shares]
    return [
        clean,
        *(
            Case(f"{100 * share:.0f} % {kind}", kind, share, runs, clean.name, _within(MAX_RATIOS.get(share)))
            for kind, share, runs in (*at_tags, *everywhere)
        ),
    ]


# Condition ``nlos``: messages that come late: single ones, or all of an anchor, always or in bursts.

_MAX_RATIO: Final = 1.3
_BURST_S: Final = 5.0
_MIN_S: Final = 3 * _BURST_S
"""Judged time, long enough to hold a burst no matter when it begins."""

_NOTHING_LATE: Final = "clean"


def nlos_cases(plan: Plan) -> list[Case]:
    """Single messages, then anchors, each world another one, and some of both with radios that report powers."""
    single, anchor, reported = "single messages", "one anchor", "reported by the first path"
    late: list[tuple[str, str, dict[str, Any], float | None]] = [
        (single, _NOTHING_LATE, {}, None),
        (single, "5 % late by exp(1 m)", {"nlos": 0.05}, None),
        (single, "20 % late by exp(1 m)", {"nlos": 0.2}, _MAX_RATIO),
        (single, "40 % late by exp(1 m)", {"nlos": 0.4}, None),
        (single, "20 % late by exp(0.2 m)", {"nlos": 0.2, "nlos_mean_m": 0.2}, None),
        (anchor, "one anchor +0.1 m", {"biases": partial(_late, plan, 0.1, None)}, None),
        (anchor, "one anchor +0.3 m", {"biases": partial(_late, plan, 0.3, None)}, _MAX_RATIO),
        (anchor, "one anchor +1.5 m", {"biases": partial(_late, plan, 1.5, None)}, None),
        (anchor, "one anchor +1.5 m in bursts", {"biases": partial(_late, plan, 1.5, _BURST_S)}, _MAX_RATIO),
    ]
    late += [
        (reported, f"{name}, reported", {**faults, "diagnostics": True}, None)
        for _, name, faults, _ in (*late[2:5], late[7], late[6])
    ]
    seconds = max(plan.seconds, _MIN_S)
    return [
        Case(name, series, None, walking(plan, seconds=seconds, **faults), _NOTHING_LATE, _within(limit))
        for series, name, faults, limit in late
        if not plan.quick or limit is not None or name == _NOTHING_LATE
    ]


def _late(plan: Plan, bias_m: float, burst_s: float | None, number: int) -> tuple[AnchorBias, ...]:
    return (AnchorBias(anchor_of(paper_lab_site(plan.noise_ps), number).id, bias_m, burst_s),)


# Condition ``sync``: anchors and masters that come and go, crystals, temperatures, superframes.

_STEADY: Final = "steady"
_SUPERFRAMES_MS: Final = (15.0, 30.0, 60.0, 120.0, 300.0, 1000.0)
_LONGEST_SLOT_S: Final = 0.06
"""Longest slot here; a site file allows 67 ms."""


def sync_cases(plan: Plan) -> list[Case]:
    """Outages, superframes, crystals, temperatures: each against the steady lab."""
    return [*_outages(plan), *_crystals(plan), *_superframes(plan)]


def _outages(plan: Plan) -> list[Case]:
    """Nothing wrong, then the last anchor of the site file or each one in its turn as the master."""
    every_s = 5.0
    lab = paper_lab_site(plan.noise_ps)
    begins_s = [LAB_WARMUP_S + 1.0 + every_s * number for number in range(int(plan.seconds / every_s) or 1)]
    masters = tuple(_off(lab, number, off_s) for number, off_s in enumerate(begins_s))
    last = tuple(_off(lab, len(lab.anchors) - 1, off_s) for off_s in begins_s)
    return [
        Case(name, "outages", None, walking(plan, outages=outages), _STEADY)
        for name, outages in (
            (_STEADY, ()),
            ("an anchor gone for 2 s of every 5 s", last),
            ("the master gone for 2 s of every 5 s", masters),
        )
    ]


def _off(site: Site, number: int, off_s: float) -> AnchorOutage:
    """An outage of 2 s of an anchor, counted in the order of the file, in which anchors become masters."""
    return AnchorOutage(anchor_of(site, number).id, Outage(off_s, off_s + 2.0))


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


# Condition ``motion``: how the error grows with speed and turns; fixes are judged when they are made.
#
# Paths for tags that move hard: turns, zigzags, stops, all at a given acceleration.

_STILL: Final = "still"

_LEG_S: Final = (2.4, 2.8)
"""Time from corner to corner; at 3 m/s² a right angle at 5 m/s takes 2.36 s."""

_LAP_SHARE: Final = (0.86, 1.0)
"""Shares of the box that laps take.

In the lab, a right angle at 3 m/s takes 4.2 m of a leg with 3 m/s², and the shortest leg has 4.3 m.
"""


def motion_cases(plan: Plan) -> list[Case]:
    """Still, rounds at three speeds, zigzags, to and fro, all in the large lab."""
    site = large_lab_site(plan.noise_ps)
    low_m, high_m = box(site)

    def paths(kind: Callable[..., Trajectory], seed: int) -> Sequence[Trajectory]:
        draw = np.random.default_rng(seed)
        return [kind(draw, low_m, high_m) for _ in range(plan.tags)]

    def moving(kind: Callable[..., Trajectory], speed_mps: float) -> Callable[..., Trajectory]:
        return partial(kind, speed_mps=speed_mps, acceleration_mps2=3.0)

    kinds = {
        _STILL: still,
        "rounds at 1 m/s": moving(rounds, 1.0),
        "rounds at 3 m/s": moving(rounds, 3.0),
        "rounds at 5 m/s": moving(rounds, 5.0),
        "zigzag at 3 m/s": moving(zigzag, 3.0),
        "to and fro at 3 m/s": moving(to_and_fro, 3.0),
        "to and fro at 5 m/s": moving(to_and_fro, 5.0),
    }
    return [
        Case(name, "motion", None, worlds(plan, site, partial(paths, kind)), _STILL) for name, kind in kinds.items()
    ]


def still(draw: Generator, low_m: Array, high_m: Array) -> Trajectory:
    """Somewhere in the box."""
    return Static(*draw.uniform(low_m, high_m))


def rounds(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle somewhere in the box, every corner turned at the acceleration."""
    return _rectangle(draw, low_m, high_m, speed_mps * draw.uniform(*_LEG_S, 2), speed_mps, acceleration_mps2)


def laps(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle that takes more than 0.86 of the box each way, every corner turned at the acceleration."""
    sides_m = (high_m - low_m)[:2] * draw.uniform(*_LAP_SHARE, 2)
    return _rectangle(draw, low_m, high_m, sides_m, speed_mps, acceleration_mps2)


def _rectangle(
    draw: Generator, low_m: Array, high_m: Array, sides_m: Array, speed_mps: float, acceleration_mps2: float
) -> Trajectory:
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * np.append(sides_m, 0.0)
    return _path(draw, low_m, high_m, corners, speed_mps, acceleration_mps2)


def zigzag(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Left and right along the box and back, by right angles as quick as the acceleration allows."""
    step = 1.02 * speed_mps * turn_s(speed_mps, acceleration_mps2) / math.sqrt(2.0)
    corners = np.array([(0, 0, 0), (1, 1, 0), (0, 2, 0), (1, 3, 0), (0, 4, 0), (-1, 3, 0), (0, 2, 0), (-1, 1, 0)])
    return _path(draw, low_m, high_m, step * corners, speed_mps, acceleration_mps2)


def to_and_fro(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Along the box and back: speeding up, driving, braking to a stop at both ends."""
    ends = np.tile(draw.uniform(low_m, high_m), (2, 1))
    ends[:, 1] = low_m[1], high_m[1]
    return Waypoints(
        ends[:: int(draw.choice((-1, 1)))], speed_mps, loop=True, corner_s=2.0 * speed_mps / acceleration_mps2
    )


def turn_s(speed_mps: float, acceleration_mps2: float) -> float:
    """Time in which a velocity turns by a right angle."""
    return math.sqrt(2.0) * speed_mps / acceleration_mps2


def _path(
    draw: Generator, low_m: Array, high_m: Array, corners: Array, speed_mps: float, acceleration_mps2: float
) -> Trajectory:
    """Put a loop somewhere in the box, begun at any corner, either way round."""
    least, most = low_m - corners.min(axis=0), high_m - corners.max(axis=0)
    placed = corners + draw.uniform(np.minimum(least, most), np.maximum(least, most))
    turned = np.roll(placed, int(draw.integers(len(placed))), axis=0)[:: int(draw.choice((-1, 1)))]
    return Waypoints(turned, speed_mps, loop=True, corner_s=turn_s(speed_mps, acceleration_mps2))


# Condition ``scale``: growing numbers of tags in the lab, and of anchors on a ring; all tags lie still.

_FLEET_S: Final = 0.5
"""Fleets of all sizes are judged in the same stretch of time, short enough for ten thousand tags."""
_FLEETS: Final = ((1, 48), (10, 24), (100, 12), (1_000, 4), (10_000, 2))
"""Numbers of tags, and of worlds with them."""
_ANCHORS: Final = (4, 6, 8, 12, 20, 30, 45, 60)
_RING_ROOM_M: Final = (12.0, 16.0)


def scale_cases(plan: Plan) -> list[Case]:
    """Growing fleets, then growing rings of anchors; a quick study has half of the worlds and no fleet of 10,000."""
    lab = paper_lab_site(plan.noise_ps)
    in_lab = partial(worlds, plan, lab, warmup_s=1.0, seconds=_FLEET_S)
    fleets = [(tags, count // 2) for tags, count in _FLEETS[:-1]] if plan.quick else _FLEETS
    rings = [(count, ring(plan, count)) for count in (_ANCHORS[::2] if plan.quick else _ANCHORS)]
    return [
        *(
            Case(
                f"{tags} tag{'s' if tags > 1 else ''}",
                "tags",
                float(tags),
                in_lab(paths=partial(_still_tags, lab, tags), count=count),
            )
            for tags, count in fleets
        ),
        *(
            Case(
                f"{count} anchors",
                "anchors in view",
                float(count),
                worlds(plan, site, partial(_still_tags, site, plan.tags), seconds=min(plan.seconds, 10.0)),
            )
            for count, site in rings
        ),
    ]


def _still_tags(site: Site, tags: int, seed: int) -> Sequence[Trajectory]:
    draw = np.random.default_rng(seed)
    return [still(draw, *box(site)) for _ in range(tags)]


def ring(plan: Plan, count: int) -> Site:
    """A site of ``count`` anchors, all in radio range of each other, evenly spread on an ellipse."""
    lab = paper_lab_site(plan.noise_ps)
    angles = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    positions = ((1.0 + np.column_stack([np.cos(angles), np.sin(angles)])) * np.array(_RING_ROOM_M) / 2.0).tolist()
    anchors = tuple(AnchorSite(id=number, x_m=x, y_m=y) for number, (x, y) in enumerate(positions, start=1))
    return replace(lab, name=f"ring of {count}", anchors=anchors)
