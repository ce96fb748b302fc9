"""Faults of anchors that their stamps show by themselves: a lost time base, and stamps that flip between two values.

An anchor that claims the common time but has lost it runs at the rate of its own crystal. A radio that takes now the
first path and now a reflection gives stamps on two parallel lines over time; those on the later one are left out.
"""

from collections import deque
from typing import Final

import numpy as np

from skyless.core.ticks import TICK_M, TICK_S, from_seconds

RATE_TICKS: Final = from_seconds(0.5)
"""Least time over which the rate of an anchor's clock is measured; at most about twice that, or two packets."""
OWN_RATE: Final = 7e-8
"""Difference of rates over that time that neither motion nor stamps that flip explain: 20 m/s."""
OWN_IN_ROW: Final = 3
"""Consecutive packets with such a rate that show that a time base is lost, or without one that it is back."""

COMPARED_TICKS: Final = from_seconds(3.0)
"""Rates of packets that are older are not compared, as the tag's crystal warms."""

WINDOW: Final = 16
"""Newest packets of an anchor that are compared."""
FIRST: Final = 8
"""Packets of an anchor from which on they are compared."""
READY_S: Final = 1.0
"""Time since the first packet, or since a fault, within which faults of other anchors show as well."""
LONGEST_GAP_S: Final = 0.2
"""Packets farther apart are not compared, as the tag may turn between them."""
BEND_M: Final = 0.4
"""Least distance of the two values, and of a packet from the line through the two before it."""
WITHIN_M: Final = 0.2
"""Distance from a line within which a packet is on it."""
FEWEST: Final = 3
"""Packets of the rarer value that show a flip …"""
CHANGES: Final = 5
"""… and changes from one value to the other: obstacles come and go more slowly."""
MOST_OTHERS: Final = 0.2
"""Largest share of packets with neither value."""
FORGETTING: Final = 0.02
"""Weight of the newest packet in an anchor's share of late ones."""
OFTEN: Final = 0.2
"""Share of late packets from which on an anchor's stamps are said to flip. Fewer are single late packets."""

NAMED_S: Final = 5.0
"""Anchors are not named after this silence."""

_ALL: Final = (1 << WINDOW) - 1


class _Stamps:
    """An anchor's newest stamps."""

    def __init__(self, rx_ticks: int, tx_ticks: int) -> None:
        self.rx_ticks, self.tx_ticks = rx_ticks, tx_ticks
        self.before = self.between = rx_ticks, tx_ticks
        """Stamps from which on the rate is measured, and those that will follow them."""
        self.rate = 0.0
        """Of the anchor's clock against the tag's, as a fraction; 0 before it is known."""
        self.own_rate = 0.0
        """Rate against the common time, once that is lost; otherwise 0."""
        self.off_in_row = 0
        self.time_s: deque[float] = deque([0.0], WINDOW)
        self.late_m: deque[float] = deque([0.0], WINDOW)
        """By how much each packet is later than at a constant clock error."""
        self.bends = 0
        """Bits of the packets in the window, the newest lowest: whether each is off the line through the two before."""
        self.gap_m = self.late_share = 0.0
        self.flipped_s = 0.0
        """When a window last had two values."""
        self.has_flipped = False
        self.packets = 1

    def measure_rate(self) -> None:
        """Update the rate to the newest stamps."""
        if self.rx_ticks - self.between[0] >= RATE_TICKS:
            self.before, self.between = self.between, (self.rx_ticks, self.tx_ticks)
        elapsed = self.rx_ticks - self.before[0]
        if elapsed >= RATE_TICKS:
            self.rate = (self.tx_ticks - self.before[1] - elapsed) / elapsed


