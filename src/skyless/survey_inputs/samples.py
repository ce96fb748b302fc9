"""What a recording gives a calibration: time differences while the tag's position is known, in bounded memory."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from math import dist, inf, log
from typing import Final, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import astuple

from skyless.air.beacon import Beacon, Malformed, MasterTime
from skyless.air.codec import decode_cached
from skyless.air.masterless_packets import Packet, PairTdoa, Point
from skyless.air.reception import Reception
from skyless.constants import TICK_M
from skyless.errors import SkylessError
from skyless.evaluation.judge import Judge
from skyless.evaluation.statistics import EvenSample
from skyless.mqtt.messages import ReceptionsMessage
from skyless.positioning.masterless.pair_engine import PairEngine
from skyless.recordings.foreign.formats import Recording
from skyless.recordings.mcap.host_clock import HostClock
from skyless.recordings.mcap.recording import McapRecording
from skyless.recordings.source import Drops
from skyless.replays.site import reception_of
from skyless.survey.tags.estimate import Differences
from skyless.ticks import difference, from_seconds

# Time differences out of a tag's recorded receptions: every anchor against the master, both in the site's time.
#
# Between two beacons of the master the tag's clock runs evenly, so the master's range less the clock is interpolated
# to the moment of the anchor's beacon.

_LONGEST_TICKS: Final = from_seconds(0.2)
"""Over a longer time between two beacons of the master the tag's clock does not run evenly enough."""

_WORST_CLOCK_TICKS: Final = 40.0
"""An anchor whose clock is known less well, 0.19 m, is not used."""


class _TimedBeacon(Struct, frozen=True):
    """A beacon with the tag's stamp and the time on the master's scale."""

    beacon: Beacon
    time: MasterTime
    rx_ticks: int
    unix_s: float


class NewReceptions:
    """One tag's receptions, as they come, each once."""

    def __init__(self) -> None:
        self._clock: HostClock[Reception] = HostClock()
        self._segment = ""
        self._next = 0

    def begins(self, message: ReceptionsMessage) -> bool:
        """Whether the tag has started again; receptions before are of another counter."""
        if message.segment == self._segment:
            return False
        self._segment, self._next, self._clock = message.segment, message.first, HostClock()
        return True

    def read(self, message: ReceptionsMessage) -> Iterator[tuple[Reception, float]]:
        """Receptions, each once, with Unix time: of this run and of runs before, as their times become known."""
        new = message.receptions[max(self._next - message.first, 0) :]
        self._next = max(self._next, message.first + len(message.receptions))
        for raw in new:
            reception = reception_of(raw)
            if reception is not None:
                yield from self._clock.add(reception, message.unix_less_host_s, reception)


class SiteListener:
    """One tag's receptions, as they come, to time differences against the master."""

    def __init__(self, site: int) -> None:
        self._site = site
        self._receptions = NewReceptions()
        self._before: _TimedBeacon | None = None
        self._between: list[_TimedBeacon] = []

    def process(self, message: ReceptionsMessage) -> Iterator[PairTdoa]:
        """Process a run of receptions, some of which may have come before; times are Unix seconds."""
        if self._receptions.begins(message):
            self._before, self._between = None, []
        for reception, unix_s in self._receptions.read(message):
            heard = self._beacon(reception, unix_s)
            if heard is not None:
                yield from self._differences(heard)

    def _beacon(self, reception: Reception, unix_s: float) -> _TimedBeacon | None:
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Malformed) or beacon.site != self._site:
            return None
        time = beacon.master_time
        if time is None or time.std_ticks > _WORST_CLOCK_TICKS:
            return None
        return _TimedBeacon(beacon, time, reception.rx_ticks, unix_s)

    def _differences(self, heard: _TimedBeacon) -> Iterator[PairTdoa]:
        if heard.beacon.anchor != heard.beacon.master:
            self._between.append(heard)
            return
        before, between = self._before, self._between
        self._before, self._between = heard, []
        if before is None or _master_term(before) != _master_term(heard):
            return
        span_ticks = difference(heard.rx_ticks, before.rx_ticks)
        if not 0 < span_ticks <= _LONGEST_TICKS:
            return
        slip_ticks = _late_ticks(heard, before)
        for one in between:
            elapsed = difference(one.rx_ticks, before.rx_ticks)
            if _master_term(one) == _master_term(heard) and 0 < elapsed < span_ticks:
                late_ticks = _late_ticks(one, before) - slip_ticks * elapsed / span_ticks
                yield PairTdoa(one.unix_s, heard.beacon.master, one.beacon.anchor, late_ticks * TICK_M)


def site_tdoas(recording: McapRecording, tags: Sequence[str], site: int, drops: Counter[str]) -> Iterator[PairTdoa]:
    """All time differences of some tags under the first master that was heard; those under others are counted."""
    listeners = {tag: SiteListener(site) for tag in tags}
    master: int | None = None
    for found in recording.messages({"receptions"}):
        if found.channel.name not in listeners:
            continue
        for pair in listeners[found.channel.name].process(cast("ReceptionsMessage", found.message)):
            master = pair.anchor_a if master is None else master
            if pair.anchor_a == master:
                yield pair
            else:
                drops["another-master"] += 1


def _master_term(heard: _TimedBeacon) -> tuple[int, int]:
    return heard.beacon.master, heard.beacon.term


def _late_ticks(heard: _TimedBeacon, before: _TimedBeacon) -> float:
    """By how much more the tag's counter went on than the site's time, from one beacon to another."""
    whole, fraction = divmod(heard.time.tx_subticks_master - before.time.tx_subticks_master, 256)
    return difference(heard.rx_ticks, before.rx_ticks) - difference(whole, 0) - fraction / 256.0


