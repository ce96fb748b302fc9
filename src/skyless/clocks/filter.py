"""The two-state clock filter: an anchor's offset and rate against the master (``docs/maths.md`` section 6).

The offset is kept in two parts, whole ticks in an integer and a remainder below one tick in metres of light, so that
nothing is lost however long the filter runs. One update takes one master beacon.
"""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S

MAX_RATE: Final = 40e-6
"""Two crystals of ±20 ppm each, the widest that IEEE 802.15.4 allows."""

OFFSET, RATE, VAR_OFFSET, COVARIANCE, VAR_RATE = range(5)
"""Places in the filter's float state: metres, m/s, and their covariance."""

WHOLE_OFFSET, EPOCH_MASTER, UPDATES, REJECTED = range(4)
"""Places in the filter's integer state: ticks, ticks, counts."""


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


@kernel
def clock_predict(state: NDArray[np.float64], dt_s: float, white: float, walk: float) -> None:
    """Advance the float state by ``dt_s`` of master time."""
    state[OFFSET] += state[RATE] * dt_s
    state[VAR_OFFSET] += dt_s * (2.0 * state[COVARIANCE] + dt_s * state[VAR_RATE])
    state[VAR_OFFSET] += dt_s * (white + walk * dt_s * dt_s / 3.0)
    state[COVARIANCE] += dt_s * (state[VAR_RATE] + walk * dt_s / 2.0)
    state[VAR_RATE] += walk * dt_s


@kernel
def clock_start(
    state: NDArray[np.float64],
    whole: NDArray[np.int64],
    tx_ticks_master: int,
    rx_ticks_own: int,
    range_m: float,
    variance_m2: float,
) -> None:
    """Begin with one master beacon: offset known to the stamps' noise, rate to the crystals' tolerance."""
    whole[WHOLE_OFFSET] = rx_ticks_own - tx_ticks_master
    whole[EPOCH_MASTER] = tx_ticks_master
    whole[UPDATES] = 1
    whole[REJECTED] = 0
    state[OFFSET] = -range_m
    state[RATE] = 0.0
    state[VAR_OFFSET] = variance_m2
    state[COVARIANCE] = 0.0
    state[VAR_RATE] = (MAX_RATE * SPEED_OF_LIGHT_MPS) ** 2


@kernel
def clock_update(
    state: NDArray[np.float64],
    whole: NDArray[np.int64],
    tx_ticks_master: int,
    rx_ticks_own: int,
    range_m: float,
    variance_m2: float,
    white: float,
    walk: float,
    gate: float,
) -> float:
    """Take one master beacon; return the normalised innovation squared.

    The state is at the time at which the beacon arrives, so the rate acts on the flight time as it should
    (``docs/maths.md`` section 4). An innovation beyond ``gate`` standard deviations changes nothing but the time.
    """
    dt_s = (tx_ticks_master - whole[EPOCH_MASTER]) * TICK_S
    clock_predict(state, dt_s, white, walk)
    whole[EPOCH_MASTER] = tx_ticks_master
    measured_m = (rx_ticks_own - tx_ticks_master - whole[WHOLE_OFFSET]) * TICK_M - range_m
    innovation = measured_m - state[OFFSET]
    spread = state[VAR_OFFSET] + variance_m2
    normalised = innovation * innovation / spread
    if normalised > gate * gate:
        whole[REJECTED] += 1
    else:
        whole[UPDATES] += 1
        whole[REJECTED] = 0
        _correct(state, innovation, spread, variance_m2)
    steps = int(np.floor(state[OFFSET] / TICK_M))
    whole[WHOLE_OFFSET] += steps
    state[OFFSET] -= steps * TICK_M
    return float(normalised)


@kernel
def _correct(state: NDArray[np.float64], innovation: float, spread: float, variance_m2: float) -> None:
    """Kalman update in Joseph form, which keeps the covariance positive whatever the rounding."""
    gain_offset = state[VAR_OFFSET] / spread
    gain_rate = state[COVARIANCE] / spread
    state[OFFSET] += gain_offset * innovation
    state[RATE] += gain_rate * innovation
    keep = 1.0 - gain_offset
    var_offset, covariance = state[VAR_OFFSET], state[COVARIANCE]
    state[VAR_OFFSET] = keep * keep * var_offset + gain_offset * gain_offset * variance_m2
    state[COVARIANCE] = keep * (covariance - gain_rate * var_offset) + gain_offset * gain_rate * variance_m2
    state[VAR_RATE] += gain_rate * (gain_rate * (var_offset + variance_m2) - 2.0 * covariance)


@kernel
def clock_to_master(
    state: NDArray[np.float64], whole: NDArray[np.int64], ticks_own: int, white: float, walk: float
) -> tuple[int, float, float]:
    """Own time on the master's scale: whole ticks, the fraction of a tick in [0, 1), and the variance in m²."""
    elapsed_own = (ticks_own - whole[WHOLE_OFFSET] - whole[EPOCH_MASTER]) - state[OFFSET] / TICK_M
    elapsed = elapsed_own / (1.0 + state[RATE] / SPEED_OF_LIGHT_MPS)
    floor = int(np.floor(elapsed))
    dt_s = elapsed * TICK_S
    span_s = abs(dt_s)
    variance = state[VAR_OFFSET] + dt_s * (2.0 * state[COVARIANCE] + dt_s * state[VAR_RATE])
    variance += span_s * (white + walk * span_s * span_s / 3.0)
    return whole[EPOCH_MASTER] + floor, elapsed - floor, variance


@kernel
def clock_from_master(state: NDArray[np.float64], whole: NDArray[np.int64], ticks_master: int) -> int:
    """Nearest own tick of a time on the master's scale."""
    elapsed = ticks_master - whole[EPOCH_MASTER]
    offset_m = state[OFFSET] + state[RATE] * (elapsed * TICK_S)
    return int(ticks_master + whole[WHOLE_OFFSET] + np.int64(np.rint(offset_m / TICK_M)))


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
        """Take a master beacon, both stamps unwrapped; return the normalised innovation squared (0 at the start)."""
        if self.updates == 0:
            self.restart(tx_ticks_master, rx_ticks_own, range_m)
            return 0.0
        return clock_update(
            self.state,
            self.whole,
            tx_ticks_master,
            rx_ticks_own,
            range_m,
            self._variance_m2,
            self._noise.white,
            self._noise.walk,
            self._gate,
        )

    def restart(self, tx_ticks_master: int, rx_ticks_own: int, range_m: float) -> None:
        """Forget all and begin with this beacon."""
        clock_start(self.state, self.whole, tx_ticks_master, rx_ticks_own, range_m, self._variance_m2)

    def doubt(self, factor: float) -> None:
        """Multiply the covariance: what is followed from now on may differ from what was followed before."""
        self.state[VAR_OFFSET:] *= factor

    def to_master(self, ticks_own: int) -> tuple[int, float, float]:
        """Own time on the master's scale: whole ticks, fraction of a tick, variance in m²."""
        white, walk = self._noise.white, self._noise.walk
        ticks, fraction_ticks, variance_m2 = clock_to_master(self.state, self.whole, ticks_own, white, walk)
        return int(ticks), fraction_ticks, variance_m2  # uncompiled it is NumPy's, which overflows in the site's time

    def from_master(self, ticks_master: int) -> int:
        """Nearest own tick of a time on the master's scale."""
        return int(clock_from_master(self.state, self.whole, ticks_master))
