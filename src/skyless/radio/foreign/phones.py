"""DL-TDoA records of phones as lines of JSON: what an app wrote of each measurement that the system gave it.

iOS, keys as the properties of ``NIDLTDOAMeasurement``: ``address``, ``measurementType`` (poll, response, final, or
0, 1, 2), ``rawTransmitTime`` and ``rawReceiveTime`` (ticks of 15.65 ps, iOS 27) or ``transmitTime`` and
``receiveTime`` (seconds), ``coordinates`` and ``coordinatesType`` (geodetic or 0: latitude, longitude, altitude;
relative or 1: metres), ``clusterInitiatorAddress`` (iOS 27). There are no reply times: TX stamps are taken to be in
the time of the cluster's initiator, without which nothing could be computed from them.

Android, keys as the properties of ``android.ranging.DlTdoaMeasurement``: ``messageType`` (0, 1, 2), ``messageControl``
(bit 0: TX stamps in the common time), ``blockIndex``, ``roundIndex``, ``txTimestamp`` and ``rxTimestamp`` (the bytes,
lowest first: an array of numbers, hexadecimal, or a whole number of ticks), ``initiatorReplyTime``,
``responderReplyTime``, ``initiatorResponderTof`` (ticks), ``anchorLocation`` with ``relativeLocation`` (``x``, ``y``,
``z`` in millimetres) or ``wgs84Location`` (``latitude``, ``longitude``, ``altitude``, the last in kilometres as in the
message: Android's documentation names either unit); and ``address``, which the app adds from the peer.

An address is a number or hexadecimal text, with or without colons. Other keys are ignored.

A line may also be an array of records, as of one call of the system. Records of one message may stand in any order;
between messages, those that are not newer than the newest are dropped.
"""

import re
from collections.abc import Iterator, Mapping
from io import BufferedIOBase
from math import isfinite
from typing import Final

import msgspec
from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, Point
from skyless.core.ticks import TICK_BITS, TICK_MASK, TICK_RATE_HZ, difference, wrap
from skyless.files import Drops, lines
from skyless.radio.foreign.uci import AnchorFrame, DtMessage, DtMessageType, DtRounds, GeodeticPoint, host_time_s

_KINDS: Final = {"poll": DtMessageType.POLL, "response": DtMessageType.RESPONSE, "final": DtMessageType.FINAL}
_STAMP_BYTES: Final = TICK_BITS // 8
_MAX_STAMP_BYTES: Final = 8
_LAST_ADDRESS: Final = (1 << 64) - 1
_HEXADECIMAL: Final = re.compile(r"(?a:[0-9A-Fa-f]{1,2}(:?[0-9A-Fa-f]{1,2}){0,7})")
_LAST_S: Final = 1e9
_FARTHEST_M: Final = 1e6
_COMMON_TIME: Final = 1
_MAX_CLUSTERS: Final = 256
_MAX_REPLY_TICKS: Final = (1 << 32) - 1

LATE_S: Final = 1.0
"""How far before the newest a record is late or a double; one from farther back means that time has begun again."""


WAIT_S: Final = 0.05
"""How much newer a record has to be for those before it not to wait any longer, in an unordered stream."""
_MOST_WAITING: Final = 1024
_ORDERED: Final = 512
"""Messages in order after which records do not wait any longer."""


class _Wgs84(Struct):
    latitude: float
    longitude: float
    altitude: float = 0.0


class _Relative(Struct):
    x: float
    y: float
    z: float


class _AnchorLocation(Struct, rename="camel"):
    wgs84_location: _Wgs84 | None = None
    relative_location: _Relative | None = None


class _Record(Struct, rename="camel"):
    """A record of either system; the key of the message's type shows which."""

    address: int | str
    measurement_type: int | str | None = None
    transmit_time: float | None = None
    receive_time: float | None = None
    raw_transmit_time: int | None = None
    raw_receive_time: int | None = None
    coordinates: tuple[float, float, float] | None = None
    coordinates_type: int | str | None = None
    cluster_initiator_address: int | str | None = None
    message_type: int | None = None
    message_control: int = 0
    block_index: int = 0
    round_index: int = 0
    tx_timestamp: list[int] | str | int | None = None
    rx_timestamp: list[int] | str | int | None = None
    initiator_reply_time: int = 0
    responder_reply_time: int = 0
    initiator_responder_tof: int = 0
    anchor_location: _AnchorLocation | None = None


_decode: Final = msgspec.json.Decoder(_Record | list[_Record]).decode
_BOM: Final = b"\xef\xbb\xbf"


def recognise(head: bytes) -> bool:
    """Whether the first line has records of either system."""
    found = _records(head.partition(b"\n")[0])
    return any(one.measurement_type is not None or one.message_type is not None for one in found or ())


