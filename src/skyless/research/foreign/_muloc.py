"""MULoc's recordings: four DW1000s that broadcast in turn and hear each other, and a tag that only listens.

An ``.npz`` of arrays over rounds k, senders p in the order in which they send, and observers o, the last of which is
the tag. TX stamps were not recorded. A sender answers the packet before its own by a delayed transmission, so

    X = ((R + 65536·d) with its low nine bits 0) + A,

R the sender's own reception of that packet, d the delay that was programmed, A its TX antenna delay (Ma, Zhang, Jin,
Li, Wang, MULoc, INFOCOM 2025). All radios change the channel after each second round. Stamps and phases of the two
channels have other constants, so one of them is read where phases are.
"""

import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BufferedIOBase
from itertools import pairwise
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.core.air.masterless_packets import Packet, Point, Relay
from skyless.core.arrays import Array
from skyless.core.input_files import Drops, open_source
from skyless.core.ticks import TICK_BITS, TICK_RATE_HZ, difference, wrap
from skyless.site.tables import Truth

CHANNELS: Final = (1, 3)

_SENDERS: Final = 4
_TAG: Final = _SENDERS
_NAMES: Final = (b"anchors_m.npy", b"start_m.npy", b"end_m.npy")
_SHAPES: Final[dict[str, tuple[int, ...]]] = {
    "index": (),
    "channel": (),
    "rx_ticks": (_SENDERS, _SENDERS + 1),
    "iq": (_SENDERS, _SENDERS + 1, 2),
    "rcphase": (_SENDERS, _SENDERS + 1),
    "anchors_m": (2,),
    "start_m": (),
    "end_m": (),
    "stops_s": (2,),
}
"""Shape of each array behind its first axis."""

_MOST_BYTES: Final = 1 << 28
_DELAY: Final = 600 << 16
_TX_ANTENNA_TICKS: Final = 32_880
_GRID: Final = 512
_MAX_STALE_TICKS: Final = round(2e-6 * TICK_RATE_HZ)
"""By how much the tag's stamps of a round may be off the programmed delay; beyond, some are of an earlier packet."""

_STOPS_S: Final = ((0.25, 3.75), (5.25, 11.5), (13.0, 19.25), (20.5, 27.0), (28.25, 34.5), (35.75, 39.75))
_STOPS_ROUNDS: Final = 14_032
"""When the tag stood in the recording location1_2, known by its number of rounds: the file does not hold that."""


def recognise(head: bytes) -> bool:
    """Whether this is a ZIP archive with the arrays' names."""
    return head.startswith(b"PK\x03\x04") and all(name in head for name in _NAMES)


def arrays_of(stream: BufferedIOBase, drops: Drops, *names: str) -> dict[str, Any] | None:
    """Some arrays of a recording by their names; None, counted, where one is missing or damaged."""
    try:
        with zipfile.ZipFile(stream) as archive:
            found = {}
            for name in names:
                if archive.getinfo(f"{name}.npy").file_size > _MOST_BYTES:
                    raise ValueError(name)
                with archive.open(f"{name}.npy") as file:
                    found[name] = np.lib.format.read_array(file, allow_pickle=False)
                if found[name].shape[1:] != _SHAPES[name] or found[name].dtype.kind not in "uif":
                    raise ValueError(name)
    except (OSError, EOFError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error):
        drops["damaged-array"] += 1
        return None
    return found


