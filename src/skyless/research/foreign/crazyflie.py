"""Recordings of Bitcraze's system: logs of a Crazyflie's SD card, and captures of a sniffer.

    0xBC, version u16 (1 or 2), number of kinds of events u16
    of each kind   number u16, name, number of fields u16, of each field "name(type)" with a type of Python's struct
    of each event  number u16, time (version 1: u32, ms; version 2: u64, µs), its fields
    CRC-32 u32 of everything before

Texts end with a zero byte; all numbers are little-endian. As in ``tools/usdlog`` of Bitcraze's firmware.
"""

import re
from binascii import Error as Base64Error
from binascii import a2b_base64
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from io import BufferedIOBase
from os import PathLike
from struct import Struct as Binary
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np
import yaml

from skyless.core.air.masterless_packets import Packet, PairTdoa
from skyless.core.arrays import Array
from skyless.core.estimator.motion import GRAVITY_MPS2
from skyless.core.ticks import TICK_BITS
from skyless.files import Drops, chunks, open_source
from skyless.radio.foreign.bitcraze import decode_payload
from skyless.site.tables import HEIGHT_STD_M, Truth

_MAGIC: Final = b"\xbc"
_HEADER: Final = Binary("<cHH")
_TWO: Final = Binary("<H")
_TIMES: Final = {1: (Binary("<HI"), 1e-3), 2: (Binary("<HQ"), 1e-6)}
_TYPES: Final = frozenset("bBhHiIqQefd?")
_CRC_BYTES: Final = 4
_MOST_KINDS: Final = 256
_MOST_FIELDS: Final = 64
_LONGEST_NAME: Final = 1 << 10

CANDIDATES, CHOSEN = "estTdoaCand", "estTDOA"
"""Differences of all pairs, logged by newer firmware, and those used by its filter."""

_TRUTHS: Final = ("estPose", "estPosition", "lhPosition")
"""Events with a position from motion capture or lighthouse, the better first."""

_SENSOR, _BAROMETER = "estTOF", "estBarometer"
_GYROSCOPE, _ACCELEROMETER = "estGyroscope", "estAcceleration"
"""In degrees per second, and in units of gravity."""
MOST_OF_SENSOR: Final = 40.0
"""Rows with a larger rate [rad/s] or specific force [m/s²] along an axis are left out, as after a crash."""

_MILLIMETRES_FROM: Final = 20.0
"""A ranger's reading above this is in millimetres: its range is four metres."""

BAROMETER_STD_M: Final = 0.2


class _Kind(NamedTuple):
    name: str
    fields: tuple[str, ...]
    """Without the prefix up to the dot."""
    binary: Binary


class _Event(NamedTuple):
    name: str
    time_s: float
    """Since the log's first event."""
    values: dict[str, float]


def recognise(head: bytes) -> bool:
    """Whether the file begins with a description of events."""
    if len(head) < _HEADER.size:
        return False
    magic, version, kinds = _HEADER.unpack_from(head)
    name = head[_HEADER.size + 2 : _HEADER.size + 34].partition(b"\0")[0]
    return magic == _MAGIC and version in _TIMES and 0 < kinds <= _MOST_KINDS and name.isalnum()


def read(stream: BufferedIOBase, drops: Drops) -> Iterator[PairTdoa]:
    """Yield the differences: of all candidates if the log has them, otherwise those used by the firmware."""
    log = _Log(stream, drops)
    wanted = CANDIDATES if CANDIDATES in log.names else CHOSEN
    for event in log.events():
        if event.name == wanted:
            values = event.values
            if not values.keys() >= {"idA", "idB", "distanceDiff"}:
                drops["unknown-fields"] += 1
            elif not np.isfinite(values["distanceDiff"]):
                drops["not-finite"] += 1
            elif values["idA"] == values["idB"]:
                drops["anchor-against-itself"] += 1
            else:
                yield PairTdoa(event.time_s, int(values["idA"]), int(values["idB"]), values["distanceDiff"])


def read_truth(path: str | PathLike[str], _listener: str | None) -> Truth | None:
    """Positions from motion capture or lighthouse in the log; None if it has none."""
    for table in _vectors(path, _TRUTHS, ("x", "y", "z", "qx", "qy", "qz", "qw")):
        if len(table):
            return Truth(table[:, 0], table[:, 1:4], table[:, 4:8] if table.shape[1] == 8 else None)
    return None


def _events(path: str | PathLike[str], names: Container[str]) -> Iterator[_Event]:
    with open_source(path) as stream:
        yield from (event for event in _Log(stream, Counter()).events() if event.name in names)


