"""Contribution to a survey of a tag that is carried around or stands at known positions (``docs/survey.md``).

In epoch k the range to anchor j is ``|p_k − a_j| + h_j + o_j + s·ln(|p_k − a_j| / 3 m) + c_k``. The tag's position p_k
and clock c_k are free in every epoch; the anchor's own constant o_j and the slope s, both due to signal strength, are
the same in all. After these are eliminated (Schur complement), the rest constrains the anchors' positions and delays h.
"""

from array import array
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from skyless.core.arrays import Array, Integers, Mask, Vector
from skyless.site.survey.facts import TagReceived
from skyless.site.survey.fit import LATE_CUTOFF
from skyless.site.survey.legs import STD_OVER_MAD, group_medians
from skyless.site.survey.problem import Problem, Solution, distances_m, solve_least_squares, unknown_columns

# Differences, averaged over epochs of half a second


EPOCH_S: Final = 0.5
"""Reflections change within half a second of carrying a tag, so the errors of two epochs count as independent."""

WALK_OFFSET_STD_M: Final = 0.07
"""Standard deviation of the constant by which an anchor's delay differs between a tag's ranges and those of anchors:
stamps of strong signals are early (APS011), and signals between anchors are stronger or weaker than at a tag."""

_MAX_SAMPLES: Final = 2_000_000  # twenty minutes of a site with 12 anchors; later samples are not used
_LONE_STD_M: Final = 0.07  # of a single difference, for its weight against the velocity's prior
_FLOOR_COUNT: Final = 20
"""More samples of a pair in one epoch do not increase its weight, as their common errors exceed their noise."""

_SPEED_STD_MPS: Final = 1.5
_REJECT: Final = 4.0
_HUBER_M: Final = 0.1
_HUBER_ROUNDS: Final = 4


class TagEpochs(TagReceived, frozen=True, eq=False):
    """One tag's differences to ``n`` anchors in ``k`` epochs: ``r`` means, each over an epoch and a pair of anchors.

    A difference is the range to ``second`` less that to ``first``, both with their delays h, plus the pair's range as
    measured by the anchors: ``second`` has received ``first`` and sent its stamp of that. ``tag_ranges`` subtracts the
    pair's range, which has the same errors.
    """

    anchors: tuple[int, ...]
    """In ascending order."""
    t_s: Vector
    """Shape (k,): middle of each epoch."""
    epoch: Integers
    first: Integers
    second: Integers
    """Shape (r,): indices."""
    difference_m: Vector
    since_s: Vector
    """Shape (r,): mean time of a difference's samples relative to the middle of its epoch."""
    count: Integers
    """Shape (r,): samples in the mean."""
    known_m: Array
    """Shape (k, 3): known coordinates of the tag, NaN where unknown."""
    known_std_m: tuple[float, float, float] = (0.01, 0.01, 0.01)
    offset_std_m: float = WALK_OFFSET_STD_M
    """Standard deviation of each anchor's own constant at the tag, beyond its delay."""
    name: str = "the walk"
    """For sentences."""


