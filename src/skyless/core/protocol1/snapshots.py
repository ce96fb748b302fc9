"""The snapshot methods: one fix a round from two consecutive frames of every node.

``literal`` is the paper to the letter (Santoro et al., ROSE 2021; first messages, unweighted), ``literal-delayed`` its
delayed messages, ``weighted`` the paper's TDoAs with their full covariance, ``bracketed`` the free gain of a third
(``docs/maths.md`` section 5). Below the methods stand their covariances, and the paper's arithmetic.
"""

from enum import StrEnum
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Matrix, Vector
from skyless.core.fix import Fix, NoFixReason
from skyless.core.tag.position import NoSolution, Solution, locate
from skyless.core.ticks import FLIGHT_SLACK_TICKS, TICK_M, FixTime, fix_time_s, may_elapse


class Observation(Struct, frozen=True, gc=False):
    """One beacon as the methods see it, every stamp unwrapped on its own clock."""

    anchor: int
    anchor_m: Array
    """Shape (3,)."""
    round: int
    """Counts the frames that each node sends: the superframe, or a fraction of it with several frames per node."""
    sequence: int
    rx_ticks_tag: int
    tx_ticks_anchor: int
    master_sequence: int | None
    """Sequence number of the last master beacon that the anchor received."""
    master_rx_ticks_anchor: int | None
    """The anchor's RX stamp of that beacon."""


class SnapshotMethod(StrEnum):
    """Names of the snapshot methods."""

    LITERAL = "literal"
    LITERAL_DELAYED = "literal-delayed"
    WEIGHTED = "weighted"
    BRACKETED = "bracketed"


# The paper's arithmetic


def relative_rate(rx_interval_anchor: float, tx_interval_master: float) -> float:
    """Relative rate ν̄_{i,m} of an anchor against the master from two messages (``eq:Synchro``)."""
    return rx_interval_anchor / tx_interval_master


def relative_offset(rx_anchor: float, tx_master: float, rate: float, tof_ticks: float) -> float:
    """Relative offset ō_{i,m} of one synchronisation message, in ticks (``eq:SynchroOffset``)."""
    return rx_anchor - rate * tx_master - tof_ticks


def averaged_offset(first: float, delayed: float) -> float:
    """Mean of the offsets of the two messages (``eq:AverageRelOff``).

    With one two-point rate both are identical for any noise (``docs/maths.md`` E2): averaging changes nothing.
    """
    return (first + delayed) / 2.0


def to_master(ticks_anchor: float, rate: float, offset: float) -> float:
    """An anchor's reading on the master's scale (``eq:AnchorSync``), in ticks."""
    return (ticks_anchor - offset) / rate


def synchronise(
    tx1_master: int, tx2_master: int, rx1_anchor: int, rx2_anchor: int, tof_ticks: float
) -> tuple[float, float]:
    """Rate and averaged offset of an anchor from two master messages.

    The offset holds for master readings counted from ``tx1_master`` and anchor readings from ``rx1_anchor``.
    """
    tx_interval = float(tx2_master - tx1_master)
    rx_interval = float(rx2_anchor - rx1_anchor)
    rate = relative_rate(rx_interval, tx_interval)
    first = relative_offset(0.0, 0.0, rate, tof_ticks)
    delayed = relative_offset(rx_interval, tx_interval, rate, tof_ticks)
    return rate, averaged_offset(first, delayed)


def tag_rate(rx_interval_tag: float, tx_interval_master: float) -> float:
    """Rate ν̄_m of the tag against the master (``eq:TagSynchro``); the motion toward the anchor is in it."""
    return rx_interval_tag / tx_interval_master


def protocol_interval(rate_tag: float, tx_anchor_master: float, tx_master: float) -> float:
    """Protocol interval g(Δ_{i,m}) as the tag's clock would show it, in ticks (``eq:ProtocolInterval``)."""
    return rate_tag * (tx_anchor_master - tx_master)


def literal_tdoa(
    m1: int, m2: int, s1: int, s2: int, a1: int, a2: int, r1: int, r2: int, rm1: int, rm2: int, tof_ticks: float
) -> tuple[float, float]:
    """TDoAs of the first and of the delayed messages in ticks of the tag (``eq:GPSTDoA``), to the letter.

    Both stamps of the anchor's pair are converted with the same synchronisation; converting each with the newest one
    doubles the error (``docs/maths.md`` section 5, "the trap").
    """
    rate, offset = synchronise(m1, m2, s1, s2, tof_ticks)
    first = to_master(float(a1 - s1), rate, offset)
    delayed = to_master(float(a2 - s1), rate, offset)
    rate_tag = tag_rate(float(r2 - r1), delayed - first)
    tdoa_first = (r1 - rm1) - protocol_interval(rate_tag, first, 0.0)
    tdoa_delayed = (r2 - rm2) - protocol_interval(rate_tag, delayed, float(m2 - m1))
    return tdoa_first, tdoa_delayed


