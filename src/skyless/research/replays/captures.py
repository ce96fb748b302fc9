"""Replay of recordings: records in, fixes out, judged against the truth where there is one."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from itertools import islice
from math import dist
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import Struct, structs

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.arguments import process_noise
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.estimator.state import EstimatorSettings
from skyless.core.fix import Fix, NoFixReason
from skyless.research.foreign.avalue import anchor_distances_m
from skyless.research.foreign.formats import Format, Recording, format_of, open_recording
from skyless.research.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.research.masterless.packet_tracking import DL_TDOA, DL_TDOA_ONE_WAY, MASTERLESS, PacketTracking
from skyless.research.masterless.pair_engine import PairEngine
from skyless.research.replays.inputs import flight_height, height_to_hold, known_anchors, known_truth
from skyless.research.replays.options import DIFFERENCES_MADE, PACKETS, ReplayOptions
from skyless.sim.evaluation.judge import Judge, Judgement
from skyless.sim.evaluation.statistics import EvenSample
from skyless.site.survey.anchor_errors import DifferenceCalibration
from skyless.site.tables import read_calibration

# Noise of the time differences of a recording, pair by pair, in bounded memory.

MAX_PAIRS: Final = 256
ROWS_PER_PAIR: Final = 4096
MIN_PAIR_DIFFERENCES: Final = 20
"""Differences of a pair from which its noise can be estimated."""


class PairNoise(Struct, frozen=True):
    """Differences of one pair of anchors."""

    anchor_a: int
    anchor_b: int
    count: int
    median_m: float
    """Median of the difference, or of its error where the truth is known."""
    noise_m: float
    """1.4826 times the median absolute deviation, a standard deviation that outliers do not touch."""
    against_truth: bool


class NoiseByPair:
    """Keeps an even sample of every pair's differences, less what the truth predicts where it is known."""

    def __init__(self, judge: Judge, anchors_m: Mapping[int, Point]) -> None:
        self._judge = judge
        self._anchors_m = anchors_m
        self._samples: dict[tuple[int, int, bool], EvenSample] = {}

    def add(self, pair: PairTdoa) -> None:
        """Add one difference."""
        predicted_m = self._predicted_m(pair) if self._judge.has_truth else None
        key = (pair.anchor_a, pair.anchor_b, predicted_m is not None)
        sample = self._samples.get(key)
        if sample is None:
            if len(self._samples) >= MAX_PAIRS:
                return
            sample = self._samples[key] = EvenSample(1, ROWS_PER_PAIR)
        sample.add((pair.tdoa_m if predicted_m is None else pair.tdoa_m - predicted_m,))

    def _predicted_m(self, pair: PairTdoa) -> float | None:
        truth = self._judge.at(pair.time_s)
        a_m = pair.a_m or self._anchors_m.get(pair.anchor_a)
        b_m = pair.b_m or self._anchors_m.get(pair.anchor_b)
        if truth is None or a_m is None or b_m is None:
            return None
        return dist(truth, b_m) - dist(truth, a_m)

    def pairs(self) -> tuple[PairNoise, ...]:
        """What is known of each pair that was heard often enough."""
        found = []
        for (a, b, against_truth), sample in sorted(self._samples.items()):
            if len(sample.rows) >= MIN_PAIR_DIFFERENCES:
                median = float(np.median(sample.rows))
                noise = 1.4826 * float(np.median(np.abs(sample.rows - median)))
                found.append(PairNoise(a, b, sample.seen, median, noise, against_truth))
        return tuple(found)


# The two ways from records to fixes: time differences of pairs, or the packets themselves.

Record = Packet | PairTdoa
Triple = tuple[float, float, float]

_SAMPLED: Final = 128
_SAMPLED_OF: Final = 1024
"""The first 128 of each 1024 packets are made into time differences as well, to measure the recording's noise."""


class ByPairs:
    """Time differences of pairs, ready or made of packets, and the filter of pairs."""

    def __init__(self, tracking: DifferenceTracking, engine: PairEngine | None, noise: NoiseByPair) -> None:
        self._tracking = tracking
        self._engine = engine
        self._noise = noise
        self._made = False

    def process(self, record: Record) -> float | None:
        """Process one record; the time of its differences."""
        pairs: Sequence[PairTdoa]
        if isinstance(record, Packet):
            assert self._engine is not None
            pairs = self._engine.on_packet(record)
        else:
            pairs = (record,)
        self._made = False
        if not pairs:
            return None
        for pair in pairs:
            self._noise.add(pair)
        self._made = self._tracking.update(pairs)
        return pairs[0].time_s

    @property
    def position_m(self) -> Triple | None:
        """Where the record put the tag, None if it made no fix."""
        return self._tracking.position_m if self._made else None

    def fix(self) -> Fix:
        """The newest position with all that is known of it."""
        return self._tracking.fix()

    @property
    def reason(self) -> NoFixReason:
        """Why there was no fix of late."""
        return self._tracking.reason

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        total = Counter({name: self._tracking.counters[name] for name in ("outlier", "unknown-anchor")})
        if self._engine is not None:
            total.update(self._engine.drops)
        return total

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """Pairs of anchors whose own ranging contradicts the table: none, as differences hold no ranges."""
        return {}


