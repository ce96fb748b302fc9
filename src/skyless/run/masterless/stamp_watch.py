"""Faults of anchors that their stamps show by themselves: a lost time base, and stamps that flip between two values.

An anchor that claims the common time but has lost it runs at the rate of its own crystal. A radio that takes now the
first path and now a reflection gives stamps on two parallel lines over time; those on the later one are left out.
"""

from collections import deque
from typing import Final

import numpy as np

from skyless.core.ticks import TICK_M, TICK_S, from_seconds

OWN_RATE: Final = 2e-7
"""Difference of rates that no motion explains: 60 m/s."""
OWN_IN_ROW: Final = 3
"""Consecutive packets with such a rate that show that a time base is lost, or without one that it is back."""

COMPARED_TICKS: Final = from_seconds(3.0)
"""Rates of packets that are older are not compared, as the tag's crystal warms."""

WINDOW: Final = 16
"""Newest packets of an anchor that are compared."""
FIRST: Final = 8
"""Packets of an anchor from which on they are compared."""
READY_S: Final = 1.0
"""Time since the first packet, or since an anchor began to be at fault, after which others have shown too."""
LONGEST_GAP_S: Final = 0.2
"""Packets farther apart are not compared, as the tag may turn between them."""
BEND_M: Final = 0.4
"""Least distance of the two values, and of a packet from the line through the two before it."""
WITHIN_M: Final = 0.2
"""Distance from a line within which a packet is on it."""
FEWEST: Final = 3
"""Packets of the rarer value, and changes from one to the other, that show a flip."""
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

    __slots__ = (
        "bends", "gap_m", "late_m", "late_share", "off_in_row", "own_rate", "packets", "rate", "rx_ticks", "time_s",
        "tx_ticks",
    )  # fmt: skip

    def __init__(self, rx_ticks: int, tx_ticks: int) -> None:
        self.rx_ticks, self.tx_ticks = rx_ticks, tx_ticks
        self.rate = 0.0
        """Of the anchor's clock against the tag's, as a fraction, over its two newest packets; 0 before the second."""
        self.own_rate = 0.0
        """Rate against the common time, once that is lost; otherwise 0."""
        self.off_in_row = 0
        self.time_s: deque[float] = deque([0.0], WINDOW)
        self.late_m: deque[float] = deque([0.0], WINDOW)
        """By how much each packet is later than at a constant clock error."""
        self.bends = 0
        """Bits of the packets in the window, the newest lowest: whether each is off the line through the two before."""
        self.gap_m = self.late_share = 0.0
        self.packets = 1


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
        one.rx_ticks, one.tx_ticks, one.rate = rx_ticks, tx_ticks, (sent - elapsed) / elapsed
        if claims_common_time and self._runs_on_its_own(one):
            return "time-base-lost"
        did_flip = one.gap_m > 0.0
        is_late = _is_late(one, elapsed * TICK_S, (elapsed - sent) * TICK_M)
        one.packets += 1
        one.late_share += max(FORGETTING, 1.0 / one.packets) * (is_late - one.late_share)
        if one.gap_m > 0.0 and not did_flip:
            self._note_change()
        return "late-of-two-values" if is_late else None

    def forget(self) -> None:
        """Forget all stamps, as the tag's counter has restarted."""
        self._stamps.clear()

    @property
    def is_ready(self) -> bool:
        """Whether enough has been received for faults to show."""
        return self._newest_s - self._first_s >= READY_S

    @property
    def own_clocks_ppm(self) -> dict[int, float]:
        """Anchors whose time base is lost, and how much faster their clocks run than the common time."""
        return {anchor: 1e6 * one.own_rate for anchor, one in self._heard_lately() if one.own_rate}

    @property
    def flips_m(self) -> dict[int, float]:
        """Anchors whose stamps flip between two values, and the distance of these."""
        return {anchor: one.gap_m for anchor, one in self._heard_lately() if one.late_share > OFTEN}

    def _heard_lately(self) -> list[tuple[int, _Stamps]]:
        after = from_seconds(self._newest_s - NAMED_S)
        return [(anchor, one) for anchor, one in self._stamps.items() if one.rx_ticks > after]

    def _note_change(self) -> None:
        self.changes += 1
        self._first_s = self._newest_s

    def _runs_on_its_own(self, one: _Stamps) -> bool:
        """Whether an anchor's clock has another rate than those of most others, of which there are two at least."""
        after = one.rx_ticks - COMPARED_TICKS
        rates = sorted([other.rate for other in self._stamps.values() if other.rate and other.rx_ticks > after])
        off = one.rate - rates[len(rates) // 2]
        is_off = len(rates) > 2 and abs(off) > OWN_RATE
        one.off_in_row = one.off_in_row + 1 if is_off != (one.own_rate != 0.0) else 0
        if one.off_in_row >= OWN_IN_ROW:
            if is_off:
                self._note_change()
            one.own_rate, one.off_in_row = off if is_off else 0.0, 0
        return one.own_rate != 0.0


def _is_late(one: _Stamps, elapsed_s: float, change_m: float) -> bool:
    """Whether an anchor's newest packet, later than the one before by ``change_m``, has the later one of two values."""
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
    fewest = 1 if one.gap_m > 0.0 else FEWEST
    if one.bends.bit_count() < fewest or len(times_s) < FIRST:
        return False
    above_m, gap_m = two_values(np.array(times_s), np.array(late_m), fewest)
    one.gap_m = gap_m or one.gap_m
    return above_m > 0.5 * gap_m > 0.0


def two_values(time_s: np.ndarray, late_m: np.ndarray, fewest: int) -> tuple[float, float]:
    """Distance of the newest value from the lower of two parallel lines over time, and that of the lines; 0, 0 if none.

    The slope is that of the pair of values whose line most values are on. ``fewest``: values on the upper line, and
    changes between the two; a rare lower one needs ``FEWEST``, as it may be a single early packet.
    """
    one, other = np.triu_indices(len(time_s), 1)
    slopes = (late_m[other] - late_m[one]) / (time_s[other] - time_s[one])
    off_m = late_m - late_m[one, None] - slopes[:, None] * (time_s - time_s[one, None])
    off_m = off_m[np.argmax((np.abs(off_m) < WITHIN_M).sum(axis=1))]
    is_first = np.abs(off_m) < WITHIN_M
    gap_m = float(np.median(off_m[~is_first])) if not is_first.all() else 0.0
    is_second = np.abs(off_m - gap_m) < WITHIN_M
    known = (is_second & ~is_first)[is_first | is_second]
    fewest = fewest if gap_m > 0.0 else FEWEST
    is_flip = abs(gap_m) > BEND_M and min(known.sum(), (~known).sum(), (known[1:] != known[:-1]).sum()) >= fewest
    if not is_flip or len(known) < (1.0 - MOST_OTHERS) * len(off_m):
        return 0.0, 0.0
    return float(off_m[-1]) - min(gap_m, 0.0), abs(gap_m)
