"""Simulated worlds of the studies: a site on the air, and its tags judged against the truth.

``run_world`` is the work of one cell; ``worlds`` makes the worlds of a case.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import compress
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.core.air.beacon import Beacon, decode_cached
from skyless.core.air.frame import Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.arrays import Array
from skyless.core.geometry import anchor_positions
from skyless.core.site import AnchorSite, NoiseSite, Site
from skyless.research.studies.runner import Plan, seed_of
from skyless.research.uncertainty import Biases, BoundSettings, Sendings, received_bound, relayed_receptions
from skyless.sim.evaluation.figures import EvenSample, FirstFixes, LevelTally
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import ROOM_QA_M2PS3, WALL_MARGIN_M, Request, impairments_of, trajectories_of
from skyless.sim.impairments import Impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.motion_sensor import MotionErrors, MotionSensor
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.streams import stream
from skyless.sim.trajectory import Trajectory
from skyless.sim.world import Broadcast

LAB_WARMUP_S: Final = 4.0
"""No fix is judged before; cold starts of the lab take a tenth of a second, those with 90 % loss some seconds."""

_LARGE_LAB_SCALE: Final = 2.5

_OUTSIDE: Final = 0.999
"""Probability of the ellipse outside of which fixes are counted."""

_SAMPLE_ROWS: Final = 1 << 13

_BOUND_SPEED_STD_MPS: Final = 1.0
"""Speed of tags before the first frame that the bound assumes; it no longer matters when the judging begins."""

_LOSS_KEY: Final = 3
"""Key of the stream of random numbers, next to the keys of the simulated world."""


class Run(Struct, frozen=True):
    """A world, and how its tags compute."""

    site: Site
    trajectories: tuple[Trajectory, ...]
    impairments: Impairments
    seed: int
    method: str
    warmup_s: float
    """True time before which no fix is judged."""
    until_s: float
    lost_at_tags: float = 0.0
    """Probability that a tag does not hear a message which anchors may well hear."""
    sensor: MotionErrors | None = None
    """The tags' motion sensors; None for tags without."""


class RunResult(Struct, frozen=True):
    """Sums over the judged fixes of a world: each tag's first fix of every superframe."""

    fixes: int
    superframes: int
    """Superframes of all tags together, with or without a fix."""
    squared_m2: float
    """Sum of squared errors; as all of these horizontal where the height is given."""
    variance_m2: float
    """Sum of the traces of the fixes' covariances."""
    nees: float
    """Sum of the normalised errors squared over their degrees of freedom."""
    outside: int
    max_m: float
    sample_m: Array
    """An even sample of the errors."""
    messages: int
    """Number of messages that all tags together received."""
    tag_s: float
    """Seconds of all tags together."""
    cpu_s: float
    """CPU time of the tags, measured."""
    levels: LevelTally | None = None
    """None for methods that give no protection levels."""


class Heard(Struct, frozen=True):
    """A beacon at the tags that received it."""

    end_s: float
    receptions: list[tuple[int, Reception, Array]]
    """Tag, reception, and the tag's true position, shape (3,)."""


def run_world(run: Run) -> RunResult:
    """Run a world and judge its tags."""
    return judged(run, beacons_of(run))


def beacons_of(run: Run) -> Iterator[Heard]:
    """Simulate what the tags of a world receive."""
    world = world_of(run.site, run.trajectories, run.impairments, run.seed)
    draw = stream(run.seed, _LOSS_KEY, 0)
    for broadcast in world.run(run.until_s):
        receptions = list(broadcast.receptions())
        if run.lost_at_tags:
            receptions = list(compress(receptions, draw.random(len(receptions)) >= run.lost_at_tags))
        yield Heard(broadcast.end_s, receptions)