def _vectors(path: str | PathLike[str], kinds: Sequence[str], names: Sequence[str]) -> list[Array]:
    """Rows of time and the named fields of each kind of event, of which those after x, y and z may be missing."""
    found: dict[str, list[tuple[float, ...]]] = {kind: [] for kind in kinds}
    for event in _events(path, found):
        if event.values.keys() >= {"x", "y", "z"}:
            found[event.name].append((event.time_s, *(event.values[name] for name in names if name in event.values)))
    return [in_order(np.array(rows or np.empty((0, 4)), dtype=np.float64)) for rows in found.values()]


def in_order(table: Array) -> Array:
    """Rows with only finite numbers, in order of their first column, time."""
    table = table[np.isfinite(table).all(axis=1)]
    return table[np.argsort(table[:, 0], kind="stable")] if len(table) else table


def read_heights(path: str | PathLike[str], *, is_barometer: bool) -> Array | None:
    """Rows of time, height and standard deviation of the ranger or the barometer; None if the log has none."""
    wanted = _BAROMETER if is_barometer else _SENSOR
    rows = [(event.time_s, next(iter(event.values.values()))) for event in _events(path, {wanted}) if event.values]
    return heights_of(np.array(rows).reshape(-1, 2), is_barometer=is_barometer)


def read_motion(path: str | PathLike[str]) -> Array | None:
    """Rows of time, rates [rad/s] and specific forces [m/s²], x, y and z each; None if the log lacks either."""
    rates, forces = _vectors(path, (_GYROSCOPE, _ACCELEROMETER), "xyz")
    if len(rates) == 0 or len(forces) == 0:
        return None
    together = [np.interp(rates[:, 0], forces[:, 0], GRAVITY_MPS2 * forces[:, axis]) for axis in (1, 2, 3)]
    rows = np.column_stack([rates[:, 0], np.radians(rates[:, 1:]), *together])
    return rows[np.all(np.abs(rows[:, 1:]) < MOST_OF_SENSOR, axis=1)]


def heights_of(rows: Array, *, is_barometer: bool) -> Array | None:
    """Convert rows of time and reading to time, height in metres and standard deviation; None if empty."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) == 0:
        return None
    if not is_barometer and np.median(rows[:, 1]) > _MILLIMETRES_FROM:
        rows = rows * (1.0, 1e-3)
    return np.column_stack([rows, np.full(len(rows), BAROMETER_STD_M if is_barometer else HEIGHT_STD_M)])


class _Log:
    """A log being read: first the kinds of events, then the events."""

    def __init__(self, stream: BufferedIOBase, drops: Drops) -> None:
        self._drops = drops
        self._chunks = chunks(stream, drops)
        self._bytes, self._at = b"", 0
        self._crc = 0
        self._kinds: dict[int, _Kind] = {}
        self._time = self._read_kinds()

    @property
    def names(self) -> frozenset[str]:
        """Names of the kinds of events."""
        return frozenset(kind.name for kind in self._kinds.values())

    def _has(self, count: int) -> bool:
        """Whether this number of bytes is left before the checksum."""
        while len(self._bytes) - self._at < count + _CRC_BYTES:
            chunk = next(self._chunks, None)
            if chunk is None:
                return False
            self._bytes, self._at = self._bytes[self._at :] + chunk, 0
        return True

    def _take(self, count: int) -> bytes | None:
        if not self._has(count):
            return None
        taken = self._bytes[self._at : self._at + count]
        self._at += count
        self._crc = crc32(taken, self._crc)
        return taken

    def _text(self) -> str:
        length = 0
        while length < _LONGEST_NAME and self._has(length + 1) and self._bytes[self._at + length] != 0:
            length += 1
        return (self._take(length + 1) or b"\0")[:-1].decode("ascii", "replace")

    def _number(self) -> int:
        taken = self._take(_TWO.size)
        return 0 if taken is None else int(_TWO.unpack(taken)[0])

    def _read_kinds(self) -> tuple[Binary, float]:
        header = self._take(_HEADER.size)
        _, version, kinds = (_MAGIC, 1, 0) if header is None else _HEADER.unpack(header)
        for _ in range(min(kinds, _MOST_KINDS)):
            number, name = self._number(), self._text()
            fields = [self._text() for _ in range(min(self._number(), _MOST_FIELDS))]
            types = "".join(field[-2:-1] for field in fields)
            if not set(types) <= _TYPES or len(types) < len(fields):
                self._drops["unknown-type"] += 1
                self._kinds.clear()
                break
            names = tuple(field[:-3].rpartition(".")[2] for field in fields)
            self._kinds[number] = _Kind(name, names, Binary("<" + types))
        return _TIMES.get(version, _TIMES[2])

    def events(self) -> Iterator[_Event]:
        """All events up to where the log is cut off or invalid."""
        binary, unit_s = self._time
        begin: int | None = None
        while (head := self._take(binary.size)) is not None:
            number, time = binary.unpack(head)
            kind = self._kinds.get(number)
            if kind is None:
                self._drops["unknown-event"] += 1
                return
            body = self._take(kind.binary.size)
            if body is None:
                break
            begin = time if begin is None else begin
            values = dict(zip(kind.fields, map(float, kind.binary.unpack(body)), strict=True))
            yield _Event(kind.name, (time - begin) * unit_s, values)
        if self._bytes[self._at :] != self._crc.to_bytes(_CRC_BYTES, "little"):
            self._drops["wrong-checksum"] += 1


# YAML captures of Bitcraze anchors: one document a packet, as the ``uwb_tdoa`` capture tool writes them.
#
# Used keys: ``data`` (payload, base64), ``from`` (anchor), ``ts`` (RX stamp of the tag, 40 bits), ``rxSys`` (host's
# Unix time). The rest repeats the payload. Documents of exactly the tool's shape are cut out by searching; any other
# goes through libyaml's events. (Its loader takes 110 µs a document and crashes on deep nesting.)

MAX_DOCUMENT_BYTES: Final = 1 << 13
_SEPARATOR: Final = b"\n---"
_DOCUMENT: Final = re.compile(
    rb"\ndata: !!binary \|\n  (.*?)\nfrom: ([^\n]*)(?=\n).*?\nrxSys: ([^\n]*)(?=\n).*?\nts: ([^\n]*)\n", re.DOTALL
)
_LAST_STAMP: Final = (1 << TICK_BITS) - 1
_LAST_HOST_S: Final = 1e11
_DEEPEST: Final = 8
_KEYS: Final = tuple(re.compile(rb"(?m)^[{ ]*[\"']?" + key + rb"[\"']? *:") for key in (b"data", b"from", b"ts"))
_Loader: Final = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def recognise_yaml(head: bytes) -> bool:
    """Whether a recording begins like a YAML capture."""
    return all(key.search(head) for key in _KEYS)


def read_yaml(stream: BufferedIOBase, drops: Drops) -> Iterator[Packet]:
    """Yield the packets of a capture."""
    for document in _documents(stream, drops):
        packet = _scan_document(document)
        if packet is None:
            packet = _parse_document(document)
        if isinstance(packet, Packet):
            yield packet
        elif packet:
            drops[packet] += 1


def _documents(stream: BufferedIOBase, drops: Drops) -> Iterator[bytes]:
    """Yield the documents, each starting with the end of its separator's line."""
    rest = b"\n"
    skipping = False
    for chunk in chunks(stream, drops):
        parts = (rest + chunk).split(_SEPARATOR)
        rest = parts.pop()
        if skipping and parts:
            del parts[0]
            skipping = False
        yield from parts
        if len(rest) > MAX_DOCUMENT_BYTES:
            if not skipping:
                drops["overlong-document"] += 1
            skipping = True
            rest = rest[1 - len(_SEPARATOR) :]
    if not skipping:
        yield rest[: rest.rfind(b"\n") + 1]  # a number in an unfinished line may be cut off