class EpochCollector:
    """Gathers a tag's differences and averages them over epochs."""

    def __init__(self) -> None:
        self._times, self._values = array("d"), array("d")
        self._firsts, self._seconds = array("q"), array("q")

    def add(self, t_s: float, first: int, second: int, difference_m: float) -> None:
        """Add one sample: the range to ``second`` less that to ``first``."""
        if len(self._times) < _MAX_SAMPLES:
            self._times.append(t_s)
            self._firsts.append(first)
            self._seconds.append(second)
            self._values.append(difference_m)

    def epochs(self) -> TagEpochs:
        """Means per epoch and pair, without samples far from the median of their pair and epoch."""
        t_s, value_m = np.array(self._times), np.array(self._values)
        ids = np.array([self._firsts, self._seconds], dtype=np.int64).reshape(2, -1)
        anchors = np.unique(ids)
        first, second = np.searchsorted(anchors, ids)
        number = np.floor((t_s - t_s.min(initial=np.inf)) / EPOCH_S).astype(np.int64) if len(t_s) else ids[0]
        numbers, epoch = np.unique(number, return_inverse=True)
        middle_s = t_s.min(initial=np.inf) + (numbers + 0.5) * EPOCH_S if len(t_s) else t_s
        n = max(len(anchors), 1)
        group, group_of = np.unique((epoch * n + first) * n + second, return_inverse=True)
        median = group_medians(group_of, value_m, len(group))
        away = np.abs(value_m - median[group_of])
        scale = np.maximum(STD_OVER_MAD * group_medians(group_of, away, len(group)), 0.02)
        kept = away <= _REJECT * scale[group_of]
        group_of, value_m, since_s = group_of[kept], value_m[kept], (t_s - middle_s[epoch])[kept]
        count = np.bincount(group_of, minlength=len(group))
        sums = (np.bincount(group_of, one, len(group)) for one in (value_m, since_s))
        mean_m, mean_s = (total / np.maximum(count, 1) for total in sums)
        return TagEpochs(
            tuple(anchors.tolist()),
            middle_s,
            group // (n * n),
            group // n % n,
            group % n,
            mean_m,
            mean_s,
            count,
            np.full((len(middle_s), 3), np.nan),
        )


def tag_ranges(epochs: TagEpochs, pair_ranges_m: Mapping[tuple[int, int], float]) -> Array:
    """Ranges to all anchors in each epoch, up to one constant per epoch, shape (k, n); NaN where there are none.

    ``pair_ranges_m``: ranges between anchors, by identifiers in ascending order. Differences of other pairs are not
    used. Anchors that an epoch's differences do not link to its largest group are NaN.
    """
    k, n = len(epochs.t_s), len(epochs.anchors)
    of_pair = np.full((n, n), np.nan)
    for i, a in enumerate(epochs.anchors):
        for j, b in enumerate(epochs.anchors):
            of_pair[i, j] = pair_ranges_m.get((min(a, b), max(a, b)), np.nan)
    value_m = epochs.difference_m - of_pair[epochs.first, epochs.second]
    known = np.isfinite(value_m)
    epoch, first, second, value_m = epochs.epoch[known], epochs.first[known], epochs.second[known], value_m[known]
    since_s, count = epochs.since_s[known], epochs.count[known]
    joined = _largest_part(epoch * n + first, epoch * n + second, k, n)
    strength = np.minimum(count, _FLOOR_COUNT) / _LONE_STD_M**2
    columns = np.stack([first, second, n + first, n + second], axis=1)
    factors = np.stack([-np.ones(len(first)), np.ones(len(first)), -since_s, since_s], axis=1)
    solution: Array = np.zeros((k, 2 * n))
    weight = strength
    for _ in range(_HUBER_ROUNDS):
        normal = np.zeros((k, 2 * n, 2 * n))
        diagonal = np.arange(2 * n)
        normal[:, diagonal[:n], diagonal[:n]] = 1e-4
        normal[:, diagonal[n:], diagonal[n:]] = 1.0 / _SPEED_STD_MPS**2
        right = np.zeros((k, 2 * n))
        for i in range(4):
            np.add.at(right, (epoch, columns[:, i]), weight * factors[:, i] * value_m)
            for j in range(4):
                np.add.at(normal, (epoch, columns[:, i], columns[:, j]), weight * factors[:, i] * factors[:, j])
        solution = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])
        model_m = (factors * np.take_along_axis(solution[epoch], columns, axis=1)).sum(axis=1)
        away = np.abs(value_m - model_m)
        weight = strength * np.minimum(1.0, _HUBER_M / np.maximum(away, _HUBER_M))
    return np.where(joined, solution[:, :n], np.nan)


