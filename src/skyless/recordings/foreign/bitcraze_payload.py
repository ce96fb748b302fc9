"""Payloads of Bitcraze's loco positioning anchors, TDoA2 and TDoA3, to packets.

Both are little-endian and hold the low 32 bits of all stamps. Distances are times of flight in ticks that include
the antenna delays. After either a short LPP packet may follow that tells the anchor's position.

TDoA2, type 0x22: sequence u8 × 8 | stamp u32 × 8 | distance u16 × 8, indexed by anchor. The sender's own stamp is the
TX time, the others are when it last heard that anchor, 0 for never.

TDoA3, type 0x30: sequence (7 bits) | TX time u32 | count, then count times: anchor | sequence (7 bits) with the high
bit telling that a distance follows | RX time u32 | distance u16, if any.
"""

from math import isfinite
from struct import Struct as Layout
from typing import Final

from skyless.air.masterless_packets import Packet, Point, Relay

TDOA2: Final = 0x22
TDOA3: Final = 0x30
STAMP_BITS: Final = 32

_TDOA2: Final = Layout("<B8B8I8H")
_TDOA3_HEAD: Final = Layout("<BBIB")
_TDOA3_RELAY: Final = Layout("<BBI")
_TDOA3_RANGED: Final = Layout("<BBIH")
_POSITION: Final = Layout("<BBfff")
_LPP_SHORT: Final = 0xF0
_LPP_POSITION: Final = 0x01
_HAS_DISTANCE: Final = 0x80
_FARTHEST_M: Final = 1e5


def decode(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    """Packet of a payload, or the reason why it is none."""
    if not payload:
        return "empty-payload"
    if payload[0] == TDOA3:
        return _tdoa3(payload, host_s, sender, rx_ticks)
    if payload[0] == TDOA2:
        return _tdoa2(payload, host_s, sender, rx_ticks)
    return "foreign-payload"


def _tdoa3(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    size = len(payload)
    if size < _TDOA3_HEAD.size:
        return "short-payload"
    _, sequence, tx_ticks, count = _TDOA3_HEAD.unpack_from(payload)
    at = _TDOA3_HEAD.size
    relays = []
    for _ in range(count):
        if at + 6 > size:
            return "short-payload"
        if payload[at + 1] & _HAS_DISTANCE:
            if at + 8 > size:
                return "short-payload"
            anchor, flags, stamp, distance = _TDOA3_RANGED.unpack_from(payload, at)
            relays.append(Relay(anchor, flags & 0x7F, stamp, distance or None))
            at += 8
        else:
            anchor, flags, stamp = _TDOA3_RELAY.unpack_from(payload, at)
            relays.append(Relay(anchor, flags, stamp, None))
            at += 6
    position_m = _position(payload, at) if at < size else None
    return Packet(host_s, sender, sequence & 0x7F, tx_ticks, rx_ticks, tuple(relays), position_m)


def _tdoa2(payload: bytes, host_s: float | None, sender: int, rx_ticks: int) -> Packet | str:
    if len(payload) < _TDOA2.size:
        return "short-payload"
    if sender > 7:
        return "sender-unknown"
    values = _TDOA2.unpack_from(payload)
    sequences, stamps, distances = values[1:9], values[9:17], values[17:25]
    relays = tuple(
        Relay(anchor, sequences[anchor], stamp, distances[anchor] or None)
        for anchor, stamp in enumerate(stamps)
        if stamp and anchor != sender
    )
    position_m = _position(payload, _TDOA2.size)
    return Packet(host_s, sender, sequences[sender], stamps[sender], rx_ticks, relays, position_m)


def _position(payload: bytes, at: int) -> Point | None:
    """Position of the LPP packet at that place, None where there is none or where it makes no sense."""
    if at + _POSITION.size > len(payload):
        return None
    short, kind, x_m, y_m, z_m = _POSITION.unpack_from(payload, at)
    if short != _LPP_SHORT or kind != _LPP_POSITION:
        return None
    sensible = all(isfinite(value) and abs(value) < _FARTHEST_M for value in (x_m, y_m, z_m))
    return (x_m, y_m, z_m) if sensible else None