def _records(line: bytes) -> list[_Record] | None:
    """The records of a line; None if it is malformed."""
    try:
        found = _decode(line.removeprefix(_BOM))
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    return found if isinstance(found, list) else [found]


def read(stream: BufferedIOBase, drops: Drops, anchors_m: Mapping[int, Point] | None = None) -> Iterator[Packet]:
    """Yield the packets of a file of records; ``anchors_m``: positions that replace all that anchors state."""
    phone = Phone(drops, AnchorFrame(anchors_m))
    for line in lines(stream, drops):
        yield from phone.on_message(line)
    yield from phone.finish()


class Phone:
    """Converts one phone's records to packets, and counts unusable ones."""

    def __init__(self, drops: Drops, frame: AnchorFrame) -> None:
        self._drops = drops
        self._rounds = DtRounds(frame)
        self._polls: dict[int, int] = {}
        """How many each cluster has sent, by its initiator."""
        self._newest_initiator: int | None = None
        self._newest_rx_ticks: int | None = None
        self._is_unordered = False
        """Whether a record has been older than one before: from then on they wait for each other."""
        self._ordered = 0
        """Messages in a row that were newer than those before."""
        self._waiting: list[_Record] = []

    def on_message(self, message: bytes) -> list[Packet]:
        """Packets of the lines of a message, and of records that have waited, in order of reception."""
        records: list[_Record] = []
        for line in message.split(b"\n"):
            found = _records(line) if line.strip() else []
            if found is None:
                self._drops["malformed-record"] += 1
            else:
                records += found
        if not self._is_unordered:
            return self._packets(_in_order(records))
        packets = self.finish() if self._has_begun_again(records) else []
        waiting = _in_order(self._waiting + records)
        self._ordered = self._ordered + 1 if waiting[: len(self._waiting)] == self._waiting else 0
        self._is_unordered = self._ordered < _ORDERED
        if not self._is_unordered:
            self._waiting = []
            return packets + self._packets(waiting)
        newest = _rx_ticks(waiting[-1]) if waiting else None
        ready = len(waiting)
        if newest is not None and ready <= _MOST_WAITING:
            stamps = [_rx_ticks(one) for one in waiting]
            ready = sum(stamp is None or _ahead(newest, stamp) > WAIT_S * TICK_RATE_HZ for stamp in stamps)
        self._waiting = waiting[ready:]
        return packets + self._packets(waiting[:ready])

    def _has_begun_again(self, records: list[_Record]) -> bool:
        """Whether the time of some records has begun again since those that wait."""
        newest = _rx_ticks(self._waiting[-1]) if self._waiting else None
        stamps = [stamp for one in records if (stamp := _rx_ticks(one)) is not None]
        return newest is not None and any(_ahead(stamp, newest) < -LATE_S * TICK_RATE_HZ for stamp in stamps)

    @property
    def is_waiting(self) -> bool:
        """Whether records wait for newer ones."""
        return bool(self._waiting)

    def finish(self) -> list[Packet]:
        """Packets of the records that still wait."""
        waiting, self._waiting = self._waiting, []
        return self._packets(waiting)

    def _packets(self, records: list[_Record]) -> list[Packet]:
        stated = (self._android(one) if one.measurement_type is None else self._ios(one) for one in records)
        return self._rounds.packets(stated, self._drops)

    def _is_late(self, rx_ticks: int) -> bool:
        """Whether a record is not newer than the newest, which it otherwise becomes."""
        ahead = 1 if self._newest_rx_ticks is None else _ahead(rx_ticks, self._newest_rx_ticks)
        if -LATE_S * TICK_RATE_HZ < ahead <= 0:
            if ahead < 0:
                self._is_unordered, self._ordered = True, 0
            return True
        self._newest_rx_ticks = rx_ticks
        return False

    def _ios(self, record: _Record) -> DtMessage | str:
        kind, address = _kind(record.measurement_type), _address(record.address)
        if kind is None or address is None:
            return "unknown-message" if kind is None else "impossible-address"
        initiator: int | None = address
        if kind is DtMessageType.RESPONSE:
            stated = record.cluster_initiator_address
            initiator = self._newest_initiator if stated is None else _address(stated)
        tx_ticks = _ios_ticks(record.raw_transmit_time, record.transmit_time)
        rx_ticks = _ios_ticks(record.raw_receive_time, record.receive_time)
        if tx_ticks is None or rx_ticks is None:
            return "stamp-missing"
        if initiator is None:
            return "message-without-poll"
        if self._is_late(rx_ticks):
            return "late-or-double-record"
        if kind is DtMessageType.POLL:
            self._polls[initiator] = self._polls.pop(initiator, 0) + 1
            if len(self._polls) > _MAX_CLUSTERS:
                del self._polls[next(iter(self._polls))]
            self._newest_initiator = initiator
        return DtMessage(
            host_s=host_time_s(rx_ticks),
            address=address,
            kind=kind,
            block=self._polls.get(initiator, 0),
            round=initiator,
            tx_ticks=wrap(tx_ticks),
            rx_ticks_tag=wrap(rx_ticks),
            common_time=True,
            location=_ios_location(record),
        )

    def _android(self, record: _Record) -> DtMessage | str:
        kind, address = _kind(record.message_type), _address(record.address)
        if kind is None or address is None:
            return "unknown-message" if kind is None else "impossible-address"
        tx_ticks, rx_ticks = _android_ticks(record.tx_timestamp), _android_ticks(record.rx_timestamp)
        if tx_ticks is None or rx_ticks is None:
            return "stamp-missing"
        replies = record.responder_reply_time, record.initiator_reply_time, record.initiator_responder_tof
        indices = record.block_index, record.round_index
        if not all(0 <= value <= _MAX_REPLY_TICKS for value in (*replies, *indices)):
            return "impossible-number"
        if self._is_late(rx_ticks):
            return "late-or-double-record"
        return DtMessage(
            host_time_s(rx_ticks),
            address,
            kind,
            *indices,
            wrap(tx_ticks),
            wrap(rx_ticks),
            bool(record.message_control & _COMMON_TIME),
            replies[0],
            replies[1],
            float(replies[2]) or None,
            _android_location(record.anchor_location),
        )