def _largest_part(first: Integers, second: Integers, k: int, n: int) -> Array:
    """Mask of the anchors in their epoch's largest group linked by differences, shape (k, n)."""
    edges = coo_array((np.ones(len(first)), (first, second)), shape=(k * n, k * n))
    label = connected_components(edges, directed=False)[1]
    size = np.bincount(label, minlength=k * n)
    of_node = size[label].reshape(k, n)
    most = of_node.max(axis=1, initial=0, keepdims=True)
    chosen = np.where(of_node == most, label.reshape(k, n), k * n).min(axis=1, initial=k * n, keepdims=True)
    return np.asarray((label.reshape(k, n) == chosen) & (most > 1))


# Rows of the fit


TAG_STD_M: Final = 0.1
"""Standard deviation of a range in one epoch. Noise and reflections give 0.07 m, but some reflections recur with each
round through a room: with 0.07 m, flights of four minutes worsen a room's horizontal positions by a fifth."""

_MIN_SCALE_M: Final = 0.05  # least scale of residuals in the search for outliers
_MIN_FREE: Final = 0.05  # least share of a range's error assumed to show in its residual
_SLOPE_M: Final = 0.025
_SLOPE_STD_M: Final = 0.03  # covers no slope as well as the 0.05 m of a typical DW1000 (docs/calibration.md)
_SLOPE_RANGE_M: Final = 3.0
_NEAREST_M: Final = 0.3
_INNER_STEPS: Final = 30
_SMALLEST_CHANGE: Final = 1e-9
_LONGEST_STEP_M: Final = 2.0
_SINGULAR: Final = 1e-9
_GRID: Final = 9  # positions along each horizontal axis from which an epoch may start
_ELSEWHERE_M: Final = 2.0
"""If an anchor has moved by more since the last evaluation, the result is a different one: the tag starts again."""

_LEVELS: Final = 5  # heights from which a walk may start; all of its epochs start at one


