"""What anchors broadcast of their own clocks, for ``joint`` where it has missed too much to know better.

Every anchor follows the master and tells its TX time in the site's. That is worth as much as all that it has heard of
the master, of which a tag gets to know only what came with the packets that it heard itself (``docs/maths.md`` 6).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.positioning.joint_algebra import along_h, along_x, project, put
from skyless.positioning.joint_state import (
    BASE,
    CLOCK_CROSS,
    CLOCK_RATE,
    CLOCK_VALUE,
    DIM,
    EPOCH,
    EXCLUDED,
    GATE,
    PLACES,
    RANGE,
    RX_VARIANCE,
    SLOTS,
    SYNCS_REFUSED,
    SYNCS_USED,
    TERMS,
    TX_VARIANCE,
    WHOLE,
    JointArrays,
    Matrix,
    lanes,
    values,
    width,
)
from skyless.ticks import TICK_MASK

SUBTICKS: Final = 256
"""Of a tick; the air's unit of the site's time, of which it tells 48 bits."""

SYNC_MASTER, SYNC_SUBTICKS, SYNC_VARIANCE = range(3)
"""Places in a row of syncs: the master's place in the table of anchors; the sender's reading less the master's at the
packet's TX stamp, in subticks modulo 2⁴⁸, NaN where one is to ask; its variance in m², 0 for none."""

NO_SYNCS: Final[Matrix] = np.empty((0, 3))

WORTH: Final = 1.25
"""The filter takes what an anchor says where its own variance is so many times larger."""

LEAST_VARIANCE: Final = 0.1
"""Of a stamp pair's: no anchor knows its clock better, whatever it says."""


@borrowing_kernel
def hear_sync(s: JointArrays, slot: int, syncs: Matrix, row: int) -> bool:
    """Let what an anchor says of its clock against the master's replace what the filter says, where that is worse.

    The anchor has heard all of the master's packets that were relayed to the tag, and more. So its error is
    uncorrelated with the difference of both estimates, of variance P − q (P: the filter's, q: the anchor's), and the
    other states follow by P_xd/P times that difference: the difference of the clocks becomes what the anchor says.
    Returns whether that would count but is not known (NaN): nothing has happened then.
    """
    master = s.slot_of[int(syncs[row, SYNC_MASTER])]
    least = LEAST_VARIANCE * (s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE])
    variance = max(syncs[row, SYNC_VARIANCE], least)
    if master < 0 or master == slot or s.slots[slot, EXCLUDED]:
        return False
    _put_difference(s, master, slot)
    if _variance(s) <= WORTH * variance:
        return False
    if np.isnan(syncs[row, SYNC_SUBTICKS]):
        return True
    whole = (s.slots[master, WHOLE] - s.slots[slot, WHOLE]) & TICK_MASK
    off = (np.int64(syncs[row, SYNC_SUBTICKS]) - SUBTICKS * whole) & (SUBTICKS * (TICK_MASK + 1) - 1)
    if off >= SUBTICKS * (TICK_MASK + 1) // 2:
        off -= SUBTICKS * (TICK_MASK + 1)
    innovation = off * (TICK_M / SUBTICKS) - along_x(s)
    term = project(s)
    spread = along_h(s, term)
    if innovation * innovation <= s.settings[GATE] * s.settings[GATE] * (spread + variance):
        s.counts[SYNCS_USED] += 1
        _replace(s, term, innovation, spread, variance)
    else:
        s.counts[SYNCS_REFUSED] += 1
    return False


@borrowing_kernel
def _put_difference(s: JointArrays, master: int, slot: int) -> None:
    """The measurement b_m − b_i when the packet was sent."""
    dim, half = int(s.settings[DIM]), values(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S - s.anchors[slot, RANGE] / SPEED_OF_LIGHT_MPS
    s.counts[PLACES] = 0
    put(s, dim + master, 1.0)
    put(s, dim + slot, -1.0)
    put(s, half + dim + master, tau_s)
    put(s, half + dim + slot, -tau_s)


@borrowing_kernel
def _variance(s: JointArrays) -> float:
    """h·P·h of the difference, pending terms and noise included: cheaper than ``project`` where nothing follows."""
    count, noise = s.counts[PLACES], s.noise
    tau_s = s.h[count - 2]
    total = 2.0 * (noise[CLOCK_VALUE] + tau_s * (2.0 * noise[CLOCK_CROSS] + tau_s * noise[CLOCK_RATE]))
    for one in range(count):
        for other in range(count):
            total += s.h[one] * s.h[other] * s.P[s.h_places[one], s.h_places[other]]
    for term in range(s.counts[TERMS]):
        total -= along_h(s, term) ** 2
    return float(total)


@borrowing_kernel
def _replace(s: JointArrays, term: int, innovation: float, spread: float, variance: float) -> None:
    """Set the measured combination to what was said of it, with that variance; the others follow by regression.

    It tells nothing of faults of the tag's receptions, but takes what they have done to the combination away.
    """
    u, r, known = s.terms, s.responses, np.sqrt(spread - variance)
    for column in range(width(s)):
        s.x[column] += innovation / spread * u[term, column]
        u[term, column] *= known / spread
    for other in range(lanes(s)):
        r[term, other] /= known
    for one in range(s.counts[SLOTS]):  # ``add_terms`` will take it off, but there is no innovation behind it
        for other in range(s.counts[SLOTS]):
            s.shared[one, other] += r[term, one] * r[term, other]
    s.counts[TERMS] = term + 1