def read(stream: BufferedIOBase, drops: Drops, channel: int | None = None) -> Iterator[Packet]:
    """Yield what the tag received; ``channel``: on this one alone, with the phases of its carrier."""
    names = ("index", "channel", "rx_ticks") if channel is None else ("index", "channel", "rx_ticks", "iq", "rcphase")
    arrays = arrays_of(stream, drops, *names)
    if arrays is None:
        return
    if len({len(one) for one in arrays.values()}) > 1:
        drops["damaged-array"] += 1
        return
    index, channels, rounds = (arrays[name].tolist() for name in ("index", "channel", "rx_ticks"))
    phases = None if channel is None else phases_cycles(arrays["iq"], arrays["rcphase"])
    before: list[list[int]] = []
    for number, (one, rx_ticks) in enumerate(zip(index, rounds, strict=False)):
        follows = bool(before) and (one - index[number - 1]) % 256 == 1
        last, before = before if follows else [[-1] * (_SENDERS + 1)] * _SENDERS, rx_ticks
        if _is_stale([stamps[_TAG] for stamps in rx_ticks]):
            drops["stale-registers"] += 1
            continue
        retuned = follows and channels[number] != channels[number - 1]
        if channel not in {None, channels[number]}:
            continue
        for sender in range(_SENDERS):
            received = [(number, other, rx_ticks[other][sender]) for other in range(sender)]
            if channel is None or not retuned:
                received += [(number - 1, other, last[other][sender]) for other in range(sender + 1, _SENDERS)]
            heard = rx_ticks[sender - 1][sender] if sender else last[-1][0]
            if min(heard, rx_ticks[sender][_TAG]) < 0:
                drops["tx-stamp-unknown" if heard < 0 else "unheard-by-the-listener"] += 1
                continue
            delay = _DELAY * (2 if retuned and not sender else 1)
            tx_ticks = wrap((heard + delay) // _GRID * _GRID + _TX_ANTENNA_TICKS)
            relays = tuple(
                Relay(other, k, stamp, None, _phase_at(phases, k, other, sender))
                for k, other, stamp in received
                if stamp >= 0
            )
            phase = _phase_at(phases, number, sender, _TAG)
            yield Packet(None, sender, number, tx_ticks, rx_ticks[sender][_TAG], relays, None, phase)


def _phase_at(phases: Array | None, number: int, sender: int, observer: int) -> float | None:
    """The phase of a packet of a round as an observer measured it, where phases are read."""
    return None if phases is None else float(phases[number, sender, observer])


def phases_cycles(iq: NDArray[Any], rcphase: NDArray[Any]) -> Array:
    """Phases of the carrier in [0, 1), of accumulator samples, shape (…, 2), and RCPHASE in 1/128 cycles, shape (…)."""
    angles = np.arctan2(iq[..., 1].astype(np.float64), iq[..., 0].astype(np.float64))
    return np.asarray((angles / (2.0 * np.pi) - rcphase / 128.0) % 1.0, np.float64)


def _is_stale(stamps: list[int]) -> bool:
    """Whether the tag's stamps of a round are not those of one packet after the other."""
    gaps = (difference(b, a, TICK_BITS) for a, b in pairwise(stamps))
    return any(abs(gap - _DELAY - _TX_ANTENNA_TICKS) > _MAX_STALE_TICKS for gap in gaps)


def read_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Where the anchors stand, in one plane, as their heights are not known; empty where the file is damaged."""
    with open_source(path) as stream:
        arrays = arrays_of(stream, Counter(), "anchors_m")
    return {} if arrays is None else {k: (x_m, y_m, 0.0) for k, (x_m, y_m) in enumerate(arrays["anchors_m"].tolist())}


def read_truth(path: str | PathLike[str], _listener: str | None) -> Truth | None:
    """Where the tag stood, at even steps from its first stop to its last, while it did; None where that is damaged."""
    with open_source(path) as stream:
        arrays = arrays_of(stream, Counter(), "index", "start_m", "end_m")
        held = arrays_of(stream, Counter(), "stops_s")
    if arrays is None or len(arrays["start_m"]) != 2 or len(arrays["end_m"]) != 2:
        return None
    known = _STOPS_S if len(arrays["index"]) == _STOPS_ROUNDS else ()
    stops_s = known if held is None else held["stops_s"].tolist()
    if not stops_s:
        return None
    rows = []
    for share, (begin_s, end_s) in zip(np.linspace(0.0, 1.0, len(stops_s)), stops_s, strict=True):
        x_m, y_m = (1.0 - share) * arrays["start_m"] + share * arrays["end_m"]
        rows += [(t_s, x_m, y_m, 0.0) for t_s in np.arange(begin_s, end_s + 0.125, 0.25)]
    table = np.array(rows)
    return Truth(table[:, 0], table[:, 1:], None)
