"""UCI of a DT-tag: notifications as packets, and logs of them, binary or as text with hexadecimal packets."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BufferedIOBase
from typing import Final, Literal

from skyless.core.air.masterless_packets import Packet, Point
from skyless.core.ticks import TICK_BITS, difference, wrap
from skyless.files import Drops, chunks, lines
from skyless.radio.foreign.uci import (
    CONTROL_HEADER_BYTES,
    STATUS_OK,
    AnchorFrame,
    DtMeasurement,
    DtMessage,
    DtMessageType,
    DtRounds,
    SessionInfo,
    UciPacket,
    UciReader,
    decode_session_info,
    host_time_s,
    location_of,
)

_STAMP_BYTES: Final = TICK_BITS // 8
_MESSAGES: Final = frozenset(map(int, DtMessageType))


class DtTag:
    """Converts a tag's stream of notifications to packets, and counts unusable ones."""

    def __init__(self, drops: Drops, frame: AnchorFrame) -> None:
        self._drops = drops
        self._reader, self._rounds = UciReader(drops), DtRounds(frame)

    def feed(self, data: bytes, host_s: float | None = None) -> Iterator[Packet]:
        """Packets of the notifications that this piece completes; ``host_s``: its arrival."""
        for packet in self._reader.feed(data):
            info = decode_session_info(packet)
            if isinstance(info, SessionInfo):
                yield from self.on_info(info, host_s)
            else:
                self._drops[info] += 1

    def on_info(self, info: SessionInfo, host_s: float | None = None) -> list[Packet]:
        """Packets of a decoded notification in order of reception."""
        reasons = [_unusable(one) for one in info.measurements]
        self._drops.update(filter(None, reasons))
        usable = [one for one, reason in zip(info.measurements, reasons, strict=True) if reason is None]
        if len(usable) > 1:
            first = usable[0].rx_ticks_tag
            usable.sort(key=lambda one: difference(one.rx_ticks_tag, first))
        return self._rounds.packets((self._message(one, info.session, host_s) for one in usable), self._drops)

    def _message(self, one: DtMeasurement, session: int, host_s: float | None) -> DtMessage:
        return DtMessage(
            host_time_s(one.rx_ticks_tag) if host_s is None else host_s,
            one.address,
            DtMessageType(one.message),
            one.block,
            session << 8 | one.round,
            wrap(one.tx_ticks),
            wrap(one.rx_ticks_tag),
            one.common_time,
            one.responder_reply_ticks,
            one.initiator_reply_ticks,
            one.flight_ticks or None,
            location_of(one),
        )


def _unusable(one: DtMeasurement) -> str | None:
    if one.status != STATUS_OK:
        return "reception-failed"
    if one.message not in _MESSAGES:
        return "unknown-message"
    return "stamp-missing" if min(one.tx_bytes, one.rx_bytes) < _STAMP_BYTES else None


# Logs: bytes as they came, or lines of text with a packet each.

_NOTIFICATION: Final = re.compile(rb"(?i)(?<![0-9a-f])(?:0x)?[67]2(?:([ :,-]|, |)(?:0x)?[0-9a-f]{2}){3,}(?![0-9a-f])")
"""The beginning of SESSION_INFO as text, its bytes adjacent or separated."""
_BYTE: Final = re.compile(rb"(?i)(?:0x)?([0-9a-f]{2})")


def recognise_binary(head: bytes) -> bool:
    """Whether there is a notification of DL-TDoA measurements near the beginning."""
    return _has_measurements(UciReader(Counter()).feed(head))


def recognise_text(head: bytes) -> bool:
    """Whether lines near the beginning contain a notification of DL-TDoA measurements."""
    reader = UciReader(Counter())
    return any(_has_measurements(reader.feed(data)) for line in head.split(b"\n") for data in _packets_of_line(line))


def _has_measurements(packets: list[UciPacket]) -> bool:
    found = (decode_session_info(packet) for packet in packets)
    return any(isinstance(info, SessionInfo) and info.measurements for info in found)


def read_binary(stream: BufferedIOBase, drops: Drops, anchors_m: Mapping[int, Point] | None = None) -> Iterator[Packet]:
    """Yield the packets of a binary log; ``anchors_m``: positions that replace those stated by anchors."""
    tag = DtTag(drops, AnchorFrame(anchors_m))
    for chunk in chunks(stream, drops):
        yield from tag.feed(chunk)


PCAPNG_MAGIC: Final = b"\x0a\x0d\x0d\x0a"
_INTERFACE, _PACKET = 1, 6
LINK_TYPE: Final = 299
"""Link type of UCI captures (tcpdump.org's list)."""

_MAX_BLOCK_BYTES: Final = 1 << 20


def recognise_pcapng(head: bytes) -> bool:
    """Whether the file is a pcapng whose first interface carries UCI."""
    blocks = _blocks(iter((head,)), Counter())
    link_types = (int.from_bytes(body[:2], order) for kind, body, order in blocks if kind == _INTERFACE)
    return head.startswith(PCAPNG_MAGIC) and next(link_types, None) == LINK_TYPE


def read_pcapng(stream: BufferedIOBase, drops: Drops, anchors_m: Mapping[int, Point] | None = None) -> Iterator[Packet]:
    """Yield the packets of a capture of UCI."""
    tag = DtTag(drops, AnchorFrame(anchors_m))
    for kind, body, order in _blocks(chunks(stream, drops), drops):
        if kind == _PACKET and len(body) >= 20:
            yield from tag.feed(body[20 : 20 + int.from_bytes(body[12:16], order)])


def _blocks(pieces: Iterator[bytes], drops: Drops) -> Iterator[tuple[int, bytes, Literal["little", "big"]]]:
    """Kind, body and byte order of each block of a pcapng; ends at an invalid or incomplete one."""
    data = b""
    order: Literal["little", "big"] = "little"
    for piece in pieces:
        data += piece
        while len(data) >= 12:
            if data.startswith(PCAPNG_MAGIC):
                order = "little" if data[8:12] == b"\x4d\x3c\x2b\x1a" else "big"
            length = int.from_bytes(data[4:8], order)
            if not 12 <= length <= _MAX_BLOCK_BYTES or length % 4:
                drops["malformed-block"] += 1
                return
            if len(data) < length:
                break
            yield int.from_bytes(data[:4], order), data[8 : length - 4], order
            data = data[length:]
    if data:
        drops["unfinished-block"] += 1


def read_text(stream: BufferedIOBase, drops: Drops, anchors_m: Mapping[int, Point] | None = None) -> Iterator[Packet]:
    """Yield the packets of a text log; lines without a packet are counted."""
    tag = DtTag(drops, AnchorFrame(anchors_m))
    for line in lines(stream, drops):
        found = _packets_of_line(line)
        if not found and line.strip():
            drops["line-without-notification"] += 1
        for data in found:
            yield from tag.feed(data)


def _packets_of_line(line: bytes) -> list[bytes]:
    """Bytes of the first notification in a line whose length matches its header, whole or a segment; or none."""
    for match in _NOTIFICATION.finditer(line):
        data = bytes.fromhex(b"".join(_BYTE.findall(match.group())).decode())
        size = CONTROL_HEADER_BYTES + data[3]
        if data[1:3] == b"\0\0" and len(data) >= size:
            return [data[:size]]
    return []
