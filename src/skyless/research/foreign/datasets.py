"""Published recordings in arrays and tables: MULoc, STARLoc, TDoA tables, and those of A-Value.

An ``.npz`` of arrays over rounds k, senders p in the order in which they send, and observers o, the last of which is
the tag. TX stamps were not recorded. A sender answers the packet before its own by a delayed transmission, so

    X = ((R + 65536·d) with its low nine bits 0) + A,

R the sender's own reception of that packet, d the delay that was programmed, A its TX antenna delay (Ma, Zhang, Jin,
Li, Wang, MULoc, INFOCOM 2025). All radios change the channel after each second round. Stamps and phases of the two
channels have other constants, so one of them is read where phases are.
"""

import re
import zipfile
import zlib
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from io import BufferedIOBase
from itertools import pairwise
from math import dist, isfinite
from os import PathLike
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point, Relay
from skyless.core.arrays import Array
from skyless.core.ticks import TICK_BITS, TICK_M, TICK_RATE_HZ, TICK_S, difference, wrap
from skyless.files import Drops, has_columns, open_source, rows
from skyless.research.foreign.crazyflie import heights_of, in_order
from skyless.site.survey.legs import AnchorFlights
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
"""Largest deviation of a round's tag stamps from the programmed delay; beyond, some are of an earlier packet."""

_STOPS_S: Final = ((0.25, 3.75), (5.25, 11.5), (13.0, 19.25), (20.5, 27.0), (28.25, 34.5), (35.75, 39.75))
_STOPS_ROUNDS: Final = 14_032
"""Stops of the tag in the recording location1_2, recognised by its number of rounds: the file lacks them."""


def recognise(head: bytes) -> bool:
    """Whether this is a ZIP archive with the arrays' names."""
    return head.startswith(b"PK\x03\x04") and all(name in head for name in _NAMES)


def arrays_of(stream: BufferedIOBase, drops: Drops, *names: str) -> dict[str, Any] | None:
    """Arrays of a recording by name; None, counted, if one is missing or damaged."""
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


def read_muloc(stream: BufferedIOBase, drops: Drops, channel: int | None = None) -> Iterator[Packet]:
    """Yield the tag's receptions; with ``channel``, only of that one and with its carrier phases."""
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
        gaps = (difference(b[_TAG], a[_TAG], TICK_BITS) for a, b in pairwise(rx_ticks))
        if any(abs(gap - _DELAY - _TX_ANTENNA_TICKS) > _MAX_STALE_TICKS for gap in gaps):
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
    """Phase of a round's packet as an observer measured it, if phases are read."""
    return None if phases is None else float(phases[number, sender, observer])


def phases_cycles(iq: NDArray[Any], rcphase: NDArray[Any]) -> Array:
    """Carrier phases in [0, 1), from accumulator samples, shape (…, 2), and RCPHASE in 1/128 cycles, shape (…)."""
    angles = np.arctan2(iq[..., 1].astype(np.float64), iq[..., 0].astype(np.float64))
    return np.asarray((angles / (2.0 * np.pi) - rcphase / 128.0) % 1.0, np.float64)


def muloc_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Anchor positions, all at z = 0 as their heights are unknown; empty if the file is damaged."""
    with open_source(path) as stream:
        arrays = arrays_of(stream, Counter(), "anchors_m")
    return {} if arrays is None else {k: (x_m, y_m, 0.0) for k, (x_m, y_m) in enumerate(arrays["anchors_m"].tolist())}


def muloc_truth(path: str | PathLike[str], _listener: str | None) -> Truth | None:
    """Positions of the tag at its stops, evenly spaced from the first to the last; None if damaged."""
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


# Tables of TDoAs with tdoa_m = |p − b| − |p − a|: by the names of ``PairTdoa``, or those of the UTIL flights and logs.

TDOA_COLUMNS: Final = ("t_s", "anchor_a", "anchor_b", "tdoa_m")
FLIGHT_COLUMNS: Final = ("t_s", "idA", "idB", "tdoa_m")
_OUR_NAMES: Final = {"idA": "anchor_a", "idB": "anchor_b"}

UTIL_COLUMNS: Final = ("t_tdoa", "idA", "idB", "tdoa_meas")
"""The same in UTIL's own tables, which have columns of other sensors, of other lengths, beside them."""

