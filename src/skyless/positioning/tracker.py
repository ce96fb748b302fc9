"""``tracker``: a filter of position, velocity and the tag's clock, updated by every message (``docs/maths.md`` 6).

Pseudoranges as in GPS: nothing is differenced, so no cross-covariance has to be carried, and each beacon is an update.
The same kernels serve message by message (``PseudorangeTracker``) and over arrays (``track``).
"""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.positioning.kalman import (
    correct,
    horizontal_variance,
    innovation_variance,
    predict_clock,
    predict_motion,
    range_and_direction,
)

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

EPOCH, WHOLE_OFFSET, ACCEPTED, REJECTED, REJECTED_IN_ROW = range(5)
"""Places in a tracker's integer state: tag ticks, ticks, counts."""

CHI2, RESIDUAL_SQUARED, REJECTED_SHARE, AGILITY = range(4)
"""Places in a tracker's statistics: running means per message, and the factor on the agility ``qa``."""

SETTING_QA, SETTING_WHITE, SETTING_WALK, SETTING_VARIANCE, SETTING_GATE, SETTING_HEIGHT = range(6)

FORGETTING: Final = 0.02
"""Weight of the newest message in the running means, about the last 50 messages."""

RESTLESS_CHI2: Final = 1.6
"""Accepted innovations that are larger than this on average show a tag more agile than assumed (noise alone: 1)."""

AGILITY_GAIN: Final = 1.1
AGILITY_LOSS: Final = 0.99
MAX_AGILITY: Final = 100.0
"""The agility grows by the gain at every message while the tag is restless, up to this factor, and then decays."""

LOST_IN_ROW: Final = 8
"""So many messages beyond the gate in a row, of more anchors than can all be blocked, mean the same."""

LOST_SHARE: Final = 0.5
"""With a larger share of messages beyond the gate the state is wrong, not the messages."""


class TrackerSettings(Struct, frozen=True):
    """What the tracker assumes."""

    qa: float = 0.5
    """Spectral density of the acceleration, m²/s³ per axis."""
    white: float = 7.2e-5
    """Of the tag's clock against the master's, m²/s."""
    walk: float = 0.18
    """Of their rate, m²/s³."""
    stamp_variance_m2: float = 1.8e-3
    """Of one TX and one RX stamp together."""
    gate: float = 4.0
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        return np.array([self.qa, self.white, self.walk, self.stamp_variance_m2, self.gate, height_m])


@borrowing_kernel
def tracker_predict(x: Vector, P: Matrix, dim: int, dt_s: float, settings: Vector, qa: float) -> None:
    """Advance the state by ``dt_s`` of master time; ``qa`` is the agility of the moment."""
    predict_motion(x, P, dim, dt_s, qa)
    predict_clock(x, P, 2 * dim, dt_s, settings[SETTING_WHITE], settings[SETTING_WALK])


@borrowing_kernel
def tracker_update(
    x: Vector,
    P: Matrix,
    whole: NDArray[np.int64],
    statistics: Vector,
    settings: Vector,
    h: Vector,
    ph: Vector,
    anchor_m: Vector,
    rx_ticks_tag: int,
    tx_ticks_master: int,
    tx_fraction_ticks: float,
    tx_variance_m2: float,
    doubt_m2: float,
) -> bool:
    """Take one beacon; False if its innovation lies beyond the gate (the state is then only predicted).

    Stamps are unwrapped; ``tx_fraction_ticks`` is what the TX time has beyond whole ticks, ``tx_variance_m2`` the
    variance of the anchor's clock against the master, ``doubt_m2`` what the reception's variance is beyond that of its
    noise: it is judged as any other, as it is rather late than noisy, but weighs less.
    """
    n = x.shape[0]
    dim = (n - 2) // 2
    clock = 2 * dim
    elapsed_s = (rx_ticks_tag - whole[EPOCH]) * TICK_S
    dt_s = elapsed_s / (1.0 + x[clock + 1] / SPEED_OF_LIGHT_MPS)
    tracker_predict(x, P, dim, dt_s, settings, settings[SETTING_QA] * statistics[AGILITY])
    whole[EPOCH] = rx_ticks_tag
    for place in range(n):
        h[place] = 0.0
    range_m = range_and_direction(x, dim, settings[SETTING_HEIGHT], anchor_m, h, 1.0)
    h[clock] = 1.0
    pseudorange_m = (rx_ticks_tag - tx_ticks_master - whole[WHOLE_OFFSET] - tx_fraction_ticks) * TICK_M
    innovation = pseudorange_m - range_m - x[clock]
    spread = innovation_variance(P, h, ph, settings[SETTING_VARIANCE] + tx_variance_m2)
    accepted = judge(whole, statistics, innovation, spread, settings[SETTING_GATE])
    if accepted:
        correct(x, P, ph, innovation, spread + doubt_m2)
    _rebase(x, whole, clock)
    return accepted


