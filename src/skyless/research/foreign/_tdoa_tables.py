"""Tables whose rows are time differences of two anchors: ready ones, and MILUV's stamps of exchanges."""

from collections.abc import Iterator
from io import BufferedIOBase
from math import dist, isfinite
from typing import Final

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.constants import TICK_M
from skyless.core.input_files import Drops, header_of, rows
from skyless.core.ticks import difference

# Tables of TDoAs: ``t_s,idA,idB,tdoa_m`` with tdoa_m = |p − b| − |p − a|, as the UTIL flights and Crazyflie logs.

TDOA_COLUMNS: Final = ("t_s", "idA", "idB", "tdoa_m")


def recognise_tdoas(head: bytes) -> bool:
    """Whether the first line names the four columns."""
    return set(TDOA_COLUMNS) <= set(header_of(head))


def read_tdoas(stream: BufferedIOBase, drops: Drops) -> Iterator[PairTdoa]:
    """Yield the TDoAs of a table, in its own time."""
    for time, a, b, tdoa in rows(stream, drops, TDOA_COLUMNS):
        try:
            time_s, anchor_a, anchor_b, tdoa_m = float(time), int(a), int(b), float(tdoa)
        except ValueError:
            blank = not (time.strip() and a.strip() and b.strip() and tdoa.strip())
            drops["blank-field" if blank else "malformed-number"] += 1
            continue
        if not (isfinite(time_s) and isfinite(tdoa_m)):
            drops["not-finite"] += 1
        elif anchor_a == anchor_b:
            drops["anchor-against-itself"] += 1
        else:
            yield PairTdoa(time_s, anchor_a, anchor_b, tdoa_m)


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


def recognise_miluv(head: bytes) -> bool:
    """Whether the first line names the nodes, the nine stamps and the positions."""
    return set(MILUV_COLUMNS) <= set(header_of(head))


def read_miluv(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[PairTdoa]:
    """Yield what one listener overheard; by default the one of the first row."""
    wanted = None if listener is None else listener.encode()
    for row in rows(stream, drops, MILUV_COLUMNS):
        wanted = wanted or row[1]
        if row[1] != wanted:
            drops["other-listener"] += 1
            continue
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
