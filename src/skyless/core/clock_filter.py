"""The two-state clock filter: an anchor's offset and rate against the master (``docs/maths.md`` section 6).

The offset is kept as whole ticks in an integer and a remainder below one tick in metres of light, so that no precision
is lost however long the filter runs. One update processes one master beacon.

Plain Python: with so little arithmetic, calling compiled code would not be faster.
"""

import math
from typing import Final

from msgspec import Struct

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S

MAX_RELATIVE_RATE: Final = 40e-6
"""Two crystals of ±20 ppm each, the widest that IEEE 802.15.4 allows."""


# The covariance of a value and its rate, in any units that fit each other. For clocks the value is an offset with white
# frequency noise, and the rate walks.

TwoState = tuple[float, float, float]
"""Variance of the value, covariance, variance of the rate."""


def predicted_value_variance(P: TwoState, dt: float, white: float, walk: float) -> float:
    """Variance of the value ``dt`` later or earlier; process noise grows in both directions."""
    variance, covariance, rate_variance = P
    span = abs(dt)
    variance += dt * (2.0 * covariance + dt * rate_variance)
    return variance + span * (white + walk * span * span / 3.0)


def predict(P: TwoState, dt: float, white: float, walk: float) -> TwoState:
    """Time update F·P·Fᵀ + Q over ``dt`` ≥ 0."""
    variance, covariance, rate_variance = P
    variance += dt * (2.0 * covariance + dt * rate_variance)
    variance += dt * (white + walk * dt * dt / 3.0)
    return variance, covariance + dt * (rate_variance + walk * dt / 2.0), rate_variance + walk * dt


def update(P: TwoState, noise: float) -> tuple[float, float, TwoState]:
    """Measure the value with that variance: the gains of value and rate, and P.

    Joseph form, which keeps P positive in spite of rounding.
    """
    variance, covariance, rate_variance = P
    innovation_variance = variance + noise
    gain = variance / innovation_variance
    rate_gain = covariance / innovation_variance
    keep = 1.0 - gain
    updated = (
        keep * keep * variance + gain * gain * noise,
        keep * (covariance - rate_gain * variance) + gain * rate_gain * noise,
        rate_variance + rate_gain * (rate_gain * (variance + noise) - 2.0 * covariance),
    )
    return gain, rate_gain, updated


# Clocks


class ClockNoise(Struct, frozen=True, gc=False):
    """Process noise of the difference of two clocks, in metres of light."""

    white: float
    """White noise of the offset, m²/s."""
    walk: float
    """Random walk of the rate, m²/s³."""


def clock_noise(white_fm: float, random_walk_fm: float) -> ClockNoise:
    """Process noise from oscillator figures: Allan deviation at 1 s, and 1/√s; summed over both clocks."""
    scale = 2.0 * SPEED_OF_LIGHT_MPS**2
    return ClockNoise(scale * white_fm**2, scale * random_walk_fm**2)


def stamp_variances_m2(tx_stamp_s: float, rx_stamp_s: float) -> tuple[float, float]:
    """Variances of a TX stamp and of an RX stamp, to which rounding to whole ticks adds a twelfth of a tick squared."""
    light_2 = SPEED_OF_LIGHT_MPS**2
    return light_2 * tx_stamp_s**2, light_2 * (rx_stamp_s**2 + TICK_S**2 / 12.0)


