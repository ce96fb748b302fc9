"""Time differences out of a tag's recorded receptions: every anchor against the master, both as the site tells time.

Between two beacons of the master the tag's clock runs evenly, so the master's range less the clock is interpolated
to the moment of the anchor's beacon.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, cast

from msgspec import Struct

from skyless.air.beacon import Beacon, Malformed, MasterTime
from skyless.air.codec import decode_cached
from skyless.air.masterless_packets import PairTdoa
from skyless.air.reception import Reception
from skyless.constants import TICK_M
from skyless.mqtt.messages import RawReception, ReceptionsMessage
from skyless.recordings.mcap.recording import McapRecording
from skyless.replay.tag import HostClock, reception_of
from skyless.ticks import difference, from_seconds

LONGEST_TICKS: Final = from_seconds(0.2)
"""Over a longer time between two beacons of the master the tag's clock does not run evenly enough."""

WORST_CLOCK_TICKS: Final = 40.0
"""An anchor whose clock is known worse, 0.19 m, is not used."""


class _Heard(Struct, frozen=True):
    """A beacon with the tag's stamp and the time on the master's scale."""

    beacon: Beacon
    time: MasterTime
    rx_ticks: int
    unix_s: float


class SiteListener:
    """One tag's receptions, as they come, to time differences against the master."""

    def __init__(self, site: int) -> None:
        self._site = site
        self._clock = HostClock()
        self._segment = ""
        self._next = 0
        self._before: _Heard | None = None
        self._between: list[_Heard] = []

    def hear(self, message: ReceptionsMessage) -> Iterator[PairTdoa]:
        """Take a run of receptions, some of which may have come before; times are Unix seconds."""
        if message.segment != self._segment:
            self._segment, self._next = message.segment, message.first
            self._clock, self._before, self._between = HostClock(), None, []
        new = message.receptions[max(self._next - message.first, 0) :]
        self._next = max(self._next, message.first + len(message.receptions))
        for raw in new:
            heard = self._beacon(raw, message.unix_less_host_s)
            if heard is not None:
                yield from self._take(heard)

    def _beacon(self, raw: RawReception, unix_less_host_s: float) -> _Heard | None:
        reception: Reception | None = reception_of(raw)
        beacon = Malformed.NOT_A_BEACON if reception is None else decode_cached(reception.frame)
        if reception is None or isinstance(beacon, Malformed) or beacon.site != self._site:
            return None
        unix_s = self._clock.unix_s(reception, unix_less_host_s)
        time = beacon.master_time
        if time is None or time.std_ticks > WORST_CLOCK_TICKS:
            return None
        return _Heard(beacon, time, reception.rx_ticks, unix_s)

    def _take(self, heard: _Heard) -> Iterator[PairTdoa]:
        if heard.beacon.anchor != heard.beacon.master:
            self._between.append(heard)
            return
        before, between = self._before, self._between
        self._before, self._between = heard, []
        if before is None or _reign(before) != _reign(heard):
            return
        span_ticks = difference(heard.rx_ticks, before.rx_ticks)
        if not 0 < span_ticks <= LONGEST_TICKS:
            return
        slip_ticks = _late_ticks(heard, before)
        for one in between:
            elapsed = difference(one.rx_ticks, before.rx_ticks)
            if _reign(one) == _reign(heard) and 0 < elapsed < span_ticks:
                late_ticks = _late_ticks(one, before) - slip_ticks * elapsed / span_ticks
                yield PairTdoa(one.unix_s, heard.beacon.master, one.beacon.anchor, late_ticks * TICK_M)


def site_tdoas(recording: McapRecording, tags: Sequence[str], site: int, drops: Counter[str]) -> Iterator[PairTdoa]:
    """All time differences of some tags under the first master that was heard; those under others are counted."""
    ears = {tag: SiteListener(site) for tag in tags}
    master: int | None = None
    for found in recording.messages({"receptions"}):
        if found.place.name not in ears:
            continue
        for pair in ears[found.place.name].hear(cast("ReceptionsMessage", found.message)):
            master = pair.anchor_a if master is None else master
            if pair.anchor_a == master:
                yield pair
            else:
                drops["another-master"] += 1


def _reign(heard: _Heard) -> tuple[int, int]:
    return heard.beacon.master, heard.beacon.term


def _late_ticks(heard: _Heard, before: _Heard) -> float:
    """By how much more the tag's counter went on than the site's time, from one beacon to another."""
    whole, fraction = divmod(heard.time.tx_subticks_master - before.time.tx_subticks_master, 256)
    return difference(heard.rx_ticks, before.rx_ticks) - difference(whole, 0) - fraction / 256.0
