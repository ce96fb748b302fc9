"""A site in the simulated world with computing tags, and their errors against the truth."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

import numpy as np
from msgspec import Struct

from skyless.core.air.frame import Reception
from skyless.core.any_anchor import new_anchor
from skyless.core.any_receiver import AnyReceiver, SiteBeacon
from skyless.core.arrays import Array
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.motion_sample import MotionSample
from skyless.core.site import Site
from skyless.core.tag.receiver import NOT_DROPS
from skyless.sim.evaluation.figures import ErrorStatistics, FirstFixes, LevelReport, LevelTally
from skyless.sim.impairments import Impairments, Outage
from skyless.sim.listening import Outcome, TagSpec
from skyless.sim.medium import Tally
from skyless.sim.motion_sensor import MotionErrors, MotionSensor
from skyless.sim.tape import Tape
from skyless.sim.trajectory import Trajectory
from skyless.sim.world import World

_LEVEL_ROWS: Final = 1 << 16
"""Protection levels kept for the median."""


class JudgedFix(Struct, frozen=True, gc=False):
    """A fix with the truth."""

    tag: int
    time_s: float
    """True time at the end of the fix's last frame."""
    fix: Fix
    truth_m: Array
    """True position of the tag when that frame was sent, shape (3,)."""

    @property
    def error_m(self) -> Array:
        """Position minus truth, shape (3,)."""
        return self.fix.position_m - self.truth_m


class TagReceiver(Protocol):
    """A tag's receiver."""

    @property
    def counters(self) -> Counter[str]:
        """Frames by outcome."""

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame made no fix."""

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns a fix if it made one."""

    def hear_motion(self, sample: MotionSample) -> bool:
        """Process what a motion sensor shows."""

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a decoded beacon as ``hear`` does."""


class FleetSettings(Struct, frozen=True):
    """How the tags compute, and which fixes are judged."""

    method: str = DEFAULT_METHOD
    warmup_s: float = 2.0
    """Fixes before this true time are not judged; ``first_fix_s`` reports cold starts."""
    most_fixes: int | None = None
    """Most judged fixes per tag."""
    integrity: IntegrityRequirement = IntegrityRequirement()
    silences: tuple[Outage, ...] = ()
    """True times in which no tag's radio receives."""
    motion: MotionErrors | None = None
    """The tags' motion sensors; None for tags without."""
    new_receiver: Callable[[], TagReceiver] | None = None
    """Creates each tag's receiver, instead of one of the method."""


class ReceiverWithOutages(AnyReceiver):
    """A receiver that drops and counts frames while its radio is off; its counter keeps running."""

    def __init__(self, method: str, *, integrity: IntegrityRequirement, silences: tuple[Outage, ...]) -> None:
        """``silences`` are in host time, which in the simulated world is true time.

        Raises:
            ValueError: there is no such method.
        """
        super().__init__(method, integrity=integrity)
        self._silences = silences

    def hear(self, reception: Reception) -> Fix | None:
        """See ``AnyReceiver``."""
        host_s = reception.host_s
        if host_s is not None and any(silence.off_s <= host_s < silence.on_s for silence in self._silences):
            self.counters["radio-off"] += 1
            return None
        return super().hear(reception)


class TagRecord(Struct):
    """Counts of one tag."""

    messages: int = 0
    fixes: int = 0
    judged: int = 0
    first_fix_s: float | None = None
    last: JudgedFix | None = None


def world_of(site: Site, trajectories: Sequence[Trajectory], impairments: Impairments, seed: int) -> World:
    """A world with the site's anchors, as they run on their hosts, and tags on the trajectories."""
    tags = [TagSpec(trajectory) for trajectory in trajectories]
    return World(site, lambda anchor: new_anchor(site, anchor), tags, impairments, seed)


