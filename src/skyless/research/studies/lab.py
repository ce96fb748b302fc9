"""The studies of the lab: ``loss``, ``nlos``, ``sync`` and ``motion``."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec.structs import replace
from numpy.random import Generator

from skyless.core.arrays import Array
from skyless.core.site import Site
from skyless.research.studies.picture import RAW_METHODS, Case, world_cells, world_rows
from skyless.research.studies.runner import Cell, Plan, Row, seed_of
from skyless.research.studies.worlds import LAB_WARMUP_S, Run, anchor_of, box, large_lab_site, walking, worlds
from skyless.research.uncertainty import BoundSettings, known_receptions, received_bound
from skyless.sim.impairments import AnchorBias, AnchorOutage, Impairments, Outage
from skyless.sim.lab import paper_lab_site
from skyless.sim.oscillator import Temperature
from skyless.sim.trajectory import Piece, Static, Trajectory, Waypoints

_SHARES: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_QUICK_SHARES: Final = (0.3, 0.5, 0.7, 0.9)
MAX_RATIOS: Final = {0.5: 1.3, 0.9: 2.5}
_NOTHING_LOST: Final = "nothing lost"

AT_TAGS: Final = "lost at tags"
EVERYWHERE: Final = "lost everywhere"


def loss_cases(plan: Plan) -> list[Case]:
    """Both kinds of loss, one case for each share."""
    nothing_lost = walking(plan)
    shares = _QUICK_SHARES if plan.quick else _SHARES
    return [
        Case(_NOTHING_LOST, AT_TAGS, 0.0, nothing_lost, _NOTHING_LOST),
        *(
            Case(_name(s, AT_TAGS), AT_TAGS, s, walking(plan, lost_at_tags=s), _NOTHING_LOST, MAX_RATIOS.get(s))
            for s in shares
        ),
        *(
            Case(_name(s, EVERYWHERE), EVERYWHERE, s, walking(plan, loss=s), _NOTHING_LOST, MAX_RATIOS.get(s))
            for s in shares
        ),
    ]


def _name(share: float, kind: str) -> str:
    return f"{100 * share:.0f} % {kind}"


_BOUND_S: Final = 9.0
_BOUND_FROM_S: Final = 3.0
_BOUND_EPISODES: Final = 24
"""Episodes from which the bound is computed."""
_BOUND_COST_S: Final = 1.0
"""About what the bound of a case takes to compute."""

_SPEED_STD_MPS: Final = 1.0
_BOUND_KEY: Final = 17
"""Key of the stream of random numbers that decides what is lost."""


def loss_cells(plan: Plan) -> list[Cell]:
    """The worlds of all cases, then the bound of each case."""
    each = loss_cases(plan)
    bounds = [Cell(case.name, partial(bound_m, case.runs, plan), _BOUND_COST_S) for case in each]
    return [*world_cells(each), *bounds]


def loss_rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each case, with the bound of all receptions in such worlds."""
    each = loss_cases(plan)
    worlds = world_rows("loss", plan, each, results[: -len(each)])
    return [replace(row, bound_m=bound) for row, bound in zip(worlds, results[-len(each) :], strict=True)]


def bound_m(runs: Sequence[Run], plan: Plan) -> float | None:
    """Root mean square of the posterior bound when the tags make the fixes that are judged.

    Of tags that accelerate at random with the process noise that filters assume, at the positions where tags of the
    worlds walk: these themselves keep their speed, which filters do not know.
    """
    variances = [_variances(runs[number % len(runs)], plan, number) for number in range(_BOUND_EPISODES)]
    judged = np.concatenate(variances)
    return float(np.sqrt(judged.mean())) if len(judged) else None