class ByPackets:
    """Packets as they are; a part of them is made into differences as well, to measure the recording's noise."""

    def __init__(self, tracking: PacketTracking, engine: PairEngine, noise: NoiseByPair) -> None:
        self._tracking = tracking
        self._engine = engine
        self._noise = noise
        self._heard = 0
        self._fix: Fix | None = None

    def process(self, record: Record) -> float | None:
        """Process one packet; its time."""
        assert isinstance(record, Packet)
        if self._heard % _SAMPLED_OF < _SAMPLED:
            for pair in self._engine.on_packet(record):
                self._noise.add(pair)
        self._heard += 1
        self._fix = self._tracking.on_packet(record)
        return self._tracking.time_s

    @property
    def position_m(self) -> Triple | None:
        """Where the packet put the tag, None if it made no fix."""
        return None if self._fix is None else self._tracking.position_m

    def fix(self) -> Fix:
        """The newest position with all that is known of it."""
        assert self._fix is not None
        return self._fix

    @property
    def reason(self) -> NoFixReason:
        """Why there was no fix of late."""
        return self._tracking.reason

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        return self._tracking.drops

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """Pairs of anchors whose own ranging contradicts the table."""
        return self._tracking.contradictions_m


# Replay of recordings: records in, fixes out, judged against the truth where there is one.

PROFILES: Final[Mapping[str, EstimatorSettings]] = {
    "miluv": structs.replace(DIFFERENCES, qa=0.1, difference_std_m=0.5, range_std_m=0.15, place_std_m=0.15),
}
"""Settings for formats that need others: MILUV's exchanges come once or twice a second, among obstacles."""

BATCH: Final = 512
"""Records that are read at a time: reading and filtering by turns evict each other from the processor's caches."""

FORMATS_BY_PACKETS: Final = frozenset({"bitcraze-yaml", "bitcraze-text", "bitcraze-binary"})
"""Formats of which packets are used by default, as real captures showed that to be better; of Avalue's it was not."""


_MAX_WITHOUT_ANCHORS: Final = 20_000
"""Records within which a recording that carries its anchors' positions has one of them."""

_MAX_TO_FIND_ANCHORS: Final = 2_000
"""Records within which every anchor of a recording of DL-TDoA is heard."""


class ReplayReport(Struct, frozen=True, kw_only=True):
    """Result of a replay: metres and seconds, None where it is not known."""

    format: str
    receptions: int
    """Packets, or rows of a table of differences."""
    fixes: int
    dropped: int
    median_m: tuple[float, float, float] | None
    """Median position after the settling time."""
    std_m: tuple[float, float, float] | None
    """Standard deviation of the position after the settling time, for tags at rest."""
    rmse_2d_m: float | None
    rmse_3d_m: float | None
    p95_m: float | None
    max_m: float | None
    rate_hz: float | None
    """Fixes per second of recorded time, None without fixes."""
    tdoa_noise_m: float | None = None
    """Median over the pairs of anchors of their differences' noise (1.4826 MAD), about the truth or the median."""
    bias_m: tuple[float, float, float] | None
    first_fix_s: float | None
    height_m: float | None
    reason: str | None
    """Why there is no fix at all."""
    drops: dict[str, int]
    pairs: tuple[PairNoise, ...] = ()
    wall_s: float
    receptions_per_s: float
    method: str | None
    measurements: str | None = None
    """What the filter was given, one of ``MEASUREMENTS``; None for the receptions of a site."""
    contradictions_m: dict[str, float] = {}
    """Pairs of anchors whose own ranging contradicts the table: by how much they are farther (if negative, nearer)
    than there."""


def common_figures(
    judgement: Judgement, receptions: int, fixes: int, drops: dict[str, int], wall_s: float
) -> dict[str, Any]:
    """What every ``ReplayReport`` holds of a judgement and of counts."""
    errors = judgement.errors
    return {
        "receptions": receptions,
        "fixes": fixes,
        "drops": drops,
        "dropped": sum(drops.values()),
        "median_m": judgement.median_m,
        "std_m": judgement.std_m,
        **{name: getattr(errors, name) for name in errors.__struct_fields__ if name != "count"},
        "wall_s": wall_s,
        "receptions_per_s": receptions / wall_s if wall_s > 0.0 else 0.0,
    }