_POSE_COLUMNS: Final = ("t_pose", "pose_x", "pose_y", "pose_z", "pose_qx", "pose_qy", "pose_qz", "pose_qw")


def read_tdoas(stream: BufferedIOBase, drops: Drops, columns: Sequence[str] = TDOA_COLUMNS) -> Iterator[PairTdoa]:
    """Yield the TDoAs of a table, in its own time.

    Rows of UTIL's tables without TDoA are of other sensors, and are not counted.
    """
    for time, a, b, tdoa in rows(stream, drops, [_OUR_NAMES.get(name, name) for name in columns], _OUR_NAMES):
        try:
            time_s, anchor_a, anchor_b, tdoa_m = float(time), _identifier(a), _identifier(b), float(tdoa)
        except ValueError:
            given = [bool(field.strip()) for field in (time, a, b, tdoa)]
            if any(given) or columns is not UTIL_COLUMNS:
                drops["malformed-number" if all(given) else "blank-field"] += 1
            continue
        if not (isfinite(time_s) and isfinite(tdoa_m)):
            drops["not-finite"] += 1
        elif anchor_a == anchor_b:
            drops["anchor-against-itself"] += 1
        else:
            yield PairTdoa(time_s, anchor_a, anchor_b, tdoa_m)


def recognise_tdoas(head: bytes) -> bool:
    """Whether it is a table of TDoAs, by either set of column names."""
    return has_columns(TDOA_COLUMNS, head) or has_columns(FLIGHT_COLUMNS, head)


def _identifier(text: bytes) -> int:
    """A whole number, written as ``7.0`` in UTIL's tables. Raises ValueError."""
    return int(text.removesuffix(b".0"))


def read_util_truth(path: str | PathLike[str], _listener: str | None) -> Truth | None:
    """Poses of motion capture in one of UTIL's tables; None if it has none."""
    table = numbers(path, _POSE_COLUMNS)
    return Truth(table[:, 0], table[:, 1:4], table[:, 4:8]) if len(table) else None


def read_util_heights(path: str | PathLike[str], *, is_barometer: bool) -> Array | None:
    """Rows of time, height and standard deviation of its ranger or barometer; None if it has none."""
    columns = ("t_baro", "baro") if is_barometer else ("t_tof", "tof")
    return heights_of(numbers(path, columns), is_barometer=is_barometer)


def numbers(path: str | PathLike[str], columns: tuple[str, ...], tag: tuple[str, str | None] | None = None) -> Array:
    """Rows of numbers of these columns in which all are given, in order of the first.

    ``tag``: the column that identifies the tag, and the wanted tag, by default that of the first row.
    """
    found = []
    names = columns if tag is None else (columns[0], tag[0], *columns[1:])
    with open_source(path) as stream:
        if has_columns(names, stream.readline()):
            stream.seek(0)
            given = rows(stream, Counter(), names)
            for row in given if tag is None else rows_of(given, Counter(), tag[1]):
                with suppress(ValueError):
                    found.append([float(field) for field in (row if tag is None else row[:1] + row[2:])])
    return in_order(np.array(found, dtype=np.float64).reshape(-1, len(columns)))


def rows_of(given: Iterable[list[bytes]], drops: Drops, listener: str | None) -> Iterator[list[bytes]]:
    """Rows of one listener, named by their second field; by default that of the first row."""
    wanted = None if listener is None else listener.encode()
    for row in given:
        wanted = wanted or row[1]
        if row[1] == wanted:
            yield row
        else:
            drops["other-listener"] += 1


# MILUV passive ticks: three-message exchanges of two nodes that a third overhears (Shalaby et al., MILUV, 2025).
#
# Initiator I sends (1), responder R answers (2) and sends once more (3); listener L stamps all three. With the
# durations of each clock, taken modulo 2³² as integers,
#
#     reply = R_tx2 − R_rx1,   ν_X = (X_rx3 − X_rx2) / (R_tx3 − R_tx2)  the rate of X = L, I against R,
#     tof = ½·[(I_rx2 − I_tx1) − ν_I·reply],
#     TDoA of R against I = (L_rx2 − L_rx1) − ν_L·reply − tof.
#
# Of the antenna delays (TX plus RX of a node) half of R's less half of I's remains. I and R may move: their positions
# go with each TDoA (a is I, b is R).