def _scan_document(document: bytes) -> Packet | str | None:
    """Packet of a document of the tool's own shape; None for any other shape."""
    match = _DOCUMENT.match(document)
    if match is None:
        return None
    base64, sender, host, stamp = match.groups()
    try:
        return _packet_of_document(base64, int(sender), int(stamp), float(host))
    except ValueError:
        return None


def _parse_document(document: bytes) -> Packet | str | None:
    """Packet of a document of any shape, or why it has none; None for an empty one."""
    text = document.partition(b"\n")[2]
    if not text.strip():
        return None
    if len(text) > MAX_DOCUMENT_BYTES:
        return "overlong-document"
    try:
        values = _top_level(text)
    except (yaml.YAMLError, ValueError):
        return "malformed-document"
    if not {"data", "from", "ts"} <= values.keys():
        return "incomplete-document"
    try:
        host_s = float(values["rxSys"]) if "rxSys" in values else None
        return _packet_of_document(values["data"].encode(), int(values["from"]), int(values["ts"]), host_s)
    except ValueError:
        return "malformed-document"


def _top_level(text: bytes) -> dict[str, str]:
    """Scalars of the outermost mapping by key, read as events so that nesting costs no stack."""
    values: dict[str, str] = {}
    depth = 0
    key: str | None = None
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                raise ValueError("too deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            key = None if depth == 1 else key
        elif depth == 1 and isinstance(event, yaml.ScalarEvent):
            if key is None:
                key = event.value
            else:
                values[key] = event.value
                key = None
    return values


def _packet_of_document(base64: bytes, sender: int, rx_ticks: int, host_s: float | None) -> Packet | str:
    """Decode a document's packet. Raises ValueError for invalid base64."""
    if not 0 <= rx_ticks <= _LAST_STAMP:
        return "impossible-stamp"
    if host_s is not None and not 0.0 <= host_s < _LAST_HOST_S:
        return "impossible-host-time"
    try:
        payload = a2b_base64(base64)
    except Base64Error as error:
        raise ValueError("not base64") from error
    return decode_payload(payload, host_s, sender, rx_ticks)