class WalkRows:
    """A tag's ranges as rows of a problem; each evaluation starts at the tag's positions of the one before."""

    def __init__(self, epochs: TagEpochs, range_m: Array, position_m: Array) -> None:
        """``range_m``: from ``tag_ranges``, with the problem's anchors as columns, shape (k, n); NaN where none.

        ``position_m``: positions of the anchors as a start, shape (n, 3).
        """
        self._known_m = epochs.known_m
        self._prior = np.where(np.isfinite(epochs.known_m), 1.0 / np.array(epochs.known_std_m) ** 2, 0.0)
        self._fewest = 2 + (self._prior == 0.0).sum(axis=1)
        self.measured = self._with_enough(np.isfinite(range_m))
        self.used: Mask = self.measured
        self._range_m = np.where(self.used, range_m, 0.0)
        self._offset_std_m = epochs.offset_std_m
        self._offset_m, self._slope_m = np.zeros(range_m.shape[1]), _SLOPE_M
        self._clock_m = np.zeros(len(range_m))
        self.tag_m = self._start(position_m)
        self.cost = 0.0
        self._latest: tuple[Array, Array, Mask, tuple[Array, Array]] | None = None
        """Positions, delays, ranges in use, and the rows of the latest evaluation."""

    @property
    def epochs(self) -> int:
        """Number of epochs in use."""
        return int(self.used.any(axis=1).sum())

    @property
    def excluded_share(self) -> float:
        """Share of the ranges not in use."""
        return 1.0 - float(self.used.sum()) / max(int(self.measured.sum()), 1)

    @property
    def freedom(self) -> int:
        """Ranges in use less the unknowns of the tag."""
        busy = self.used.any(axis=1)
        return int(self.used.sum() - (self._fewest[busy] - 1).sum())

    def residuals_m(self, position_m: Array, delay_m: Array) -> Array:
        """Measured less modelled ranges at the latest tag positions, shape (k, n); 0 where none was measured."""
        distance = self._distances(position_m)
        model = distance + delay_m + self._offset_m + self._slope_m * np.log(distance / _SLOPE_RANGE_M)
        return np.asarray(np.where(self.measured, self._range_m - model - self._clock_m[:, None], 0.0))

    def exclude_beyond(self, position_m: Array, delay_m: Array, limit: float) -> None:
        """Exclude each epoch's worst range if it is off by more than ``limit`` standard deviations.

        Residuals are scaled up by the share that the tag's free position and clock absorb.
        """
        local, _, residual = self._derivatives(position_m, delay_m)
        inverse = self._inverse_local(local)
        leverage = np.einsum("kjl,klm,kjm->kj", local, inverse, local) / TAG_STD_M**2
        away = np.abs(residual) / np.sqrt(np.maximum(1.0 - leverage, _MIN_FREE))
        typical = STD_OVER_MAD * float(np.median(away[self.used])) if self.used.any() else 0.0
        worst = (away == away.max(axis=1, initial=0.0, keepdims=True)) & (away > limit * max(_MIN_SCALE_M, typical))
        if (worst & self.used).any():
            self.used = self._with_enough(self.used & ~worst)

    def rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array]:
        """Jacobian and residuals as in ``MoreRows``; the last residual is the cost that no position changes."""
        if self._latest is not None:
            before_m, before_delay_m, used, rows = self._latest
            if used is self.used and np.array_equal(before_m, position_m) and np.array_equal(before_delay_m, delay_m):
                return rows
            if np.abs(before_m - position_m).max() > _ELSEWHERE_M:
                self.tag_m = self._start(position_m)
        rows = self._rows(position_m, delay_m)
        self._latest = position_m.copy(), delay_m.copy(), self.used, rows
        return rows

    def _rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array]:
        n = len(position_m)
        self._locate_tag(position_m, delay_m)
        local, constants, residual = self._derivatives(position_m, delay_m)
        anchors = np.zeros((*residual.shape, 4 * n))
        column = np.arange(n)
        for axis in range(3):
            anchors[:, column, 3 * column + axis] = -local[:, :, axis]
        anchors[:, column, 3 * n + column] = 1.0
        normal, gradient, _ = self._eliminated(local, np.concatenate([anchors, constants], axis=2), residual)
        prior, missing_m = self._constants_prior()
        normal[4 * n :, 4 * n :] += np.diag(prior)
        gradient[4 * n :] += prior * missing_m
        gain = np.linalg.solve(normal[4 * n :, 4 * n :], normal[4 * n :, : 4 * n])
        information = normal[: 4 * n, : 4 * n] - normal[: 4 * n, 4 * n :] @ gain
        self.cost = self._cost(residual)
        return _square_root(information, gradient[: 4 * n] - gain.T @ gradient[4 * n :], self.cost)

    def _locate_tag(self, position_m: Array, delay_m: Array) -> None:
        """Gauss–Newton for the tag's positions, clocks and constants with fixed anchors."""
        before = np.inf
        for _ in range(_INNER_STEPS):
            local, constants, residual = self._derivatives(position_m, delay_m)
            normal, gradient, (inverse, cross, right) = self._eliminated(local, constants, residual)
            prior, missing_m = self._constants_prior()
            common = np.linalg.solve(normal + np.diag(prior), gradient + prior * missing_m)
            step = np.einsum("klm,km->kl", inverse, right - cross @ common)
            length = np.sqrt((step[:, :3] ** 2).sum(axis=1))
            step *= np.minimum(1.0, _LONGEST_STEP_M / np.maximum(length, 1e-12))[:, None]
            self.tag_m += step[:, :3]
            self._clock_m += step[:, 3]
            self._offset_m = self._offset_m + common[:-1]
            self._slope_m += float(common[-1])
            cost = self._cost(self.residuals_m(position_m, delay_m) * self.used)
            if abs(before - cost) <= _SMALLEST_CHANGE * (1.0 + cost):
                return
            before = cost

    def _derivatives(self, position_m: Array, delay_m: Array) -> tuple[Array, Array, Array]:
        """Derivatives by tag and clock, (k, n, 4), by constants and slope, (k, n, n + 1), and residuals, (k, n).

        Residuals of ranges not in use are 0.
        """
        k, n = self.used.shape
        distance = self._distances(position_m)
        growth = (1.0 + self._slope_m / distance) / distance
        local = np.ones((k, n, 4))
        local[:, :, :3] = (self.tag_m[:, None, :] - position_m[None, :, :]) * growth[:, :, None]
        constants = np.zeros((k, n, n + 1))
        constants[:, np.arange(n), np.arange(n)] = 1.0
        constants[:, :, n] = np.log(distance / _SLOPE_RANGE_M)
        return local, constants, self.residuals_m(position_m, delay_m) * self.used

    def _eliminated(
        self, local: Array, whole: Array, residual: Array
    ) -> tuple[Array, Array, tuple[Array, Array, Array]]:
        """Normal matrix and gradient of ``whole``'s g columns after eliminating tag and clocks.

        Also returns the terms from which tag and clocks can be computed again.
        """
        weight = self.used / TAG_STD_M**2
        inverse = self._inverse_local(local)
        right = np.einsum("kjl,kj->kl", local, weight * residual)
        right[:, :3] += self._prior * np.where(self._prior > 0.0, self._known_m - self.tag_m, 0.0)
        weighted = whole * weight[:, :, None]
        cross = np.swapaxes(local, 1, 2) @ weighted
        inner = inverse @ cross
        columns = whole.shape[2]
        flat = whole.reshape(-1, columns)
        normal = weighted.reshape(-1, columns).T @ flat - cross.reshape(-1, columns).T @ inner.reshape(-1, columns)
        gradient = weighted.reshape(-1, columns).T @ residual.ravel() - np.einsum("klg,kl->g", inner, right)
        return normal, gradient, (inverse, cross, right)

    def _inverse_local(self, local: Array) -> Array:
        """Covariance of tag and clock in each epoch given everything else, shape (k, 4, 4)."""
        normal = np.einsum("kjl,kj,kjm->klm", local, self.used / TAG_STD_M**2, local)
        diagonal = np.arange(3)
        normal[:, diagonal, diagonal] += self._prior
        return np.asarray(np.linalg.pinv(normal, rcond=_SINGULAR, hermitian=True))

    def _constants_prior(self) -> tuple[Array, Array]:
        """Prior information on constants and slope, and expected less current values, each (n + 1,)."""
        prior = np.append(np.full(len(self._offset_m), self._offset_std_m**-2), _SLOPE_STD_M**-2)
        return prior, np.append(-self._offset_m, _SLOPE_M - self._slope_m)

    def _cost(self, residual: Array) -> float:
        prior, missing_m = self._constants_prior()
        known = self._prior * np.where(self._prior > 0.0, self._known_m - self.tag_m, 0.0) ** 2
        return float((residual**2).sum() / TAG_STD_M**2 + known.sum() + prior @ missing_m**2)

    def _distances(self, position_m: Array) -> Array:
        apart = self.tag_m[:, None, :] - position_m[None, :, :]
        return np.asarray(np.maximum(np.sqrt(np.einsum("kja,kja->kj", apart, apart)), _NEAREST_M))

    def _with_enough(self, usable: Mask) -> Mask:
        """The mask without epochs that have too few ranges."""
        return np.asarray(usable & (usable.sum(axis=1) >= self._fewest)[:, None])

    def _start(self, position_m: Array) -> Array:
        """Start of the tag in each epoch, shape (k, 3): the best of a grid, with all epochs on the best level."""
        low, high = position_m.min(axis=0), position_m.max(axis=0)
        size = float((high - low)[:2].max())
        across = [np.linspace(low[axis] - 0.1 * size, high[axis] + 0.1 * size, _GRID) for axis in (0, 1)]
        levels = np.linspace(low[2] - 0.5 * size, high[2] + 0.5 * size, _LEVELS)
        count = np.maximum(self.used.sum(axis=1), 1)
        best_cost, best = np.inf, np.zeros((len(self.used), 3))
        for z_m in levels:
            chosen, chosen_cost = np.zeros_like(best), np.full(len(best), np.inf)
            for x_m, y_m in ((x_m, y_m) for x_m in across[0] for y_m in across[1]):
                self.tag_m = np.where(self._prior > 0.0, self._known_m, np.array([x_m, y_m, z_m]))
                short_m = np.where(self.used, self._range_m - self._distances(position_m), 0.0)
                away = np.where(self.used, short_m - (short_m.sum(axis=1) / count)[:, None], 0.0)
                cost = (away**2).sum(axis=1)
                better = cost < chosen_cost
                chosen[better], chosen_cost[better] = self.tag_m[better], cost[better]
            if chosen_cost.sum() < best_cost:
                best_cost, best = float(chosen_cost.sum()), chosen
        self.tag_m = best
        short_m = np.where(self.used, self._range_m - self._distances(position_m), 0.0)
        self._clock_m = short_m.sum(axis=1) / count
        return best


