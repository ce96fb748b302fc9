"""Robust estimates of one constant per anchor from time differences at known positions, with honest standard errors.

A difference measures |p − b| − |p − a| + bias_b − bias_a (+ slope·ln(|p − b| / |p − a|)) + noise. With p known the
biases follow by linear regression with Huber's weights; residuals beyond four standard deviations are rejected. Only
differences of constants are observable, so their mean is set to zero.
"""

from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from skyless.core.arrays import Array, Integers, Mask, Vector
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration
from skyless.site.survey.legs import STD_OVER_MAD, group_medians

# Robust regression

_HUBER: Final = 1.345
"""Standard deviations up to which a residual has full weight: 95 % of the efficiency on Gaussian noise."""

_REJECT: Final = 4.0

_BLOCK_S: Final = 5.0
"""Reflections persist until a walker or a drone has moved a metre or two: errors within this time count as one."""

_FEWEST_BLOCKS: Final = 10

_MIN_MOTION: Final = 0.05
"""Change of the log ratios, beyond what constants explain, that is needed to estimate a slope."""


class Differences(Struct, frozen=True):
    """``n`` time differences at known positions."""

    t_s: Vector
    """Shape (n,), not decreasing."""
    anchor_a: Integers
    anchor_b: Integers
    excess_m: Vector
    """Measured difference less the geometric one."""
    log_ratio: Vector
    """ln(range to b / range to a)."""

    def select(self, rows: Mask | Integers) -> "Differences":
        """Select rows."""
        a, b = self.anchor_a[rows], self.anchor_b[rows]
        return Differences(self.t_s[rows], a, b, self.excess_m[rows], self.log_ratio[rows])


class Fit(Struct, frozen=True):
    """Result of a regression over ``m`` anchors and ``n`` differences."""

    anchors: Integers
    bias_m: Vector
    """Shape (m,), sum 0."""
    covariance_m2: Array
    """Shape (m, m), or (m + 1, m + 1) with the slope."""
    slope_m: float | None
    residual_m: Vector
    used: Mask
    scale_m: float
    a: Integers
    b: Integers
    counts: Integers


def fit(data: Differences, anchors: Integers, *, slope: bool) -> Fit:
    """Fit one constant per anchor, and a slope if wanted. The differences must link all anchors."""
    a, b = np.searchsorted(anchors, data.anchor_a), np.searchsorted(anchors, data.anchor_b)
    design = _design(a, b, data.log_ratio if slope else np.zeros(len(a)), len(anchors))
    pair, pairs = a * len(anchors) + b, len(anchors) ** 2
    # Each difference is first its pair's median: a start that outliers do not affect.
    medians = [group_medians(pair, data.excess_m, pairs, upper=upper) for upper in (False, True)]
    y = np.mean(medians, axis=0)[pair]
    weights = np.ones(len(a))
    for step in range(50):
        before = weights
        solution = np.linalg.solve(_normal(design, weights), design.T @ (weights * y))
        residual_m = data.excess_m - design @ solution
        scale_m = max(STD_OVER_MAD * float(np.median(np.abs(residual_m))), 1e-6)
        share = np.abs(residual_m) / scale_m
        weights = np.where(share <= _REJECT, np.minimum(1.0, _HUBER / np.maximum(share, _HUBER)), 0.0)
        y = data.excess_m
        if step and np.abs(weights - before).max() < 1e-6:
            break
    used = share <= _REJECT
    counts = np.bincount(a[used], minlength=len(anchors)) + np.bincount(b[used], minlength=len(anchors))
    covariance = _covariance(data.t_s, design, residual_m, scale_m)
    if not slope:
        covariance = covariance[:-1, :-1]
    bias, slope_m = solution[:-1], float(solution[-1]) if slope else None
    return Fit(anchors, bias, covariance, slope_m, residual_m, used, scale_m, a, b, counts)


def moves(data: Differences, found: Fit) -> bool:
    """Whether the ranges change enough to separate a slope from the constants."""
    still = np.zeros(len(found.a))
    design = _design(found.a, found.b, still, len(found.anchors))
    alike = np.linalg.solve(_normal(design, still + 1.0), design.T @ data.log_ratio)
    return float(np.sqrt(np.mean((data.log_ratio - design @ alike) ** 2))) > _MIN_MOTION


