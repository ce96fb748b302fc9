"""An emulated FiRa board: a site's beacons as the rounds of a DL-TDoA session, in notifications of UCI.

Every superframe is a round. The master's beacon is the poll; those of the other anchors are the responses, as each
holds when its sender received the master's.
"""

from collections import Counter
from collections.abc import Callable
from math import dist
from typing import Final, Literal

from skyless.air.beacon import Beacon
from skyless.air.codec import decode_cached
from skyless.air.masterless_packets import Point
from skyless.air.reception import Diagnostics, Reception
from skyless.air.uci import (
    NO_LOCATION,
    RELATIVE_LOCATION,
    DtMeasurement,
    DtMessageType,
    SessionInfo,
    encode_packet,
    encode_session_info,
)
from skyless.air.uci_location import encode_relative
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.radios.interface import RadioEvent
from skyless.site.almanac_pages import AlmanacAssembly
from skyless.ticks import difference

_SESSION: Final = 1
_MOST_FLIGHT_TICKS: Final = 0xFFFF
_MOST_REPLY_TICKS: Final = 0xFFFF_FFFF
_MOST_MEASUREMENTS: Final = 0xFF
_RELATIVE_2: Final = bytes((1, 1 | 1 << 1))
"""How a relative location begins in version 2."""


class UciProtocol:
    """What the board sends; a round as soon as all have been heard that were in the one before, or with the next."""

    def __init__(self, send: Callable[[bytes], bool], version: Literal[1, 2]) -> None:
        self._send, self._version = send, version
        self._almanac = AlmanacAssembly()
        self._round: dict[int, DtMeasurement] = {}
        self._usual: frozenset[int] = frozenset()
        self._is_sent = True
        self._poll: Beacon | None = None
        self._sequence = 0
        self.drops: Counter[str] = Counter()

    def on_radio_event(self, event: RadioEvent) -> None:
        """Add a beacon to its round, and send the round before or the one that it completes."""
        if not isinstance(event, Reception):
            return
        beacon = decode_cached(event.frame)
        if not isinstance(beacon, Beacon):
            self.drops["not-translated"] += 1
            return
        self._almanac.add_page(beacon.almanac_issue, beacon.page)
        if beacon.anchor == beacon.master:
            self._finish()
            self._usual, self._round, self._is_sent, self._poll = frozenset(self._round), {}, False, beacon
        measurement = self._measurement(beacon, event)
        if measurement is None:
            self.drops["not-of-a-round"] += 1
            return
        self._round[beacon.anchor] = measurement
        if self._usual and self._usual <= self._round.keys():
            self._finish()

    def on_host_data(self, data: bytes) -> None:
        """It takes no commands: its session goes on from the start."""

    def _measurement(self, beacon: Beacon, reception: Reception) -> DtMeasurement | None:
        """What the board reports of a beacon; None for one that answers no poll of this round."""
        poll, heard = self._poll, beacon.master_heard
        if poll is None or self._is_sent or len(self._round) >= _MOST_MEASUREMENTS:
            return None
        reply = flight = 0
        is_poll = beacon is poll
        if not is_poll:
            if heard is None or (heard.anchor, heard.sequence) != (poll.anchor, poll.sequence):
                return None
            reply = difference(beacon.tx_ticks, heard.rx_ticks)
            if not 0 < reply <= _MOST_REPLY_TICKS:
                return None
            flight = self._flight_ticks(poll.anchor, beacon.anchor)
        measured = reception.diagnostics or Diagnostics()
        location = self._location(beacon.anchor)
        return DtMeasurement(
            address=beacon.anchor,
            message=DtMessageType.POLL if is_poll else DtMessageType.RESPONSE,
            block=poll.superframe & 0xFFFF,
            round=0,
            tx_ticks=beacon.tx_ticks,
            rx_ticks_tag=reception.rx_ticks,
            rssi_dbm=-min(max(-(measured.rx_power_dbm or 0.0), 0.0), 127.5),
            cfo_ppm=measured.carrier_offset_ppm,
            responder_reply_ticks=reply,
            flight_ticks=flight,
            location_kind=RELATIVE_LOCATION if location and self._version == 1 else NO_LOCATION,
            location=location,
        )

    def _flight_ticks(self, one: int, other: int) -> int:
        """As anchors would have ranged each other; 0 while their positions are not known."""
        one_m, other_m = self._position_m(one), self._position_m(other)
        if one_m is None or other_m is None:
            return 0
        return min(round(dist(one_m, other_m) / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ), _MOST_FLIGHT_TICKS)

    def _location(self, anchor: int) -> bytes:
        position_m = self._position_m(anchor)
        if position_m is None:
            return b""
        try:
            location = encode_relative(position_m)
        except ValueError:
            self.drops["location-too-far"] += 1
            return b""
        return location if self._version == 1 else _RELATIVE_2 + location

    def _position_m(self, anchor: int) -> Point | None:
        return self._almanac.anchors_m.get(anchor)

    def _finish(self) -> None:
        """Send the round, if it is not sent yet."""
        if self._is_sent or not self._round:
            return
        self._is_sent = True
        info = SessionInfo(self._sequence, _SESSION, self._version, tuple(self._round.values()))
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        self._send(encode_packet(encode_session_info(info)))