def bracketed_tdoa(
    m1: int, m2: int, s1: int, s2: int, a1: int, a2: int, r1: int, r2: int, rm2: int, tof_ticks: float
) -> float:
    """TDoA in ticks against the master's second message, which the anchor's two enclose (``docs/maths.md`` section 5).

    The anchor's own RX stamp of that message shows where between its two transmissions it was sent; no
    synchronisation parameter enters but the rate that scales the flight time.
    """
    rate = float(s2 - s1) / float(m2 - m1)
    sent_after_first = (s2 - a1) - rate * tof_ticks
    return (r1 - rm2) + float(r2 - r1) / float(a2 - a1) * sent_after_first


# Covariances of the TDoAs


def literal_covariance(kappa: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Covariance of the first messages by ``eq:GPSTDoA``: their reference is one of the two sync messages.

    There the master's noise and the rate error β cancel exactly: Q_i + 1 stamps of the tag and of the anchor remain,
    Q = (1 + κ)² + κ².
    """
    return _shared_reference((1.0 + kappa) ** 2 + kappa**2, tx_var_m2, rx_var_m2)


def literal_delayed_covariance(kappa: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Covariance of the delayed messages: the anchor's pair encloses the reference, Q = (1 - κ)² + κ²."""
    return _shared_reference((1.0 - kappa) ** 2 + kappa**2, tx_var_m2, rx_var_m2)


bracketed_covariance: Final = literal_delayed_covariance
"""Covariance of the bracketed TDoAs: their stamps and weights are those of the delayed messages."""


def _shared_reference(q: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Each TDoA holds its pair (factor Q) and one RX stamp of the anchor; the tag's reference stamp is common."""
    own = q * (tx_var_m2 + rx_var_m2) + rx_var_m2
    covariance: Matrix = np.full((len(q), len(q)), rx_var_m2) + np.diag(own)
    return covariance


# The methods


_COVARIANCES: Final = {
    SnapshotMethod.LITERAL: literal_covariance,
    SnapshotMethod.LITERAL_DELAYED: literal_delayed_covariance,
    SnapshotMethod.WEIGHTED: literal_covariance,
    SnapshotMethod.BRACKETED: bracketed_covariance,
}

_UNWEIGHTED: Final = frozenset({SnapshotMethod.LITERAL, SnapshotMethod.LITERAL_DELAYED})


class SnapshotSettings(Struct, frozen=True):
    """What a snapshot method needs to know of the site."""

    master: int
    anchors: int
    """Number of anchors of the site, the master included."""
    tx_variance_m2: float
    rx_variance_m2: float
    height_m: float | None
    z_bounds_m: tuple[float, float] | None = None


class _Rounds(Struct):
    """The observations of two rounds, by anchor."""

    round: int | None = None
    previous: dict[int, Observation] = {}
    current: dict[int, Observation] = {}


class Snapshots:
    """Collects two rounds of beacons and solves them."""

    def __init__(self, method: SnapshotMethod, settings: SnapshotSettings, fix_time: FixTime | None = None) -> None:
        """``fix_time``: the receiver's, if it outlives this object."""
        self._method = method
        self._settings = settings
        self._kept = _Rounds()
        self._time = fix_time or FixTime()

    def update(self, observation: Observation) -> Fix | NoFixReason:
        """Process an observation. It gives a fix if it completes its round or is the first of the next one."""
        result: Fix | NoFixReason = NoFixReason.ACQUIRING
        kept = self._kept
        if observation.round != kept.round:
            if kept.current:
                result = self._solve()
            consecutive = kept.round is not None and observation.round == kept.round + 1
            kept.previous = (kept.current or kept.previous) if consecutive else {}
            kept.current = {}
            kept.round = observation.round
        kept.current[observation.anchor] = observation
        if len(kept.current) == self._settings.anchors:
            result = self._solve()
            kept.previous, kept.current = kept.current, {}
        return result

    def _solve(self) -> Fix | NoFixReason:
        master, previous, current = self._settings.master, self._kept.previous, self._kept.current
        if master not in current or master not in previous:
            return NoFixReason.TOO_FEW_ANCHORS
        reference = (previous[master], current[master])
        pairs = [
            (first, second)
            for anchor, second in current.items()
            if (first := previous.get(anchor)) is not None and _synchronised(first, second, reference)
        ]
        if not pairs:
            return NoFixReason.TOO_FEW_ANCHORS
        tdoa_m = np.array([self._tdoa_ticks(pair, reference) for pair in pairs]) * TICK_M
        kappa = np.array([_kappa(first, second) for first, second in pairs])
        covariance = _COVARIANCES[self._method](kappa, self._settings.tx_variance_m2, self._settings.rx_variance_m2)
        anchors_m = np.array([reference[0].anchor_m, *(first.anchor_m for first, _ in pairs)])
        solution = locate(
            anchors_m,
            tdoa_m,
            covariance,
            height_m=self._settings.height_m,
            weighted=self._method not in _UNWEIGHTED,
            z_bounds_m=self._settings.z_bounds_m,
        )
        if isinstance(solution, NoSolution):
            return solution.reason
        return self._fix(solution, reference, (master, *(first.anchor for first, _ in pairs)), anchors_m)

    def _tdoa_ticks(self, pair: tuple[Observation, Observation], reference: tuple[Observation, Observation]) -> float:
        (first, second), (m1, m2) = pair, reference
        s1, s2 = first.master_rx_ticks_anchor, second.master_rx_ticks_anchor
        assert s1 is not None
        assert s2 is not None
        tof_ticks = float(np.linalg.norm(first.anchor_m - m1.anchor_m)) / TICK_M
        a1, a2, r1, r2 = first.tx_ticks_anchor, second.tx_ticks_anchor, first.rx_ticks_tag, second.rx_ticks_tag
        tx1, tx2, rm1, rm2 = m1.tx_ticks_anchor, m2.tx_ticks_anchor, m1.rx_ticks_tag, m2.rx_ticks_tag
        if self._method is SnapshotMethod.BRACKETED:
            return bracketed_tdoa(tx1, tx2, s1, s2, a1, a2, r1, r2, rm2, tof_ticks)
        tdoas = literal_tdoa(tx1, tx2, s1, s2, a1, a2, r1, r2, rm1, rm2, tof_ticks)
        return tdoas[self._method is SnapshotMethod.LITERAL_DELAYED]

    def _fix(
        self, solution: Solution, reference: tuple[Observation, Observation], anchors: tuple[int, ...], anchors_m: Array
    ) -> Fix:
        first_message = self._method in {SnapshotMethod.LITERAL, SnapshotMethod.WEIGHTED}
        message = reference[0 if first_message else 1]
        residuals = solution.residuals_m
        quality = np.array((solution.chi2, residuals @ residuals / len(residuals), 0.0))
        return Fix(
            time_s=fix_time_s(self._time, message.tx_ticks_anchor, message.rx_ticks_tag),
            rows=np.vstack((solution.position_m, solution.covariance_m2, quality)).tobytes(),
            anchors=anchors,
            anchors_m=anchors_m,
            method=str(self._method),
            height_known=self._settings.height_m is not None,
            dof=solution.dof,
        )


def _synchronised(first: Observation, second: Observation, reference: tuple[Observation, Observation]) -> bool:
    """Whether anchor and tag received the same two master frames, and no clock jumped in between."""
    return (
        first.anchor != reference[0].anchor
        and first.master_rx_ticks_anchor is not None
        and second.master_rx_ticks_anchor is not None
        and first.master_sequence == reference[0].sequence
        and second.master_sequence == reference[1].sequence
        and _is_plausible_interval(second.tx_ticks_anchor - first.tx_ticks_anchor, first, second)
        and _is_plausible_interval(second.master_rx_ticks_anchor - first.master_rx_ticks_anchor, *reference)
        and _is_plausible_interval(reference[1].tx_ticks_anchor - reference[0].tx_ticks_anchor, *reference)
    )


def _is_plausible_interval(elapsed_ticks: int, first: Observation, second: Observation) -> bool:
    """Whether an interval on an anchor's clock agrees with the tag's between two receptions."""
    elapsed = second.rx_ticks_tag - first.rx_ticks_tag
    return elapsed > 0 and may_elapse(elapsed_ticks, elapsed, FLIGHT_SLACK_TICKS)


def _kappa(first: Observation, second: Observation) -> float:
    """κ: the anchor's delay after the master's first message over the spacing of its own pair."""
    assert first.master_rx_ticks_anchor is not None
    delay = first.tx_ticks_anchor - first.master_rx_ticks_anchor
    return delay / (second.tx_ticks_anchor - first.tx_ticks_anchor)
