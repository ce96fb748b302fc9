"""Backhaul of an Avalue real-time location system: anchors that hear each other, raw 40-bit stamps.

Each row of ``ccp.csv`` is one reception: ``slave`` heard message ``order`` of ``master``. Any anchor can play a tag
that only listens: its packets are the transmissions that it received, and each relays what the sender had heard since
its own transmission before. Identifiers are hexadecimal.
"""

from collections import OrderedDict
from collections.abc import Iterator
from io import BufferedIOBase
from os import PathLike
from typing import Final

from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, Relay
from skyless.core.input_files import Drops, open_source, rows
from skyless.core.ticks import TICK_BITS, TICK_M
from skyless.site.survey.legs import TwoWayRanging

RECEPTION_COLUMNS: Final = ("t_host", "order", "slave", "master", "status", "tx_ticks_u40", "rx_ticks_u40")
BLINK_COLUMNS: Final = ("tag", "anchor", "rx_ticks_u40")
"""Of the same system's tables of tag blinks, which go the other way."""
_HELD_TRANSMISSIONS: Final = 6
"""Number of newer transmissions that may begin before a row of an older one."""

_RANGED: Final = 2001
_MAX_RELAYS: Final = 64
_MAX_ANCHORS: Final = 256
_LAST_HOST_S: Final = 1e11
_LAST_STAMP: Final = (1 << TICK_BITS) - 1


class CrossReception(Struct, frozen=True, gc=False):
    """One anchor heard another."""

    host_s: float
    sequence: int
    sender: int
    receiver: int
    tx_ticks: int
    """In the sender's clock."""
    rx_ticks: int
    """In the receiver's clock."""


class _Transmission(Struct):
    """One transmission and all who are known to have heard it."""

    first: CrossReception
    rx_ticks: dict[int, int]


def read(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[Packet]:
    """Yield the packets that one anchor heard; by default the receiver of the first row."""
    tag = None if listener is None else int(listener)
    relays: dict[int, list[Relay]] = {}
    for sent in _transmissions(cross_receptions(stream, drops), drops):
        first = sent.first
        tag = first.receiver if tag is None else tag
        if first.sender == tag:
            continue
        heard = relays.pop(first.sender, [])
        rx_ticks = sent.rx_ticks.get(tag)
        if rx_ticks is None:
            drops["unheard-by-the-listener"] += 1
        else:
            yield Packet(first.host_s, first.sender, first.sequence, first.tx_ticks, rx_ticks, tuple(heard))
        for receiver, stamp in sent.rx_ticks.items():
            if receiver != tag and (receiver in relays or len(relays) < _MAX_ANCHORS):
                pending = relays.setdefault(receiver, [])
                pending.append(Relay(first.sender, first.sequence, stamp, None))
                del pending[:-_MAX_RELAYS]


def cross_receptions(stream: BufferedIOBase, drops: Drops) -> Iterator[CrossReception]:
    """Yield the receptions as they stand, row by row."""
    for host, order, slave, master, status, tx, rx in rows(stream, drops, RECEPTION_COLUMNS):
        try:
            reception = CrossReception(float(host), int(order), int(master, 16), int(slave, 16), int(tx), int(rx))
        except ValueError:
            drops["malformed-number"] += 1
            continue
        if status.strip() != b"0":
            drops["bad-status"] += 1
        elif not (0 <= reception.tx_ticks <= _LAST_STAMP and 0 <= reception.rx_ticks <= _LAST_STAMP):
            drops["impossible-stamp"] += 1
        elif not 0.0 <= reception.host_s < _LAST_HOST_S:
            drops["impossible-host-time"] += 1
        elif reception.sender == reception.receiver:
            drops["heard-itself"] += 1
        else:
            yield reception


def anchor_distances_m(path: str | PathLike[str], drops: Drops) -> dict[tuple[int, int], float]:
    """Distance of every pair of anchors that hear each other, by two-way ranging.

    Each is the median of the latest ``_RANGED`` exchanges, so that memory stays flat in the length of the capture.

    Raises:
        ConfigurationError: the file cannot be opened.
    """
    ranging = TwoWayRanging(TICK_BITS, window=_RANGED)
    with open_source(path) as stream:
        for heard in cross_receptions(stream, drops):
            ranging.add(heard.sender, heard.receiver, heard.tx_ticks, heard.rx_ticks)
    return {pair: flight * TICK_M for pair, flight in ranging.flights_ticks().items()}


def _transmissions(receptions: Iterator[CrossReception], drops: Drops) -> Iterator[_Transmission]:
    """Gather the receptions of each transmission, in the order in which the transmissions first appear."""
    held: OrderedDict[tuple[int, int], _Transmission] = OrderedDict()
    done: OrderedDict[tuple[int, int], None] = OrderedDict()
    for heard in receptions:
        key = (heard.sender, heard.tx_ticks)
        if key in held:
            held[key].rx_ticks.setdefault(heard.receiver, heard.rx_ticks)
        elif key in done:
            drops["late-row"] += 1
        else:
            held[key] = _Transmission(heard, {heard.receiver: heard.rx_ticks})
            if len(held) > _HELD_TRANSMISSIONS:
                finished, sent = held.popitem(last=False)
                done[finished] = None
                if len(done) > 8 * _HELD_TRANSMISSIONS:
                    done.popitem(last=False)
                yield sent
    yield from held.values()
