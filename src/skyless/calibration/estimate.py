"""One constant for each anchor from time differences at known places, robustly, with honest standard errors.

A difference measures |p − b| − |p − a| + bias_b − bias_a (+ slope·ln(|p − b| / |p − a|)) + noise. With p known the
biases follow by linear regression: Huber's weights, and nothing beyond four standard deviations. Only differences of
constants can be seen; the zero is their mean, or one anchor.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.calibration.fit import Differences, Fit, fit, moves
from skyless.kernels.arrays import Mask, Vector
from skyless.positioning.masterless.anchor_errors import AnchorCalibration, DifferenceCalibration

FEWEST: Final = 3
"""Accepted differences below which nothing is said of an anchor."""

MAX_STD_M: Final = 0.1
"""A constant that is known worse does more harm than good."""

STEEPEST_M: Final = 0.12
"""Decawave's table (APS011) is nowhere steeper than 12 mm/dB, 0.105 m while the range grows by the factor e."""

SURE: Final = 3.0
"""The slope is believed from so many of its standard errors on."""

MAD_ERROR: Final = 1.17
"""Relative standard error of a 1.4826 MAD of n Gaussian values, times √n."""

ALIKE: Final = "not used: the places are too much alike to tell it"


class AnchorEstimate(Struct, frozen=True):
    """What was found out about one anchor, metres."""

    anchor: int
    count: int
    """Differences that were used."""
    bias_m: float | None
    """None where it is not determined."""
    std_m: float | None
    """Standard error; 0 for the anchor that is the zero."""
    noise_m: float | None
    reason: str | None
    """Why the constant is not determined."""


class CalibrationEstimate(Struct, frozen=True):
    """All that a calibration found, metres."""

    anchors: tuple[AnchorEstimate, ...]
    zero: str
    """"mean" of the determined anchors, or "anchor N"."""
    slope_m: float | None
    """Growth of every bias while the range grows by the factor e; None where it is not used."""
    slope_std_m: float | None
    slope_note: str
    noise_m: float | None
    """Of a difference once the calibration is off (1.4826 MAD)."""
    noise_before_m: float | None
    """The same about zero before."""
    loop_m: float | None
    """What constants cannot explain: root mean square over the pairs of their median residual."""
    used: int
    rejected: int

    def calibration(self) -> DifferenceCalibration:
        """As a receiver applies it."""
        slope_m = self.slope_m or 0.0
        return DifferenceCalibration(
            {
                anchor.anchor: AnchorCalibration(anchor.bias_m, slope_m, _at_most(anchor))
                for anchor in self.anchors
                if anchor.bias_m is not None
            }
        )


def _at_most(anchor: AnchorEstimate) -> float | None:
    """The noise that it has at most, as far as so many differences can tell (twice the error of a 1.4826 MAD)."""
    return None if anchor.noise_m is None else anchor.noise_m * (1.0 + 2.0 * MAD_ERROR / anchor.count**0.5)


def estimate(differences: Differences, *, zero: int | None = None, slope: bool = True) -> CalibrationEstimate:
    """Estimate the anchors' constants; ``zero``: the anchor whose constant is 0, by default their mean is.

    With ``slope`` the growth with the range is estimated too, and used if it can be told from zero and is one that
    the radio can have.
    """
    found = np.unique(np.concatenate([differences.anchor_a, differences.anchor_b]))
    kept, reasons = _connected(differences, found.tolist(), zero)
    data = _only(differences, kept)
    plain = fit(data, np.array(kept, dtype=np.int64), slope=False)
    steep = fit(data, plain.anchors, slope=True) if slope and moves(data, plain) else None
    note = ALIKE if slope else "not asked for"
    if steep is not None:
        note = _slope_note(steep)
    chosen = steep if steep is not None and not note else plain
    for anchor, count in zip(chosen.anchors.tolist(), chosen.counts.tolist(), strict=True):
        if count < FEWEST:
            reasons[anchor] = f"only {count} differences that can be used; it takes {FEWEST}"
    return _estimate(differences, chosen, steep, note or "used", reasons, zero)


