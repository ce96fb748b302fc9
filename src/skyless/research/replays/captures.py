"""Replay of recordings: records, anchors, truth and heights in, fixes out, judged where there is a truth."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct, field, structs
from numpy.typing import ArrayLike

from skyless.arguments import check_point, existing_file, wrong
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.fix import Fix, NoFixReason
from skyless.core.geometry import GUESSED_STD_M, plane_height_m
from skyless.core.motion_sample import MotionSample
from skyless.core.site import Site
from skyless.core.ticks import CARRIER_CYCLES
from skyless.research.foreign.datasets import anchor_distances_m
from skyless.research.foreign.formats import Format, Recording, format_of, open_recording
from skyless.research.replays.options import (
    BAROMETER,
    DIFFERENCES_MADE,
    PACKETS,
    RECORDED,
    RecordingOptions,
    ReplayOptions,
)
from skyless.run.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.run.masterless.packet_tracking import DL_TDOA, DL_TDOA_ONE_WAY, MASTERLESS, PacketTracking
from skyless.run.masterless.pair_engine import PairEngine
from skyless.run.masterless.smoothing import Event, Height, OwnEstimator, heard, smoothed
from skyless.sim.evaluation.figures import (
    FLIGHT_M,
    EvenSample,
    Figures,
    FixSamples,
    FixTable,
    Judged,
    antenna_truth,
    estimated_offset_s,
    figures_of,
    flies,
    shifted,
    truth_at,
)
from skyless.site.file.load import site_of
from skyless.site.survey.anchor_errors import DifferenceCalibration
from skyless.site.tables import HEIGHT_STD_M, Truth, read_anchors, read_calibration, read_height_readings, read_truth

if TYPE_CHECKING:
    from skyless.research.replays.options import Anchors

TOO_FLAT = "the anchors' mean: they lie too flat to determine the height"
"""Source of a height that nobody gave."""

YAML_SUFFIXES: Final = frozenset({".yaml", ".yml"})


def known_anchors(anchors: "Anchors | None", site: Site | str | Path | None) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors, and the tags' height if a site states it. Raises SkylessError."""
    if anchors is not None and site is not None:
        raise SkylessError("give either --anchors or --site, not both")
    if site is not None:
        known = site_of(site)[0]
        return {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in known.anchors}, known.tags.height_m
    if anchors is None:
        return {}, None
    if not isinstance(anchors, Mapping):
        path = existing_file("--anchors", anchors)
        return (_read_yaml(path) if path.suffix in YAML_SUFFIXES else read_anchors(path)), None
    anchors_m: dict[int, Point] = {}
    for identifier, position_m in anchors.items():
        if not isinstance(identifier, int) or identifier < 0:
            raise wrong("--anchors", identifier, "positions by identifiers, which are whole numbers")
        x_m, y_m, z_m = check_point(f"--anchors[{identifier}]", position_m, (3,))
        anchors_m[identifier] = (x_m, y_m, z_m)
    return anchors_m, None


_MAX_TO_FIND_ANCHORS: Final = 2_000
"""Every anchor of a DL-TDoA recording is heard within this many records."""


def stated_anchors(file: str | Path, kind: Format) -> dict[int, Point]:
    """Positions stated by the anchors of a DL-TDoA recording."""
    if not kind.is_dl_tdoa:
        return {}
    with open_recording(file, kind.name) as recording:
        packets = [record for record in islice(recording, _MAX_TO_FIND_ANCHORS) if isinstance(record, Packet)]
    return {packet.anchor: packet.position_m for packet in packets if packet.position_m is not None}