def _square_root(information: Array, gradient: Array, cost: float) -> tuple[Array, Array]:
    """Jacobian and residuals that have these normal equations and this sum of squares."""
    values, vectors = np.linalg.eigh(information)
    kept = values > _SINGULAR * values.max(initial=0.0)
    root = np.sqrt(values[kept])
    jacobian = root[:, None] * vectors[:, kept].T
    residual = (vectors[:, kept].T @ gradient) / root
    rest = np.sqrt(max(cost - float(residual @ residual), 0.0))
    return np.vstack([jacobian, np.zeros((1, len(information)))]), np.append(residual, rest)


# Ranges of anchors and of a tag in one fit


_FEWEST_EPOCHS: Final = 10
_LIMIT: Final = 4.0  # standard deviations beyond which a tag's range is not used
_MAX_EXCLUDED: Final = 0.2
_FALSE_ALARM: Final = 1e-4  # probability that the chi-squared tests reject a walk that fits
_RANGES_PER_INDEPENDENT: Final = 4.0
"""Residuals of a walk are tested as if only every fourth range were independent, as reflections outlast an epoch."""

_CLEARLY: Final = 16.0  # a result whose cost is higher by more than this is ruled out
_EXCLUSION_ROUNDS: Final = 6
_SAME_M: Final = 0.02  # two results whose distances all differ by less are one