_STAMP_COLUMNS: Final = ("L_rx1", "L_rx2", "L_rx3", "I_tx1", "R_rx1", "R_tx2", "I_rx2", "R_tx3", "I_rx3")
_POSITIONS: Final = tuple(f"gt_{node}_{axis}_m" for node in "IR" for axis in "xyz")
MILUV_COLUMNS: Final = ("t_s", "listener", "initiator", "responder", *_STAMP_COLUMNS, *_POSITIONS)
_STAMP_BITS: Final = 32
_MARGIN_M: Final = 1.0
"""By how much a TDoA may exceed the distance of its nodes; beyond, the messages are mostly of different exchanges."""

_MAX_RATE: Final = 100e-6


def read_miluv(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[PairTdoa]:
    """Yield what one listener overheard; by default that of the first row."""
    for row in rows_of(rows(stream, drops, MILUV_COLUMNS), drops, listener):
        tdoa = _overheard(row)
        if isinstance(tdoa, str):
            drops[tdoa] += 1
        else:
            yield tdoa


def _overheard(row: list[bytes]) -> PairTdoa | str:
    """TDoA of a row with the fields ``MILUV_COLUMNS``, or the reason why it has none."""
    time, _, initiator, responder, *rest = row
    try:
        stamps = [int(field) for field in rest[: len(_STAMP_COLUMNS)]]
        ix, iy, iz, rx, ry, rz = (float(field) for field in rest[len(_STAMP_COLUMNS) :])
        time_s, a, b = float(time), int(initiator), int(responder)
    except ValueError:
        return "malformed-number"
    distance_m = dist((ix, iy, iz), (rx, ry, rz))
    if not (isfinite(time_s) and isfinite(distance_m)):
        return "not-finite"
    tdoa_m = overheard_tdoa_m(stamps)
    if tdoa_m is None:
        return "stamps-of-no-exchange"
    if abs(tdoa_m) > distance_m + _MARGIN_M:
        return "beyond-anchors"
    return PairTdoa(time_s, a, b, tdoa_m, (ix, iy, iz), (rx, ry, rz))


def overheard_tdoa_m(stamps: list[int]) -> float | None:
    """TDoA of the responder against the initiator in metres; None for stamps that no clocks can produce.

    ``stamps`` are the nine of ``_STAMP_COLUMNS``, in that order.
    """
    *listeners, i_tx1, r_rx1, r_tx2, i_rx2, r_tx3, i_rx3 = stamps
    reply, span = wrap(r_tx2 - r_rx1, _STAMP_BITS), wrap(r_tx3 - r_tx2, _STAMP_BITS)
    heard, answered = (_beyond_reply(three, reply, span) for three in (listeners, [i_tx1, i_rx2, i_rx3]))
    return None if heard is None or answered is None else (heard - answered / 2) * TICK_M


def _beyond_reply(stamps: list[int], reply: int, span: int) -> float | None:
    """Ticks from the first to the second of a clock's three stamps, less the reply by that clock's rate.

    ``reply``, ``span``: before and after the second message, on the clock that replied. None for impossible rates.
    """
    first, second, third = stamps
    gain = difference(third - second, span, _STAMP_BITS) / span if span else _MAX_RATE
    return difference(second - first, reply, _STAMP_BITS) - gain * reply if abs(gain) < _MAX_RATE else None


# STARLOC's tables of two-way exchanges (Dümbgen et al., arXiv 2309.05518), as differences of one tag's ranges.
#
# In an exchange the tag sends (1), the anchor answers (2) and sends once more (3); both stamp all three. With the
# rate ν of the tag's clock against the anchor's from the last two,
#
#     range = ½·c·[(rx2 − tx1) − ν·(tx2 − rx1)],   ν = (rx3 − rx2) / (tx3 − tx2).
#
# What a range has too much, such as antenna delays of the tag, cancels in the difference of two.

_STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
_TRUTH: Final = ("tag_pos_x", "tag_pos_y", "tag_pos_z")
COLUMNS: Final = ("time_s", "from_id", "to_id", *_STAMPS)
_TICK_NS: Final = 1e9 * TICK_S

_MAX_APART_S: Final = 0.05
"""Of the two ranges of a difference: a tag that walks has gone some centimetres by then."""

_FARTHEST_M: Final = 1000.0

_MARKERS: Final = {4: 12, 5: 15, 6: 16, 7: 11, 9: 9, 10: 13, 11: 10, 12: 6}
"""Anchors by their rows in the table of markers, in the sessions s1 and s2."""


class _Range(NamedTuple):
    time_s: float
    anchor: int
    range_m: float


def read_starloc(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[PairTdoa]:
    """Yield differences of one tag's successive ranges; by default those of the tag of the first row."""
    before: _Range | None = None
    for row in rows_of(rows(stream, drops, COLUMNS), drops, listener):
        found = _range_of(row)
        if isinstance(found, str):
            drops[found] += 1
            continue
        if before is None or found.anchor == before.anchor or not 0.0 <= found.time_s - before.time_s < _MAX_APART_S:
            drops["range-without-another"] += 1
        else:
            yield PairTdoa(found.time_s, before.anchor, found.anchor, found.range_m - before.range_m)
        before = found


def _range_of(row: list[bytes]) -> _Range | str:
    """Range of a row whose fields are ``COLUMNS``, or the reason why it has none."""
    try:
        time_s, anchor = float(row[0]), int(row[2])
        stamps = [wrap(round(float(field) / _TICK_NS), _STAMP_BITS) for field in row[3:]]
    except (ValueError, OverflowError):
        return "malformed-number"
    if not isfinite(time_s):
        return "not-finite"
    tx1, rx1, tx2, rx2, tx3, rx3 = stamps
    span, reply = (wrap(later - earlier, _STAMP_BITS) for later, earlier in ((tx3, tx2), (tx2, rx1)))
    answered = _beyond_reply([tx1, rx2, rx3], reply, span)
    if answered is None or abs(answered / 2 * TICK_M) > _FARTHEST_M:
        return "stamps-of-no-exchange"
    return _Range(time_s, anchor, answered / 2 * TICK_M)


def starloc_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Where the anchors stand by the published table ``mocap/uwb_markers_v1.csv`` beside the recording's folder.

    Empty where that is missing, or the folder is of another session than s1 and s2.
    """
    folder = Path(path).absolute().parent
    table = folder.parent / "mocap" / "uwb_markers_v1.csv"
    if not re.search("_s[12]$", folder.name) or not table.is_file():
        return {}
    found: dict[int, Point] = {}
    for line in table.read_text(encoding="utf-8", errors="replace").splitlines():
        with suppress(ValueError):
            marker, x_m, y_m, z_m = line.split(",")
            found[int(marker)] = (float(x_m), float(y_m), float(z_m))
    return {anchor: found[marker] for anchor, marker in _MARKERS.items() if marker in found}


def starloc_truth(path: str | PathLike[str], listener: str | None) -> Truth | None:
    """Where one tag was by motion capture, by default that of the first row; None where the table has none."""
    table = numbers(path, ("time_s", *_TRUTH), ("from_id", listener))
    return Truth(table[:, 0], table[:, 1:], None) if len(table) else None


# Backhaul of an Avalue real-time location system: anchors that hear each other, raw 40-bit stamps.
#
# Each row of ``ccp.csv`` is one reception: ``slave`` heard message ``order`` of ``master``. Any anchor can play a tag
# that only listens: its packets are the transmissions that it received, and each relays what the sender had heard
# since its own transmission before. Identifiers are hexadecimal.

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


def read_avalue(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[Packet]:
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

    Raises ConfigurationError: the file cannot be opened.
    """
    flights = AnchorFlights(_RANGED)
    with open_source(path) as stream:
        for heard in cross_receptions(stream, drops):
            flights.update(heard.sender, heard.receiver, heard.tx_ticks, heard.rx_ticks)
    return {pair: flight * TICK_M for pair, flight in flights.ranged_ticks().items()}


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
