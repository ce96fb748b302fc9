"""Inner steps of ``joint``: time passes, an anchor joins, a reception of the tag, a reception that an anchor relays.

The covariance stays positive as every state gains noise all the time (``docs/maths.md`` section 6).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.eights import EIGHT, repeated, store
from skyless.positioning.joint_algebra import along_h, along_x, project, put, settle, take
from skyless.positioning.joint_monitor import LATE_ENOUGH, believe, follow, follow_clocks
from skyless.positioning.joint_state import (
    BASE,
    CAUTION,
    CLOCK_AGILITY,
    DIM,
    EPOCH,
    GATE,
    HEIGHT,
    INNOVATION,
    JOIN_DOUBT,
    LAG,
    LATE_SHARE,
    NOISE,
    PLACES,
    RANGE,
    RATE_VARIANCE,
    REJECTIONS,
    RELAYS_IN_ROW,
    RELAYS_REFUSED,
    RELAYS_REJECTED,
    RELAYS_USED,
    RX_VARIANCE,
    TX,
    TX_VARIANCE,
    WALK,
    WEIGHT,
    WHITE,
    WHOLE,
    JointArrays,
    lanes,
    states,
    values,
    width,
)
from skyless.positioning.protection_updates import gather_refused, join_faults

CALMING: Final = 0.98
LEAST_CAUTION_M2: Final = 1e-5
"""After a start that failed receptions are taken to be so late at first; it fades with each of them, to nothing."""

BENT: Final = 0.01
"""Where ranges are so curved that it counts for more than this part of the stamps' variance, it is counted."""

JOIN_VARIANCE_M2: Final = 1.0
"""Where messages are late an anchor's first packets may be so too: they decide nothing, ..."""

TRUST: Final = 0.5
"""... and of each further one this share of the additional variance is left."""


@borrowing_kernel
def new_packet(s: JointArrays, slot: int) -> None:
    """Forget the noise of an anchor's last TX stamp for that of a new one."""
    if s.slots[slot, NOISE] >= 0:
        place = 2 * values(s) + s.slots[slot, NOISE]
        s.x[place] = 0.0
        nothing = repeated(0.0)
        for column in range(0, width(s), EIGHT):
            store(s.P, (place, column), nothing)
        for row in range(states(s)):
            s.P[row, place] = 0.0
        s.P[place, place] = s.settings[TX_VARIANCE]
        for slots in range(0, lanes(s), EIGHT):
            store(s.sensitivities, (place, slots), nothing)


