"""The ways from the records of a recording to fixes: by time differences, smoothed, by packets, by one's own estimator.

All have the same methods: ``process`` takes a record, and ``rest`` gives the fixes that only the whole recording makes.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, Protocol

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


class Pipeline(Protocol):
    """A way from records to fixes."""

    @property
    def reason(self) -> NoFixReason:
        """Why there was no fix of late."""

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """Process one record: the time of its differences, and a fix if it made one."""

    def process_height(self, height: Height) -> None:
        """Process a reading of the tag's height sensor, which came before the next record."""

    def rest(self, on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """Fixes that only the whole recording makes, at its end; ``on_progress`` gets the share that is done."""

    def measured(self) -> Iterable[Measured]:
        """What the last ``process``, or ``rest``, gave the estimator."""

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """Pairs of anchors whose own ranging contradicts the table."""


class _Differences:
    """Time differences of pairs, ready or made of packets."""

    contradictions_m: Mapping[tuple[int, int], float] = {}
    """None, as differences hold no ranges."""

    def __init__(self, engine: PairEngine | None, noise: NoiseByPair) -> None:
        self._engine = engine
        self._noise = noise
        self._measured: Sequence[PairTdoa] = ()
        self._used: Sequence[bool] = ()

    def measured(self) -> Iterable[Measured]:
        """See ``Pipeline``."""
        return ((pair.time_s, pair, used) for pair, used in zip(self._measured, self._used, strict=True))

    def pairs(self, record: Record) -> Sequence[PairTdoa]:
        """The differences of one record."""
        if isinstance(record, Packet):
            assert self._engine is not None
            found: Sequence[PairTdoa] = self._engine.on_packet(record)
        else:
            found = (record,)
        for pair in found:
            self._noise.add(pair)
        return found

    @property
    def drops(self) -> Counter[str]:
        """What the engine could not use, by reason."""
        return Counter() if self._engine is None else Counter(self._engine.drops)

    def rest(self, _on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """See ``Pipeline``."""
        self._measured = self._used = ()
        return ()


class ByPairs(_Differences):
    """Time differences and the filter of pairs."""

    def __init__(self, tracking: DifferenceTracking, engine: PairEngine | None, noise: NoiseByPair) -> None:
        super().__init__(engine, noise)
        self._tracking = tracking

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self.pairs(record)
        if not pairs:
            self._measured = self._used = ()
            return None, None
        fix = self._tracking.fix() if self._tracking.update(pairs) else None
        self._measured, self._used = pairs, self._tracking.used
        return pairs[0].time_s, fix

    def process_height(self, height: Height) -> None:
        """See ``Pipeline``."""
        self._tracking.update_height(height.height_m, height.std_m, height.is_barometer)

    @property
    def reason(self) -> NoFixReason:
        """See ``Pipeline``."""
        return self._tracking.reason

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
        pairs = self.pairs(record)
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
        self._measured, self._used = tuple(pairs.values()), [number in numbers for number in pairs]
        return reversed(found)


class ByPackets:
    """Packets as they are; a part of them is made into differences as well, to measure the recording's noise."""

    def __init__(self, tracking: PacketTracking, engine: PairEngine, noise: NoiseByPair) -> None:
        self._tracking = tracking
        self._differences = _Differences(engine, noise)
        self._heard = 0
        self._newest: Packet | None = None

    def measured(self) -> Iterable[Measured]:
        """See ``Pipeline``."""
        return () if self._newest is None else ((self._tracking.newest_s, self._newest, self._tracking.used),)

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        assert isinstance(record, Packet)
        if self._heard % _SAMPLED_OF < _SAMPLED:
            self._differences.pairs(record)
        self._heard += 1
        fix = self._tracking.on_packet(record)
        self._newest = record
        return self._tracking.time_s, fix

    def process_height(self, height: Height) -> None:
        """See ``Pipeline``."""
        self._tracking.tracking.update_height(height.height_m, height.std_m)

    def rest(self, _on_progress: Callable[[float], None]) -> Iterable[Fix]:
        """See ``Pipeline``."""
        self._newest = None
        return ()

    @property
    def reason(self) -> NoFixReason:
        """See ``Pipeline``."""
        return self._tracking.reason

    @property
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        return self._tracking.drops

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """See ``Pipeline``."""
        return self._tracking.contradictions_m


class ByOwnEstimator(_Differences):
    """Time differences and an estimator of the reader's own."""

    def __init__(
        self, estimator: OwnEstimator, anchors_m: Mapping[int, Point], engine: PairEngine | None, noise: NoiseByPair
    ) -> None:
        super().__init__(engine, noise)
        self._estimator = estimator
        self._anchors_m = dict(anchors_m)
        self._drops: Counter[str] = Counter()

    def process(self, record: Record) -> tuple[float | None, Fix | None]:
        """See ``Pipeline``."""
        pairs = self.pairs(record)
        fixes = [heard(self._estimator, pair, self._anchors_m, self._drops) for pair in pairs]
        self._measured, self._used = pairs, [fix is not None for fix in fixes]
        return (pairs[0].time_s if pairs else None), next((fix for fix in reversed(fixes) if fix), None)

    @property
    def reason(self) -> NoFixReason:
        """See ``Pipeline``."""
        return NoFixReason.NO_ALMANAC if self._drops else NoFixReason.ACQUIRING

    def process_height(self, height: Height) -> None:
        """Leave heights out: an own estimator gets differences alone."""

    @property
    def drops(self) -> Counter[str]:
        """See ``Pipeline``."""
        return super().drops + self._drops