class CaptureReplay:
    """One recording of another system on its way through the filter."""

    def __init__(
        self,
        asked: ReplayOptions,
        calibration: DifferenceCalibration | None = None,
        judge_class: type[Judge] = Judge,
    ) -> None:
        """Open the recording; ``calibration`` is used instead of that of the table of anchors. Raises SkylessError."""
        asked.leave_out(
            *("tag", "method", "integrity_risk", "alert_limit_m", "max_acceleration_mps2"),
            why="it is for recordings of skyless record",
        )
        self._asked, kind = asked, format_of(asked.file, asked.format)
        self._anchors_m, site_height_m = known_anchors(asked.anchors, asked.site)
        self._truth = known_truth(Path(asked.file), asked)
        if not self._anchors_m:
            _check_carries_anchors(asked)
        self._known_m = self._anchors_m or _stated_anchors(asked, kind)
        """Positions at the recording's beginning, for time differences; packets carry theirs, which may change."""
        self._height_m, self._height_std_m, self.height_note = height_to_hold(
            asked.tag_height_m, self._known_m, site_height_m, self._truth, kind.name
        )
        if asked.tag_height_std_m is not None:
            self._height_std_m = asked.tag_height_std_m
            if self._height_m is None:
                asked.leave_out("tag_height_std_m", why="the height is estimated")
        settle_s = asked.settle_s if asked.settle_s is not None else (2.0 if self._truth is None else 3.0)
        above_m = flight_height(asked.above_m, self._truth)
        self.judge = judge_class(self._truth, planar=self._height_m is not None, settle_s=settle_s, above_m=above_m)
        self.measurements = self._measurements(kind)
        path, anchors_m = asked.file, self._anchors_m
        self.recording: Recording = open_recording(path, asked.format, asked.listener, anchors_m)
        self._qa = process_noise(asked.qa, asked.dynamics)
        self._calibration = calibration
        if calibration is None and isinstance(asked.anchors, str | Path) and not asked.uncalibrated:
            self._calibration = read_calibration(asked.anchors)
        self._noise = NoiseByPair(self.judge, self._known_m)
        self._pipeline: ByPairs | ByPackets = self._by_packets() if self.measurements == PACKETS else self._by_pairs()
        self.receptions = 0
        self.fixes = 0
        self._first_s: float | None = None
        self._last_s = 0.0
        self._first_fix_s: float | None = None

    def _measurements(self, kind: Format) -> str:
        """The measurements that were asked for, or that suit the recording."""
        asked = self._asked
        if asked.measurements is None:
            suits = kind.is_dl_tdoa or (kind.name in FORMATS_BY_PACKETS and self._anchors_m)
            return PACKETS if suits and asked.tdoa_std_m is None else DIFFERENCES_MADE
        if asked.measurements == PACKETS and kind.tx_bits is None:
            wanted = f"it should be 'differences': {kind.name} holds no anchors' packets"
            raise SkylessError(f"--measurements is 'packets'; {wanted}")
        if asked.measurements == PACKETS and asked.tdoa_std_m is not None:
            raise SkylessError("--tdoa-std is the noise of differences; --measurements packets makes none")
        return asked.measurements

    def _engine(self) -> PairEngine | None:
        bits = self.recording.format.tx_bits
        return None if bits is None else PairEngine(bits, anchors_m=self._known_m)

    def _by_pairs(self) -> ByPairs:
        asked = {"qa": self._qa, "difference_std_m": self._asked.tdoa_std_m, "height_m": self._height_m}
        asked["height_std_m"] = self._height_std_m
        known = {key: value for key, value in asked.items() if value is not None}
        settings = structs.replace(PROFILES.get(self.recording.format.name, DIFFERENCES), **known)
        tracking = DifferenceTracking(settings, self._known_m, calibration=self._calibration)
        return ByPairs(tracking, self._engine(), self._noise)

    def _by_packets(self) -> ByPackets:
        engine, bits = self._engine(), self.recording.format.tx_bits
        assert engine is not None
        assert bits is not None
        qa = MASTERLESS.qa if self._qa is None else self._qa
        known = {"qa": qa, "height_m": self._height_m, "height_std_m": self._height_std_m}
        is_dl_tdoa = self.recording.format.is_dl_tdoa
        tracking = PacketTracking(
            structs.replace(DL_TDOA if is_dl_tdoa else MASTERLESS, **known),
            self._anchors_m,
            bits,
            calibration=self._calibration,
            one_way=structs.replace(DL_TDOA_ONE_WAY, **known) if is_dl_tdoa else None,
        )
        return ByPackets(tracking, engine, self._noise)

    def run(self, on_fix: Callable[[Fix], None] | None, on_progress: Callable[[int], None]) -> ReplayReport:
        """Read to the end; ``on_fix`` gets every fix, ``on_progress`` now and then the bytes read so far."""
        started_s = time.perf_counter()
        with closing(self.recording):
            records = iter(self.recording)
            while batch := list(islice(records, BATCH)):
                for record in batch:
                    self.receptions += 1
                    time_s = self._pipeline.process(record)
                    if time_s is not None:
                        self._add_result(time_s, on_fix)
                on_progress(self.recording.bytes_read)
        report = self._report(time.perf_counter() - started_s)
        self._check_afterwards(report)
        return report

    def _check_afterwards(self, report: "ReplayReport") -> None:
        """See that the listener was in the recording, and that the truth was of it. Raises SkylessError."""
        asked, judge = self._asked, self.judge
        if asked.listener is not None and report.receptions == 0:
            raise ConfigurationError(asked.file, "listener", asked.listener, "one that the recording names")
        times_s, true_x_m = judge.track.rows[:, 0], judge.track.rows[:, 4]
        if asked.truth is not None and self._truth is not None and len(times_s) and np.isnan(true_x_m).all():
            span = f"{self._truth.t_s[0]:.3f} to {self._truth.t_s[-1]:.3f}"
            expected = f"in the time of the recording, whose fixes are from {times_s.min():.3f} to {times_s.max():.3f}"
            table = asked.truth if isinstance(asked.truth, str | Path) else "truth"
            raise ConfigurationError(table, "column t_s", span, expected)

    def _add_result(self, time_s: float, on_fix: Callable[[Fix], None] | None) -> None:
        """Add what one reception gave: one fix at most."""
        if self._first_s is None:
            self._first_s = time_s
        self._last_s = time_s
        position_m = self._pipeline.position_m
        if position_m is None:
            return
        self.fixes += 1
        if self._first_fix_s is None:
            self._first_fix_s = time_s - self._first_s
        self.judge.add(time_s, time_s - self._first_s, position_m)
        if on_fix is not None:
            on_fix(self._pipeline.fix())

    def _drops(self) -> dict[str, int]:
        total = self.recording.drops + self._pipeline.drops
        return {name: count for name, count in sorted(total.items()) if count}

    def _report(self, wall_s: float) -> ReplayReport:
        pairs = self._noise.pairs()
        span_s = self._last_s - (self._first_s or 0.0)
        reason = self._pipeline.reason if self._known_m or self.fixes else NoFixReason.NO_ALMANAC
        return ReplayReport(
            format=self.recording.format.name,
            **common_figures(self.judge.judgement(), self.receptions, self.fixes, self._drops(), wall_s),
            rate_hz=self.fixes / span_s if self.fixes and span_s > 0.0 else None,
            tdoa_noise_m=float(np.median([pair.noise_m for pair in pairs])) if pairs else None,
            first_fix_s=self._first_fix_s,
            height_m=self._height_m,
            reason=None if self.fixes else str(reason),
            pairs=pairs,
            method="joint",
            measurements=self.measurements,
            contradictions_m={f"{a}-{b}": by_m for (a, b), by_m in sorted(self._pipeline.contradictions_m.items())},
        )