def _design(a: Integers, b: Integers, x: Vector, count: int) -> Any:  # noqa: ANN401 - a sparse array
    """Derivatives of the differences with respect to the constants and, last, the slope; shape (n, count + 1)."""
    ones, rows = np.ones(len(a)), np.tile(np.arange(len(a)), 3)
    columns = np.concatenate([b, a, np.full(len(a), count)])
    return csr_array((np.concatenate([ones, -ones, x]), (rows, columns)), shape=(len(a), count + 1))


def _normal(design: Any, weights: Vector) -> Array:  # noqa: ANN401 - a sparse array
    """Hᵀ W H, with terms that hold the sum of the constants, and an undetermined slope, at zero."""
    normal: Array = (design.T @ design.multiply(weights[:, None])).toarray()
    count = len(normal) - 1
    typical = max(float(np.trace(normal[:-1, :-1])) / count, 1e-9)
    normal[:-1, :-1] += typical / count
    normal[-1, -1] += 1e-9 * typical
    return normal


def _covariance(t_s: Vector, design: Any, residual_m: Vector, scale_m: float) -> Array:  # noqa: ANN401 - sparse
    """Sandwich covariance, clustered by blocks of time; no variance is below that for independent errors."""
    share = np.abs(residual_m) / scale_m
    influence = np.where(share <= _REJECT, np.clip(residual_m, -_HUBER * scale_m, _HUBER * scale_m), 0.0)
    bread = np.linalg.inv(_normal(design, (share < _HUBER).astype(np.float64)))
    block_s = min(_BLOCK_S, (t_s[-1] - t_s[0]) / _FEWEST_BLOCKS)
    _, block = np.unique(((t_s - t_s[0]) / max(block_s, 1e-9)).astype(np.int64), return_inverse=True)
    sums = (csr_array((influence, (block, np.arange(len(block))))) @ design).toarray()
    meat = sums.T @ sums * len(sums) / max(len(sums) - 1, 1)
    together, apart = bread @ meat @ bread, bread @ _normal(design, influence**2) @ bread
    grow = np.sqrt(np.maximum(np.diag(apart) / np.maximum(np.diag(together), 1e-30), 1.0))
    result: Array = together * np.outer(grow, grow)
    return result


# Calibration: which constants are determined, their zero and their standard errors.

_FEWEST: Final = 3  # accepted differences below which an anchor's constant is not determined
_MAX_STD_M: Final = 0.1  # a constant with a larger error does more harm than good
_STEEPEST_M: Final = 0.12
"""Decawave's table (APS011) is nowhere steeper than 12 mm/dB, 0.105 m as the range grows by a factor of e."""

_SURE: Final = 3.0  # the slope is used if it is at least this many standard errors
_MAD_ERROR: Final = 1.17  # relative standard error of a 1.4826 MAD of n Gaussian values, times √n
_ALIKE: Final = "not used: the positions are too much alike to determine it"


class AnchorEstimate(Struct, frozen=True):
    """Calibration result of one anchor, metres."""

    anchor: int
    count: int
    """Differences used."""
    bias_m: float | None
    """None if not determined."""
    std_m: float | None
    """Standard error."""
    noise_m: float | None
    reason: str | None
    """Why the constant is not determined."""


class CalibrationEstimate(Struct, frozen=True):
    """Result of a calibration, metres."""

    anchors: tuple[AnchorEstimate, ...]
    zero: Literal["mean"]
    """Biases are relative to the mean of the determined anchors."""
    slope_m: float | None
    """Growth of every bias as the range grows by a factor of e; None if not used."""
    slope_std_m: float | None
    slope_note: str
    noise_m: float | None
    """Noise of a difference after the calibration (1.4826 MAD)."""
    noise_before_m: float | None
    """Noise of a difference before the calibration (1.4826 MAD about zero)."""
    loop_m: float | None
    """Error that constants cannot explain: RMS over the pairs of their median residual."""
    used: int
    rejected: int

    def calibration(self) -> DifferenceCalibration:
        """The calibration that a receiver applies."""
        slope_m = self.slope_m or 0.0
        return DifferenceCalibration(
            {
                anchor.anchor: AnchorCalibration(anchor.bias_m, slope_m, _at_most(anchor))
                for anchor in self.anchors
                if anchor.bias_m is not None
            }
        )


def _at_most(anchor: AnchorEstimate) -> float | None:
    """Upper limit of the anchor's noise: its estimate plus twice the standard error of a 1.4826 MAD."""
    return None if anchor.noise_m is None else anchor.noise_m * (1.0 + 2.0 * _MAD_ERROR / anchor.count**0.5)


