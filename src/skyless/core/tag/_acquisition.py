"""The cold start: where the tag is, from packets alone and without a guess.

When anchor i relays its reception of a packet of anchor j that the tag received too, the difference of their clocks at
that moment is known but for noise. Along such links all TX times are carried to the clock of one anchor,
unless more anchors state theirs on the master's. The tag's clock runs up to 20 ppm off, so pseudoranges of one
superframe drift by tens of metres. Two messages of the same anchor give the drift; then all anchors' newest
pseudoranges are carried to one time and solved in closed form.
"""

from collections import deque
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.constants import MAX_DRIFT, SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.core.estimator.settings import TUNING
from skyless.core.fix import NoFixReason
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.observation import Observation
from skyless.core.tag.locate import NoSolution, locate_pseudoranges

CONTRADICTIONS: Final = frozenset({NoFixReason.RESIDUALS, NoFixReason.BAD_GEOMETRY, NoFixReason.NOT_CONVERGED})
"""How a start fails with one faulty anchor; absurd pseudoranges count as bad geometry."""


class _Link(Struct, frozen=True):
    """Reading of one anchor's clock less that of another's, when the tag's read ``rx_ticks_tag``."""

    rx_ticks_tag: int
    ticks: int
    fraction_ticks: float


class _Scale(Struct, frozen=True):
    """How an anchor's TX times become those of the reference: the sum of links on the path to it."""

    ticks: int
    fraction_ticks: float
    drifts: tuple[tuple[float, float, int], ...]
    """Of each link: the rate at which it goes out of date, its variance in m²/s², and since when."""


class Start(Struct, frozen=True):
    """A first position."""

    used: tuple[Observation, ...]
    """The messages that it uses, one of each anchor."""
    rx_ticks_tag: int
    solution: Array
    """[position (dim), clock offset], metres."""
    covariance: Array
    is_contradicted: bool = False
    """Whether the messages of all anchors contradict each other."""
    misfitting: tuple[int, ...] = ()
    """Anchors that are not in ``used``: without them there is no contradiction."""