class JointFit(Struct, frozen=True, eq=False):
    """Result of a fit with a walk."""

    solution: Solution | None
    """Solution with the walk; None if it was not used."""
    chosen: int
    """Number of the start that led to ``solution``."""
    possible: tuple[int, ...]
    """Starts that the walk does not rule out, including ``chosen``; all if the walk was not used."""
    sentence: str
    """How the walk was used, or why not."""
    rows: WalkRows | None
    """For further fits from ``solution``: ``replace(problem, more=(*problem.more, rows))``."""


class _Trial(Struct, frozen=True, eq=False):
    solution: Solution
    rows: WalkRows
    cost: float
    """Including unused ranges of the tag and of anchors, each with the cost at its limit."""


def fit_with_tag(
    problem: Problem,
    anchors: Sequence[int],
    alone: Sequence[Solution],
    epochs: TagEpochs,
    pair_ranges_m: Mapping[tuple[int, int], float],
    used: Sequence[Mask] = (),
) -> JointFit:
    """Fit ranges and tag together, starting from each result of the ranges ``alone``, best first.

    The first result is kept unless the tag clearly contradicts it. ``anchors``: identifiers in the problem's order.
    ``pair_ranges_m``: see ``tag_ranges``. ``used``: ranges in use in each result; by default all.
    """
    everything, name = tuple(range(len(alone))), epochs.name
    by_anchor = dict(zip(epochs.anchors, tag_ranges(epochs, pair_ranges_m).T, strict=True))
    nothing = np.full(len(epochs.t_s), np.nan)
    range_m = np.column_stack([by_anchor.get(anchor, nothing) for anchor in anchors])
    in_use = used or [np.ones(len(problem.range_m), dtype=bool)] * len(alone)
    trials = [
        _trial(problem, start.position_m, epochs, range_m, mask) for start, mask in zip(alone, in_use, strict=True)
    ]
    least = min(trial.cost for trial in trials)
    possible = tuple(number for number in everything if trials[number].cost <= least + _CLEARLY)
    chosen = 0 if 0 in possible else min(possible, key=lambda number: trials[number].cost)
    best = trials[chosen]
    reason = _unfit(problem, alone[chosen], best)
    if reason is not None:
        return JointFit(None, 0, everything, f"what {name} received was not used: {reason}", None)
    apart_m = [distances_m(trial.solution.position_m) - distances_m(best.solution.position_m) for trial in trials]
    apart = [number for number in possible if number == chosen or np.abs(apart_m[number]).max() >= _SAME_M]
    seconds, excluded = best.rows.epochs * EPOCH_S, best.rows.excluded_share
    sentence = f"{seconds:g} s of {name} were used" + (
        f"; {excluded:.0%} of its ranges were left out" if excluded else ""
    )
    return JointFit(best.solution, chosen, tuple(apart), sentence, best.rows)


