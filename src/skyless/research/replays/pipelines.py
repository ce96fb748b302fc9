"""The ways from records of a recording to fixes: by differences, smoothed, by packets, by an estimator of one's own."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.fix import Fix, NoFixReason
from skyless.research.masterless.difference_tracking import DifferenceTracking
from skyless.research.masterless.own_estimator import OwnEstimator, heard
from skyless.research.masterless.packet_tracking import PacketTracking
from skyless.research.masterless.pair_engine import PairEngine
from skyless.research.masterless.smoothing import Event, Height, smoothed
from skyless.research.replays.noise import NoiseByPair

Record = Packet | PairTdoa

Measured = tuple[float, Record, bool]
"""A time, what the estimator was given, and whether it used that."""

_SAMPLED: Final = 128
_SAMPLED_OF: Final = 1024
"""The first 128 of each 1024 packets are made into time differences as well, to measure the recording's noise."""


class Pipeline:
    """A way from records to fixes; this one's are made into time differences of pairs, where they are none already."""

    contradictions_m: Mapping[tuple[int, int], float] = {}
    """Pairs of anchors whose own ranging contradicts the table."""
    reason = NoFixReason.NO_BEACONS
    """Why there was no fix of late."""

    def __init__(self, engine: PairEngine | None, noise: NoiseByPair) -> None:
        self._engine, self._noise = engine, noise
        self.measured: Sequence[Measured] = ()
        """What the last ``process``, or ``rest``, gave the estimator."""

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """Process one record: the time of its differences, and a fix if it made one."""
        raise NotImplementedError

    def process_height(self, height: Height) -> None:
        """Process a reading of the tag's height sensor, which came before the next record; left out by default."""

    def rest(self, _on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """Fixes that only the whole recording makes, at its end; ``on_progress`` gets the share that is done."""
        self.measured = ()
        return ()

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        return Counter() if self._engine is None else Counter(self._engine.drops)

    def _pairs(self, record: Record) -> Sequence[PairTdoa]:
        """The differences of one record."""
        if isinstance(record, Packet):
            assert self._engine is not None
            found: Sequence[PairTdoa] = self._engine.on_packet(record)
        else:
            found = (record,)
        for pair in found:
            self._noise.add(pair)
        return found


def _measured(pairs: Iterable[PairTdoa], used: Iterable[bool]) -> Sequence[Measured]:
    return [(pair.time_s, pair, is_used) for pair, is_used in zip(pairs, used, strict=True)]


class ByPairs(Pipeline):
    """Time differences and the filter of pairs."""

    def __init__(self, tracking: DifferenceTracking, engine: PairEngine | None, noise: NoiseByPair) -> None:
        super().__init__(engine, noise)
        self._tracking = tracking

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self._pairs(record)
        if not pairs:
            self.measured = ()
            return None, None
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
    """Packets as they are; a part of them is made into differences as well, to measure the recording's noise."""

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
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        return self._tracking.drops


class ByOwnEstimator(Pipeline):
    """Time differences and an estimator of the reader's own, which gets no heights."""

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
