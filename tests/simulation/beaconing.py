"""Minimal anchors without a master: they speak at free instants or in slots of their own clocks, and relay."""

import struct
from dataclasses import dataclass, field

from skyless.air.reception import Reception, Transmission
from skyless.constants import DEFAULT_ANTENNA_DELAY_TICKS, TICK_RATE_HZ
from skyless.site.free_access import first_free_window, free_instant_ticks
from skyless.ticks import Unwrapper, from_seconds, wrap

FRAME_BYTES = 123
MOST_RELAYS = 6
LEAD_TICKS = from_seconds(1e-3)
OLDEST_TICKS = round(1.0 * TICK_RATE_HZ)
HEAD = struct.Struct("<HBQB")
RELAY = struct.Struct("<HBQ")


def on_grid(ticks: int) -> int:
    raw = ticks - DEFAULT_ANTENNA_DELAY_TICKS
    return raw - raw % 512 + DEFAULT_ANTENNA_DELAY_TICKS


@dataclass
class FreeAnchor:
    """Speaks at the instants of free access; sequence numbers and relays as in ``skyless.anchor``."""

    id: int
    window_ticks: int
    log: list[tuple[int, int, int]] = field(default_factory=list)
    """Anchor, sequence and RX stamp of everything that it received."""
    sent: list[int] = field(default_factory=list)
    """Its unwrapped TX stamps."""
    own_ticks: Unwrapper = field(default_factory=Unwrapper)
    heard: dict[int, tuple[tuple[int, int, int], int]] = field(default_factory=dict)

    def hear(self, reception: Reception) -> None:
        anchor, sequence, _, _ = HEAD.unpack_from(reception.frame)
        received = (anchor, sequence, reception.rx_ticks)
        self.log.append(received)
        self.heard.pop(anchor, None)
        self.heard[anchor] = (received, self.own_ticks.unwrap(reception.rx_ticks))

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        return wrap(on_grid(self.instant(self.own_ticks.unwrap(now_ticks) + LEAD_TICKS + 512)))

    def instant(self, earliest: int) -> int:
        window = first_free_window(self.id, earliest, self.window_ticks)
        return free_instant_ticks(self.id, window, self.window_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        unwrapped = self.own_ticks.expect(tx_ticks)
        oldest = unwrapped - OLDEST_TICKS
        relays = [received for received, ticks in reversed(self.heard.values()) if ticks > oldest][:MOST_RELAYS]
        head = HEAD.pack(self.id, len(self.sent) & 0xFF, tx_ticks, len(relays))
        self.sent.append(unwrapped)
        frame = head + b"".join(RELAY.pack(*one) for one in relays)
        return Transmission(frame.ljust(FRAME_BYTES, b"\0"), tx_ticks)


@dataclass
class SlotAnchor(FreeAnchor):
    """Speaks in slots that its own clock counts from the moment at which it is switched on."""

    colour: int = 0
    slot_ticks: int = from_seconds(1e-3)
    start: int | None = None

    def instant(self, earliest: int) -> int:
        if self.start is None:
            self.start = earliest + from_seconds(1e-3) + self.colour * self.slot_ticks
        return self.start + -((self.start - earliest) // self.window_ticks) * self.window_ticks


def contents(frame: bytes) -> tuple[int, int, int, tuple[tuple[int, int, int], ...]]:
    """Anchor, sequence, TX stamp and relays (anchor, sequence, RX stamp) of a frame."""
    anchor, sequence, tx_ticks, count = HEAD.unpack_from(frame)
    return anchor, sequence, tx_ticks, tuple(RELAY.unpack_from(frame, HEAD.size + k * RELAY.size) for k in range(count))
