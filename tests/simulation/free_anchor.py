"""A minimal anchor of a site without a schedule: it speaks at the free instants, and relays what it heard."""

import struct
from collections.abc import Callable

from skyless.air.reception import Reception, Transmission
from skyless.constants import DEFAULT_ANTENNA_DELAY_TICKS, TICK_RATE_HZ
from skyless.site.free_access import first_free_window, free_instant_ticks
from skyless.ticks import Unwrapper, from_seconds, wrap

FRAME_BYTES = 123
MOST_RELAYS = 6
HEAD = struct.Struct("<HBQB")
RELAY = struct.Struct("<HBQ")
OLDEST_TICKS = round(1.0 * TICK_RATE_HZ)


class FreeAnchor:
    """Sequence numbers and relays as in ``skyless.anchor``."""

    def __init__(self, anchor_id: int, window_ticks: int, lead_s: float = 1e-3) -> None:
        self.id = anchor_id
        self._window_ticks = window_ticks
        self._lead_ticks = from_seconds(lead_s)
        self._own_ticks = Unwrapper()
        self._heard: dict[int, tuple[tuple[int, int, int], int]] = {}
        self._sequence = 0

    def hear(self, reception: Reception) -> None:
        anchor, sequence, _, _ = HEAD.unpack_from(reception.frame)
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks)
        self._heard.pop(anchor, None)
        self._heard[anchor] = ((anchor, sequence, reception.rx_ticks), rx_ticks)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        earliest = self._own_ticks.unwrap(now_ticks) + self._lead_ticks + 512
        window = first_free_window(self.id, earliest, self._window_ticks)
        raw = free_instant_ticks(self.id, window, self._window_ticks) - DEFAULT_ANTENNA_DELAY_TICKS
        return wrap(raw - raw % 512 + DEFAULT_ANTENNA_DELAY_TICKS)

    def transmission(self, tx_ticks: int) -> Transmission:
        oldest = self._own_ticks.expect(tx_ticks) - OLDEST_TICKS
        relays = [heard for heard, rx_ticks in reversed(self._heard.values()) if rx_ticks > oldest][:MOST_RELAYS]
        frame = HEAD.pack(self.id, self._sequence, tx_ticks, len(relays)) + b"".join(RELAY.pack(*one) for one in relays)
        self._sequence = (self._sequence + 1) & 0xFF
        return Transmission(frame.ljust(FRAME_BYTES, b"\0"), tx_ticks)


def contents(frame: bytes) -> tuple[int, int, int, list[tuple[int, int, int]]]:
    """Anchor, sequence, TX stamp and relays (anchor, sequence, RX stamp) of a frame."""
    anchor, sequence, tx_ticks, count = HEAD.unpack_from(frame)
    return anchor, sequence, tx_ticks, [RELAY.unpack_from(frame, HEAD.size + k * RELAY.size) for k in range(count)]


def free_anchors(window_ticks: int) -> Callable[[int], FreeAnchor]:
    return lambda anchor_id: FreeAnchor(anchor_id, window_ticks)
