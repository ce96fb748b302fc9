"""The table of recording formats, and opening a recording of any of them."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from io import BufferedIOBase
from os import PathLike, fspath
from typing import Final

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.arrays import Array
from skyless.core.errors import ConfigurationError
from skyless.core.ticks import TICK_BITS
from skyless.files import Drops, has_columns, header_of, open_source, read_head
from skyless.radio.foreign import bitcraze, fira, phones
from skyless.research.foreign import crazyflie, datasets
from skyless.site.anchor_names import anchor_name
from skyless.site.tables import Truth, read_truth

Record = Packet | PairTdoa


@dataclass(frozen=True)
class Format:
    """A format: how to recognise and read it."""

    name: str
    recognise: Callable[[bytes], bool]
    """From the first bytes, decompressed."""
    read: Callable[..., Iterator[Record]]
    """From an open stream and a counter of drops; with ``listener`` if ``any_listener``, and ``anchors_m`` if
    ``is_dl_tdoa``."""
    tx_bits: int | None = None
    """Width of the anchors' stamps in its packets; None for a format of ready TDoAs."""
    any_listener: bool = False
    """One recording holds several listeners, one of which is chosen."""
    is_dl_tdoa: bool = False
    """FiRa's: packets may state their senders' positions, and relay only initiators and those that answered them."""
    read_truth: Callable[[str | PathLike[str], str | None], Truth | None] | None = None
    """The truth in the recording itself, from its path and the listener; None for formats without."""
    truth_is_of_body: bool = False
    """Whether that truth is of the body that carries the antenna."""
    read_heights: Callable[..., Array | None] | None = None
    """Rows of time, height and standard deviation of a recorded sensor, from the path and ``is_barometer``."""
    read_motion: Callable[[str | PathLike[str]], Array | None] | None = None
    """Rows of time, rates and specific forces of a recorded motion sensor, from the path."""
    read_anchors: Callable[[str | PathLike[str]], dict[int, Point]] | None = None
    """Positions of all anchors, from the path, if the recording itself has them."""
    channels: tuple[int, ...] = ()
    """Selectable channels; with one selected, packets have carrier phases."""
    delays_ticks: int = 0
    """Antenna delays of a sender and a receiver together, if its stamps include them."""

    def anchor_name(self, anchor: int) -> str:
        """The name of an anchor for people."""
        return anchor_name(anchor, addresses=self.is_dl_tdoa)


_bitcraze: Final = partial(Format, tx_bits=bitcraze.STAMP_BITS, delays_ticks=bitcraze.ANTENNA_DELAYS_TICKS)
_dl_tdoa: Final = partial(Format, tx_bits=TICK_BITS, is_dl_tdoa=True)

FORMATS: Final = (
    _bitcraze("bitcraze-yaml", crazyflie.recognise_yaml, crazyflie.read_yaml),
    _bitcraze("bitcraze-text", bitcraze.recognise_text, bitcraze.read_text),
    Format(
        "miluv",
        partial(has_columns, datasets.MILUV_COLUMNS),
        datasets.read_miluv,
        any_listener=True,
        read_truth=read_truth,
    ),
    Format(
        "avalue", partial(has_columns, datasets.RECEPTION_COLUMNS), datasets.read_avalue, TICK_BITS, any_listener=True
    ),
    _dl_tdoa("dl-tdoa-json", phones.recognise, phones.read),
    _dl_tdoa("uci-text", fira.recognise_text, fira.read_text),
    Format("tdoa-table", datasets.recognise_tdoas, datasets.read_tdoas),
    Format(
        "util-table",
        partial(has_columns, datasets.UTIL_COLUMNS),
        partial(datasets.read_tdoas, columns=datasets.UTIL_COLUMNS),
        read_truth=datasets.read_util_truth,
        truth_is_of_body=True,
        read_heights=datasets.read_util_heights,
    ),
    Format(
        "crazyflie-log",
        crazyflie.recognise,
        crazyflie.read,
        read_truth=crazyflie.read_truth,
        truth_is_of_body=True,
        read_heights=crazyflie.read_heights,
        read_motion=crazyflie.read_motion,
    ),
    _dl_tdoa("uci-pcapng", fira.recognise_pcapng, fira.read_pcapng),
    Format(
        "starloc",
        partial(has_columns, datasets.COLUMNS),
        datasets.read_starloc,
        any_listener=True,
        read_truth=datasets.starloc_truth,
        read_anchors=datasets.starloc_anchors,
    ),
    Format(
        "muloc",
        datasets.recognise,
        datasets.read_muloc,
        TICK_BITS,
        read_truth=datasets.muloc_truth,
        read_anchors=datasets.muloc_anchors,
        channels=datasets.CHANNELS,
    ),
    _bitcraze("bitcraze-binary", bitcraze.recognise_binary, bitcraze.read_binary),
    _dl_tdoa("uci-binary", fira.recognise_binary, fira.read_binary),
)
"""In the order of recognition: the more specific first."""