def _variances(run: Run, plan: Plan, number: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Traces of the bound at the first frame of each superframe that the tag receives."""
    site, noise = run.site, run.site.noise
    anchors_m = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    n, slot_s = len(anchors_m), site.schedule.slot_s
    superframes = int(_BOUND_S / (n * slot_s))
    tag = run.trajectories[number % len(run.trajectories)]
    times = run.warmup_s + slot_s * np.arange(n * superframes)
    path_m = np.array([tag.position(float(t)) for t in times])
    everywhere = run.impairments.channel.loss_probability
    known = known_receptions(
        np.random.default_rng(seed_of(plan.seed, number, _BOUND_KEY)),
        len(times),
        n,
        lost_at_tags=1.0 - (1.0 - run.lost_at_tags) * (1.0 - everywhere),
        lost_at_anchors=everywhere,
        mesh=run.method in RAW_METHODS,
    )
    settings = BoundSettings(
        noise.rx_stamp_ps * 1e-12,
        white_fm=noise.white_fm,
        random_walk_fm=noise.random_walk_fm,
        qa=run.qa,
        slot_s=slot_s,
        speed_std_mps=_SPEED_STD_MPS,
        mesh=True,
        height_known=site.tags.height_m is not None,
    )
    traces = np.trace(received_bound(anchors_m, path_m, settings, known), axis1=1, axis2=2).reshape(superframes, n)
    heard = known[:, -1].reshape(superframes, n)
    begin = int(_BOUND_FROM_S / (n * slot_s))
    firsts = traces[np.arange(superframes), heard.argmax(axis=1)]
    judged: np.ndarray[Any, np.dtype[np.float64]] = firsts[begin:][heard[begin:].any(axis=1)]
    return judged


# The study ``nlos``: messages that come late: single ones, or all of an anchor, always or in bursts.

_MAX_RATIO: Final = 1.3
_BURST_S: Final = 5.0
_MIN_S: Final = 3 * _BURST_S
"""Judged time, long enough to hold a burst no matter when it begins."""

_NOTHING_LATE: Final = "clean"


def nlos_cases(plan: Plan) -> list[Case]:
    """Single messages, then anchors, each world another one, and some of both with radios that report powers."""
    messages: list[tuple[str, dict[str, Any], float | None]] = [
        ("5 % late by exp(1 m)", {"nlos": 0.05}, None),
        ("20 % late by exp(1 m)", {"nlos": 0.2}, _MAX_RATIO),
        ("40 % late by exp(1 m)", {"nlos": 0.4}, None),
        ("20 % late by exp(0.2 m)", {"nlos": 0.2, "nlos_mean_m": 0.2}, None),
    ]
    anchors: list[tuple[str, dict[str, Any], float | None]] = [
        ("one anchor +0.1 m", {"biases": partial(_late, plan, 0.1, None)}, None),
        ("one anchor +0.3 m", {"biases": partial(_late, plan, 0.3, None)}, _MAX_RATIO),
        ("one anchor +1.5 m", {"biases": partial(_late, plan, 1.5, None)}, None),
        ("one anchor +1.5 m in bursts", {"biases": partial(_late, plan, 1.5, _BURST_S)}, _MAX_RATIO),
    ]
    reported = [
        (f"{name}, reported", {**faults, "diagnostics": True}, None)
        for name, faults, _ in (*messages[1:], anchors[2], anchors[1])
    ]
    late = [
        (name, series, faults, limit)
        for series, cases_of in (
            ("single messages", [(_NOTHING_LATE, {}, None), *messages]),
            ("one anchor", anchors),
            ("reported by the first path", reported),
        )
        for name, faults, limit in cases_of
    ]
    if plan.quick:
        late = [case for case in late if case[0] == _NOTHING_LATE or case[3] is not None]
    seconds = max(plan.seconds, _MIN_S)
    return [
        Case(name, series, None, walking(plan, seconds=seconds, **faults), _NOTHING_LATE, limit)
        for name, series, faults, limit in late
    ]


def _late(plan: Plan, bias_m: float, burst_s: float | None, number: int) -> tuple[AnchorBias, ...]:
    return (AnchorBias(anchor_of(paper_lab_site(plan.noise_ps), number).id, bias_m, burst_s),)


_STEADY: Final = "steady"
_SUPERFRAMES_MS: Final = (15.0, 30.0, 60.0, 120.0, 300.0, 1000.0)
_LONGEST_SLOT_S: Final = 0.06
"""A site file may say 67 ms."""


def sync_cases(plan: Plan) -> list[Case]:
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


# The study ``motion``: how the error grows with speed and turns; fixes are judged when they are made.
#
# Paths for tags that move hard: turns, zigzags, stop and go, all at a given acceleration.

_ACCELERATION_MPS2: Final = 3.0
_STILL: Final = "still"

_LEG_S: Final = (2.4, 2.8)
"""Time from corner to corner; at 3 m/s² a right angle at 5 m/s takes 2.36 s."""

_LAP_SHARE: Final = (0.86, 1.0)
"""Shares of the box that laps take.

In the lab, a right angle at 3 m/s takes 4.2 m of a leg with 3 m/s², and the shortest leg has 4.3 m.
"""


def motion_cases(plan: Plan) -> list[Case]:
    """Still, rounds at three speeds, zigzags, stop and go, all in the large lab."""
    site = large_lab_site(plan.noise_ps)
    low_m, high_m = box(site)

    def paths(kind: Callable[..., Trajectory], seed: int) -> Sequence[Trajectory]:
        draw = np.random.default_rng(seed)
        return [kind(draw, low_m, high_m) for _ in range(plan.tags)]

    def moving(kind: Callable[..., Trajectory], speed_mps: float) -> Callable[..., Trajectory]:
        return partial(kind, speed_mps=speed_mps, acceleration_mps2=_ACCELERATION_MPS2)

    kinds = {
        _STILL: still,
        "rounds at 1 m/s": moving(rounds, 1.0),
        "rounds at 3 m/s": moving(rounds, 3.0),
        "rounds at 5 m/s": moving(rounds, 5.0),
        "zigzag at 3 m/s": moving(zigzag, 3.0),
        "stop and go, 3 m/s": moving(stop_and_go, 3.0),
        "stop and go, 5 m/s": moving(stop_and_go, 5.0),
    }
    return [
        Case(name, "motion", None, worlds(plan, site, partial(paths, kind)), _STILL) for name, kind in kinds.items()
    ]


class StopAndGo(Trajectory):
    """From point to point and round again: speeding up, driving, braking, resting."""

    def __init__(self, points_m: Array, speed_mps: float, acceleration_mps2: float, rest_s: float) -> None:
        """``points_m`` has shape (n, 3), n ≥ 2, neighbours apart; short legs do not reach the speed."""
        self._pieces: list[Piece] = []
        now_s = 0.0
        for start, end in zip(points_m, np.roll(points_m, -1, axis=0), strict=True):
            now_s = self._leg(start, end, now_s, speed_mps, acceleration_mps2, rest_s)
        self._lap_s = now_s

    def _leg(self, start: Array, end: Array, now_s: float, speed: float, acceleration: float, rest_s: float) -> float:
        length = float(np.linalg.norm(end - start))
        way = (end - start) / length
        top = min(speed, math.sqrt(acceleration * length))
        ramp_s, cruise_s = top / acceleration, length / top - top / acceleration
        still = np.zeros(3)
        for duration_s, at_mps, push in (
            (rest_s, 0.0, 0.0),
            (ramp_s, 0.0, acceleration),
            (cruise_s, top, 0.0),
            (ramp_s, top, -acceleration),
        ):
            until_s = now_s + duration_s
            if duration_s > 0.0:
                self._pieces.append(Piece(now_s, until_s, now_s, start, at_mps * way + still, push * way))
            start = start + way * (at_mps * duration_s + 0.5 * push * duration_s**2)
            now_s = until_s
        return now_s

    def piece(self, t_s: float) -> Piece:
        """See ``Trajectory``."""
        lap = math.floor(t_s / self._lap_s)
        within_s, passed_s = t_s - lap * self._lap_s, lap * self._lap_s
        found = next((one for one in self._pieces if within_s < one.end_s), self._pieces[-1])
        return found._replace(
            start_s=found.start_s + passed_s, end_s=found.end_s + passed_s, origin_s=found.origin_s + passed_s
        )


def still(draw: Generator, low_m: Array, high_m: Array) -> Trajectory:
    """Somewhere in the box."""
    return Static(*draw.uniform(low_m, high_m))


def rounds(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle somewhere in the box, every corner turned at the acceleration."""
    size = np.append(speed_mps * draw.uniform(*_LEG_S, 2), 0.0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * size
    return _path(draw, low_m, high_m, corners, speed_mps, acceleration_mps2)


def laps(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle that takes more than 0.86 of the box each way, every corner turned at the acceleration."""
    size = np.append((high_m - low_m)[:2] * draw.uniform(*_LAP_SHARE, 2), 0.0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * size
    return _path(draw, low_m, high_m, corners, speed_mps, acceleration_mps2)


def zigzag(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Left and right along the box and back, by right angles as quick as the acceleration allows."""
    step = 1.02 * speed_mps * turn_s(speed_mps, acceleration_mps2) / math.sqrt(2.0)
    corners = np.array([(0, 0, 0), (1, 1, 0), (0, 2, 0), (1, 3, 0), (0, 4, 0), (-1, 3, 0), (0, 2, 0), (-1, 1, 0)])
    return _path(draw, low_m, high_m, step * corners, speed_mps, acceleration_mps2)


def stop_and_go(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """To eight points in the box, with rests of a second."""
    return StopAndGo(draw.uniform(low_m, high_m, (8, 3)), speed_mps, acceleration_mps2, 1.0)


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
