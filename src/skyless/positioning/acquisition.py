"""A cold start: position and clock from beacons alone, without a guess.

The tag's clock runs up to 20 ppm off, so pseudoranges of one superframe drift by tens of metres. Two messages of the
same anchor tell the drift; then all anchors' newest pseudoranges are carried to one time and solved in closed form.
"""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.constants import MAX_DRIFT, SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.positioning.fix import NoFixReason
from skyless.positioning.observation import Observation
from skyless.positioning.solver import NoSolution, locate_pseudoranges

MAX_AGE_S: Final = 0.5
"""Older messages no longer serve the start, unless superframes are so long; and then only for the rate of the clock, as
the tag may be elsewhere by now."""

WIDE: Final = 0.05
"""With a standard deviation above this part of the mean range, ranges are not linear in the state: updates would make
the filter sure of a wrong place. More anchors are waited for, ..."""

PATIENCE_S: Final = 0.5
"""... for so long after the first such start, and four times as long for one wider by four times."""

CONTRADICTIONS: Final = frozenset({NoFixReason.RESIDUALS, NoFixReason.BAD_GEOMETRY, NoFixReason.NOT_CONVERGED})
"""What one lying anchor makes of a start; absurd pseudoranges count as bad geometry."""

SPEED_STD_MPS: Final = 1.0
"""Typical speed of a tag; it smears pseudoranges taken at different times and starts the velocity."""

MAX_GAP_S: Final = 5.0
"""After a longer silence the state says less than a new start would."""

MAX_SPREAD: Final = 0.05
"""With a horizontal standard deviation above this part of the anchors' mean range, ranges are no longer linear in the
state: updates would make it confident of a wrong place, so a new start is better."""

SLOW_S: Final = 0.2
SLOW_SPREAD: Final = 0.2
"""Borne in longer superframes, where a new start takes seconds."""

SHORT_SILENCE_S: Final = 0.1
"""Over shorter silences no state grows much wider."""

EARLY_S: Final = 1.0
"""A filter that is lost so soon after its start may have a tag that is faster than assumed; ..."""

SPEED_STD_GROWTH: Final = 4.0
MAX_SPEED_STD_MPS: Final = 32.0
"""... the next start assumes a speed higher by this factor, up to this."""


class Start(Struct, frozen=True):
    """A first position, and the speed that is assumed of the tag."""

    used: tuple[Observation, ...]
    """The messages that it rests on, one of each anchor."""
    rx_ticks_tag: int
    solution: NDArray[np.float64]
    """[position (dim), clock offset], metres."""
    covariance: NDArray[np.float64]
    speed_variance: float