class Acquisition(Struct):
    """Gathers beacons until a start is possible."""

    _height_m: float | None
    _variance_m2: float
    """Variance of a TX and an RX stamp together."""
    _z_bounds_m: tuple[float, float] | None
    _max_age_s: float
    _speed_std_mps: float
    """Assumed speed of the tag."""
    _error_variance_m2: float = 0.0
    """Variance of survey and ranges."""
    _heard: dict[int, list[Observation]] = {}
    _wide_ticks: int | None = None
    """When a start was first possible, but wide."""
    _contradicted_ticks: int | None = None
    """When packets first contradicted each other."""
    _links: dict[tuple[int, int], _Link] = {}
    _rival_count: int = 0
    """Anchors with which two positions fitted alike; as many of them are tried again once a superframe only."""

    def expect_height(self, low_m: float, high_m: float) -> None:
        """Look only between these heights from now on."""
        self._z_bounds_m = low_m, high_m

    def remove_anchor(self, anchor: int) -> None:
        """Forget what was received of an anchor, because its position has changed."""
        self._heard.pop(anchor, None)
        self._links = {ends: link for ends, link in self._links.items() if anchor not in ends}

    def packets(self) -> list[Observation]:
        """The last two packets of each anchor, in the order of their receptions."""
        kept = [observation for pair in self._heard.values() for observation in pair]
        return sorted(kept, key=lambda observation: observation.rx_ticks_tag)

    def add_relays(self, observation: Observation) -> None:
        """Keep what an anchor relays; to be called before ``add``."""
        for anchor, sequence, rx_ticks in observation.all_relays():
            for packet in self._heard.get(anchor, ()):
                if packet.sequence == sequence:
                    range_ticks = float(np.linalg.norm(observation.anchor_m - packet.anchor_m)) / TICK_M
                    link = _Link(packet.rx_ticks_tag, rx_ticks - packet.tx_ticks_anchor, -range_ticks)
                    self._links[observation.anchor, anchor] = link

    def add(self, observation: Observation) -> Start | NoFixReason:
        """Add one observation; try to start each time an anchor comes around again."""
        now = observation.rx_ticks_tag
        for anchor, kept in list(self._heard.items()):
            if (now - kept[-1].rx_ticks_tag) * TICK_S > self._max_age_s:
                del self._heard[anchor]
        kept = self._heard.setdefault(observation.anchor, [])
        came_around = len(kept) == 2
        self._heard[observation.anchor] = [*kept[-1:], observation]
        pairs = [kept for kept in self._heard.values() if len(kept) == 2]
        pairs = [kept for kept in pairs if (now - kept[-1].rx_ticks_tag) * TICK_S < TUNING.start_age_s]
        pairs = [kept for kept in self._on_one_scale(pairs) if _possible(*kept)][:MAX_ANCHORS]
        needed = 4 if self._height_m is None else 3
        if len(pairs) < needed:
            return NoFixReason.TOO_FEW_ANCHORS
        if not came_around or (len(pairs) == self._rival_count and observation.anchor != pairs[0][-1].anchor):
            return NoFixReason.MIRROR if self._rival_count else NoFixReason.ACQUIRING
        result = self._solve(pairs, now)
        self._rival_count = len(pairs) if result is NoFixReason.MIRROR else 0
        if isinstance(result, Start):
            return self._unless_wide(result)
        if result not in CONTRADICTIONS or len(pairs) <= needed + 1 or observation.anchor != pairs[0][-1].anchor:
            return result
        return self._solve_without_one(pairs, now)

    def _on_one_scale(self, pairs: list[list[Observation]]) -> list[list[Observation]]:
        """The packets on the scale of the anchor that reaches most others, or on the master's if that is more."""
        with_master = [pair for pair in pairs if all(packet.tx_ticks_master is not None for packet in pair)]
        if not pairs:
            return with_master
        now = pairs[-1][-1].rx_ticks_tag
        self._links = {
            ends: link
            for ends, link in self._links.items()
            if (now - link.rx_ticks_tag) * TICK_S < 2.0 * self._max_age_s
        }
        by_anchor = {pair[0].anchor: pair for pair in pairs}
        rates = {name: _rate(first, second, self._variance_m2) for name, (first, second) in by_anchor.items()}
        best: dict[int, _Scale] = {}
        for reference in rates:
            if reference not in best:  # it would reach the same anchors as before
                reached = self._reach(reference, rates)
                if len(reached) > len(best):
                    best = reached
        if len(best) < len(with_master):
            return with_master
        return [
            [self._convert(packet, best[anchor]) for packet in by_anchor[anchor]] for anchor in rates if anchor in best
        ]

    def _reach(self, reference: int, rates: dict[int, tuple[float, float]]) -> dict[int, _Scale]:
        """The scale of every anchor to which links lead, by as few of them as can be."""
        reached = {reference: _Scale(0, 0.0, ())}
        queue = deque([reference])
        while queue:
            known = queue.popleft()
            for (listener, sender), link in self._links.items():
                if known not in (listener, sender):
                    continue
                other, sign = (sender, 1) if known == listener else (listener, -1)
                if other in reached or other not in rates:
                    continue
                scale, known_rate, rate = reached[known], rates[known], rates[other]
                drift = (known_rate[0] - rate[0], known_rate[1] + rate[1], link.rx_ticks_tag)
                reached[other] = _Scale(
                    scale.ticks + sign * link.ticks,
                    scale.fraction_ticks + sign * link.fraction_ticks,
                    (*scale.drifts, drift),
                )
                queue.append(other)
        return reached

    def _convert(self, packet: Observation, scale: _Scale) -> Observation:
        fraction = scale.fraction_ticks
        variance_m2 = 2.0 * len(scale.drifts) * self._variance_m2
        for rate, rate_variance, rx_ticks in scale.drifts:
            elapsed = packet.rx_ticks_tag - rx_ticks
            fraction += rate * elapsed
            variance_m2 += rate_variance * (elapsed * TICK_S) ** 2
        whole = int(np.floor(fraction))
        return msgspec.structs.replace(
            packet,
            tx_ticks_master=packet.tx_ticks_anchor + scale.ticks + whole,
            tx_fraction_ticks=fraction - whole,
            tx_variance_m2=variance_m2,
        )

    def _unless_wide(self, start: Start) -> Start | NoFixReason:
        """Hold a start back while ranges are curved within its standard deviation by more than their noise.

        Updates would then make the filter sure of a wrong position. More anchors may come; if they do not, a start that
        at least one anchor more than needed agrees with is used.
        """
        dim = len(start.solution) - 1
        range_m = np.mean([np.linalg.norm(o.anchor_m[:dim] - start.solution[:dim]) for o in start.used])
        curvature_m = 0.5 * np.trace(start.covariance[:2, :2]) / range_m
        if curvature_m**2 < self._variance_m2 + self._error_variance_m2:
            return start
        if self._wide_ticks is None:
            self._wide_ticks = start.rx_ticks_tag
        waited_s = (start.rx_ticks_tag - self._wide_ticks) * TICK_S
        is_checked = len(start.used) > len(start.solution)
        return start if is_checked and waited_s > TUNING.start_patience_s else NoFixReason.ACQUIRING

    def _solve_without_one(self, pairs: list[list[Observation]], now: int) -> Start | NoFixReason:
        """If exactly one anchor contradicts all others, leave it out. The others must still be able to contradict.

        If there is no such anchor for half a second, start from all of them as they are.
        """
        if self._contradicted_ticks is None:
            self._contradicted_ticks = now
        results = [self._solve(pairs[:k] + pairs[k + 1 :], now) for k in range(len(pairs))]
        starts = [
            msgspec.structs.replace(result, is_contradicted=True, misfitting=(pairs[k][0].anchor,))
            for k, result in enumerate(results)
            if isinstance(result, Start)
        ]
        if len(starts) == 1:
            return starts[0]
        if (now - self._contradicted_ticks) * TICK_S < TUNING.start_patience_s:
            return NoFixReason.RESIDUALS
        result = self._solve(pairs, now, residual_tail=0.0)
        return msgspec.structs.replace(result, is_contradicted=True) if isinstance(result, Start) else result

    def _solve(
        self, pairs: list[list[Observation]], now: int, residual_tail: float | None = None
    ) -> Start | NoFixReason:
        base = _offset_ticks(pairs[0][-1])[0]
        rates = np.array([_clock_rate(first, second) for first, second in pairs])
        intervals = np.array([(second.rx_ticks_tag - first.rx_ticks_tag) * TICK_S for first, second in pairs])
        rate = float(np.median(rates))
        rate_variance = 2.0 * self._variance_m2 / float(np.min(intervals)) ** 2 + self._speed_std_mps**2
        newest = [second for _, second in pairs]
        ages_s = np.array([(now - o.rx_ticks_tag) * TICK_S for o in newest])
        pseudoranges = np.array([_pseudorange_m(o, base) for o in newest]) + rate * ages_s
        variances = np.array([o.rx_variance_factor * self._variance_m2 + o.tx_variance_m2 for o in newest])
        variances += self._error_variance_m2 + ages_s**2 * (rate_variance / len(pairs) + self._speed_std_mps**2)
        result = locate_pseudoranges(
            np.array([o.anchor_m for o in newest]),
            pseudoranges,
            variances,
            height_m=self._height_m,
            z_bounds_m=self._z_bounds_m,
            residual_tail=TUNING.start_tail if residual_tail is None else residual_tail,
        )
        if isinstance(result, NoSolution):
            return result.reason
        dim = 3 if self._height_m is None else 2
        solution = np.append(result.position_m[:dim], result.bias_m)
        return Start(tuple(newest), now, solution, result.covariance_joint_m2)