@dataclass
class Recording:
    """An open recording: iterate over it once, and close it (or use ``with``)."""

    format: Format
    path: str
    records: Iterator[Record]
    stream: BufferedIOBase
    drops: Drops = field(default_factory=Counter)
    """What could not be used, by reason; complete once the records are exhausted."""

    def __iter__(self) -> Iterator[Record]:
        return self.records

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def bytes_read(self) -> int:
        """Position of reading in the file, in compressed bytes if it is compressed."""
        return os.lseek(self.stream.fileno(), 0, os.SEEK_CUR)

    def close(self) -> None:
        """Close the file."""
        self.stream.close()


def open_recording(
    path: str | PathLike[str],
    format_name: str | None = None,
    listener: str | None = None,
    anchors_m: Mapping[int, Point] | None = None,
    channel: int | None = None,
) -> Recording:
    """Open a recording of a named format, or of the one recognised from its first bytes.

    ``listener`` selects one receiver if a recording has several; by default that of the first row. ``anchors_m``:
    positions that replace those stated by the anchors of a DL-TDoA recording. ``channel``: the only one to read, with
    its carrier phases.

    Raises ConfigurationError: the file cannot be opened, its format is unknown, or listener or channel are invalid.
    """
    chosen = format_of(path, format_name)
    read = _listening(path, chosen, listener)
    if chosen.is_dl_tdoa:
        read = partial(chosen.read, anchors_m=anchors_m)
    if channel is not None:
        if channel not in chosen.channels:
            right = " or ".join(map(str, chosen.channels)) or f"left out: {chosen.name} has one channel only"
            raise ConfigurationError(path, "channel", channel, right)
        read = partial(chosen.read, channel=channel)
    stream = open_source(path)
    drops: Drops = Counter()
    return Recording(chosen, fspath(path), read(stream, drops), stream, drops)


_TABLES: Final = (datasets.TDOA_COLUMNS, datasets.UTIL_COLUMNS, datasets.RECEPTION_COLUMNS, datasets.COLUMNS)
"""Columns that a user may have meant if a table has others; of equal matches the first."""
_HEADER: Final = re.compile(r"[A-Za-z_][\w. ]*(,[ \w.]+)+")

_MCAP: Final = b"\x89MCAP0"


def format_of(path: str | PathLike[str], name: str | None = None) -> Format:
    """The named format, or the one recognised from the file's first bytes.

    Raises ConfigurationError: the file cannot be opened, or its format is unknown.
    """
    if name is None:
        return _recognised(path)
    for known in FORMATS:
        if known.name == name:
            return known
    raise ConfigurationError(path, "format", name, f"one of {_names()}")


def _recognised(path: str | PathLike[str]) -> Format:
    head = read_head(path)
    for known in FORMATS:
        if known.recognise(head):
            return known
    if not head:
        raise ConfigurationError(path, "the file", "empty", f"a recording {_readable()}")
    if head.startswith(_MCAP):
        raise ConfigurationError(path, "the file", "a compressed MCAP", "unpacked first, as by gunzip")
    if has_columns(datasets.BLINK_COLUMNS, head):
        expected = "ccp.csv of the same system: what tags send up to anchors cannot be replayed as a tag's receptions"
        raise ConfigurationError(path, "the format", "tag blinks", expected)
    header = head.partition(b"\n")[0].decode("ascii", "replace").strip()
    if _HEADER.fullmatch(header):
        meant = max(_TABLES, key=lambda columns: len({*columns} & {*header_of(head)}) / len(columns))
        missing = ", ".join(name for name in meant if name not in header_of(head))
        right = f"a known table's, such as {','.join(meant)} (missing: {missing}); formats: {_names()}"
        raise ConfigurationError(path, "the header", header[:80], right)
    start = head[:24].decode("ascii", "backslashreplace")
    raise ConfigurationError(path, "the beginning", start, f"that of a recording {_readable()}")


def _listening(
    path: str | PathLike[str], chosen: Format, listener: str | None
) -> Callable[[BufferedIOBase, Drops], Iterator[Record]]:
    """Bind the reader to its listener."""
    if listener is None:
        return chosen.read
    if not chosen.any_listener:
        raise ConfigurationError(path, "listener", listener, f"left out: format {chosen.name} has one listener only")
    try:
        identifier = int(listener, 16 if re.search("[xa-f]", listener.lower()) else 10)
    except ValueError as error:
        right = "an identifier, decimal, or hexadecimal with 0x or letters"
        raise ConfigurationError(path, "listener", listener, right) from error
    return partial(chosen.read, listener=str(identifier))


def _readable() -> str:
    return f"of skyless record, or of one of the formats {_names()}"


def _names() -> str:
    return ", ".join(known.name for known in FORMATS)