class Acquisition:
    """Gathers beacons until a start is possible."""

    def __init__(
        self,
        height_m: float | None,
        stamp_variance_m2: float,
        z_bounds_m: tuple[float, float] | None = None,
        max_age_s: float = MAX_AGE_S,
        speed_std_mps: float = SPEED_STD_MPS,
    ) -> None:
        self._max_age_s = max_age_s
        self._speed_variance = speed_std_mps**2
        self._height_m = height_m
        self._variance_m2 = stamp_variance_m2
        self._z_bounds_m = z_bounds_m
        self._heard: dict[int, list[Observation]] = {}
        self._hasty = speed_std_mps > SPEED_STD_MPS
        """A tag that is taken for fast: its speed makes a start wide, and more anchors do not help."""
        self._possible_ticks: int | None = None
        """When a start was first possible."""

    def hear(self, observation: Observation) -> Start | NoFixReason:
        """Take one observation; try to start each time an anchor comes around again."""
        now = observation.rx_ticks_tag
        for anchor, kept in list(self._heard.items()):
            if (now - kept[-1].rx_ticks_tag) * TICK_S > self._max_age_s:
                del self._heard[anchor]
        kept = self._heard.setdefault(observation.anchor, [])
        came_around = len(kept) == 2
        self._heard[observation.anchor] = [*kept[-1:], observation]
        pairs = [kept for kept in self._heard.values() if len(kept) == 2]
        pairs = [kept for kept in pairs if (now - kept[-1].rx_ticks_tag) * TICK_S < MAX_AGE_S]
        pairs = [kept for kept in self._on_one_scale(pairs) if _possible(*kept)]
        needed = 4 if self._height_m is None else 3
        if len(pairs) < needed:
            return NoFixReason.TOO_FEW_ANCHORS
        if not came_around:
            return NoFixReason.ACQUIRING
        result = self._solve(pairs, now)
        if isinstance(result, Start):
            return self._unless_wide(result)
        if result not in CONTRADICTIONS or len(pairs) <= needed + 1 or observation.anchor != pairs[0][-1].anchor:
            return result
        return self._solve_without_one(pairs, now)

    def _on_one_scale(self, pairs: list[list[Observation]]) -> list[list[Observation]]:
        """Messages whose TX times are all on one scale: as they are, on the master's."""
        return pairs

    def _unless_wide(self, start: Start) -> Start | NoFixReason:
        """Hold a start back while it is wide and more anchors may come."""
        if self._possible_ticks is None:
            self._possible_ticks = start.rx_ticks_tag
        waited_s = (start.rx_ticks_tag - self._possible_ticks) * TICK_S
        dim = len(start.solution) - 1
        ranges_m = [np.linalg.norm(o.anchor_m[:dim] - start.solution[:dim]) for o in start.used]
        spread = np.sqrt(np.trace(start.covariance[:2, :2])) / np.mean(ranges_m)
        patience_s = PATIENCE_S * min(spread / WIDE, 4.0) if spread > WIDE and not self._hasty else 0.0
        return start if waited_s >= patience_s else NoFixReason.ACQUIRING

    def _solve_without_one(self, pairs: list[list[Observation]], now: int) -> Start | NoFixReason:
        """Where one anchor alone contradicts all others, do without it; they must still be able to contradict."""
        results = [self._solve(pairs[:k] + pairs[k + 1 :], now) for k in range(len(pairs))]
        starts = [result for result in results if isinstance(result, Start)]
        return starts[0] if len(starts) == 1 else NoFixReason.RESIDUALS

    def _solve(self, pairs: list[list[Observation]], now: int) -> Start | NoFixReason:
        base = _offset_ticks(pairs[0][-1])[0]
        rates = np.array([_clock_rate(first, second) for first, second in pairs])
        intervals = np.array([(second.rx_ticks_tag - first.rx_ticks_tag) * TICK_S for first, second in pairs])
        rate = float(np.median(rates))
        rate_variance = 2.0 * self._variance_m2 / float(np.min(intervals)) ** 2 + self._speed_variance
        newest = [second for _, second in pairs]
        ages_s = np.array([(now - o.rx_ticks_tag) * TICK_S for o in newest])
        pseudoranges = np.array([_pseudorange_m(o, base) for o in newest]) + rate * ages_s
        variances = np.array([o.rx_variance_factor * self._variance_m2 + o.tx_variance_m2 for o in newest])
        variances += ages_s**2 * (rate_variance / len(pairs) + self._speed_variance)
        result = locate_pseudoranges(
            np.array([o.anchor_m for o in newest]),
            pseudoranges,
            variances,
            height_m=self._height_m,
            z_bounds_m=self._z_bounds_m,
        )
        if isinstance(result, NoSolution):
            return result.reason
        dim = 3 if self._height_m is None else 2
        solution = np.append(result.position_m[:dim], result.bias_m)
        return Start(
            tuple(newest),
            now,
            solution,
            result.covariance_joint_m2,
            self._speed_variance,
        )


def _offset_ticks(observation: Observation) -> tuple[int, float]:
    """Tag's reading minus the master's TX time: whole ticks and the fraction to take off."""
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
    """Whether two messages of one anchor are on one scale, that of a crystal."""
    if second.rx_ticks_tag <= first.rx_ticks_tag:
        return False
    return abs(_clock_rate(first, second)) <= MAX_DRIFT * SPEED_OF_LIGHT_MPS