def _connected(differences: Differences, anchors: Sequence[int], zero: int | None) -> tuple[list[int], dict[int, str]]:
    """Anchors of the part that holds the zero, or else of the part with most anchors; and why others are not."""
    part_of = {anchor: {anchor} for anchor in anchors}
    pairs = np.unique(np.stack([differences.anchor_a, differences.anchor_b], 1), axis=0)
    for a, b in pairs.tolist():
        joined, other = part_of[a], part_of[b]
        if joined is not other:
            joined |= other
            part_of.update(dict.fromkeys(other, joined))
    chosen = part_of[zero] if zero in part_of else max(part_of.values(), key=lambda part: (len(part), -min(part)))
    kept = sorted(chosen)
    lost = [anchor for anchor in anchors if anchor not in chosen]
    return kept, dict.fromkeys(lost, "no chain of differences ties it to the others")


def _only(differences: Differences, anchors: Sequence[int]) -> Differences:
    keep = np.isin(differences.anchor_a, anchors)
    return Differences(
        differences.t_s[keep],
        differences.anchor_a[keep],
        differences.anchor_b[keep],
        differences.excess_m[keep],
        differences.log_ratio[keep],
    )


def _slope_note(found: Fit) -> str:
    """Why the slope is not used; empty if it is."""
    slope_m, std_m = found.slope_m or 0.0, float(np.sqrt(found.covariance_m2[-1, -1]))
    if std_m > STEEPEST_M / SURE:
        return ALIKE
    if slope_m < SURE * std_m:
        return "not used: it cannot be told from zero"
    if slope_m > STEEPEST_M:
        return "not used: no radio has such a slope, so something else is behind it"
    return ""


def _estimate(
    differences: Differences,
    found: Fit,
    steep: Fit | None,
    note: str,
    reasons: dict[int, str],
    zero: int | None,
) -> CalibrationEstimate:
    count = len(found.anchors)
    good = np.array([anchor not in reasons for anchor in found.anchors.tolist()])
    bias_m, std_m = _in_gauge(found, good, zero)
    for row in np.flatnonzero(good & (std_m > MAX_STD_M)):
        reasons[int(found.anchors[row])] = f"its standard error would be {std_m[row]:.2f} m"
    rows = {anchor: row for row, anchor in enumerate(found.anchors.tolist())}
    anchors = []
    differences_used = int(found.used.sum())
    for anchor in np.unique(np.concatenate([differences.anchor_a, differences.anchor_b])).tolist():
        place = rows.get(anchor)
        used = 0 if place is None else int(found.counts[place])
        if place is None or anchor in reasons:
            anchors.append(AnchorEstimate(anchor, used, None, None, None, reasons[anchor]))
            continue
        of_anchor = np.abs(found.residual_m[found.used & ((found.a == place) | (found.b == place))])
        noise_m = 1.4826 * float(np.median(of_anchor)) * _spent(differences_used, len(found.anchors))
        anchors.append(AnchorEstimate(anchor, used, float(bias_m[place]), float(std_m[place]), noise_m, None))
    pair = found.a * count + found.b
    medians = [float(np.median(found.residual_m[here])) for here in map(pair.__eq__, np.unique(pair[found.used]))]
    return CalibrationEstimate(
        anchors=tuple(anchors),
        zero="mean" if zero is None else f"anchor {zero}",
        slope_m=found.slope_m,
        slope_std_m=None if steep is None else float(np.sqrt(steep.covariance_m2[-1, -1])),
        slope_note=note,
        noise_m=found.scale_m * _spent(differences_used, len(found.anchors)),
        noise_before_m=1.4826 * float(np.median(np.abs(differences.excess_m))),
        loop_m=float(np.sqrt(np.mean(np.square(medians)))),
        used=differences_used,
        rejected=len(differences.t_s) - differences_used,
    )


def _spent(differences: int, anchors: int) -> float:
    """Residuals are smaller than the noise by what the estimated constants took out of them."""
    return float(np.sqrt(differences / max(differences - anchors + 1, 1)))


def _in_gauge(found: Fit, good: Mask, zero: int | None) -> tuple[Vector, Vector]:
    """Constants and their standard errors with the zero where it should be, each of shape (m,)."""
    count = len(found.anchors)
    place = np.zeros(count)
    if zero is not None:
        place[found.anchors == zero] = 1.0
    else:
        place[good] = 1.0 / max(int(good.sum()), 1)
    shift = np.eye(count) - place
    covariance = shift @ found.covariance_m2[:count, :count] @ shift.T
    return shift @ found.bias_m, np.sqrt(np.maximum(np.diag(covariance), 0.0))
