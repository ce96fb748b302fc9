"""One cell of most studies: a site in the simulated world, its tags judged against the truth."""

import math
import time
from functools import lru_cache
from itertools import compress
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.air.beacon import Malformed
from skyless.air.codec import decode_cached, encode
from skyless.anchor import Anchor
from skyless.evaluation.statistics import EvenSample
from skyless.kernels.arrays import Array
from skyless.positioning.fix import Fix
from skyless.positioning.integrity import IntegrityRequirement
from skyless.receiver import Receiver
from skyless.simulation.impairments import Impairments
from skyless.simulation.stations import TagSpec
from skyless.simulation.streams import stream
from skyless.simulation.trajectory import Trajectory
from skyless.simulation.world import World
from skyless.site.model import Site
from skyless.site.slots import schedule_of
from skyless.studies.level_counts import LevelCounter, LevelCounts

OUTSIDE: Final = 0.999
"""Probability of the ellipse outside of which fixes are counted."""

SAMPLE_ROWS: Final = 1 << 13

_LOSS_KEY: Final = 3
"""Of the stream of random numbers, beside those of the simulated world."""


class Run(Struct, frozen=True):
    """A world, and how its tags compute."""

    site: Site
    trajectories: tuple[Trajectory, ...]
    impairments: Impairments
    seed: int
    method: str
    qa: float
    mesh: bool
    warmup_s: float
    """True time before which no fix is judged."""
    until_s: float
    lost_at_tags: float = 0.0
    """Probability that a tag does not hear a message which anchors may well hear."""
    integrity: IntegrityRequirement = IntegrityRequirement()


class RunResult(Struct, frozen=True):
    """Sums over the judged fixes of a world: of each tag the first of every superframe."""

    fixes: int
    superframes: int
    """Of all tags together, with a fix or without."""
    squared_m2: float
    """Sum of squared errors; as all of these horizontal where the height is given."""
    variance_m2: float
    """Sum of the traces of the fixes' covariances."""
    nees: float
    """Sum of the normalised errors squared over their degrees of freedom."""
    outside: int
    max_m: float
    sample_m: Array
    """Errors, an even sample of them."""
    messages: int
    """Heard by all tags."""
    tag_s: float
    """Seconds of all tags together."""
    cpu_s: float
    """That the tags took, measured."""
    levels: LevelCounts | None = None
    """None for methods that give no protection levels."""


class _Judge:
    """Counts one fix per tag and superframe, so that all methods are judged at the same times."""

    def __init__(self, run: Run) -> None:
        self._superframe_s = 1.0 / schedule_of(run.site).superframe_rate_hz
        self._from_s = run.warmup_s
        self._last = [-1] * len(run.trajectories)
        self._dim = 2 if run.site.tags.height_m is not None else 3
        self._far = float(chi2.ppf(OUTSIDE, self._dim))
        self._sums = np.zeros(4)
        self._max_m = 0.0
        self._sample = EvenSample(1, SAMPLE_ROWS)
        self._levels = LevelCounter(len(run.trajectories))
        first, end = int(run.warmup_s / self._superframe_s), math.ceil(run.until_s / self._superframe_s - 1e-3)
        self._superframes = (end - first) * len(run.trajectories)

    def add(self, tag: int, time_s: float, fix: Fix, truth_m: Array) -> None:
        superframe = int(time_s / self._superframe_s)
        if time_s < self._from_s or superframe == self._last[tag]:
            return
        self._last[tag] = superframe
        off_m = fix.position_m - truth_m
        self._levels.add(tag, fix, math.hypot(off_m[0], off_m[1]))
        error = off_m[: self._dim]
        covariance = fix.covariance_m2[: self._dim, : self._dim]
        squared = float(error @ error)
        nees = float(error @ np.linalg.solve(covariance, error))
        self._sums += (squared, float(np.trace(covariance)), nees / self._dim, nees > self._far)
        self._max_m = max(self._max_m, squared**0.5)
        self._sample.add((squared**0.5,))

    def result(self, messages: int, tag_s: float, cpu_s: float) -> RunResult:
        squared_m2, variance_m2, nees, outside = self._sums.tolist()
        return RunResult(
            fixes=self._sample.seen,
            superframes=self._superframes,
            squared_m2=squared_m2,
            variance_m2=variance_m2,
            nees=nees,
            outside=int(outside),
            max_m=self._max_m,
            sample_m=self._sample.rows[:, 0],
            messages=messages,
            tag_s=tag_s,
            cpu_s=cpu_s,
            levels=self._levels.counts(),
        )


def run_world(run: Run) -> RunResult:
    """Let a world run and judge its tags."""
    tags = [TagSpec(trajectory) for trajectory in run.trajectories]
    world = World(run.site, lambda anchor: Anchor(run.site, anchor), tags, run.impairments, run.seed)
    receivers = [Receiver(run.method, qa=run.qa, integrity=run.integrity) for _ in tags]
    judge, messages, cpu_s = _Judge(run), 0, 0.0
    draw = stream(run.seed, _LOSS_KEY, 0)
    for broadcast in world.run(run.until_s):
        if not run.mesh:
            broadcast.frame = without_mesh(broadcast.frame)
        receptions = list(broadcast.receptions())
        if run.lost_at_tags:
            receptions = list(compress(receptions, draw.random(len(receptions)) >= run.lost_at_tags))
        begun_s = time.thread_time()
        fixes = [receivers[tag].hear(reception) for tag, reception, _ in receptions]
        cpu_s += time.thread_time() - begun_s
        messages += len(receptions)
        for (tag, _, truth_m), fix in zip(receptions, fixes, strict=True):
            if fix is not None:
                judge.add(tag, broadcast.end_s, fix, truth_m)
    return judge.result(messages, run.until_s * len(tags), cpu_s)


@lru_cache(64)
def without_mesh(frame: bytes) -> bytes:
    """The same beacon from an anchor that relays nothing but when it heard the master."""
    beacon = decode_cached(frame)
    return frame if isinstance(beacon, Malformed) else encode(replace(beacon, heard=()))