def judged(run: Run, beacons: Iterable[Heard]) -> RunResult:
    """Let the tags of a world compute their positions from what they received, and judge them."""
    tags, dim = len(run.trajectories), 2 if run.site.tags.height_m is not None else 3
    receivers, paths = [AnyReceiver(run.method) for _ in run.trajectories], enumerate(run.trajectories)
    sensors = [MotionSensor(path, run.sensor, run.seed, tag) for tag, path in paths if run.sensor is not None]
    first_fixes, levels = FirstFixes(run.site, tags), LevelTally(tags, _SAMPLE_ROWS)
    sums, max_m, sample, outside_chi2 = np.zeros(4), 0.0, EvenSample(1, _SAMPLE_ROWS), float(chi2.ppf(_OUTSIDE, dim))
    messages, cpu_s = 0, 0.0
    for beacon in beacons:
        for receiver, sensor in zip(receivers, sensors, strict=False):
            for moved in sensor.until(beacon.end_s):
                receiver.hear_motion(moved)
        begun_s = time.thread_time()
        fixes = [receivers[tag].hear(reception) for tag, reception, _ in beacon.receptions]
        cpu_s += time.thread_time() - begun_s
        messages += len(fixes)
        for (tag, _, truth_m), fix in zip(beacon.receptions, fixes, strict=True):
            if fix is None or beacon.end_s < run.warmup_s or not first_fixes.is_first(tag, beacon.end_s):
                continue
            error_m = fix.position_m - truth_m
            levels.add(tag, fix, error_m)
            error, covariance = error_m[:dim], fix.covariance_m2[:dim, :dim]
            squared, nees = float(error @ error), float(error @ np.linalg.solve(covariance, error))
            sums += (squared, float(np.trace(covariance)), nees / dim, nees > outside_chi2)
            max_m = max(max_m, squared**0.5)
            sample.add((squared**0.5,))
    superframe_s = first_fixes.superframe_s
    squared_m2, variance_m2, sum_nees, outside = sums.tolist()
    return RunResult(
        fixes=sample.seen,
        superframes=(math.ceil(run.until_s / superframe_s - 1e-3) - int(run.warmup_s / superframe_s)) * tags,
        squared_m2=squared_m2,
        variance_m2=variance_m2,
        nees=sum_nees,
        outside=int(outside),
        max_m=max_m,
        sample_m=sample.rows[:, 0],
        messages=messages,
        tag_s=run.until_s * tags,
        cpu_s=cpu_s,
        levels=None if levels.risk is None else levels,
    )


def bound_m2(run: Run, biases: Biases) -> float:
    """Mean trace of the bound over all tags of a world and the time in which fixes are judged."""
    site, noise = run.site, run.impairments
    anchors_m = {one.id: position_m for one, position_m in zip(site.anchors, anchor_positions(site), strict=True)}
    for one in noise.anchor_displacements:
        anchors_m[one.anchor] = anchors_m[one.anchor] + (one.x_m, one.y_m, one.z_m)
    of_tags: list[list[tuple[Broadcast, Array]]] = [[] for _ in run.trajectories]
    for broadcast in world_of(site, run.trajectories, noise, run.seed).run(run.until_s):
        for tag, position_m in zip(broadcast.tags.tolist(), broadcast.positions_m, strict=True):
            of_tags[tag].append((broadcast, position_m))
    means = []
    for received in of_tags:
        beacons = [beacon for one, _ in received if isinstance(beacon := decode_cached(one.frame), Beacon)]
        times_s = np.array([broadcast.emission_s for broadcast, _ in received])
        path_m = np.array([position_m for _, position_m in received])
        stamps_s, is_flat = noise.rx_stamp_ps * 1e-12, site.tags.height_m is not None
        bounds = bounds_m2(anchors_m, beacons, times_s, path_m, stamps_s, noise.oscillator, biases, is_flat=is_flat)
        means.append(bounds[times_s >= run.warmup_s].mean())
    return float(np.mean(means))


