"""The two-state clock filter: an anchor's offset and rate against the master (``docs/maths.md`` section 6).

The offset is kept in two parts, whole ticks in an integer and a remainder below one tick in metres of light, so that
nothing is lost however long the filter runs. One update takes one master beacon.

This is plain Python: so little arithmetic a beacon takes no longer than a kernel takes to be called.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S

MAX_RATE: Final = 40e-6
"""Two crystals of ±20 ppm each, the widest that IEEE 802.15.4 allows."""

OFFSET, RATE, VAR_OFFSET, COVARIANCE, VAR_RATE = range(5)
"""Places in the filter's float state: metres, m/s, and their covariance."""

WHOLE_OFFSET, EPOCH_MASTER, UPDATES, REJECTED = range(4)
"""Places in the filter's integer state: ticks, ticks, counts."""

_MAX_RATE_MPS: Final = MAX_RATE * SPEED_OF_LIGHT_MPS
_State = tuple[float, float, float, float, float]


class ClockNoise(Struct, frozen=True, gc=False):
    """Process noise of the difference of two clocks, in metres of light."""

    white: float
    """Of the offset, m²/s."""
    walk: float
    """Of the rate, m²/s³."""


def clock_noise(white_fm: float, random_walk_fm: float, clocks: int = 2) -> ClockNoise:
    """Process noise from oscillator figures: Allan deviation at 1 s, and 1/√s; summed over both clocks."""
    scale = clocks * SPEED_OF_LIGHT_MPS**2
    return ClockNoise(scale * white_fm**2, scale * random_walk_fm**2)


class ClockFilter:
    """One anchor's clock against the master, beacon by beacon."""

    def __init__(self, noise: ClockNoise, variance_m2: float, gate: float = 6.0) -> None:
        self._noise = noise
        self._variance_m2 = variance_m2
        self._gate = gate
        self.state = np.zeros(5)
        self.whole = np.zeros(4, dtype=np.int64)

    @property
    def updates(self) -> int:
        """Beacons taken since the last start."""
        return int(self.whole[UPDATES])

    @property
    def rejected(self) -> int:
        """Beacons refused in a row."""
        return int(self.whole[REJECTED])

    @property
    def rate(self) -> float:
        """Fractional rate of the own clock against the master's."""
        return float(self.state[RATE]) / SPEED_OF_LIGHT_MPS

    @property
    def offset_std_m(self) -> float:
        """Standard deviation of the offset at the last beacon, in metres of light."""
        return float(np.sqrt(self.state[VAR_OFFSET]))

    def hear(self, tx_ticks_master: int, rx_ticks_own: int, range_m: float) -> float:
        """Take a master beacon, both stamps unwrapped; return the normalised innovation squared (0 at the start).

        The state is at the time at which the beacon arrives, so the rate acts on the flight time as it should
        (``docs/maths.md`` section 4). An innovation beyond the gate changes nothing but the time.
        """
        whole_offset, epoch_master, updates, rejected = self.whole.tolist()
        if updates == 0:
            self.restart(tx_ticks_master, rx_ticks_own, range_m)
            return 0.0
        state = self._predicted((tx_ticks_master - epoch_master) * TICK_S)
        measured_m = (rx_ticks_own - tx_ticks_master - whole_offset) * TICK_M - range_m
        innovation = measured_m - state[OFFSET]
        spread = state[VAR_OFFSET] + self._variance_m2
        normalised = innovation * innovation / spread
        if normalised > self._gate * self._gate:
            rejected += 1
        else:
            updates, rejected = updates + 1, 0
            state = self._corrected(state, innovation, spread)
        steps = math.floor(state[OFFSET] / TICK_M)
        self.state[:] = (state[OFFSET] - steps * TICK_M, *state[RATE:])
        self.whole[:] = (whole_offset + steps, tx_ticks_master, updates, rejected)
        return normalised

    def _predicted(self, dt_s: float) -> _State:
        """The float state ``dt_s`` of master time later."""
        offset, rate, var_offset, covariance, var_rate = self.state.tolist()
        white, walk = self._noise.white, self._noise.walk
        var_offset += dt_s * (2.0 * covariance + dt_s * var_rate)
        var_offset += dt_s * (white + walk * dt_s * dt_s / 3.0)
        covariance += dt_s * (var_rate + walk * dt_s / 2.0)
        return offset + rate * dt_s, rate, var_offset, covariance, var_rate + walk * dt_s

    def _corrected(self, state: _State, innovation: float, spread: float) -> _State:
        """Kalman update in Joseph form, which keeps the covariance positive whatever the rounding."""
        offset, rate, var_offset, covariance, var_rate = state
        noise = self._variance_m2
        gain_offset = var_offset / spread
        gain_rate = covariance / spread
        keep = 1.0 - gain_offset
        return (
            offset + gain_offset * innovation,
            rate + gain_rate * innovation,
            keep * keep * var_offset + gain_offset * gain_offset * noise,
            keep * (covariance - gain_rate * var_offset) + gain_offset * gain_rate * noise,
            var_rate + gain_rate * (gain_rate * (var_offset + noise) - 2.0 * covariance),
        )

    def restart(self, tx_ticks_master: int, rx_ticks_own: int, range_m: float) -> None:
        """Forget all and begin with this beacon: offset known to the stamps' noise, rate to the crystals' tolerance."""
        self.whole[:] = (rx_ticks_own - tx_ticks_master, tx_ticks_master, 1, 0)
        self.state[:] = (-range_m, 0.0, self._variance_m2, 0.0, _MAX_RATE_MPS * _MAX_RATE_MPS)

    def doubt(self, factor: float) -> None:
        """Multiply the covariance: what is followed from now on may differ from what was followed before."""
        self.state[VAR_OFFSET:] *= factor

    def to_master(self, ticks_own: int) -> tuple[int, float, float]:
        """Own time on the master's scale: whole ticks, the fraction of a tick in [0, 1), and the variance in m²."""
        whole_offset, epoch_master = self.whole[: EPOCH_MASTER + 1].tolist()
        offset, rate, var_offset, covariance, var_rate = self.state.tolist()
        elapsed_own = (ticks_own - whole_offset - epoch_master) - offset / TICK_M
        elapsed = elapsed_own / (1.0 + rate / SPEED_OF_LIGHT_MPS)
        floor = math.floor(elapsed)
        dt_s = elapsed * TICK_S
        span_s = abs(dt_s)
        variance = var_offset + dt_s * (2.0 * covariance + dt_s * var_rate)
        variance += span_s * (self._noise.white + self._noise.walk * span_s * span_s / 3.0)
        return epoch_master + floor, elapsed - floor, variance

    def from_master(self, ticks_master: int) -> int:
        """Nearest own tick of a time on the master's scale."""
        whole_offset, epoch_master = self.whole[: EPOCH_MASTER + 1].tolist()
        offset, rate = self.state[: RATE + 1].tolist()
        offset_m = offset + rate * ((ticks_master - epoch_master) * TICK_S)
        own_ticks: int = ticks_master + whole_offset + round(offset_m / TICK_M)
        return own_ticks
