"""Text stream of Bitcraze's sniffer: ``From 02 to ff @487696ad28: 300c00…``, one packet a line, all hexadecimal."""

import re
from collections.abc import Iterator
from io import BufferedIOBase
from typing import Final

from skyless.air.masterless_packets import Packet
from skyless.recordings.foreign.bitcraze_payload import decode
from skyless.recordings.source import Drops, lines

_LINE: Final = re.compile(rb"From ([0-9a-f]{2}) to [0-9a-f]{2} @([0-9a-f]{10}): *((?:[0-9a-f]{2} ?)+) *")


def recognise(head: bytes, name: str) -> bool:
    """Tell whether a line of the sniffer's text stands near the beginning."""
    del name
    return _LINE.search(head) is not None


def read(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a text stream."""
    for line in lines(stream, drops):
        packet = packet_of(line, drops)
        if packet is not None:
            yield packet


def packet_of(line: bytes, drops: Drops) -> Packet | None:
    """Packet of a line; None, and a count, for what is none."""
    if not line:
        return None
    match = _LINE.fullmatch(line)
    if match is None:
        drops["malformed-line"] += 1
        return None
    sender, stamp, payload = match.groups()
    packet = decode(bytes.fromhex(payload.decode()), None, int(sender, 16), int(stamp, 16))
    if isinstance(packet, Packet):
        return packet
    drops[packet] += 1
    return None