@borrowing_kernel
def hear_anchor(s: JointArrays, slot: int, rx_ticks: int, tx_ticks: int) -> bool:
    """Take the tag's reception of a packet; False if it lies beyond the gate.

    R − T = |p − a| + b + noise of the TX stamp + noise of the reception. A doubtful one is judged as any other, as it
    is rather late than noisy, but weighs less if it is taken.
    """
    dim, half = int(s.settings[DIM]), values(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    offset, noise = dim + slot, s.slots[slot, NOISE]
    s.counts[PLACES] = 0
    put(s, offset, 1.0)
    put(s, half + offset, tau_s)
    variance = s.settings[RX_VARIANCE]
    if noise >= 0:
        put(s, 2 * half + noise, 1.0)
    else:
        variance += s.settings[TX_VARIANCE]
    expected = along_x(s)
    range_m = put_direction(s, slot, tau_s, 1.0)
    bend_m = _bend(s, range_m, variance)
    term = project(s)
    doubt = (s.anchors[slot, WEIGHT] - 1.0) * variance
    if s.anchors[slot, JOIN_DOUBT] > LEAST_CAUTION_M2:
        s.anchors[slot, JOIN_DOUBT] *= TRUST
        variance += s.anchors[slot, JOIN_DOUBT]
    variance += 2.0 * bend_m * bend_m
    if s.statistics[CAUTION] > 0.0:
        variance += s.statistics[CAUTION]
        s.statistics[CAUTION] *= CALMING
        if s.statistics[CAUTION] < LEAST_CAUTION_M2:
            s.statistics[CAUTION] = 0.0
    spread = along_h(s, term) + variance
    innovation = (rx_ticks - tx_ticks - s.slots[slot, WHOLE]) * TICK_M - (range_m + bend_m + expected)
    s.anchors[slot, RANGE] = range_m
    s.anchors[slot, INNOVATION] = innovation
    factor = believe(s, slot, innovation, spread)
    if factor > 0.0:
        follow(s, innovation / np.sqrt(spread + doubt) / factor)
        take(s, term, innovation, spread * factor + doubt, slot)
        steps = int(np.floor(s.x[offset] / TICK_M))
        s.slots[slot, WHOLE] += steps
        s.x[offset] -= steps * TICK_M
    else:
        s.evidence[REJECTIONS, slot] += 1.0
        gather_refused(s, term, slot, innovation, spread)
    return bool(factor > 0.0)


@borrowing_kernel
def put_direction(s: JointArrays, slot: int, tau_s: float, sign: float) -> float:
    """Add the gradient of the range from the anchor to the tag to the measurement; returns the range."""
    x, dim, half = s.x, int(s.settings[DIM]), values(s)
    dx = x[0] + tau_s * x[half] - s.anchors[slot, 0]
    dy = x[1] + tau_s * x[half + 1] - s.anchors[slot, 1]
    z = x[2] + tau_s * x[half + 2] if dim == 3 else s.settings[HEIGHT]
    dz = z - s.anchors[slot, 2]
    range_m: float = np.sqrt(dx * dx + dy * dy + dz * dz)
    scale = sign / max(range_m, 1e-6)
    s.statistics[LAG + 3] = dx * scale
    s.statistics[LAG + 4] = dy * scale
    s.statistics[LAG + 5] = dz * scale
    put(s, 0, dx * scale)
    put(s, 1, dy * scale)
    put(s, half, tau_s * dx * scale)
    put(s, half + 1, tau_s * dy * scale)
    if dim == 3:
        put(s, 2, dz * scale)
        put(s, half + 2, tau_s * dz * scale)
    return range_m


@borrowing_kernel
def _bend(s: JointArrays, range_m: float, variance: float) -> float:
    """Half the position's variance across the direction, over the range: what the range is longer by on average.

    The second term of its Taylor series, with the variance 2·bend² (Jazwinski 1970, section 9.3); 0 where that is
    small beside that of the stamps. Without it, updates of wide states become sure of a wrong place.
    """
    P, dim = s.P, int(s.settings[DIM])
    across = 0.0
    for axis in range(dim):
        across += P[axis, axis]
    least = BENT * variance * range_m * range_m
    if 0.5 * across * across < least:
        return 0.0
    for one in range(dim):
        for other in range(dim):
            across -= s.statistics[LAG + 3 + one] * P[one, other] * s.statistics[LAG + 3 + other]
    return float(0.5 * across / max(range_m, 1e-6)) if 0.5 * across * across >= least else 0.0


@borrowing_kernel
def join(s: JointArrays, slot: int, rx_ticks: int, tx_ticks: int) -> None:
    """Begin with an anchor's clock: what its first packet says, whatever is wrong with the position being in it.

    This is the limit of an update of an offset of which nothing was known.
    """
    settle(s)
    P, dim, half = s.P, int(s.settings[DIM]), values(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    place, rate = dim + slot, half + dim + slot
    P[rate, rate] = s.settings[RATE_VARIANCE]
    s.counts[PLACES] = 0
    range_m = put_direction(s, slot, tau_s, -1.0)
    put(s, rate, -tau_s)
    term = project(s)
    variance = s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE]
    bend_m = _bend(s, range_m, variance)
    variance += along_h(s, term) + 2.0 * bend_m * bend_m
    if s.statistics[CAUTION] > 0.0 or s.statistics[LATE_SHARE] > LATE_ENOUGH:
        s.anchors[slot, JOIN_DOUBT] = JOIN_VARIANCE_M2
        variance += JOIN_VARIANCE_M2
    for row in range(states(s)):
        P[row, place] = s.terms[term, row]
        P[place, row] = s.terms[term, row]
    P[place, place] = variance
    whole = rx_ticks - tx_ticks - int(np.floor(range_m / TICK_M))
    s.x[place] = (rx_ticks - tx_ticks - whole) * TICK_M - (range_m + bend_m)
    join_faults(s, slot, place)
    s.slots[slot, WHOLE] = whole
    s.anchors[slot, RANGE] = range_m


@borrowing_kernel
def _between(s: JointArrays, one: int, other: int) -> float:
    squared = 0.0
    for axis in range(3):
        squared += (s.anchors[one, axis] - s.anchors[other, axis]) ** 2
    return float(np.sqrt(squared))


@borrowing_kernel
def hear_relay(s: JointArrays, listener: int, slot: int, packet_tx: int, packet_rx: int, relayed_rx: int) -> bool:
    """Take the reception, by the anchor ``listener``, of a packet of the anchor ``slot``; False beyond the gate.

    S − T = |a_i − a_j| + b_j − b_i + noise of the TX stamp + noise of the reception, when the packet reached anchor i.
    Both values go back to that moment by their rates. What their oscillators have done since counts as noise of the
    stamp; the tag's oscillator cancels.
    """
    dim, half = int(s.settings[DIM]), values(s)
    distance_m = _between(s, listener, slot)
    age_s = (s.counts[EPOCH] - packet_rx) * TICK_S + (s.anchors[slot, RANGE] - distance_m) / SPEED_OF_LIGHT_MPS
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S - age_s
    one, other, noise = dim + slot, dim + listener, s.slots[slot, NOISE]
    s.counts[PLACES] = 0
    put(s, one, 1.0)
    put(s, other, -1.0)
    put(s, half + one, tau_s)
    put(s, half + other, -tau_s)
    variance = s.settings[RX_VARIANCE]
    if noise >= 0 and s.slots[slot, TX] == packet_tx:
        put(s, 2 * half + noise, 1.0)
    else:
        variance += s.settings[TX_VARIANCE]
    walk = s.settings[WALK] * s.statistics[CLOCK_AGILITY]
    variance += 2.0 * age_s * (s.settings[WHITE] + walk * age_s * age_s / 3.0)
    term = project(s)
    spread = along_h(s, term) + variance
    whole = s.slots[slot, WHOLE] - s.slots[listener, WHOLE]
    innovation = (relayed_rx - packet_tx - whole) * TICK_M - distance_m - along_x(s)
    follow_clocks(s, 1.0 if innovation * innovation > spread else 0.0)
    accepted = innovation * innovation <= s.settings[GATE] * s.settings[GATE] * spread
    if accepted:
        s.counts[RELAYS_USED] += 1
        s.slots[slot, RELAYS_IN_ROW] = s.slots[listener, RELAYS_IN_ROW] = 0
        take(s, term, innovation, spread, -1)
    else:
        s.counts[RELAYS_REJECTED] += 1
        s.recent[RELAYS_REFUSED] += 1.0
        s.slots[slot, RELAYS_IN_ROW] += 1
        s.slots[listener, RELAYS_IN_ROW] += 1
    return bool(accepted)
