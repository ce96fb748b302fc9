"""The two ways from records to fixes: time differences of pairs, or the packets themselves."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final, Protocol

from skyless.air.masterless_packets import Packet, PairTdoa
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.masterless.difference_tracking import DifferenceTracking
from skyless.positioning.masterless.packet_tracking import PacketTracking
from skyless.positioning.masterless.pair_engine import PairEngine
from skyless.replay.noise import NoiseByPair

Record = Packet | PairTdoa
Triple = tuple[float, float, float]

SAMPLED: Final = 128
SAMPLED_OF: Final = 1024
"""Of each 1024 packets the first 128 are made into time differences as well, to measure the recording's noise."""


class ReplayPipeline(Protocol):
    """What a replay asks of either."""

    def hear(self, record: Record) -> float | None:
        """Take one record; the time up to which positions may be known now, None where it tells nothing."""
        ...

    @property
    def position_m(self) -> Triple | None:
        """Where the record put the tag, None if it made no fix."""
        ...

    def fix(self) -> Fix:
        """The newest position with all that is known of it, after a record that made one."""
        ...

    @property
    def reason(self) -> NoFixReason:
        """Why there was no fix of late."""
        ...

    @property
    def drops(self) -> Counter[str]:
        """What could not be used, by reason."""
        ...

    @property
    def contradictions_m(self) -> Mapping[tuple[int, int], float]:
        """Pairs of anchors whose own ranging contradicts the table."""
        ...


class ByPairs:
    """Time differences of pairs, ready or made of packets, and the filter of pairs."""

    def __init__(self, tracking: DifferenceTracking, engine: PairEngine | None, noise: NoiseByPair) -> None:
        self._tracking = tracking
        self._engine = engine
        self._noise = noise
        self._made = False

    def hear(self, record: Record) -> float | None:
        """Take one record; the time of its differences."""
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
        """Pairs of anchors whose own ranging contradicts the table: differences do not tell."""
        return {}


class ByPackets:
    """Packets as they are; a part of them is made into differences as well, to measure the recording's noise."""

    def __init__(self, tracking: PacketTracking, engine: PairEngine, noise: NoiseByPair) -> None:
        self._tracking = tracking
        self._engine = engine
        self._noise = noise
        self._heard = 0
        self._fix: Fix | None = None

    def hear(self, record: Record) -> float | None:
        """Take one packet; its time."""
        assert isinstance(record, Packet)
        if self._heard % SAMPLED_OF < SAMPLED:
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