def bounds_m2(
    anchors_m: Mapping[int, Array],
    beacons: Sequence[Beacon],
    times_s: Array,
    path_m: Array,
    stamp_s: float,
    crystals: OscillatorModel | NoiseSite,
    biases: Biases,
    *,
    is_flat: bool = True,
) -> Array:
    """Trace of the bound after each beacon that a tag received, shape (beacons,): of all that these beacons state.

    ``anchors_m``: true positions by identifier; relays of other anchors do not count. ``path_m``: where the tag was.
    """
    index_of = {anchor: index for index, anchor in enumerate(anchors_m)}
    senders = np.array([index_of[one.anchor] for one in beacons])
    sequences = np.array([one.sequence for one in beacons])
    relays = [
        [(index_of[relay.anchor], relay.sequence) for relay in one.heard if relay.anchor in index_of] for one in beacons
    ]
    known = relayed_receptions(senders, sequences, relays, len(index_of))
    settings = BoundSettings(
        stamp_s,
        white_fm=crystals.white_fm,
        random_walk_fm=crystals.random_walk_fm,
        qa=ROOM_QA_M2PS3,
        slot_s=1.0,  # of no use here: the frames state when they were sent
        speed_std_mps=_BOUND_SPEED_STD_MPS,
        mesh=True,
        height_known=is_flat,
    )
    positions_m = np.array(list(anchors_m.values()))
    bound = received_bound(positions_m, path_m, settings, known, Sendings(senders, times_s), biases)
    return np.asarray(np.trace(bound, axis1=1, axis2=2))


def large_lab_site(noise_ps: float) -> Site:
    """The lab at 15 m × 20 m: space for 5 m/s, and the same dilution of precision at the corresponding positions."""
    lab = paper_lab_site(noise_ps)
    anchors = tuple(replace(one, x_m=_LARGE_LAB_SCALE * one.x_m, y_m=_LARGE_LAB_SCALE * one.y_m) for one in lab.anchors)
    return replace(lab, name="hall", anchors=anchors)


def walking(plan: Plan, site: Site | None = None, **options: Any) -> tuple[Run, ...]:  # noqa: ANN401 - of ``worlds``
    """Worlds of the lab, or another site, with tags that walk at 1 m/s from point to point."""
    in_site = site or paper_lab_site(plan.noise_ps)
    return worlds(plan, in_site, lambda seed: trajectories_of(Request(in_site, seed=seed, tags=plan.tags)), **options)


def worlds(
    plan: Plan,
    site: Site,
    paths: Callable[[int], Sequence[Trajectory]],
    *,
    assumed: Site | None = None,
    change: Callable[[Impairments], Impairments] | None = None,
    sensor: MotionErrors | None = None,
    warmup_s: float = LAB_WARMUP_S,
    seconds: float | None = None,
    count: int | None = None,
    lost_at_tags: float = 0.0,
    **faults: Any,  # noqa: ANN401 - of a Request
) -> tuple[Run, ...]:
    """Worlds of a case; those of the same number have the same seed in all cases of a study.

    ``paths`` gets a world's seed. Crystals and stamps have the noise of ``site``; the filters assume that of
    ``assumed``, where it is given. ``faults`` are fields of a ``Request``, or functions of the world's number that
    return them; ``change`` is for impairments that a request has no field for.
    """
    runs = []
    for number in range(count or plan.worlds):
        seed = seed_of(plan.seed, number)
        own = {name: fault(number) if callable(fault) else fault for name, fault in faults.items()}
        impairments = impairments_of(Request(site, seed=seed, **own), site)
        runs.append(
            Run(
                site=assumed or site,
                trajectories=tuple(paths(seed)),
                impairments=impairments if change is None else change(impairments),
                seed=seed,
                method=plan.method,
                warmup_s=warmup_s,
                until_s=warmup_s + (seconds or plan.seconds),
                lost_at_tags=lost_at_tags,
                sensor=sensor,
            )
        )
    return tuple(runs)


def box(site: Site) -> tuple[Array, Array]:
    """Lowest and highest corner of the space in which tags move, shape (3,): half a metre within the anchors."""
    anchors_m = anchor_positions(site)
    low_m, high_m = anchors_m.min(axis=0) + WALL_MARGIN_M, anchors_m.max(axis=0) - WALL_MARGIN_M
    low_m[2] = high_m[2] = site.tags.height_m or 0.0
    return low_m, high_m


def anchor_of(site: Site, number: int) -> AnchorSite:
    """The anchor of a world: each one in turn, including the master."""
    return site.anchors[number % len(site.anchors)]
