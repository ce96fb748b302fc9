"""Tables of TDoAs: ``t_s,idA,idB,tdoa_m`` with tdoa_m = |p − b| − |p − a|, as the UTIL flights and Crazyflie logs."""

from collections.abc import Iterator
from io import BufferedIOBase
from math import isfinite
from typing import Final

from skyless.air.masterless_packets import PairTdoa
from skyless.recordings.source import Drops
from skyless.recordings.tables import header_of, rows

COLUMNS: Final = ("t_s", "idA", "idB", "tdoa_m")


def recognise(head: bytes, name: str) -> bool:
    """Tell whether the first line names the four columns."""
    del name
    return set(COLUMNS) <= set(header_of(head))


def read(stream: BufferedIOBase, drops: Drops) -> Iterator[PairTdoa]:
    """Yield the TDoAs of a table, in its own time."""
    for time, a, b, tdoa in rows(stream, drops, COLUMNS):
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
