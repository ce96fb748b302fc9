"""YAML captures of Bitcraze anchors: one document a packet, as the ``uwb_tdoa`` capture tool writes them.

Used keys: ``data`` (payload, base64), ``from`` (anchor), ``ts`` (RX stamp of the tag, 40 bits), ``rxSys`` (host's
Unix time). The rest repeats the payload. Documents of exactly the tool's shape are cut out by searching;
any other goes through libyaml's events. (Its loader takes 110 µs a document and crashes on deep nesting.)
"""

import re
from binascii import Error as Base64Error
from binascii import a2b_base64
from collections.abc import Iterator
from io import BufferedIOBase
from typing import Final

import yaml

from skyless.core.air.masterless_packets import Packet
from skyless.core.input_files import Drops, chunks
from skyless.core.ticks import TICK_BITS
from skyless.radio.foreign.bitcraze import decode_payload

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
    """Yield the documents, each beginning with the end of its separator's line."""
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
    """Packet of a document of any shape, or the reason why it has none; None for an empty one."""
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
    """Scalars of the outermost mapping, by key; walked over as events, so that nesting costs no stack."""
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
    """Raises ValueError for what is not base64."""
    if not 0 <= rx_ticks <= _LAST_STAMP:
        return "impossible-stamp"
    if host_s is not None and not 0.0 <= host_s < _LAST_HOST_S:
        return "impossible-host-time"
    try:
        payload = a2b_base64(base64)
    except Base64Error as error:
        raise ValueError("not base64") from error
    return decode_payload(payload, host_s, sender, rx_ticks)
