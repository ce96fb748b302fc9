"""Which anchors of a large site a tag uses: the strongest of those that other anchors receive too."""

import math
from collections.abc import Callable, Collection
from typing import Final, TypeVar

from msgspec import Struct

from skyless.core.air.frame import HEARD
from skyless.core.ticks import FLIGHT_SLACK_TICKS, from_seconds, may_elapse, nearest

MAX_ANCHORS_IN_USE: Final = 24
"""In the estimator's state; more cost accuracy, as each then sends less, and time."""

BETTER_DB: Final = 3.0
"""By which another anchor must be stronger to replace the weakest."""

RELAYED_TICKS: Final = from_seconds(2.0)
"""A reception by an anchor in use, or by one that is confirmed itself, confirms its sender for this time."""

MIN_FITTING: Final = 2
"""An anchor that relays this number of receptions of anchors in use, and they fit, is there."""

MAX_KEPT: Final = 256
"""Identifiers kept: more than there are in reach. Forged ones cannot use more memory."""

POWER_GAIN: Final = 0.1
"""Weight of the newest value in the running mean of an anchor's received power."""

NOMINAL_POWER_DBM: Final = -63.0
"""Assumed power at 1 m where the radio reports none, so that nearer anchors count as stronger."""


Value = TypeVar("Value")


class AnchorSelection(Struct):
    """Which anchors have been received by others, and with which power by the tag."""

    relayed_ticks: dict[int, int] = {}
    """The tag's reading when another anchor last relayed that it had received this one."""
    own_relays_ticks: dict[int, int] = {}
    """The tag's reading when the anchor's own relays last fitted, for anchors that no other has relayed since."""
    power_dbm: dict[int, float] = {}

    def forget_times(self) -> None:
        """The tag's counter has restarted."""
        self.relayed_ticks = {}
        self.own_relays_ticks = {}

    def add_power(self, anchor: int, power_dbm: float) -> None:
        """Process the power of a beacon."""
        if math.isfinite(power_dbm):
            mean = self.power_dbm.pop(anchor, power_dbm)
            _keep(self.power_dbm, anchor, mean + POWER_GAIN * (power_dbm - mean))

    def add_relays(self, relays: bytes, rx_ticks: int) -> None:
        """Process what an anchor relays (``packed_relays_2``), so that it confirms others."""
        for anchor, _, _, _ in HEARD.iter_unpack(relays):
            self.own_relays_ticks.pop(anchor, None)
            self.relayed_ticks.pop(anchor, None)
            _keep(self.relayed_ticks, anchor, rx_ticks)

    def confirm_by_own_relays(self, anchor: int, rx_ticks: int) -> None:
        """An anchor is there, as what it relays fits (``fitting_relays``), but no other has received it."""
        self.own_relays_ticks.pop(anchor, None)
        _keep(self.own_relays_ticks, anchor, rx_ticks)

    def is_confirmed_by_others(self, anchor: int, rx_ticks: int, *, in_use: bool) -> bool:
        """Whether others have recently received an anchor, or had when it came into use.

        Only then its pages take part in the majority, and its relays confirm others.
        """
        return _is_recent(self.relayed_ticks, anchor, rx_ticks) or (in_use and anchor not in self.own_relays_ticks)

    def is_confirmed(self, anchor: int, rx_ticks: int) -> bool:
        """Whether another anchor has recently received this one, or its own relays have fitted."""
        return _is_recent(self.relayed_ticks, anchor, rx_ticks) or _is_recent(self.own_relays_ticks, anchor, rx_ticks)

    def replaced_by(self, anchor: int, ranges_m: dict[int, float]) -> int | None:
        """The anchor in use that ``anchor`` should replace, None if ``anchor`` is too weak.

        ``ranges_m``: ranges of ``anchor`` and of all anchors in use.
        """
        powers = {one: self.power_dbm.get(one, _nominal_dbm(range_m)) for one, range_m in ranges_m.items()}
        own_dbm = powers.pop(anchor)
        weakest = min(powers, key=lambda one: powers[one])
        return weakest if own_dbm > powers[weakest] + BETTER_DB else None


def fitting_relays(
    relays: bytes, tx_ticks_anchor: int, rx_ticks_tag: int, packets: Callable[[int], tuple[int, int] | None]
) -> int:
    """How many receptions that an anchor relays fit what the tag has received itself: so it really receives them.

    The stamps are those of the anchor's beacon; ``packets`` gives sequence number and the tag's stamp of the last
    beacon of another anchor, None for one that does not count. A reception fits if, on the anchor's counter, it lies as
    long before its own frame as on the tag's, to 1 µs (300 m) and the drift of crystals.
    """
    fitting = 0
    for anchor, sequence, low, high in HEARD.iter_unpack(relays):
        packet = packets(anchor)
        if packet is not None and packet[0] == sequence:
            elapsed = rx_ticks_tag - packet[1]
            received_ticks = nearest(low | high << 32, tx_ticks_anchor - elapsed)
            fitting += may_elapse(tx_ticks_anchor - received_ticks, elapsed, FLIGHT_SLACK_TICKS)
    return fitting


def is_full(anchors: Collection[int]) -> bool:
    """Whether another anchor can only be used instead of one of these."""
    return len(anchors) >= MAX_ANCHORS_IN_USE


def _is_recent(times: dict[int, int], anchor: int, rx_ticks: int) -> bool:
    ticks = times.get(anchor)
    return ticks is not None and rx_ticks - ticks < RELAYED_TICKS


def _nominal_dbm(range_m: float) -> float:
    return NOMINAL_POWER_DBM - 20.0 * math.log10(max(range_m, 0.1))


def _keep(kept: dict[int, Value], anchor: int, value: Value) -> None:
    """Set the value of an anchor as the newest one; that kept longest is forgotten."""
    kept[anchor] = value
    if len(kept) > MAX_KEPT:
        del kept[next(iter(kept))]
