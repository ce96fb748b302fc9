"""Observations out of beacons: stamps unwrapped, variances of receptions, times of fixes."""

from typing import Final

from msgspec import Struct

from skyless.core.air.beacon import Beacon
from skyless.core.constants import MAX_DRIFT, TICK_S
from skyless.core.kernels.arrays import Array
from skyless.core.observation import Observation
from skyless.core.ticks import from_seconds


def observation_of(
    beacon: Beacon,
    relays: bytes,
    anchor_m: Array,
    anchor_std_m: float,
    rx_ticks: int,
    tx_ticks: int,
    rx_variance_factor: float,
) -> Observation:
    """One observation of a beacon; ``relays``: ``packed_relays``."""
    return Observation(
        beacon.anchor, anchor_m, 0, beacon.sequence, rx_ticks, tx_ticks, None, None, None, 0.0, 0.0, (), None,
        rx_variance_factor, relays, anchor_std_m,
    )  # fmt: skip


# The time of fixes


FLIGHT_SLACK_TICKS: Final = from_seconds(1e-6)
"""Flight times differ between anchors by less than this (300 m)."""


class FixTime(Struct):
    """Counts from the first fix of a receiver and never goes back, also where master or method change."""

    first_ticks_master: int | None = None
    last_ticks_master: int = 0
    last_rx_ticks_tag: int = 0

    def time_s(self, ticks_master: int, rx_ticks_tag: int) -> float:
        """Time in seconds of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
        if self.first_ticks_master is None:
            self.first_ticks_master = ticks_master
        else:
            elapsed = rx_ticks_tag - self.last_rx_ticks_tag
            off = ticks_master - self.last_ticks_master - elapsed
            if elapsed <= 0 or (abs(off) > FLIGHT_SLACK_TICKS and abs(off) > MAX_DRIFT * elapsed + FLIGHT_SLACK_TICKS):
                self.first_ticks_master += off + elapsed - max(elapsed, 1)
        self.last_ticks_master, self.last_rx_ticks_tag = ticks_master, rx_ticks_tag
        return (ticks_master - self.first_ticks_master) * TICK_S
