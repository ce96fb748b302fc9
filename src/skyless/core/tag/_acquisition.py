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

from skyless.core.constants import MAX_DRIFT, SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.core.fix import NoFixReason
from skyless.core.kernels.arrays import Array
from skyless.core.observation import Observation
from skyless.core.tag.locate import RESIDUAL_TAIL, RIVAL_MINIMUM_CHI2, NoSolution, locate_pseudoranges

# Older messages are not used for the start, unless superframes are longer; and then only for the rate of the clock,
# as the tag may be elsewhere by now.
START_MAX_AGE_S: Final = 0.5
# With a standard deviation above this part of the mean range, ranges are not linear in the state: updates would make
# the filter sure of a wrong position. It waits for more anchors: START_PATIENCE_S after the first such start, and four
# times as long for one wider by four times.
WIDE_START: Final = 0.05
WIDEST_START: Final = 1.0  # wider ones are not used at all: they would be tens of metres off
START_PATIENCE_S: Final = 0.5

CONTRADICTIONS: Final = frozenset({NoFixReason.RESIDUALS, NoFixReason.BAD_GEOMETRY, NoFixReason.NOT_CONVERGED})
"""How a start fails with one faulty anchor; absurd pseudoranges count as bad geometry."""

# Typical speed of a tag; it smears pseudoranges taken at different times and starts the velocity.
TAG_SPEED_STD_MPS: Final = 1.0
MAX_SILENCE_S: Final = 5.0  # after a longer silence the state is worse than a new start
# With a horizontal standard deviation above this part of the anchors' mean range, ranges are no longer linear in the
# state: updates would make it confident of a wrong position, so a new start is better.
MAX_RELATIVE_STD: Final = 0.05
# Accepted in longer superframes, where a new start takes seconds.
SLOW_S: Final = 0.2
SLOW_MAX_RELATIVE_STD: Final = 0.2
SHORT_SILENCE_S: Final = 0.1  # over shorter silences no state grows much wider
# A filter that is lost within this time of its start may have a tag that is faster than assumed: the next start assumes
# a speed higher by this factor, up to this.
EARLY_S: Final = 1.0
SPEED_STD_GROWTH: Final = 4.0
MAX_SPEED_STD_MPS: Final = 32.0


MAX_LINK_AGE_S: Final = 1.0  # older links are forgotten


class _Link(Struct, frozen=True):
    """Reading of one anchor's clock less that of another's, when the tag's read ``rx_ticks_tag``."""

    rx_ticks_tag: int
    ticks: int
    fraction_ticks: float


class _Scale(Struct, frozen=True):
    """How an anchor's TX times become those of the reference: the sum of links on the path to it."""

    ticks: int
    fraction_ticks: float
    rates_at: tuple[tuple[float, int], ...]
    """What each link lacks: a rate, and since which reading of the tag."""
    links: int