def _in_order(records: list[_Record]) -> list[_Record]:
    """Records of one message by their RX stamps; those without one come first, to be counted."""
    if len(records) < 2:
        return records
    stamps = [_rx_ticks(one) for one in records]
    first = next((stamp for stamp in stamps if stamp is not None), 0)
    ahead = [-TICK_MASK if stamp is None else _ahead(stamp, first) for stamp in stamps]
    return [records[number] for number in sorted(range(len(records)), key=ahead.__getitem__)]


def _rx_ticks(record: _Record) -> int | None:
    if record.measurement_type is None:
        return _android_ticks(record.rx_timestamp)
    return _ios_ticks(record.raw_receive_time, record.receive_time)


def _ahead(rx_ticks: int, other: int) -> int:
    """How much later a stamp is than another; stamps of more than 40 bits do not wrap."""
    return rx_ticks - other if max(rx_ticks, other) > TICK_MASK else difference(rx_ticks, other)


def _kind(stated: int | str | None) -> DtMessageType | None:
    if isinstance(stated, str):
        return _KINDS.get(stated.lower())
    return DtMessageType(stated) if stated in (0, 1, 2) else None


def _address(stated: int | str) -> int | None:
    if isinstance(stated, str):
        return int(stated.replace(":", ""), 16) if _HEXADECIMAL.fullmatch(stated) else None
    return stated if 0 <= stated <= _LAST_ADDRESS else None


def _ios_ticks(raw: int | None, seconds: float | None) -> int | None:
    if raw is not None:
        return raw if 0 <= raw < 1 << 8 * _MAX_STAMP_BYTES else None
    return round(seconds * TICK_RATE_HZ) if seconds is not None and 0.0 <= seconds < _LAST_S else None


def _ios_location(record: _Record) -> Point | GeodeticPoint | None:
    given, kind = record.coordinates, record.coordinates_type
    if given is None or kind is None or not all(map(isfinite, given)):
        return None
    if kind in (0, "geodetic"):
        return _geodetic(*given)
    return given if kind in (1, "relative") and max(map(abs, given)) < _FARTHEST_M else None


def _android_ticks(stated: list[int] | str | int | None) -> int | None:
    if isinstance(stated, int):
        return stated if 0 <= stated < 1 << 8 * _MAX_STAMP_BYTES else None
    try:
        data = bytes.fromhex(stated) if isinstance(stated, str) else bytes(value & 0xFF for value in stated or ())
    except ValueError:
        return None
    return int.from_bytes(data, "little") if _STAMP_BYTES <= len(data) <= _MAX_STAMP_BYTES else None


def _android_location(stated: _AnchorLocation | None) -> Point | GeodeticPoint | None:
    if stated is None:
        return None
    if stated.wgs84_location is not None:
        one = stated.wgs84_location
        return _geodetic(one.latitude, one.longitude, one.altitude * 1000.0)
    if stated.relative_location is None:
        return None
    x_m, y_m, z_m = (value / 1000.0 for value in msgspec.structs.astuple(stated.relative_location))
    sensible = all(isfinite(value) and abs(value) < _FARTHEST_M for value in (x_m, y_m, z_m))
    return (x_m, y_m, z_m) if sensible else None


def _geodetic(latitude_deg: float, longitude_deg: float, height_m: float) -> GeodeticPoint | None:
    point = GeodeticPoint(latitude_deg, longitude_deg, height_m)
    sensible = abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0 and abs(height_m) < _FARTHEST_M
    return point if sensible else None