def _check_carries_anchors(asked: ReplayOptions) -> None:
    """See that a recording without a table of anchors says something of them itself, before the whole of it is read.

    Raises SkylessError.
    """
    read = 0
    with open_recording(asked.file, asked.format, asked.listener) as recording:
        for read, record in enumerate(islice(recording, _MAX_WITHOUT_ANCHORS), start=1):  # noqa: B007 - used below
            if any(getattr(record, name, None) is not None for name in ("position_m", "a_m", "b_m")):
                return
        name = recording.format.name
    if read and not distances_of(asked.file, name):  # those are worth a replay by themselves
        raise SkylessError(
            f"--anchors is missing: {asked.file} ({name}) does not say where its anchors are; give their table, "
            "id,x_m,y_m,z_m, or --site"
        )


def _stated_anchors(asked: ReplayOptions, kind: Format) -> dict[int, Point]:
    """Where the anchors of a recording of DL-TDoA say that they are."""
    if not kind.is_dl_tdoa:
        return {}
    with open_recording(asked.file, asked.format) as recording:
        packets = [record for record in islice(recording, _MAX_TO_FIND_ANCHORS) if isinstance(record, Packet)]
    return {packet.anchor: packet.position_m for packet in packets if packet.position_m is not None}


def distances_of(file: str | Path, name: str) -> dict[str, float]:
    """Distances of the anchors, where the recording itself measures them."""
    if name != "avalue":
        return {}
    return {f"{a:X}-{b:X}": metres for (a, b), metres in sorted(anchor_distances_m(file, Counter()).items())}