class Start(Struct, frozen=True):
    """A first position, and the speed that is assumed of the tag."""

    used: tuple[Observation, ...]
    """The messages that it uses, one of each anchor."""
    rx_ticks_tag: int
    solution: Array
    """[position (dim), clock offset], metres."""
    covariance: Array
    speed_variance: float
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
    """Assumed speed of the tag. A fast tag makes a start wide, and more anchors do not help."""
    _error_variance_m2: float = 0.0
    """Variance of survey and ranges. Rivals must differ by more, so that no mirror image is chosen."""
    _heard: dict[int, list[Observation]] = {}
    _possible_ticks: int | None = None
    """When a start was first possible."""
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
        pairs = [kept for kept in pairs if (now - kept[-1].rx_ticks_tag) * TICK_S < START_MAX_AGE_S]
        pairs = [kept for kept in self._on_one_scale(pairs) if _possible(*kept)]
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
            if (now - link.rx_ticks_tag) * TICK_S < max(MAX_LINK_AGE_S, self._max_age_s)
        }
        by_anchor = {pair[0].anchor: pair for pair in pairs}
        rates = {anchor: _rate(*pair) for anchor, pair in by_anchor.items()}
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

    def _reach(self, reference: int, rates: dict[int, float]) -> dict[int, _Scale]:
        """The scale of every anchor to which links lead, by as few of them as can be."""
        reached = {reference: _Scale(0, 0.0, (), 0)}
        queue = deque([reference])
        while queue:
            known = queue.popleft()
            for (listener, sender), link in self._links.items():
                if known not in (listener, sender):
                    continue
                other, sign = (sender, 1) if known == listener else (listener, -1)
                if other in reached or other not in rates:
                    continue
                scale = reached[known]
                reached[other] = _Scale(
                    scale.ticks + sign * link.ticks,
                    scale.fraction_ticks + sign * link.fraction_ticks,
                    (*scale.rates_at, (rates[known] - rates[other], link.rx_ticks_tag)),
                    scale.links + 1,
                )
                queue.append(other)
        return reached

    def _convert(self, packet: Observation, scale: _Scale) -> Observation:
        fraction = scale.fraction_ticks
        variance = 2.0 * scale.links * self._variance_m2
        for rate, rx_ticks in scale.rates_at:
            fraction += rate * (packet.rx_ticks_tag - rx_ticks)
        whole = int(np.floor(fraction))
        return msgspec.structs.replace(
            packet,
            tx_ticks_master=packet.tx_ticks_anchor + scale.ticks + whole,
            tx_fraction_ticks=fraction - whole,
            tx_variance_m2=variance,
        )

    def _unless_wide(self, start: Start) -> Start | NoFixReason:
        """Hold a start back while it is wide and more anchors may come."""
        if self._possible_ticks is None:
            self._possible_ticks = start.rx_ticks_tag
        waited_s = (start.rx_ticks_tag - self._possible_ticks) * TICK_S
        dim = len(start.solution) - 1
        ranges_m = [np.linalg.norm(o.anchor_m[:dim] - start.solution[:dim]) for o in start.used]
        relative_std = np.sqrt(np.trace(start.covariance[:2, :2])) / np.mean(ranges_m)
        patience_s = (
            START_PATIENCE_S * min(relative_std / WIDE_START, 4.0)
            if relative_std > WIDE_START and self._speed_std_mps <= TAG_SPEED_STD_MPS
            else 0.0
        )
        return start if waited_s >= patience_s and relative_std < WIDEST_START else NoFixReason.ACQUIRING

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
        if (now - self._contradicted_ticks) * TICK_S < START_PATIENCE_S:
            return NoFixReason.RESIDUALS
        result = self._solve(pairs, now, residual_tail=0.0)
        return msgspec.structs.replace(result, is_contradicted=True) if isinstance(result, Start) else result

    def _solve(
        self, pairs: list[list[Observation]], now: int, residual_tail: float = RESIDUAL_TAIL
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
        variances += ages_s**2 * (rate_variance / len(pairs) + self._speed_std_mps**2)
        result = locate_pseudoranges(
            np.array([o.anchor_m for o in newest]),
            pseudoranges,
            variances,
            height_m=self._height_m,
            z_bounds_m=self._z_bounds_m,
            residual_tail=residual_tail,
            rival_chi2=RIVAL_MINIMUM_CHI2 * (1.0 + self._error_variance_m2 / float(variances.min())),
        )
        if isinstance(result, NoSolution):
            return result.reason
        dim = 3 if self._height_m is None else 2
        solution = np.append(result.position_m[:dim], result.bias_m)
        return Start(tuple(newest), now, solution, result.covariance_joint_m2, self._speed_std_mps**2)


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


def _rate(first: Observation, second: Observation) -> float:
    """How much faster an anchor's clock runs than the tag's, as a fraction."""
    elapsed = second.rx_ticks_tag - first.rx_ticks_tag
    return (second.tx_ticks_anchor - first.tx_ticks_anchor - elapsed) / elapsed if elapsed > 0 else 0.0