class StampWatch:
    """Watches the stamps of all anchors of one tag."""

    def __init__(self) -> None:
        self._stamps: dict[int, _Stamps] = {}
        self._first_s = self._newest_s = 0.0
        self.changes = 0
        """Number of times that an anchor began to be at fault: what the filter took before may be wrong."""

    def check(self, anchor: int, rx_ticks: int, tx_ticks: int, *, claims_common_time: bool) -> str | None:
        """Look at an anchor's unwrapped stamps. Returns why its packet must not be used, None if it may be."""
        one, self._newest_s = self._stamps.get(anchor), rx_ticks * TICK_S
        if not self._stamps:
            self._first_s = self._newest_s
        if one is None or rx_ticks <= one.rx_ticks or tx_ticks <= one.tx_ticks:
            self._stamps[anchor] = _Stamps(rx_ticks, tx_ticks)
            return None
        elapsed, sent = rx_ticks - one.rx_ticks, tx_ticks - one.tx_ticks
        one.rx_ticks, one.tx_ticks = rx_ticks, tx_ticks
        one.measure_rate()
        if claims_common_time and self._runs_on_its_own(one):
            return "time-base-lost"
        is_late = self._is_late(one, elapsed * TICK_S, (elapsed - sent) * TICK_M)
        one.packets += 1
        one.late_share += max(FORGETTING, 1.0 / one.packets) * (is_late - one.late_share)
        return "late-of-two-values" if is_late else None

    def forget(self) -> None:
        """Forget all stamps, as the tag's counter has restarted."""
        self._stamps.clear()

    @property
    def is_ready(self) -> bool:
        """Whether enough has been received for faults to show."""
        has_many = any(one.packets > WINDOW for one in self._stamps.values())
        return has_many and self._newest_s - self._first_s >= READY_S

    @property
    def own_clocks_ppm(self) -> dict[int, float]:
        """Anchors whose time base is lost, and how much faster their clocks run than the common time."""
        return {anchor: 1e6 * one.own_rate for anchor, one in self._heard_recently() if one.own_rate}

    @property
    def flips_m(self) -> dict[int, float]:
        """Anchors whose stamps flip between two values, and the distance of these."""
        return {anchor: one.gap_m for anchor, one in self._heard_recently() if one.late_share > OFTEN}

    def _heard_recently(self) -> list[tuple[int, _Stamps]]:
        after = from_seconds(self._newest_s - NAMED_S)
        return [(anchor, one) for anchor, one in self._stamps.items() if one.rx_ticks > after]

    def _note_change(self) -> None:
        self.changes += 1
        self._first_s = self._newest_s

    def _runs_on_its_own(self, one: _Stamps) -> bool:
        """Whether an anchor's clock has another rate than those of most anchors, which agree."""
        after = one.rx_ticks - COMPARED_TICKS
        rates = [other.rate for other in self._stamps.values() if other.rate and other.rx_ticks > after]
        agreeing = [sum([abs(rate - other) <= OWN_RATE for other in rates]) for rate in rates]
        most = max(agreeing, default=0)
        common = [rate for rate, agree in zip(rates, agreeing, strict=True) if agree == most]
        off = one.rate - (common[0] if common else 0.0)
        is_known = most > 1 and len(rates) > 2 and max(common) - min(common) <= OWN_RATE
        is_off = is_known and abs(off) > OWN_RATE
        one.off_in_row = one.off_in_row + 1 if is_off != (one.own_rate != 0.0) else 0
        if one.off_in_row >= OWN_IN_ROW:
            if is_off:
                self._note_change()
            one.own_rate, one.off_in_row = off if is_off else 0.0, 0
        return one.own_rate != 0.0

    def _is_late(self, one: _Stamps, elapsed_s: float, change_m: float) -> bool:
        """Whether an anchor's newest packet, ``change_m`` later than the one before, has the later of two values."""
        times_s, late_m = one.time_s, one.late_m
        if elapsed_s > LONGEST_GAP_S:
            times_s.clear()
            late_m.clear()
            one.bends = 0
        times_s.append(times_s[-1] + elapsed_s if times_s else 0.0)
        late_m.append(late_m[-1] + change_m if late_m else 0.0)
        if len(times_s) > 2:
            before_mps = (late_m[-2] - late_m[-3]) / (times_s[-2] - times_s[-3])
            one.bends = (one.bends << 1 | (abs(late_m[-1] - late_m[-2] - before_mps * elapsed_s) > BEND_M)) & _ALL
        if one.gap_m and self._newest_s - one.flipped_s > NAMED_S:
            one.gap_m = 0.0
        if one.bends.bit_count() < (1 if one.gap_m else FEWEST) or len(times_s) < FIRST:
            return False
        above_m, gap_m, evidence = two_values(np.array(times_s), np.array(late_m))
        if evidence >= 1.0:
            if not one.has_flipped:
                self._note_change()
            one.gap_m, one.flipped_s, one.has_flipped = gap_m, self._newest_s, True
        elif abs(gap_m - one.gap_m) > 2.0 * WITHIN_M:
            return one.gap_m > 0.0  # which of the two it is remains open
        return above_m > 0.5 * gap_m > 0.0


def two_values(time_s: np.ndarray, late_m: np.ndarray) -> tuple[float, float, float]:
    """Distance of the newest value from the lower of two parallel lines over time, that of the lines, and the evidence.

    The slope is that of the pair of values whose line most values are on. The evidence is 1 where ``FEWEST`` values are
    on either line, with ``CHANGES`` between them, and less in proportion. Zeros if there are no two lines, or if the
    lower one has less evidence, as of single early packets.
    """
    one, other = np.triu_indices(len(time_s), 1)
    slopes = (late_m[other] - late_m[one]) / (time_s[other] - time_s[one])
    off_m = late_m - late_m[one, None] - slopes[:, None] * (time_s - time_s[one, None])
    off_m = off_m[np.argmax((np.abs(off_m) < WITHIN_M).sum(axis=1))]
    is_first = np.abs(off_m) < WITHIN_M
    gap_m = float(np.median(off_m[~is_first])) if not is_first.all() else 0.0
    is_second = np.abs(off_m - gap_m) < WITHIN_M
    known = (is_second & ~is_first)[is_first | is_second]
    rarer = min(known.sum(), (~known).sum()) / FEWEST
    evidence = float(min(rarer, (known[1:] != known[:-1]).sum() / CHANGES))
    is_flip = abs(gap_m) > BEND_M and (gap_m > 0.0 or evidence >= 1.0)
    if not is_flip or len(known) < (1.0 - MOST_OTHERS) * len(off_m):
        return 0.0, 0.0, 0.0
    return float(off_m[-1]) - min(gap_m, 0.0), abs(gap_m), evidence
