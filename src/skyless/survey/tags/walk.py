"""Rows of a survey from a tag's ranges, with the tag's own positions and clocks eliminated (``docs/survey.md``).

In epoch k the range to anchor j is ``|p_k − a_j| + h_j + o_j + s·ln(|p_k − a_j| / 3 m) + c_k``. The tag's position p_k
and clock c_k are free in every epoch; the anchor's own constant o_j and the slope s, both from the strength of signals,
are the same in all. What remains once these are eliminated (Schur complement) constrains the anchors' positions and
delays h.
"""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Mask
from skyless.survey.tags.epochs import TagEpochs

TAG_STD_M: Final = 0.1
"""Of a range in one epoch. Noise and reflections make 0.07 m, but some reflections return with each round through a
room: with 0.07 m, flights of four minutes spoil a room's horizontal positions by a fifth (test_walk.py)."""

_LEAST_SCALE_M: Final = 0.05
"""Of residuals, where ranges are looked for that do not fit."""

_LEAST_FREE: Final = 0.05
"""Least part of a range's error that is assumed to show in its residual."""

_SLOPE_M: Final = 0.025
_SLOPE_STD_M: Final = 0.03
"""Between none, and 0.05 m of a typical DW1000 (docs/calibration.md)."""

_SLOPE_RANGE_M: Final = 3.0
_NEAREST_M: Final = 0.3
_INNER_STEPS: Final = 30
_SMALLEST_CHANGE: Final = 1e-9
_LONGEST_STEP_M: Final = 2.0
_SINGULAR: Final = 1e-9
_GRID: Final = 9
"""Positions along each horizontal axis from which an epoch may start."""

_ELSEWHERE_M: Final = 2.0
"""If an anchor has moved by more since the last evaluation, it is another result: the tag's positions start again."""

_LEVELS: Final = 5
"""Heights from which a walk may start; all of its epochs start at one."""


class WalkRows:
    """A tag's ranges as rows of a problem; the tag's positions are the start of the next evaluation."""

    def __init__(self, epochs: TagEpochs, range_m: Array, position_m: Array) -> None:
        """``range_m``: of ``tag_ranges`` with the problem's anchors as columns, shape (k, n); NaN where none.

        ``position_m``: of the anchors, shape (n, 3), as a start.
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
        """Positions, delays and ranges in use of the latest rows, and these."""

    @property
    def epochs(self) -> int:
        """Number of epochs in use."""
        return int(self.used.any(axis=1).sum())

    @property
    def excluded_share(self) -> float:
        """Part of the ranges that is not in use."""
        return 1.0 - float(self.used.sum()) / max(int(self.measured.sum()), 1)

    @property
    def freedom(self) -> int:
        """Ranges in use less the unknowns of the tag."""
        busy = self.used.any(axis=1)
        return int(self.used.sum() - (self._fewest[busy] - 1).sum())

    def residuals_m(self, position_m: Array, delay_m: Array) -> Array:
        """Measured less modelled ranges with the latest positions of the tag, shape (k, n); 0 where none was made."""
        distance = self._distances(position_m)
        model = distance + delay_m + self._offset_m + self._slope_m * np.log(distance / _SLOPE_RANGE_M)
        return np.asarray(np.where(self.measured, self._range_m - model - self._clock_m[:, None], 0.0))

    def exclude_beyond(self, position_m: Array, delay_m: Array, limit: float) -> None:
        """Exclude of each epoch the range that fits worst, if it is off by more than ``limit`` standard deviations.

        Residuals are scaled up by what the tag's free position and clock take out of them.
        """
        local, _, residual = self._derivatives(position_m, delay_m)
        inverse = self._inverse_local(local)
        leverage = np.einsum("kjl,klm,kjm->kj", local, inverse, local) / TAG_STD_M**2
        away = np.abs(residual) / np.sqrt(np.maximum(1.0 - leverage, _LEAST_FREE))
        typical = 1.4826 * float(np.median(away[self.used])) if self.used.any() else 0.0
        worst = (away == away.max(axis=1, initial=0.0, keepdims=True)) & (away > limit * max(_LEAST_SCALE_M, typical))
        if (worst & self.used).any():
            self.used = self._with_enough(self.used & ~worst)

    def rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array]:
        """Jacobian and residuals as ``MoreRows`` has them; the last residual is what no position changes."""
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
        """Gauss–Newton for the tag's positions, clocks and constants while the anchors stay."""
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
        """By tag and clock, (k, n, 4); by constants and slope, (k, n, n + 1); residuals, (k, n), 0 where not in use."""
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
        """Normal matrix and gradient of ``whole``'s g columns without tag and clocks; and what gives these back."""
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
        """Covariance of tag and clock in each epoch while all else is known, shape (k, 4, 4)."""
        normal = np.einsum("kjl,kj,kjm->klm", local, self.used / TAG_STD_M**2, local)
        diagonal = np.arange(3)
        normal[:, diagonal, diagonal] += self._prior
        return np.asarray(np.linalg.pinv(normal, rcond=_SINGULAR, hermitian=True))

    def _constants_prior(self) -> tuple[Array, Array]:
        """Information on constants and slope, and how far they are from what is expected, each (n + 1,)."""
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
        """Without epochs that have no more ranges than unknowns."""
        return np.asarray(usable & (usable.sum(axis=1) >= self._fewest)[:, None])

    def _start(self, position_m: Array) -> Array:
        """The tag in each epoch, shape (k, 3): the best of a grid, all epochs on that level which fits best."""
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
    """Rows whose normal equations these are, and whose squared residuals sum up to the cost."""
    values, vectors = np.linalg.eigh(information)
    kept = values > _SINGULAR * values.max(initial=0.0)
    root = np.sqrt(values[kept])
    jacobian = root[:, None] * vectors[:, kept].T
    residual = (vectors[:, kept].T @ gradient) / root
    rest = np.sqrt(max(cost - float(residual @ residual), 0.0))
    return np.vstack([jacobian, np.zeros((1, len(information)))]), np.append(residual, rest)