def _trial(problem: Problem, start_m: Array, epochs: TagEpochs, range_m: Array, used: Mask) -> _Trial:
    rows = WalkRows(epochs, range_m, start_m)
    both = replace(problem, more=(*problem.more, rows))
    weight = used.astype(np.float64)
    solution = solve_least_squares(both, start_m, weight)
    for _ in range(_EXCLUSION_ROUNDS):
        before = rows.used
        rows.exclude_beyond(solution.position_m, solution.delay_m, _LIMIT)
        if rows.used is before:
            break
        solution = solve_least_squares(both, solution.position_m, weight)
    excluded = int(rows.measured.sum() - rows.used.sum())
    return _Trial(solution, rows, solution.cost + _LIMIT**2 * excluded + LATE_CUTOFF**2 * int((~used).sum()))


def _unfit(problem: Problem, alone: Solution, trial: _Trial) -> str | None:
    """Reason not to use ranges and walk together, or None."""
    rows, solution = trial.rows, trial.solution
    if rows.epochs < _FEWEST_EPOCHS:
        return f"only {rows.epochs} epochs of half a second have enough anchors; {_FEWEST_EPOCHS} are needed"
    if rows.excluded_share > _MAX_EXCLUDED:
        return f"{rows.excluded_share:.0%} of its ranges do not fit, as where anchors are not in sight"
    jacobian, _ = rows.rows(solution.position_m, solution.delay_m)
    independent = rows.freedom / _RANGES_PER_INDEPENDENT
    excess = rows.cost / max(rows.freedom, 1)
    if excess > chdtri(independent, _FALSE_ALARM) / independent:
        return f"its residuals are {np.sqrt(excess):.1f} times what they should be"
    n = len(solution.delay_m)
    unknown = unknown_columns(problem)
    of_walk = jacobian[:, unknown].T @ jacobian[:, unknown]
    of_ranges = solution.information - of_walk
    taken = np.linalg.matrix_rank(of_ranges, hermitian=True) - float(
        np.trace(np.linalg.pinv(solution.information, rcond=1e-12, hermitian=True) @ of_ranges)
    )
    rise = solution.cost - rows.cost - alone.cost
    checks = int(alone.residual_m.size + n - np.linalg.matrix_rank(of_ranges, hermitian=True))
    usual = max(1.0, alone.cost / checks) if checks > 0 else 1.0
    if rise > usual * chdtri(max(taken, 1.0), _FALSE_ALARM):
        return "it contradicts the ranges between the anchors"
    return None
