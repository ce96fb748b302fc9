"""An emulated FiRa board: a site's beacons as the rounds of a DL-TDoA session, in notifications of UCI.

Every superframe is a round. The master's beacon is the poll; those of the other anchors are the responses, as each
holds when its sender received the master's. Where anchors have two frames in a superframe, the master's second one is
the final message, which holds when it received the responses; what comes after it belongs to no round.
"""

from collections import Counter
from collections.abc import Callable
from math import dist
from typing import Final, Literal

from msgspec.structs import replace

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
    """What the board sends: a round, as soon as it holds all messages that the one before had, or with the next poll.

    What joins a round after that has a notification of its own.
    """

    def __init__(self, send: Callable[[bytes], bool], version: Literal[1, 2]) -> None:
        self._send, self._version = send, version
        self._almanac = AlmanacAssembly()
        self._heard: set[tuple[int, DtMessageType]] = set()
        """Messages of this round."""
        self._usual: set[tuple[int, DtMessageType]] = set()
        """Those of the round before."""
        self._waiting: list[tuple[Beacon, DtMeasurement]] = []
        self._poll: Beacon | None = None
        self._sequence = 0
        self.drops: Counter[str] = Counter()

    def on_radio_event(self, event: RadioEvent) -> None:
        """Add a beacon to its round."""
        if not isinstance(event, Reception):
            return
        beacon = decode_cached(event.frame)
        if not isinstance(beacon, Beacon):
            self.drops["not-translated"] += 1
            return
        self._almanac.add_page(beacon.almanac_issue, beacon.page)
        poll = self._poll
        if beacon.anchor == beacon.master and (poll is None or beacon.superframe != poll.superframe):
            self._notify()
            self._usual, self._heard, self._poll = self._heard, set(), beacon
        measurement = self._measurement(beacon, event)
        if measurement is None:
            self.drops["not-of-a-round"] += 1
            return
        self._heard.add((beacon.anchor, DtMessageType(measurement.message)))
        if measurement.message == DtMessageType.FINAL:
            self._waiting = [(sent, _answered(one, sent, beacon)) for sent, one in self._waiting]
        self._waiting.append((beacon, measurement))
        if self._usual <= self._heard or len(self._waiting) >= _MOST_MEASUREMENTS:
            self._notify()

    def on_host_data(self, data: bytes) -> None:
        """It takes no commands: its session goes on from the start."""

    def _measurement(self, beacon: Beacon, reception: Reception) -> DtMeasurement | None:
        """What the board reports of a beacon; None for one that answers no poll of this round."""
        poll, heard = self._poll, beacon.master_heard
        if poll is None or (poll.anchor, DtMessageType.FINAL) in self._heard:
            return None
        reply = flight = 0
        if beacon is poll:
            kind = DtMessageType.POLL
        elif beacon.anchor == poll.anchor:
            kind = DtMessageType.FINAL
        else:
            kind = DtMessageType.RESPONSE
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
            message=kind,
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

    def _notify(self) -> None:
        if not self._waiting:
            return
        info = SessionInfo(self._sequence, _SESSION, self._version, tuple(one for _, one in self._waiting))
        self._waiting.clear()
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        self._send(encode_packet(encode_session_info(info)))


def _answered(one: DtMeasurement, sent: Beacon, final: Beacon) -> DtMeasurement:
    """A response with the reply of the final message, where the initiator received it."""
    heard = next((entry for entry in final.heard if entry.anchor == one.address), None)
    if one.message != DtMessageType.RESPONSE or heard is None or heard.sequence != sent.sequence:
        return one
    reply = difference(final.tx_ticks, heard.rx_ticks)
    return replace(one, initiator_reply_ticks=reply) if 0 < reply <= _MOST_REPLY_TICKS else one