class TagFleet:
    """Computing tags and their errors; ``Fleet`` and ``TapeFleet`` differ in how tags receive."""

    def __init__(self, site: Site, tags: int, settings: FleetSettings) -> None:
        self._settings = settings
        self.site = site
        self.receivers = [self._new_receiver() for _ in range(tags)]
        self.records = [TagRecord() for _ in range(tags)]
        self._first_fixes = FirstFixes(site, tags)
        self.errors = ErrorStatistics(planar=site.tags.height_m is not None)
        self.sigma_squared_sum = 0.0
        self.levels = LevelTally(tags, _LEVEL_ROWS)

    def _new_receiver(self) -> TagReceiver:
        asked = self._settings
        if asked.new_receiver is not None:
            return asked.new_receiver()
        if asked.silences:
            return ReceiverWithOutages(asked.method, integrity=asked.integrity, silences=asked.silences)
        return AnyReceiver(asked.method, integrity=asked.integrity)

    def add(self, tag: int, fix: Fix | None, truth_m: Array, at_s: float) -> JudgedFix | None:
        """Count a processed frame that ended at ``at_s``, and judge its fix if there is one."""
        record = self.records[tag]
        record.messages += 1
        if fix is None:
            return None
        record.fixes += 1
        if record.first_fix_s is None:
            record.first_fix_s = at_s
        judged = JudgedFix(tag, at_s, fix, truth_m)
        record.last = judged
        if at_s >= self._settings.warmup_s:
            self._judge(judged)
        return judged

    def _judge(self, judged: JudgedFix) -> None:
        record = self.records[judged.tag]
        if record.judged == self._settings.most_fixes or not self._first_fixes.is_first(judged.tag, judged.time_s):
            return
        record.judged += 1
        error = judged.error_m
        self.levels.add(judged.tag, judged.fix, error)
        self.errors.add(float(error[0]), float(error[1]), float(error[2]))
        dim = 2 if self.site.tags.height_m is not None else 3
        self.sigma_squared_sum += float(np.trace(judged.fix.covariance_m2[:dim, :dim]))

    @property
    def drops(self) -> dict[str, int]:
        """Frames not used by the tags, by reason."""
        total: Counter[str] = Counter()
        for receiver in self.receivers:
            total.update(receiver.counters)
        return {reason: count for reason, count in sorted(total.items()) if reason not in NOT_DROPS}


class Fleet(TagFleet):
    """Tags listening in a world; each frame on the air becomes fixes."""

    step_s = 0.25
    """Suitable true time per call of ``run``."""

    def __init__(
        self,
        site: Site,
        trajectories: Sequence[Trajectory],
        impairments: Impairments,
        seed: int,
        settings: FleetSettings,
    ) -> None:
        super().__init__(site, len(trajectories), settings)
        errors = settings.motion
        self.sensors = [
            [] if errors is None else [MotionSensor(path, errors, seed, tag)] for tag, path in enumerate(trajectories)
        ]
        self.world = world_of(site, trajectories, impairments, seed)

    @property
    def now_s(self) -> float:
        """The present true time."""
        return self.world.now_s

    @property
    def tally(self) -> Tally:
        """Counts of what was on the air."""
        return self.world.tally

    def run(self, until_s: float) -> Iterator[JudgedFix]:
        """Advance true time. Yields every fix of every tag, with the truth."""
        for broadcast in self.world.run(until_s):
            for tag, reception, truth_m in broadcast.receptions():
                for sensor in self.sensors[tag]:
                    for sample in sensor.until(broadcast.end_s):
                        self.receivers[tag].hear_motion(sample)
                judged = self.add(tag, self.receivers[tag].hear(reception), truth_m, broadcast.end_s)
                if judged is not None:
                    yield judged


