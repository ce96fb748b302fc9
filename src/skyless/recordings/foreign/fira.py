"""UCI of a DT-tag: notifications as packets, and logs of them, binary or as text with hexadecimal packets."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BufferedIOBase
from typing import Final

from skyless.air.dl_tdoa import DtMessage, DtRounds
from skyless.air.masterless_packets import Packet, Point
from skyless.air.uci import (
    CONTROL_HEADER_BYTES,
    STATUS_OK,
    DtMeasurement,
    DtMessageType,
    SessionInfo,
    UciPacket,
    UciReader,
    decode_session_info,
)
from skyless.air.uci_location import GeodeticPoint, location_of
from skyless.constants import TICK_BITS, TICK_S
from skyless.recordings.foreign.anchor_frame import AnchorFrame
from skyless.recordings.source import Drops, chunks, lines
from skyless.ticks import difference, wrap

_STAMP_BYTES: Final = TICK_BITS // 8
_MESSAGES: Final = frozenset(map(int, DtMessageType))


class DtTag:
    """From a tag's notifications to packets; what is of no use is counted."""

    def __init__(self, drops: Drops, anchors_m: Mapping[int, Point] | None = None) -> None:
        """``anchors_m``: positions that are known, where anchors may state none."""
        self._drops = drops
        self._rounds = DtRounds(anchors_m)
        self._frame = AnchorFrame()

    @property
    def origin(self) -> GeodeticPoint | None:
        """Where the frame of the positions begins, where anchors state theirs on the Earth."""
        return self._frame.origin

    def on_uci(self, packet: UciPacket, host_s: float | None = None) -> list[Packet]:
        """Packets of a notification, in the order in which they were received; ``host_s``: when it came."""
        info = decode_session_info(packet)
        if isinstance(info, SessionInfo):
            return self.on_info(info, host_s)
        self._drops[info] += 1
        return []

    def on_info(self, info: SessionInfo, host_s: float | None = None) -> list[Packet]:
        """Packets of a decoded notification."""
        usable = []
        for one in info.measurements:
            reason = _unusable(one)
            if reason is None:
                usable.append(one)
            else:
                self._drops[reason] += 1
        if len(usable) > 1:
            first = usable[0].rx_ticks_tag
            usable.sort(key=lambda one: difference(one.rx_ticks_tag, first))
        packets = []
        for one in usable:
            packet = self._rounds.on_message(self._message(one, host_s))
            if isinstance(packet, Packet):
                packets.append(packet)
            else:
                self._drops[packet] += 1
        return packets

    def _message(self, one: DtMeasurement, host_s: float | None) -> DtMessage:
        if host_s is None and one.rx_bytes > _STAMP_BYTES:
            host_s = one.rx_ticks_tag * TICK_S  # it has more bits, which bridge silences
        return DtMessage(
            host_s,
            one.address,
            DtMessageType(one.message),
            one.block,
            one.round,
            wrap(one.tx_ticks),
            wrap(one.rx_ticks_tag),
            one.common_time,
            one.responder_reply_ticks,
            one.initiator_reply_ticks,
            one.flight_ticks or None,
            self._frame.position_m(location_of(one)),
        )


def _unusable(one: DtMeasurement) -> str | None:
    if one.status != STATUS_OK:
        return "reception-failed"
    if one.message not in _MESSAGES:
        return "unknown-message"
    return "stamp-missing" if min(one.tx_bytes, one.rx_bytes) < _STAMP_BYTES else None


# Logs: bytes as they came, or lines of text with a packet each.

_NOTIFICATION: Final = re.compile(rb"(?i)(?<![0-9a-f])(?:0x)?[67]2(?:([ :,-]|, |)(?:0x)?[0-9a-f]{2}){3,}(?![0-9a-f])")
"""The beginning of SESSION_INFO as text, its bytes run together or with something between them."""
_BYTE: Final = re.compile(rb"(?i)(?:0x)?([0-9a-f]{2})")


def recognise_binary(head: bytes) -> bool:
    """Whether a notification of DL-TDoA measurements stands near the beginning."""
    return _has_measurements(UciReader(Counter()).feed(head))


def recognise_text(head: bytes) -> bool:
    """Whether lines near the beginning hold a notification of DL-TDoA measurements."""
    reader = UciReader(Counter())
    return any(_has_measurements(reader.feed(data)) for line in head.split(b"\n") for data in _packets_of_line(line))


def _has_measurements(packets: list[UciPacket]) -> bool:
    found = (decode_session_info(packet) for packet in packets)
    return any(isinstance(info, SessionInfo) and info.measurements for info in found)


def read_binary(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a binary log."""
    reader, tag = UciReader(drops), DtTag(drops)
    for chunk in chunks(stream, drops):
        for packet in reader.feed(chunk):
            yield from tag.on_uci(packet)


def read_text(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a log of lines; lines without a packet are counted."""
    reader, tag = UciReader(drops), DtTag(drops)
    for line in lines(stream, drops):
        found = _packets_of_line(line)
        if not found and line.strip():
            drops["line-without-notification"] += 1
        for data in found:
            for packet in reader.feed(data):
                yield from tag.on_uci(packet)


def _packets_of_line(line: bytes) -> list[bytes]:
    """Bytes of the first notification in a line whose length fits its header, whole or a segment; or none."""
    for match in _NOTIFICATION.finditer(line):
        data = bytes.fromhex(b"".join(_BYTE.findall(match.group())).decode())
        size = CONTROL_HEADER_BYTES + data[3]
        if data[1:3] == b"\0\0" and len(data) >= size:
            return [data[:size]]
    return []
