"""The snapshot methods: one fix a round from two consecutive frames of every node.

``literal`` is the paper to the letter (first messages, unweighted), ``literal-delayed`` its delayed messages,
``weighted`` the paper's TDoAs with their full covariance, ``bracketed`` the free gain of a third (``docs/maths.md``
section 5).
"""

from enum import StrEnum
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import MAX_DRIFT, TICK_M
from skyless.kernels.arrays import Array
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.fix_time import SLACK_TICKS, FixTime
from skyless.positioning.observation import Observation
from skyless.positioning.solver.locate import NoSolution, Solution, locate
from skyless.positioning.solver.paper import bracketed_tdoa, literal_tdoa
from skyless.uncertainty.tdoa import bracketed_covariance, literal_covariance, literal_delayed_covariance


class SnapshotMethod(StrEnum):
    """Names of the snapshot methods."""

    LITERAL = "literal"
    LITERAL_DELAYED = "literal-delayed"
    WEIGHTED = "weighted"
    BRACKETED = "bracketed"


_COVARIANCES: Final = {
    SnapshotMethod.LITERAL: literal_covariance,
    SnapshotMethod.LITERAL_DELAYED: literal_delayed_covariance,
    SnapshotMethod.WEIGHTED: literal_covariance,
    SnapshotMethod.BRACKETED: bracketed_covariance,
}

_UNWEIGHTED: Final = frozenset({SnapshotMethod.LITERAL, SnapshotMethod.LITERAL_DELAYED})


class SnapshotSettings(Struct, frozen=True):
    """What a snapshot method must know of the site."""

    master: int
    anchors: int
    """Number of anchors of the site, the master included."""
    tx_variance_m2: float
    rx_variance_m2: float
    height_m: float | None
    z_bounds_m: tuple[float, float] | None = None


class SnapshotsState(Struct, frozen=True, tag="snapshots"):
    """What ``Snapshots`` remembers."""

    round: int | None
    previous: dict[int, Observation]
    current: dict[int, Observation]


class Snapshots:
    """Collects two rounds of beacons and solves them."""

    def __init__(self, method: SnapshotMethod, settings: SnapshotSettings, fix_time: FixTime | None = None) -> None:
        """``fix_time``: the receiver's, where it outlives this method."""
        self._method = method
        self._settings = settings
        self._previous: dict[int, Observation] = {}
        self._current: dict[int, Observation] = {}
        self._round: int | None = None
        self._time = fix_time or FixTime()

    def state(self) -> SnapshotsState:
        """What it remembers, as it is now."""
        return SnapshotsState(self._round, self._previous, self._current)

    def restore(self, state: SnapshotsState) -> None:
        """Continue from a state."""
        self._round, self._previous, self._current = state.round, state.previous, state.current

    def hear(self, observation: Observation) -> Fix | NoFixReason:
        """Take one observation; a fix when it completes its round or is the first of the next one."""
        result: Fix | NoFixReason = NoFixReason.ACQUIRING
        if observation.round != self._round:
            if self._current:
                result = self._solve()
            consecutive = self._round is not None and observation.round == self._round + 1
            self._previous = (self._current or self._previous) if consecutive else {}
            self._current = {}
            self._round = observation.round
        self._current[observation.anchor] = observation
        if len(self._current) == self._settings.anchors:
            result = self._solve()
            self._previous, self._current = self._current, {}
        return result

    def _solve(self) -> Fix | NoFixReason:
        master = self._settings.master
        if master not in self._current or master not in self._previous:
            return NoFixReason.TOO_FEW_ANCHORS
        reference = (self._previous[master], self._current[master])
        pairs = [
            (first, second)
            for anchor, second in self._current.items()
            if (first := self._previous.get(anchor)) is not None and _synchronised(first, second, reference)
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
        self,
        solution: Solution,
        reference: tuple[Observation, Observation],
        anchors: tuple[int, ...],
        anchors_m: Array,
    ) -> Fix:
        first_message = self._method in {SnapshotMethod.LITERAL, SnapshotMethod.WEIGHTED}
        message = reference[0 if first_message else 1]
        residuals = solution.residuals_m
        quality = np.array((solution.chi2, residuals @ residuals / len(residuals), 0.0))
        return Fix(
            time_s=self._time.time_s(message.tx_ticks_anchor, message.rx_ticks_tag),
            rows=np.vstack((solution.position_m, solution.covariance_m2, quality)).tobytes(),
            anchors=anchors,
            anchors_m=anchors_m,
            method=str(self._method),
            height_known=self._settings.height_m is not None,
            dof=solution.dof,
        )


def _synchronised(first: Observation, second: Observation, reference: tuple[Observation, Observation]) -> bool:
    """Whether the anchor heard, before its two frames, the very master frames that the tag heard, and its clock ran."""
    return (
        first.anchor != reference[0].anchor
        and first.master_rx_ticks_anchor is not None
        and second.master_rx_ticks_anchor is not None
        and first.master_sequence == reference[0].sequence
        and second.master_sequence == reference[1].sequence
        and _in_step(second.tx_ticks_anchor - first.tx_ticks_anchor, first, second)
        and _in_step(second.master_rx_ticks_anchor - first.master_rx_ticks_anchor, *reference)
        and _in_step(reference[1].tx_ticks_anchor - reference[0].tx_ticks_anchor, *reference)
    )


def _in_step(elapsed_ticks: int, first: Observation, second: Observation) -> bool:
    """Whether an interval on an anchor's clock can be the one that the tag measured between two receptions."""
    elapsed = second.rx_ticks_tag - first.rx_ticks_tag
    return elapsed > 0 and abs(elapsed_ticks - elapsed) <= MAX_DRIFT * elapsed + SLACK_TICKS


def _kappa(first: Observation, second: Observation) -> float:
    """κ: the anchor's delay after the master's first message over the spacing of its own pair."""
    assert first.master_rx_ticks_anchor is not None
    delay = first.tx_ticks_anchor - first.master_rx_ticks_anchor
    return delay / (second.tx_ticks_anchor - first.tx_ticks_anchor)