class ClockFilter:
    """One anchor's clock against the master, beacon by beacon."""

    def __init__(self, noise: ClockNoise, variance_m2: float, gate: float = 6.0) -> None:
        self._noise = noise
        self._variance_m2 = variance_m2
        self._gate = gate
        self._whole_offset = self._epoch_master = 0
        """Offset in whole ticks, and the master's time of the last beacon."""
        self._offset_m = self._rate_mps = 0.0
        """The rest of the offset, and the rate, in metres of light."""
        self.covariance: TwoState = (0.0, 0.0, 0.0)
        """Covariance of offset and rate."""
        self.updates = 0
        """Beacons processed since the last start."""
        self.rejected = 0
        """Beacons rejected in a row."""

    @property
    def rate(self) -> float:
        """Fractional rate of the own clock against the master's."""
        return self._rate_mps / SPEED_OF_LIGHT_MPS

    @property
    def offset_std_m(self) -> float:
        """Standard deviation of the offset at the last beacon, in metres of light."""
        return math.sqrt(self.covariance[0])

    def update(self, tx_ticks_master: int, rx_ticks_own: int, range_m: float) -> float:
        """Process a master beacon with unwrapped stamps. Returns the normalised innovation squared (0 at the start).

        The state is at the time of the beacon's arrival, so that the rate also acts during the time of flight
        (``docs/maths.md`` section 4). An innovation beyond the gate changes nothing but the time.
        """
        if self.updates == 0:
            self.restart(tx_ticks_master, rx_ticks_own, range_m)
            return 0.0
        dt_s = (tx_ticks_master - self._epoch_master) * TICK_S
        offset_m = self._offset_m + self._rate_mps * dt_s
        self.covariance = predict(self.covariance, dt_s, self._noise.white, self._noise.walk)
        innovation = (rx_ticks_own - tx_ticks_master - self._whole_offset) * TICK_M - range_m - offset_m
        nis = innovation * innovation / (self.covariance[0] + self._variance_m2)
        if nis > self._gate * self._gate:
            self.rejected += 1
        else:
            gain, rate_gain, self.covariance = update(self.covariance, self._variance_m2)
            offset_m += gain * innovation
            self._rate_mps += rate_gain * innovation
            self.updates, self.rejected = self.updates + 1, 0
        steps = math.floor(offset_m / TICK_M)
        self._offset_m = offset_m - steps * TICK_M
        self._whole_offset += steps
        self._epoch_master = tx_ticks_master
        return nis

    def restart(
        self,
        tx_ticks_master: int,
        rx_ticks_own: int,
        range_m: float,
        rate: float = 0.0,
        rate_std: float = MAX_RELATIVE_RATE,
    ) -> None:
        """Restart with this beacon: the offset known to the stamps' noise, the rate to the crystals' tolerance.

        A rate known better is passed with its standard deviation, both fractional.
        """
        self._whole_offset, self._epoch_master = rx_ticks_own - tx_ticks_master, tx_ticks_master
        self._offset_m, self._rate_mps = -range_m, rate * SPEED_OF_LIGHT_MPS
        rate_std_mps = rate_std * SPEED_OF_LIGHT_MPS
        self.covariance = (self._variance_m2, 0.0, rate_std_mps * rate_std_mps)
        self.updates, self.rejected = 1, 0

    def inflate_covariance(self, factor: float) -> None:
        """Scale the covariance, because the tracked clock may have been replaced by another one."""
        variance, covariance, rate_variance = self.covariance
        self.covariance = (variance * factor, covariance * factor, rate_variance * factor)

    def add_offset_variance(self, variance_m2: float) -> None:
        """Add variance to the offset alone: range or antenna delays have changed, the clocks have not."""
        variance, covariance, rate_variance = self.covariance
        self.covariance = (variance + variance_m2, covariance, rate_variance)

    def to_master(self, ticks_own: int) -> tuple[int, float, float]:
        """Convert own time to the master's scale: whole ticks, fraction of a tick in [0, 1), and variance in m²."""
        elapsed_own = (ticks_own - self._whole_offset - self._epoch_master) - self._offset_m / TICK_M
        elapsed = elapsed_own / (1.0 + self._rate_mps / SPEED_OF_LIGHT_MPS)
        whole = math.floor(elapsed)
        variance = predicted_value_variance(self.covariance, elapsed * TICK_S, self._noise.white, self._noise.walk)
        return self._epoch_master + whole, elapsed - whole, variance

    def from_master(self, ticks_master: int) -> int:
        """Own tick nearest to a time on the master's scale."""
        offset_m = self._offset_m + self._rate_mps * ((ticks_master - self._epoch_master) * TICK_S)
        return ticks_master + self._whole_offset + round(offset_m / TICK_M)