def _read_yaml(path: Path) -> dict[int, Point]:
    """Anchor positions from a YAML file of Bitcraze's programs: x, y and z by identifier. Raises ConfigurationError."""
    import yaml  # noqa: PLC0415 - of the extra research

    try:
        known = yaml.safe_load(path.read_text(encoding="utf-8"))
        return {int(anchor): (float(one["x"]), float(one["y"]), float(one["z"])) for anchor, one in known.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
        raise ConfigurationError(path, "the file", type(error).__name__, "identifiers with x, y and z each") from None


def known_truth(path: Path, asked: "RecordingOptions") -> Truth | None:
    """Positions of the antenna, from an array, a table or the recording itself. Raises SkylessError."""
    truth, arm_m = asked.truth, asked.lever_arm_m
    own, known = format_of(path, asked.format).read_truth, None
    if truth is None and own is not None:
        known = own(path, asked.listener)
    if truth is None and known is None:
        asked.leave_out("lever_arm_m", "truth_offset_s", why="it moves the truth, which --truth must give")
        return None
    if isinstance(truth, str | Path):
        known = read_truth(existing_file("--truth", truth), asked.listener)
    elif truth is not None:
        known = _truth_of(truth)
    assert known is not None
    if isinstance(asked.truth_offset_s, float | int):
        known = shifted(known, asked.truth_offset_s)
    return known if arm_m is None else antenna_truth(known, arm_m)


def _truth_of(given: ArrayLike) -> Truth:
    right = "an array of shape (n, 4), n at least 1: time in s, which does not decrease, x, y, z in metres, all finite"
    try:
        rows = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise wrong("--truth", given, right) from None
    is_table = rows.ndim == 2 and rows.shape[1] == 4 and len(rows) > 0
    if not (is_table and np.isfinite(rows).all() and (np.diff(rows[:, 0]) >= 0.0).all()):
        raise SkylessError(f"--truth is an array of shape {rows.shape}; it should be {right}")
    return Truth(rows[:, 0], rows[:, 1:], None)


def known_heights(asked: "ReplayOptions") -> deque[Height]:
    """Readings of the tag's height sensor by time, from an array or a table. Raises SkylessError."""
    given = asked.heights
    if given is None:
        return deque()
    if str(given) == RECORDED:
        own = format_of(asked.file, asked.format).read_heights
        found = None if own is None else own(asked.file, is_barometer=asked.height_kind == BAROMETER)
        if found is None:
            raise wrong("--heights", RECORDED, "a table: the recording holds none of this kind")
        rows = found
    elif isinstance(given, str | Path):
        rows = read_height_readings(existing_file("--heights", given))
    else:
        rows = np.array(given, dtype=np.float64)
        if rows.ndim == 2 and rows.shape[1] == 2:
            rows = np.column_stack([rows, np.full(len(rows), HEIGHT_STD_M)])
    right = rows.ndim == 2 and rows.shape[1] == 3 and np.isfinite(rows).all() and (rows[:, 2] > 0.0).all()
    if not right or (np.diff(rows[:, 0]) < 0.0).any():
        expected = "rows of time in s, which does not decrease, height in m and, above 0, its standard deviation in m"
        raise wrong("--heights", given, expected)
    return deque(Height(t_s, height_m, std_m, asked.height_kind == BAROMETER) for t_s, height_m, std_m in rows.tolist())


def height_to_hold(
    wish: float | str, anchors_m: dict[int, Point], site_m: float | None, truth: Truth | None, format_name: str
) -> tuple[float | None, float, str]:
    """Height to hold (None to estimate it), its standard deviation, and its source.

    ``wish``: metres, or one of ``HEIGHT_WORDS``. Raises SkylessError.
    """
    if not isinstance(wish, str):
        return wish, 0.0, "given"
    if wish == "free":
        return None, 0.0, "estimated"
    if wish == "truth" or (truth is not None and format_name == "miluv"):
        if truth is None:
            raise SkylessError("--tag-height truth takes the height from the truth, which --truth must give")
        return float(np.median(truth.position_m[:, 2])), 0.0, "the truth's median"
    if site_m is not None:
        return site_m, 0.0, "from the site file"
    plane_m = plane_height_m(anchors_m)
    if plane_m is None:
        return None, 0.0, "estimated"
    return plane_m, GUESSED_STD_M, TOO_FLAT


def flight_height(wish: float | None, truth: Truth | None) -> float | None:
    """Height above which fixes are judged: ``wish``, or 0.3 m if the truth starts on the floor and rises above it."""
    if wish is not None or truth is None:
        return wish
    return FLIGHT_M if flies(truth) else None


# Noise of the time differences of a recording, pair by pair, in bounded memory.

MAX_PAIRS: Final = 256
ROWS_PER_PAIR: Final = 2048
MIN_PAIR_DIFFERENCES: Final = 20
"""Differences of a pair from which its noise can be estimated."""

_NOWHERE: Final = (np.nan, np.nan, np.nan)


class PairNoise(Struct, frozen=True):
    """Differences of one pair of anchors."""

    anchor_a: int
    anchor_b: int
    count: int
    median_m: float
    """Median of the difference, or of its error if the truth is known."""
    noise_m: float
    """1.4826 times the median absolute deviation, a standard deviation insensitive to outliers."""
    against_truth: bool


class NoiseByPair:
    """Keeps an even sample of every pair's differences, minus the truth's prediction if known."""

    def __init__(self, truth: Truth | None, anchors_m: Mapping[int, Point]) -> None:
        self.truth = truth
        self._anchors_m = anchors_m
        self._samples: dict[tuple[int, int], EvenSample] = {}

    def add(self, pair: PairTdoa) -> None:
        """Add one difference."""
        key = (pair.anchor_a, pair.anchor_b)
        sample = self._samples.get(key)
        if sample is None:
            if len(self._samples) >= MAX_PAIRS:
                return
            sample = self._samples[key] = EvenSample(8, ROWS_PER_PAIR)
        a_m = pair.a_m or self._anchors_m.get(pair.anchor_a, _NOWHERE)
        b_m = pair.b_m or self._anchors_m.get(pair.anchor_b, _NOWHERE)
        sample.add((pair.time_s, pair.tdoa_m, *a_m, *b_m))

    def pairs(self) -> tuple[PairNoise, ...]:
        """Noise of each pair received often enough."""
        found = []
        for (a, b), sample in sorted(self._samples.items()):
            time_s, tdoa_m, places_m = sample.rows[:, 0], sample.rows[:, 1], sample.rows[:, 2:].reshape(-1, 2, 3)
            to_a_m, to_b_m = np.linalg.norm(truth_at(self.truth, time_s)[:, None] - places_m, axis=2).T
            errors_m = tdoa_m - (to_b_m - to_a_m)
            known = np.isfinite(errors_m)
            against_truth = bool(known.sum() >= MIN_PAIR_DIFFERENCES)
            values_m = errors_m[known] if against_truth else tdoa_m
            if len(values_m) >= MIN_PAIR_DIFFERENCES:
                median = float(np.median(values_m))
                noise = 1.4826 * float(np.median(np.abs(values_m - median)))
                found.append(PairNoise(a, b, sample.seen, median, noise, against_truth))
        return tuple(found)


# The ways from records of a recording to fixes: by differences, smoothed, by packets, by an estimator of one's own.

Record = Packet | PairTdoa

Measured = tuple[float, Record, bool]
"""A time, the record passed to the estimator, and whether it was used."""

_SAMPLED: Final = 128
_SAMPLED_OF: Final = 1024
"""The first 128 of each 1024 packets are also converted to time differences, to measure the recording's noise."""


class Pipeline:
    """A way from records to fixes; this one converts packets to time differences of pairs."""

    contradictions_m: Mapping[tuple[int, int], float] = {}
    """Pairs of anchors whose own ranging contradicts the table."""
    reason = NoFixReason.NO_BEACONS
    """Why there was no recent fix."""

    def __init__(self, engine: PairEngine | None, noise: NoiseByPair) -> None:
        self._engine, self._noise = engine, noise
        self.measured: Iterable[Measured] = ()
        """Input of the estimator in the last ``process`` or ``rest``; to be read once."""

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """Process one record. Returns the time of its differences, and a fix if it made one."""
        raise NotImplementedError

    def process_height(self, height: Height) -> None:
        """Process a height reading that precedes the next record; ignored by default."""

    def rest(self, _on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """Fixes that need the whole recording, at its end; ``on_progress`` gets the share done."""
        self.measured = ()
        return ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What is wrong with the anchors, in sentences."""
        return ()

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        return Counter() if self._engine is None else Counter(self._engine.drops)

    def _pairs(self, record: Record) -> Sequence[PairTdoa]:
        if isinstance(record, Packet):
            assert self._engine is not None
            found: Sequence[PairTdoa] = self._engine.on_packet(record)
        else:
            found = (record,)
        for pair in found:
            self._noise.add(pair)
        return found


def _measured(pairs: Iterable[PairTdoa], used: Iterable[bool]) -> Iterator[Measured]:
    return ((pair.time_s, pair, is_used) for pair, is_used in zip(pairs, used, strict=True))


class ByPairs(Pipeline):
    """Time differences, and the filter of pairs."""

    def __init__(
        self,
        tracking: DifferenceTracking,
        engine: PairEngine | None,
        noise: NoiseByPair,
        motion: Sequence[MotionSample] = (),
    ) -> None:
        """``motion``: all samples of the tag's motion sensor, in order of time."""
        super().__init__(engine, noise)
        self._tracking, self._motion = tracking, deque(motion)

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self._pairs(record)
        if not pairs:
            self.measured = ()
            return None, None
        while self._motion and self._motion[0].time_s <= pairs[0].time_s:
            self._tracking.hear_motion(self._motion.popleft())
        fix = self._tracking.fix() if self._tracking.update(pairs) else None
        self.measured, self.reason = _measured(pairs, self._tracking.used), self._tracking.reason
        return pairs[0].time_s, fix

    def process_height(self, height: Height) -> None:
        """See ``Pipeline``."""
        self._tracking.update_height(height.height_m, height.std_m, height.is_barometer)

    @property
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        names = "outlier", "outlier-height", "unknown-anchor"
        return super().drops + Counter({name: self._tracking.counters[name] for name in names})


class Smoothed(ByPairs):
    """The same, smoothed: all fixes come at the end."""

    def __init__(self, tracking: DifferenceTracking, engine: PairEngine | None, noise: NoiseByPair) -> None:
        super().__init__(tracking, engine, noise)
        self._events: list[Event] = []

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self._pairs(record)
        self._events.extend(pairs)
        return (pairs[0].time_s if pairs else None), None

    def process_height(self, height: Height) -> None:
        """See ``Pipeline``."""
        self._events.append(height)

    def rest(self, on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """See ``Pipeline``."""
        found, numbers, count = [], set(), max(len(self._events), 1)
        for number, fix in smoothed(self._tracking, self._events):
            found.append(fix)
            numbers.add(number)
            on_progress(1.0 - number / count)
        pairs = {number: event for number, event in enumerate(self._events) if isinstance(event, PairTdoa)}
        self.measured, self.reason = _measured(pairs.values(), map(numbers.__contains__, pairs)), self._tracking.reason
        return reversed(found)


class ByPackets(Pipeline):
    """Packets as they are; some are also converted to differences, to measure the recording's noise."""

    def __init__(self, tracking: PacketTracking, engine: PairEngine, noise: NoiseByPair) -> None:
        super().__init__(engine, noise)
        self._tracking, self._heard = tracking, 0

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        assert isinstance(record, Packet)
        if self._heard % _SAMPLED_OF < _SAMPLED:
            self._pairs(record)
        self._heard += 1
        fix = self._tracking.on_packet(record)
        self.measured = ((self._tracking.newest_s, record, self._tracking.used),)
        self.reason, self.contradictions_m = self._tracking.reason, self._tracking.contradictions_m
        return self._tracking.time_s, fix

    def process_height(self, height: Height) -> None:
        """See ``Pipeline``."""
        self._tracking.tracking.update_height(height.height_m, height.std_m)

    @property
    def notes(self) -> tuple[str, ...]:
        """See ``Pipeline``."""
        return self._tracking.notes

    @property
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        return self._tracking.drops


class ByOwnEstimator(Pipeline):
    """Time differences, and the user's own estimator, which gets no heights."""

    def __init__(
        self, estimator: OwnEstimator, anchors_m: Mapping[int, Point], engine: PairEngine | None, noise: NoiseByPair
    ) -> None:
        super().__init__(engine, noise)
        self._estimator = estimator
        self._anchors_m = dict(anchors_m)
        self._drops: Counter[str] = Counter()

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self._pairs(record)
        fixes = [heard(self._estimator, pair, self._anchors_m, self._drops) for pair in pairs]
        self.measured = _measured(pairs, [fix is not None for fix in fixes])
        self.reason = NoFixReason.NO_ALMANAC if self._drops else NoFixReason.ACQUIRING
        return (pairs[0].time_s if pairs else None), next((fix for fix in reversed(fixes) if fix), None)

    @property
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        return super().drops + self._drops


PROFILES: Final[Mapping[str, EstimatorSettings]] = {
    "miluv": DIFFERENCES.changed(qa=0.1, difference_std_m=0.5, range_std_m=0.15, place_std_m=0.15)
}
"""Settings for formats that need others: MILUV's exchanges come once or twice a second, among obstacles."""

BATCH: Final = 512
"""Records read at a time: alternating reading and filtering evict each other from the processor's caches."""

READING_SHARE: Final = 0.1
"""Share of a smoothed replay's time that reading takes."""

FORMATS_BY_PACKETS: Final = frozenset({"bitcraze-yaml", "bitcraze-text", "bitcraze-binary"})
"""Formats whose packets are used by default, as that is better on real captures; on Avalue's it is not."""

_MAX_WITHOUT_ANCHORS: Final = 20_000
"""A recording that carries anchor positions has one within this many records."""


class ReplayReport(Figures, frozen=True, kw_only=True):
    """Result of a replay: metres and seconds, None if unknown."""

    format: str
    receptions: int
    """Packets, or rows of a table of differences."""
    fixes: int
    dropped: int
    rate_hz: float | None
    """Fixes per second of recorded time, None without fixes."""
    tdoa_noise_m: float | None = None
    """Median over the pairs of anchors of their differences' noise (1.4826 MAD), about the truth or the median."""
    truth_offset_s: float | None = None
    """Further offset of the truth's times that fits the fixes best; None if none stands out."""
    height_m: float | None
    reason: str | None
    """Why there is no fix at all."""
    drops: dict[str, int]
    pairs: tuple[PairNoise, ...] = ()
    wall_s: float
    receptions_per_s: float
    method: str | None
    measurements: str | None = None
    """Input of the filter, one of ``MEASUREMENTS``; None for the receptions of a site."""
    contradictions_m: dict[str, float] = field(default_factory=dict)
    """Pairs of anchors whose own ranging contradicts the table: how much farther (if negative, nearer) they are."""
    notes: tuple[str, ...] = ()
    """What is wrong with the anchors, in sentences."""


def common_figures(
    figures: Figures, receptions: int, fixes: int, drops: dict[str, int], wall_s: float
) -> dict[str, Any]:
    """Fields common to all reports: figures and counts."""
    return {
        **structs.asdict(figures),
        "receptions": receptions,
        "fixes": fixes,
        "drops": drops,
        "dropped": sum(drops.values()),
        "wall_s": wall_s,
        "receptions_per_s": receptions / wall_s if wall_s > 0.0 else 0.0,
    }


OnFix = Callable[[str, float, Fix], None]
"""Called with the tag's name, the fix's time on the recording's scale (Unix time for skyless record), and the fix."""

OnMeasured = Callable[[str, float, Record, bool], None]
"""Called with the tag's name, a time, a measurement given to the estimator, and whether it was used."""

NAMELESS: Final = "tag"
"""Name of the tag of a recording that has one tag without a name."""


class CaptureReplay:
    """Replays one recording of another system through the filter."""

    def __init__(self, asked: ReplayOptions, calibration: DifferenceCalibration | None = None) -> None:
        """Open the recording; ``calibration`` is used instead of that of the table of anchors. Raises SkylessError."""
        asked.leave_out(
            *("tag", "method", "integrity_risk", "alert_limit_m"), why="it is for recordings of skyless record"
        )
        self._asked, kind = asked, format_of(asked.file, asked.format)
        self._anchors_m, site_height_m = known_anchors(asked.anchors, asked.site)
        if not self._anchors_m and kind.read_anchors is not None:
            self._anchors_m = kind.read_anchors(asked.file)
        self._truth = known_truth(Path(asked.file), asked)
        if not self._anchors_m:
            _check_carries_anchors(asked)
        self.known_m = self._anchors_m or stated_anchors(asked.file, kind)
        """Positions at the recording's beginning, for time differences; packets carry theirs, which may change."""
        self.height_m, self._height_std_m, self.height_note = height_to_hold(
            asked.tag_height_m, self.known_m, site_height_m, self._truth, kind.name
        )
        if asked.tag_height_std_m is not None:
            self._height_std_m = asked.tag_height_std_m
            if self.height_m is None:
                asked.leave_out("tag_height_std_m", why="the height is estimated")
        if self.height_m is not None:
            asked.leave_out("z_bounds_m", "height_kind", why=f"the height is not estimated ({self.height_note})")
        self.measurements = self._measurements(kind)
        self._heights = known_heights(asked)
        path, anchors_m = asked.file, self._anchors_m
        self._channel = asked.channel
        if self._channel is None and self.measurements == PACKETS and kind.channels:
            self._channel = kind.channels[0]  # stamps of two channels have other constants
        self.recording: Recording = open_recording(path, asked.format, asked.listener, anchors_m, self._channel)
        self._calibration = calibration
        table = asked.anchors if isinstance(asked.anchors, str | Path) and not asked.uncalibrated else None
        if calibration is None and table is not None and Path(table).suffix not in YAML_SUFFIXES:
            self._calibration = read_calibration(table)
        self._noise = NoiseByPair(self._truth, self.known_m)
        self._pipeline = self._new_pipeline()
        self.receptions = 0
        self.samples = FixSamples()
        self._first_s: float | None = None
        self._last_s = 0.0

    def _measurements(self, kind: Format) -> str:
        """The measurements that were asked for, or that suit the recording."""
        asked = self._asked
        if asked.needs_differences:
            if asked.measurements == PACKETS:
                raise SkylessError(f"--measurements is 'packets'; {asked.needs_differences} needs differences")
            return DIFFERENCES_MADE
        if asked.measurements is None:
            suits = kind.channels or kind.is_dl_tdoa or (kind.name in FORMATS_BY_PACKETS and self._anchors_m)
            return PACKETS if suits and asked.tdoa_std_m is None else DIFFERENCES_MADE
        if asked.measurements == PACKETS and kind.tx_bits is None:
            wanted = f"it should be 'differences': {kind.name} holds no anchors' packets"
            raise SkylessError(f"--measurements is 'packets'; {wanted}")
        if asked.measurements == PACKETS and asked.tdoa_std_m is not None:
            raise SkylessError("--tdoa-std is the noise of differences; --measurements packets makes none")
        return asked.measurements

    @property
    def _has_phases(self) -> bool:
        """Whether phases of a channel's carrier are used."""
        return self._channel is not None and not self._asked.stamps_only and self.measurements == PACKETS

    def _new_pipeline(self) -> Pipeline:
        if self.measurements == PACKETS:
            return self._by_packets()
        bits = self.recording.format.tx_bits
        engine = None if bits is None else PairEngine(bits, anchors_m=self.known_m)
        if self._asked.estimator is not None:
            return ByOwnEstimator(self._asked.estimator(), self.known_m, engine, self._noise)
        asked = {"difference_std_m": self._asked.tdoa_std_m, "height_m": self.height_m}
        asked["height_std_m"] = self._height_std_m
        known = {key: value for key, value in asked.items() if value is not None}
        settings = PROFILES.get(self.recording.format.name, DIFFERENCES).changed(**known)
        tracking = DifferenceTracking(settings, self.known_m, self._asked.z_bounds_m, self._calibration)
        if self._asked.smooth:
            return Smoothed(tracking, engine, self._noise)
        return ByPairs(tracking, engine, self._noise, self._motion())

    def _motion(self) -> Sequence[MotionSample]:
        """What the tag's motion sensor showed, if it was recorded and is wanted."""
        read, arm_m = self.recording.format.read_motion, self._asked.lever_arm_m or (0.0, 0.0, 0.0)
        rows = None if read is None or self._asked.imu != RECORDED else read(self._asked.file)
        return [
            MotionSample(t_s, (p, q, r), (x, y, z), arm_m=arm_m)
            for t_s, p, q, r, x, y, z in ([] if rows is None else rows.tolist())
        ]

    def _by_packets(self) -> ByPackets:
        bits = self.recording.format.tx_bits
        assert bits is not None
        known = {"height_m": self.height_m, "height_std_m": self._height_std_m}
        known["carrier_cycles"] = CARRIER_CYCLES[self._channel or 5] if self._has_phases else 0
        is_dl_tdoa = self.recording.format.is_dl_tdoa
        tracking = PacketTracking(
            (DL_TDOA if is_dl_tdoa else MASTERLESS).changed(**known),
            self._anchors_m,
            bits,
            self._asked.z_bounds_m,
            calibration=self._calibration,
            one_way=DL_TDOA_ONE_WAY.changed(**known) if is_dl_tdoa else None,
        )
        return ByPackets(tracking, PairEngine(bits, anchors_m=self.known_m), self._noise)

    def run(
        self,
        on_fix: OnFix | None,
        on_progress: Callable[[float], None],
        on_measured: OnMeasured | None = None,
    ) -> ReplayReport:
        """Read to the end.

        ``on_progress`` gets now and then the share that is done, and ``on_measured`` the parts of ``Measured``.
        """
        started_s, size = time.perf_counter(), max(Path(self._asked.file).stat().st_size, 1)
        reading = READING_SHARE if self._asked.smooth else 1.0
        with closing(self.recording):
            records = iter(self.recording)
            while not self._is_over() and (batch := list(islice(records, BATCH))):
                for record in batch:
                    self.receptions += 1
                    time_s, fix = self._pipeline.process(record)
                    self._tell(on_measured)
                    if time_s is not None:
                        self._first_s = time_s if self._first_s is None else self._first_s
                        self._last_s = time_s
                        while self._heights and self._heights[0].time_s <= time_s:
                            self._pipeline.process_height(self._heights.popleft())
                        if self._is_over():
                            break
                    if fix is not None:
                        self._add(fix, on_fix)
                on_progress(reading * min(self.recording.bytes_read / size, 1.0))
            for fix in self._pipeline.rest(lambda share: on_progress(reading + (1.0 - reading) * share)):
                self._add(fix, on_fix)
            self._tell(on_measured)
        table = self.samples.table()
        self._check_truth(table)
        offset_s = None if self._truth is None else estimated_offset_s(self._truth, table.time_s, table.position_m)
        if self._truth is not None and self._asked.truth_offset_s == "auto" and offset_s is not None:
            self._truth, offset_s = shifted(self._truth, offset_s), 0.0
            self._noise.truth = self._truth
        figures = figures_of(table, self.judged, self.samples.count)
        return self._report(figures, offset_s, time.perf_counter() - started_s)

    def _tell(self, on_measured: OnMeasured | None) -> None:
        if on_measured is not None:
            for measured in self._pipeline.measured:
                on_measured(NAMELESS, *measured)

    def _is_over(self) -> bool:
        """Whether as much has been replayed as was asked for."""
        first_s = self._asked.first_s
        return first_s is not None and self._first_s is not None and self._last_s - self._first_s > first_s

    @property
    def judged(self) -> Judged:
        """Which fixes are judged."""
        asked, settle_s = self._asked, 2.0 if self._truth is None else 3.0
        return Judged(
            truth=self._truth,
            begin_s=self._first_s,
            end_s=self._last_s,
            planar=self.height_m is not None,
            settle_s=settle_s if asked.settle_s is None else asked.settle_s,
            above_m=flight_height(asked.above_m, self._truth),
        )

    def _add(self, fix: Fix, on_fix: OnFix | None) -> None:
        self.samples.add(fix.time_s, fix)
        if on_fix is not None:
            on_fix(NAMELESS, fix.time_s, fix)

    def _check_truth(self, table: FixTable) -> None:
        """Check that the listener is in the recording, and that the truth overlaps it. Raises SkylessError."""
        asked, truth, times_s = self._asked, self._truth, table.time_s
        if asked.listener is not None and self.receptions == 0:
            raise ConfigurationError(asked.file, "listener", asked.listener, "one that the recording names")
        if asked.truth is not None and truth is not None and len(times_s) and np.isnan(truth_at(truth, times_s)).all():
            span = f"{truth.t_s[0]:.3f} to {truth.t_s[-1]:.3f}"
            expected = f"in the time of the recording, whose fixes are from {times_s.min():.3f} to {times_s.max():.3f}"
            table_name = asked.truth if isinstance(asked.truth, str | Path) else "truth"
            raise ConfigurationError(table_name, "column t_s", span, expected)

    def _report(self, figures: Figures, offset_s: float | None, wall_s: float) -> ReplayReport:
        pairs, fixes = self._noise.pairs(), self.samples.count
        span_s = self._last_s - (self._first_s or 0.0)
        reason = self._pipeline.reason if self.known_m or fixes else NoFixReason.NO_ALMANAC
        total = self.recording.drops + self._pipeline.drops
        drops = {name: count for name, count in sorted(total.items()) if count}
        by_m = sorted(self._pipeline.contradictions_m.items())
        name = self.recording.format.anchor_name
        own, filtered = self._asked.estimator, "joint-smoothed" if self._asked.smooth else "joint"
        return ReplayReport(
            format=self.recording.format.name,
            **common_figures(figures, self.receptions, fixes, drops, wall_s),
            rate_hz=fixes / span_s if fixes and span_s > 0.0 else None,
            tdoa_noise_m=float(np.median([pair.noise_m for pair in pairs])) if pairs else None,
            truth_offset_s=offset_s,
            height_m=self.height_m,
            reason=None if fixes else str(reason),
            pairs=pairs,
            method=filtered if own is None else getattr(own, "__name__", "own"),
            measurements=f"{self.measurements} and phases" if self._has_phases else self.measurements,
            contradictions_m={f"{name(a)}-{name(b)}": metres for (a, b), metres in by_m},
            notes=self._pipeline.notes,
        )


def _check_carries_anchors(asked: ReplayOptions) -> None:
    """Check that a recording without a table of anchors has their positions, before it is read as a whole.

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
            f"id,x_m,y_m,z_m, or --site{how_to_find_anchors(asked.file, recording.format)}"
        )


def how_to_find_anchors(file: str | Path, kind: Format) -> str:
    """The command that finds the anchors of a recording in which they range each other; otherwise empty."""
    ranges = kind.tx_bits is not None and not kind.is_dl_tdoa
    return f"; skyless survey --recording {file} --out anchors.csv finds them" if ranges else ""


def distances_of(file: str | Path, name: str) -> dict[str, float]:
    """Distances between anchors, if the recording measures them."""
    if name != "avalue":
        return {}
    return {f"{a}-{b}": metres for (a, b), metres in sorted(anchor_distances_m(file, Counter()).items())}
