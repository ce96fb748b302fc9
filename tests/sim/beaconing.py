"""Minimal anchors: they send at the instants of protocol 2, each with a period that stays the same, and relay."""

import struct
from dataclasses import dataclass, field

from skyless.core.air.almanac import gap_ticks
from skyless.core.air.frame import Reception, Transmission
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS, TICK_RATE_HZ, Unwrapper, from_seconds, wrap

FRAME_BYTES = 123
MAX_RELAYS = 6
LEAD_TICKS = from_seconds(1e-3)
OLDEST_TICKS = round(1.0 * TICK_RATE_HZ)
HEAD = struct.Struct("<HBQB")
RELAY = struct.Struct("<HBQ")


def on_grid(ticks: int) -> int:
    raw = ticks - DEFAULT_ANTENNA_DELAY_TICKS
    return raw - raw % 512 + DEFAULT_ANTENNA_DELAY_TICKS


@dataclass
class FreeAnchor:
    """Instants, sequence numbers and relays as in ``skyless.core.anchor``."""

    id: int
    code: int
    """Code of its mean period."""
    log: list[tuple[int, int, int]] = field(default_factory=list)
    """Anchor, sequence and RX stamp of everything that it received."""
    sent: list[int] = field(default_factory=list)
    """Its unwrapped TX stamps."""
    own_ticks: Unwrapper = field(default_factory=Unwrapper)
    next_ticks: int | None = None
    heard: dict[int, tuple[tuple[int, int, int], int]] = field(default_factory=dict)

    def hear(self, reception: Reception) -> None:
        anchor, sequence, _, _ = HEAD.unpack_from(reception.frame)
        received = (anchor, sequence, reception.rx_ticks)
        self.log.append(received)
        self.heard.pop(anchor, None)
        self.heard[anchor] = (received, self.own_ticks.unwrap(reception.rx_ticks))

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        now = self.own_ticks.unwrap(now_ticks)
        if self.next_ticks is None:
            self.next_ticks = on_grid(now + LEAD_TICKS + 512 + gap_ticks(self.id, 255, self.code))
        return wrap(self.next_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        unwrapped = self.own_ticks.expect(tx_ticks)
        oldest = unwrapped - OLDEST_TICKS
        relays = [received for received, ticks in reversed(self.heard.values()) if ticks > oldest][:MAX_RELAYS]
        head = HEAD.pack(self.id, len(self.sent) & 0xFF, tx_ticks, len(relays))
        self.next_ticks += gap_ticks(self.id, len(self.sent), self.code)
        self.sent.append(unwrapped)
        frame = head + b"".join(RELAY.pack(*one) for one in relays)
        return Transmission(frame.ljust(FRAME_BYTES, b"\0"), tx_ticks)


def contents(frame: bytes) -> tuple[int, int, int, tuple[tuple[int, int, int], ...]]:
    """Anchor, sequence, TX stamp and relays (anchor, sequence, RX stamp) of a frame."""
    anchor, sequence, tx_ticks, count = HEAD.unpack_from(frame)
    return anchor, sequence, tx_ticks, tuple(RELAY.unpack_from(frame, HEAD.size + k * RELAY.size) for k in range(count))
