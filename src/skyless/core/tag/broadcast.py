"""The clock of an anchor as a listener receives it: packet after packet, against the listener's clock alone.

A two-state filter (phase and rate) over the pairs of TX stamp and RX stamp. The rate contains the Doppler shift of a
moving listener, and must: then the phase, carried back by a few milliseconds, is that of the position at that time.
Everything is in ticks, integers as long as they are large.
"""

from typing import Final

from skyless.core.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.core.kernels.filter import MAX_RELATIVE_RATE, TwoState, predict, update
from skyless.core.ticks import difference, nearest

STAMP_TICKS: Final = 150e-12 / TICK_S
"""Noise of TX and RX stamp together; a DW1000 has 100 to 163 ps on a reception."""

BROADCAST_WALK_FM: Final = 3e-9
"""Random walk of each clock's rate in 1/√s. Measured on the captures of TDoA3 anchors: 1e-9 begins to lag behind."""

ACCELERATION_M2PS3: Final = 4.0
"""Power of the listener's acceleration, m²/s³: a change of 2 m/s in a second."""

WHITE_FM: Final = 2e-11
GATE: Final = 5.0
RESTART_AFTER: Final = 3
"""If this number of rejected packets in a row agree with each other, the clock has restarted."""

_WALK: Final = (2 * BROADCAST_WALK_FM**2 + ACCELERATION_M2PS3 / SPEED_OF_LIGHT_MPS**2) * TICK_S
_WHITE: Final = 2 * WHITE_FM**2 / TICK_S
_STAMP_VARIANCE: Final = STAMP_TICKS**2
_START_RATE_VARIANCE: Final = (MAX_RELATIVE_RATE / 2) ** 2


class BroadcastClock:
    """One anchor's clock against the listener's; TX counters of ``tx_bits``, RX stamps already unwrapped.

    ``tx_ticks`` and ``rx_ticks`` are those of the last accepted packet, unwrapped. By the filter that packet
    was received ``phase`` ticks later than stamped; ``rate`` is what the listener's clock gains on the anchor's.
    """

    __slots__ = (
        "_covariance",
        "_rejected",
        "_streak",
        "_tx_bits",
        "phase",
        "rate",
        "restarts",
        "rx_ticks",
        "tx_ticks",
    )

    def __init__(self, tx_bits: int, tx_ticks: int, rx_ticks: int) -> None:
        self._tx_bits = tx_bits
        self.restarts = 0
        self._begin(tx_ticks, rx_ticks)

    def _begin(self, tx_ticks: int, rx_ticks: int) -> None:
        self.tx_ticks = tx_ticks
        self.rx_ticks = rx_ticks
        self.phase = 0.0
        self.rate = 0.0
        self._covariance: TwoState = (_STAMP_VARIANCE, 0.0, _START_RATE_VARIANCE)
        self._rejected: tuple[int, int] | None = None
        self._streak = 0

    def unwrap(self, counter: int, rx_ticks: int) -> int:
        """Unwrapped time of the anchor's counter at about the listener's time ``rx_ticks``.

        The listener's 40 bits determine how often the anchor's 32 bits wrapped since the last packet; right for gaps of
        minutes, which 32 bits alone are not beyond 67 ms (``docs/maths.md`` section 3).
        """
        elapsed = rx_ticks - self.rx_ticks
        guess = self.tx_ticks + elapsed - int(self.rate * elapsed)
        return nearest(counter, guess, self._tx_bits)

    def update(self, tx_counter: int, rx_ticks: int) -> bool:
        """Process one packet; False when it does not fit the clock and was left out."""
        tx_ticks = self.unwrap(tx_counter, rx_ticks)
        span = tx_ticks - self.tx_ticks
        if span > 0 and rx_ticks > self.rx_ticks and self._filter(span, rx_ticks - self.rx_ticks - span):
            self.tx_ticks = tx_ticks
            self.rx_ticks = rx_ticks
            self._rejected = None
            self._streak = 0
            return True
        self._reject(tx_counter, rx_ticks)
        return False

    def _filter(self, span: int, gained: int) -> bool:
        """Predict over ``span`` ticks of the anchor and measure the gain of the listener's clock on it."""
        covariance = predict(self._covariance, span, _WHITE, _WALK)
        innovation = gained - (self.phase + self.rate * span)
        if innovation * innovation > GATE * GATE * (covariance[0] + _STAMP_VARIANCE):
            return False
        gain, rate_gain, self._covariance = update(covariance, _STAMP_VARIANCE)
        self.rate += rate_gain * innovation
        self.phase = (gain - 1.0) * innovation
        return True

    def _reject(self, tx_counter: int, rx_ticks: int) -> None:
        """Keep a rejected packet; start again when several in a row agree with each other."""
        agrees = False
        if self._rejected is not None:
            tx_before, rx_before = self._rejected
            elapsed = rx_ticks - rx_before
            gained = difference(elapsed - (tx_counter - tx_before), 0, self._tx_bits)
            agrees = elapsed > 0 and abs(gained) < MAX_RELATIVE_RATE * elapsed + GATE * STAMP_TICKS
        self._streak = self._streak + 1 if agrees else 1
        self._rejected = (tx_counter, rx_ticks)
        if self._streak >= RESTART_AFTER:
            self.restarts += 1
            self._begin(tx_counter, rx_ticks)

    def uncertainty_ticks(self, span: float) -> float:
        """Standard deviation in ticks of what the rate's error does over ``span`` ticks."""
        return float(abs(span) * self._covariance[2] ** 0.5)