# Differences of a recording at known positions.

_MOST_ROWS: Final = 300_000
"""Of a longer recording an even sample is used."""

_NEAREST_M: Final = 0.01

PositionAt = Callable[[float], Point | None]
"""Where the tag's antenna was at a time of the recording; None where that is not known."""


class Stay(Struct, frozen=True):
    """A tag at rest at a known position."""

    x_m: float
    y_m: float
    z_m: float | None = None
    """None: at the height of the site's tags."""
    from_s: float = -inf
    """Since the first difference."""
    to_s: float = inf


class First(Struct, frozen=True):
    """Only the beginning of a recording: a number of differences, of seconds, or a part of its time."""

    count: int | None = None
    seconds: float | None = None
    part: float | None = None


class Samples(Struct, frozen=True):
    """Time differences at known positions, out of a recording."""

    differences: Differences
    anchors_m: dict[int, Point]
    """Where the anchors stand, or last stood."""
    seen: int
    drops: dict[str, int]
    """Differences that could not be used, by reason."""


def position_of_truth(judge: Judge, above_m: float | None) -> PositionAt:
    """Truth by time, where it is high enough."""

    def position_at(time_s: float) -> Point | None:
        at_m = judge.at(time_s)
        return None if at_m is None or (above_m is not None and at_m[2] <= above_m) else at_m

    return position_at


def position_of_stays(stays: Sequence[Stay], height_m: float | None, begin_s: float) -> PositionAt:
    """Known positions by time; of stays that overlap the first counts.

    Raises:
        SkylessError: a stay has no height, and the site does not know it either.
    """
    stays_m: list[tuple[Stay, Point]] = []
    for stay in stays:
        z_m = height_m if stay.z_m is None else stay.z_m
        if z_m is None:
            raise SkylessError(f"--at {stay.x_m:g},{stay.y_m:g} lacks its height: it should be x,y,z")
        stays_m.append((stay, (stay.x_m, stay.y_m, z_m)))

    def position_at(time_s: float) -> Point | None:
        since_s = time_s - begin_s
        return next((position_m for stay, position_m in stays_m if stay.from_s <= since_s <= stay.to_s), None)

    return position_at


def tdoas_of(recording: Recording, anchors_m: Mapping[int, Point]) -> Iterator[PairTdoa]:
    """All time differences of a recording, whatever its format."""
    bits = recording.format.tx_bits
    engine = None if bits is None else PairEngine(bits, anchors_m=dict(anchors_m))
    for record in recording:
        if isinstance(record, Packet):
            assert engine is not None
            yield from engine.on_packet(record)
        else:
            yield record


def gather(
    pairs: Iterable[PairTdoa],
    anchors_m: Mapping[int, Point],
    position_from: Callable[[float], PositionAt],
    first: First,
) -> Samples:
    """Gather the differences at known positions; ``position_from`` gets the time of the first difference."""
    drops: Drops = Counter()
    anchor_positions_m = dict(anchors_m)
    sample = EvenSample(5, _MOST_ROWS)
    position_at: PositionAt | None = None
    begin_s = last_s = 0.0
    for pair in pairs:
        if position_at is None:
            position_at, begin_s = position_from(pair.time_s), pair.time_s
        if first.seconds is not None and pair.time_s - begin_s > first.seconds:
            break
        last_s = max(last_s, pair.time_s)
        row = _row(pair, anchor_positions_m, position_at)
        if isinstance(row, str):
            drops[row] += 1
            continue
        sample.add(row)
        if sample.seen == first.count:
            break
    rows = sample.rows
    if first.part is not None:
        rows = rows[rows[:, 0] <= begin_s + first.part * (last_s - begin_s)]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    ids = rows[:, 1:3].astype(np.int64)
    differences = Differences(rows[:, 0], ids[:, 0], ids[:, 1], rows[:, 3], rows[:, 4])
    return Samples(differences, anchor_positions_m, sample.seen, dict(sorted(drops.items())))


def _row(pair: PairTdoa, anchor_positions_m: dict[int, Point], position_at: PositionAt) -> tuple[float, ...] | str:
    """Time, anchors, excess over the geometry, logarithm of the ranges' ratio; or why there is none."""
    if pair.a_m is not None:
        anchor_positions_m[pair.anchor_a] = pair.a_m
    if pair.b_m is not None:
        anchor_positions_m[pair.anchor_b] = pair.b_m
    a_m, b_m = anchor_positions_m.get(pair.anchor_a), anchor_positions_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        return "unknown-anchor"
    at_m = position_at(pair.time_s)
    if at_m is None:
        return "place-unknown"
    range_a, range_b = max(dist(at_m, a_m), _NEAREST_M), max(dist(at_m, b_m), _NEAREST_M)
    excess_m = pair.tdoa_m - (range_b - range_a)
    return pair.time_s, float(pair.anchor_a), float(pair.anchor_b), excess_m, log(range_b / range_a)


def joined(samples: Sequence[Samples]) -> Samples:
    """Samples of several tags as one, in the order of time."""
    parts = [one.differences for one in samples]
    differences = Differences(*map(np.concatenate, zip(*map(astuple, parts), strict=True)))
    differences = differences.select(np.argsort(differences.t_s, kind="stable"))
    drops: Drops = Counter()
    for one in samples:
        drops.update(one.drops)
    return Samples(differences, samples[0].anchors_m, sum(one.seen for one in samples), dict(sorted(drops.items())))