class TapeFleet(TagFleet):
    """Tags at a large site of protocol 2, whose anchors are a tape; each beacon that a tag hears becomes fixes."""

    step_s = 0.5

    def __init__(
        self,
        site: Site,
        trajectories: Sequence[Trajectory],
        impairments: Impairments,
        seed: int,
        settings: FleetSettings,
        survey_std_m: float = 0.0,
    ) -> None:
        """``survey_std_m``: standard deviation of the anchors' true positions around the stated ones, per axis.

        Raises:
            ValueError: an impairment is not modelled.
        """
        super().__init__(site, len(trajectories), settings)
        self.tape = Tape(site, trajectories, impairments, seed, survey_std_m=survey_std_m)
        self.now_s = 0.0
        """The present true time."""

    @property
    def tally(self) -> Tally:
        """What tags have received; what others have, and what was lost, is not counted."""
        return Tally(0, 0, {}, {str(Outcome.HEARD): sum(record.messages for record in self.records)})

    def run(self, until_s: float) -> Iterator[JudgedFix]:
        """Advance true time, tag by tag within each half second. Yields every fix of every tag, with the truth."""
        while self.now_s < until_s:
            end_s = min(self.now_s + self.step_s, until_s)
            for tag, receiver in enumerate(self.receivers):
                for heard in self.tape.hear(tag, self.now_s, end_s):
                    fix = receiver.hear_beacon(heard.beacon, heard.reception)
                    judged = self.add(tag, fix, heard.truth_m, heard.reception.host_s or 0.0)
                    if judged is not None:
                        yield judged
            self.now_s = end_s


AnyFleet = Fleet | TapeFleet


class FleetReport(Struct, frozen=True):
    """Results of a run; errors in metres, over one fix per tag and superframe after the warm-up."""

    method: str
    tags: int
    messages: int
    fixes: int
    """Judged fixes."""
    rmse_m: float | None
    p95_m: float | None
    max_m: float | None
    updates_per_s: float
    """All fixes per second and tag."""
    dropped: int
    std_m: float | None
    """Root mean square error about the mean error."""
    sigma_m: float | None
    """As claimed by the fixes: the root of the mean trace of their covariances."""
    bias_m: tuple[float, float, float] | None
    first_fix_s: float | None
    """Median over the tags of the true time of the first fix, after a cold start of the whole site."""
    tags_without_fix: int
    levels: LevelReport | None
    """None for methods without protection levels."""
    drops: dict[str, int]
    air: Tally
    simulated_s: float
    wall_s: float
    speed: float
    """Simulated seconds per second."""


def report(fleet: AnyFleet, method: str, started_s: float) -> FleetReport:
    """Summarise a run; ``started_s`` is ``time.perf_counter()`` at its start."""
    wall_s = time.perf_counter() - started_s
    summary = fleet.errors.summary()
    simulated_s = fleet.now_s
    firsts = [record.first_fix_s for record in fleet.records if record.first_fix_s is not None]
    fixes = sum(record.fixes for record in fleet.records)
    listening_s = sum(simulated_s - first for first in firsts)
    rmse_m = summary.rmse_2d_m if fleet.site.tags.height_m is not None else summary.rmse_3d_m
    std_m = None
    if rmse_m is not None and summary.bias_m is not None:
        std_m = float(np.sqrt(max(rmse_m**2 - sum(value * value for value in summary.bias_m), 0.0)))
    claims = np.isfinite(fleet.sigma_squared_sum)  # one's own estimator may claim nothing
    return FleetReport(
        method=method,
        tags=len(fleet.records),
        messages=sum(record.messages for record in fleet.records),
        fixes=summary.count,
        rmse_m=rmse_m,
        p95_m=summary.p95_m,
        max_m=summary.max_m,
        updates_per_s=fixes / listening_s if listening_s > 0.0 else 0.0,
        dropped=sum(fleet.drops.values()),
        std_m=std_m,
        sigma_m=(fleet.sigma_squared_sum / summary.count) ** 0.5 if summary.count and claims else None,
        bias_m=summary.bias_m,
        first_fix_s=float(np.median(firsts)) if firsts else None,
        tags_without_fix=len(fleet.records) - len(firsts),
        levels=fleet.levels.report(),
        drops=fleet.drops,
        air=fleet.tally,
        simulated_s=simulated_s,
        wall_s=wall_s,
        speed=simulated_s / wall_s if wall_s > 0.0 else 0.0,
    )