def _offset_ticks(observation: Observation) -> tuple[int, float]:
    """Tag's reading minus the master's TX time: whole ticks and the fraction to subtract."""
    assert observation.tx_ticks_master is not None
    return observation.rx_ticks_tag - observation.tx_ticks_master, observation.tx_fraction_ticks


def _pseudorange_m(observation: Observation, base_ticks: int) -> float:
    whole, fraction = _offset_ticks(observation)
    return (whole - base_ticks - fraction) * TICK_M


def _clock_rate(first: Observation, second: Observation) -> float:
    """Rate of the tag's clock against the master's in m/s, from two messages of one anchor."""
    change_m = _pseudorange_m(second, _offset_ticks(first)[0]) - _pseudorange_m(first, _offset_ticks(first)[0])
    return change_m / ((second.rx_ticks_tag - first.rx_ticks_tag) * TICK_S)


def _possible(first: Observation, second: Observation) -> bool:
    """Whether a crystal can have sent both messages of an anchor."""
    if second.rx_ticks_tag <= first.rx_ticks_tag:
        return False
    return abs(_clock_rate(first, second)) <= MAX_DRIFT * SPEED_OF_LIGHT_MPS


def _rate(first: Observation, second: Observation, variance_m2: float) -> tuple[float, float]:
    """How much faster an anchor's clock runs than the tag's, as a fraction, and the variance of that in m²/s²."""
    elapsed = second.rx_ticks_tag - first.rx_ticks_tag
    if elapsed <= 0:
        return 0.0, 0.0
    rate = (second.tx_ticks_anchor - first.tx_ticks_anchor - elapsed) / elapsed
    return rate, 2.0 * variance_m2 / (elapsed * TICK_S) ** 2