def estimate(differences: Differences) -> CalibrationEstimate:
    """Estimate the anchors' constants, with mean 0.

    A slope over the range is also estimated, and used if it differs from zero and is plausible for the radio.
    """
    kept, reasons = _connected(differences, np.unique(np.concatenate([differences.anchor_a, differences.anchor_b])))
    data = differences.select(np.isin(differences.anchor_a, kept))
    plain = fit(data, kept, slope=False)
    steep = fit(data, plain.anchors, slope=True) if moves(data, plain) else None
    note = _ALIKE if steep is None else _slope_note(steep)
    chosen = steep if steep is not None and not note else plain
    for anchor, count in zip(chosen.anchors.tolist(), chosen.counts.tolist(), strict=True):
        if count < _FEWEST:
            reasons[anchor] = f"only {count} differences that can be used; {_FEWEST} are needed"
    return _estimate(differences, chosen, steep, note or "used", reasons)


def _connected(differences: Differences, anchors: Integers) -> tuple[Integers, dict[int, str]]:
    """Anchors of the largest connected component, and why each other anchor is left out."""
    ends = np.searchsorted(anchors, differences.anchor_a), np.searchsorted(anchors, differences.anchor_b)
    links = coo_array((np.ones(len(ends[0])), ends), shape=(len(anchors), len(anchors)))
    part = connected_components(links, directed=False)[1]
    is_chosen = part == np.argmax(np.bincount(part))
    lost = anchors[~is_chosen].tolist()
    return anchors[is_chosen], dict.fromkeys(lost, "no chain of differences ties it to the others")


def _slope_note(found: Fit) -> str:
    slope_m, std_m = found.slope_m or 0.0, float(np.sqrt(found.covariance_m2[-1, -1]))
    if std_m > _STEEPEST_M / _SURE:
        return _ALIKE
    if slope_m < _SURE * std_m:
        return "not used: it does not differ from zero"
    if slope_m > _STEEPEST_M:
        return "not used: no radio has such a slope, so it has another cause"
    return ""


def _estimate(
    differences: Differences, found: Fit, steep: Fit | None, note: str, reasons: dict[int, str]
) -> CalibrationEstimate:
    count = len(found.anchors)
    good = np.array([anchor not in reasons for anchor in found.anchors.tolist()])
    shift = np.eye(count) - good / max(int(good.sum()), 1)
    covariance = shift @ found.covariance_m2[:count, :count] @ shift.T
    bias_m, std_m = shift @ found.bias_m, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for row in np.flatnonzero(good & (std_m > _MAX_STD_M)):
        reasons[int(found.anchors[row])] = f"its standard error would be {std_m[row]:.2f} m"
    rows = {anchor: row for row, anchor in enumerate(found.anchors.tolist())}
    anchors = []
    differences_used = int(found.used.sum())
    for anchor in np.unique(np.concatenate([differences.anchor_a, differences.anchor_b])).tolist():
        own_row = rows.get(anchor)
        used = 0 if own_row is None else int(found.counts[own_row])
        if own_row is None or anchor in reasons:
            anchors.append(AnchorEstimate(anchor, used, None, None, None, reasons[anchor]))
            continue
        of_anchor = np.abs(found.residual_m[found.used & ((found.a == own_row) | (found.b == own_row))])
        noise_m = STD_OVER_MAD * float(np.median(of_anchor)) * _spent(differences_used, len(found.anchors))
        anchors.append(AnchorEstimate(anchor, used, float(bias_m[own_row]), float(std_m[own_row]), noise_m, None))
    pair = found.a * count + found.b
    medians = [float(np.median(found.residual_m[here])) for here in map(pair.__eq__, np.unique(pair[found.used]))]
    return CalibrationEstimate(
        anchors=tuple(anchors),
        zero="mean",
        slope_m=found.slope_m,
        slope_std_m=None if steep is None else float(np.sqrt(steep.covariance_m2[-1, -1])),
        slope_note=note,
        noise_m=found.scale_m * _spent(differences_used, len(found.anchors)),
        noise_before_m=STD_OVER_MAD * float(np.median(np.abs(differences.excess_m))),
        loop_m=float(np.sqrt(np.mean(np.square(medians)))),
        used=differences_used,
        rejected=len(differences.t_s) - differences_used,
    )


def _spent(differences: int, anchors: int) -> float:
    """Factor from residuals to noise, for the degrees of freedom that the constants use up."""
    return float(np.sqrt(differences / max(differences - anchors + 1, 1)))