@borrowing_kernel
def judge(whole: NDArray[np.int64], statistics: Vector, innovation: float, spread: float, gate: float) -> bool:
    """Whether an innovation lies within the gate; keeps the counts, running means and agility.

    The agility follows accepted messages only: those of a blocked anchor are late by more than the gate, while a tag
    that turns shows in all anchors at once and first within it.
    """
    normalised = innovation * innovation / spread
    statistics[REJECTED_SHARE] *= 1.0 - FORGETTING
    if not 0.0 <= normalised <= gate * gate:
        whole[REJECTED] += 1
        whole[REJECTED_IN_ROW] += 1
        statistics[REJECTED_SHARE] += FORGETTING
        return False
    whole[ACCEPTED] += 1
    whole[REJECTED_IN_ROW] = 0
    statistics[CHI2] += FORGETTING * (normalised - statistics[CHI2])
    statistics[RESIDUAL_SQUARED] += FORGETTING * (innovation * innovation - statistics[RESIDUAL_SQUARED])
    adapt_agility(statistics, statistics[CHI2] > RESTLESS_CHI2)
    return True


@borrowing_kernel
def adapt_agility(statistics: Vector, restless: bool) -> None:
    """Take the tag for more agile while it shows that it is, and else ever less, down to what was assumed."""
    if restless:
        statistics[AGILITY] = min(statistics[AGILITY] * AGILITY_GAIN, MAX_AGILITY)
    else:
        statistics[AGILITY] = max(statistics[AGILITY] * AGILITY_LOSS, 1.0)


@borrowing_kernel
def _rebase(x: Vector, whole: NDArray[np.int64], clock: int) -> None:
    """Move whole ticks of the clock offset into the integer, so that it keeps its precision for months."""
    steps = int(np.floor(x[clock] / TICK_M))
    whole[WHOLE_OFFSET] += steps
    x[clock] -= steps * TICK_M


@borrowing_kernel
def track(
    x: Vector,
    P: Matrix,
    whole: NDArray[np.int64],
    statistics: Vector,
    settings: Vector,
    h: Vector,
    ph: Vector,
    anchors_m: Matrix,
    rx_ticks_tag: NDArray[np.int64],
    tx_ticks_master: NDArray[np.int64],
    tx_fraction_ticks: Vector,
    tx_variance_m2: Vector,
    states: Matrix,
) -> int:
    """Take ``len(rx_ticks_tag)`` beacons in one loop; row k of ``states`` is x after beacon k. Returns the accepted.

    ``anchors_m`` has one row per beacon. The arithmetic is ``tracker_update``'s, so the states are those of
    streaming, bit for bit.
    """
    accepted = 0
    for k in range(rx_ticks_tag.shape[0]):
        accepted += tracker_update(
            x,
            P,
            whole,
            statistics,
            settings,
            h,
            ph,
            anchors_m[k],
            rx_ticks_tag[k],
            tx_ticks_master[k],
            tx_fraction_ticks[k],
            tx_variance_m2[k],
            0.0,
        )
        for place in range(x.shape[0]):
            states[k, place] = x[place]
    return accepted


class PseudorangeTracker:
    """The tracker's state of one tag, fed beacon by beacon once a first position is known."""

    def __init__(self, settings: TrackerSettings) -> None:
        self.dim = settings.dim
        n = 2 * self.dim + 2
        self.settings = settings.array()
        self.x = np.zeros(n)
        self.P = np.zeros((n, n))
        self.whole = np.zeros(5, dtype=np.int64)
        self.statistics = np.ones(4)
        self.h = np.zeros(n)
        self.ph = np.zeros(n)

    def start(
        self,
        rx_ticks_tag: int,
        whole_offset_ticks: int,
        solution: Vector,
        covariance: Matrix,
        clock_rate_mps: float,
        clock_rate_variance: float,
        speed_variance: float,
    ) -> None:
        """Begin at a solved position.

        ``solution`` is [position (dim), clock offset] in metres and ``covariance`` that of both, shape (dim+1, dim+1);
        the offset is counted from ``whole_offset_ticks``.
        """
        dim = self.dim
        places = [*range(dim), 2 * dim]
        self.x[:] = 0.0
        self.P[:] = 0.0
        self.x[places] = solution
        self.P[np.ix_(places, places)] = covariance
        for axis in range(dim):
            self.P[dim + axis, dim + axis] = speed_variance
        self.x[2 * dim + 1] = clock_rate_mps
        self.P[2 * dim + 1, 2 * dim + 1] = clock_rate_variance
        self.whole[:] = (rx_ticks_tag, whole_offset_ticks, 0, 0, 0)
        self.statistics[:] = (1.0, self.settings[SETTING_VARIANCE], 0.0, 1.0)

    @property
    def lost(self) -> bool:
        """Whether so many messages do not fit that the state must be wrong."""
        in_row = self.whole[REJECTED_IN_ROW]
        return bool(self.statistics[REJECTED_SHARE] > LOST_SHARE or in_row >= LOST_IN_ROW)

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        return horizontal_variance(self.P, self.dim, ahead_s, self.settings[SETTING_QA] * self.statistics[AGILITY])

    def hear(
        self,
        anchor_m: Vector,
        rx_ticks_tag: int,
        tx_ticks_master: int,
        tx_fraction_ticks: float,
        tx_variance_m2: float,
        doubt_m2: float = 0.0,
    ) -> bool:
        """Take one beacon (``tracker_update``)."""
        return tracker_update(
            self.x,
            self.P,
            self.whole,
            self.statistics,
            self.settings,
            self.h,
            self.ph,
            anchor_m,
            rx_ticks_tag,
            tx_ticks_master,
            tx_fraction_ticks,
            tx_variance_m2,
            doubt_m2,
        )
