"""Tables whose rows are time differences of two anchors: ready ones, and MILUV's stamps of exchanges."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from io import BufferedIOBase
from math import dist, isfinite
from os import PathLike
from typing import Final

import numpy as np

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.arrays import Array
from skyless.core.input_files import Drops, has_columns, open_source, rows
from skyless.core.ticks import TICK_M, difference
from skyless.research.foreign.crazyflie import heights_of, in_order
from skyless.site.tables import Truth

# Tables of TDoAs with tdoa_m = |p − b| − |p − a|: by the names of ``PairTdoa``, or those of the UTIL flights and logs.

TDOA_COLUMNS: Final = ("t_s", "anchor_a", "anchor_b", "tdoa_m")
FLIGHT_COLUMNS: Final = ("t_s", "idA", "idB", "tdoa_m")
_OUR_NAMES: Final = {"idA": "anchor_a", "idB": "anchor_b"}

UTIL_COLUMNS: Final = ("t_tdoa", "idA", "idB", "tdoa_meas")
"""The same in UTIL's own tables, which have the columns of other sensors, of other lengths, beside them."""

_POSE_COLUMNS: Final = ("t_pose", "pose_x", "pose_y", "pose_z", "pose_qx", "pose_qy", "pose_qz", "pose_qw")


def read_tdoas(stream: BufferedIOBase, drops: Drops, columns: Sequence[str] = TDOA_COLUMNS) -> Iterator[PairTdoa]:
    """Yield the TDoAs of a table, in its own time.

    Rows of UTIL's tables without any of them are those of other sensors, and not counted.
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
    """Whether it is a table of TDoAs, by either names of its columns."""
    return has_columns(TDOA_COLUMNS, head) or has_columns(FLIGHT_COLUMNS, head)


def _identifier(text: bytes) -> int:
    """A whole number, which UTIL's tables write as ``7.0``. Raises ValueError."""
    return int(text.removesuffix(b".0"))


def read_util(stream: BufferedIOBase, drops: Drops) -> Iterator[PairTdoa]:
    """Yield the TDoAs of one of UTIL's tables."""
    yield from read_tdoas(stream, drops, UTIL_COLUMNS)


def read_util_truth(path: str | PathLike[str], _listener: str | None) -> Truth | None:
    """Poses of motion capture in one of UTIL's tables; None where it has none."""
    table = numbers(path, _POSE_COLUMNS)
    return Truth(table[:, 0], table[:, 1:4], table[:, 4:8]) if len(table) else None


def read_util_heights(path: str | PathLike[str], *, is_barometer: bool) -> Array | None:
    """Rows of time, height and standard deviation of its ranger or barometer; None where it has none."""
    columns = ("t_baro", "baro") if is_barometer else ("t_tof", "tof")
    return heights_of(numbers(path, columns), is_barometer=is_barometer)


def numbers(path: str | PathLike[str], columns: tuple[str, ...], tag: tuple[str, str | None] | None = None) -> Array:
    """Rows of numbers of some columns where all of them are given, in the order of the first.

    ``tag``: the column that names whose rows they are, and whose are wanted, by default those of the first row's.
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
    """Rows that one listener made, whom their second field names; by default the one of the first row."""
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

_STAMPS: Final = ("L_rx1", "L_rx2", "L_rx3", "I_tx1", "R_rx1", "R_tx2", "I_rx2", "R_tx3", "I_rx3")
_POSITIONS: Final = tuple(f"gt_{node}_{axis}_m" for node in "IR" for axis in "xyz")
MILUV_COLUMNS: Final = ("t_s", "listener", "initiator", "responder", *_STAMPS, *_POSITIONS)
_STAMP_BITS: Final = 32
_MARGIN_M: Final = 1.0
"""By how much a TDoA may exceed the distance of its nodes; beyond, the messages mostly are of different exchanges."""

_MAX_RATE: Final = 100e-6


def read_miluv(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[PairTdoa]:
    """Yield what one listener overheard; by default the one of the first row."""
    for row in rows_of(rows(stream, drops, MILUV_COLUMNS), drops, listener):
        tdoa = _overheard(row)
        if isinstance(tdoa, str):
            drops[tdoa] += 1
        else:
            yield tdoa


def _overheard(row: list[bytes]) -> PairTdoa | str:
    """TDoA of a row whose fields are ``MILUV_COLUMNS``, or the reason why it has none."""
    time, _, initiator, responder, *rest = row
    try:
        stamps = [int(field) for field in rest[: len(_STAMPS)]]
        ix, iy, iz, rx, ry, rz = (float(field) for field in rest[len(_STAMPS) :])
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
    """TDoA of the responder against the initiator in metres; None for stamps that no clocks can make.

    ``stamps`` are the nine of ``_STAMPS``, in that order.
    """
    l_rx1, l_rx2, l_rx3, i_tx1, r_rx1, r_tx2, i_rx2, r_tx3, i_rx3 = stamps
    reply = _elapsed(r_tx2, r_rx1)
    span = _elapsed(r_tx3, r_tx2)
    if span == 0:
        return None
    gain_l = difference(_elapsed(l_rx3, l_rx2), span, _STAMP_BITS) / span
    gain_i = difference(_elapsed(i_rx3, i_rx2), span, _STAMP_BITS) / span
    if abs(gain_l) > _MAX_RATE or abs(gain_i) > _MAX_RATE:
        return None
    flight = (difference(_elapsed(i_rx2, i_tx1), reply, _STAMP_BITS) - gain_i * reply) / 2
    return (difference(_elapsed(l_rx2, l_rx1), reply, _STAMP_BITS) - gain_l * reply - flight) * TICK_M


def _elapsed(later: int, earlier: int) -> int:
    """Ticks from one stamp to the next of the same clock, less than one wrap of 67.2 ms."""
    return (later - earlier) & ((1 << _STAMP_BITS) - 1)
