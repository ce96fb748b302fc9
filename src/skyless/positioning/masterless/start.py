"""Where a tag is by a window of time differences of pairs, without a guess, and past one anchor that is wrong.

The differences of arbitrary pairs, as systems without a master give them, are first brought against one reference.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.air.masterless_packets import PairTdoa
from skyless.kernels.arrays import Array
from skyless.positioning.fix import NoFixReason
from skyless.positioning.masterless.calibration import DifferenceCalibration
from skyless.positioning.solver.locate import NoSolution, Solution, locate

NEIGHBOURHOOD: Final = 1.5
"""A tag farther from the anchors' centre than this part of their figure's diagonal, in x or y, is lost; ..."""

STOREYS: Final = 0.5
"""... and so is one farther above or below than this part."""

LEAST_DIAGONAL_M: Final = 5.0

START_STD_M: Final = 0.22
"""Of a difference with all that is wrong with it, where nothing has been learnt yet."""

MISFIT: Final = 4.0
"""A start with so much larger residuals than expected, chi² per degree of freedom, is tried without each anchor."""

FITS: Final = 0.1
"""Without the wrong anchor no more than this part of the misfit is left."""


class Start(Struct, frozen=True):
    """Where a filter begins."""

    solution: Solution
    without: int | None
    """The anchor that does not fit; None where all do."""
    low_m: Array
    """Corner of the neighbourhood of the anchors, shape (3,); ..."""
    high_m: Array
    """... and the opposite one."""
    extent_m: float
    """Longest edge of the anchors' bounding box."""

    def holds(self, position_m: Array) -> bool:
        """Whether a position, of two or three coordinates, lies in the neighbourhood of the anchors."""
        return all(self.low_m[axis] <= place <= self.high_m[axis] for axis, place in enumerate(position_m.tolist()))


def find_start(
    window: Sequence[PairTdoa],
    places_m: Mapping[int, Array],
    calibration: DifferenceCalibration,
    height_m: float | None,
    z_bounds_m: tuple[float, float] | None,
) -> Start | NoSolution:
    """Solve for the position; medians of each pair keep single outliers out of it.

    Where the residuals are too large, each anchor is left out once: on the floor or behind metal one is often wrong.
    """
    grouped: dict[tuple[int, int], list[float]] = {}
    for pair in window:
        without_bias_m = pair.tdoa_m - calibration.constant_m(pair)
        grouped.setdefault((pair.anchor_a, pair.anchor_b), []).append(without_bias_m)
    medians = {pair: float(np.median(group)) for pair, group in grouped.items()}
    anchors = sorted({anchor for pair in medians for anchor in pair})
    found = _solve(medians, places_m, height_m, z_bounds_m)
    best, without = found, None
    least = np.inf if isinstance(found, NoSolution) else FITS * found.chi2
    dim = 3 if height_m is None else 2
    if _is_suspect(found) and len(anchors) > dim + 2:
        for anchor in anchors:
            rest = {pair: median for pair, median in medians.items() if anchor not in pair}
            other = _solve(rest, places_m, height_m, z_bounds_m)
            if isinstance(other, Solution) and other.dof > 0 and other.chi2 < least:
                best, without, least = other, anchor, other.chi2
    if isinstance(best, NoSolution):
        return best
    anchors_m = np.array([places_m[anchor] for anchor in anchors])
    low, high = anchors_m.min(axis=0), anchors_m.max(axis=0)
    diagonal_m = max(float(np.linalg.norm((high - low)[:2])), LEAST_DIAGONAL_M)
    reach_m = diagonal_m * np.array([NEIGHBOURHOOD, NEIGHBOURHOOD, STOREYS])
    centre_m = (low + high) / 2.0
    start = Start(best, without, centre_m - reach_m, centre_m + reach_m, float((high - low).max()))
    if not start.holds(best.position_m[:dim]):
        return NoSolution(NoFixReason.NOT_CONVERGED, "the position lies far from all anchors")
    return start


def _is_suspect(found: Solution | NoSolution) -> bool:
    if isinstance(found, NoSolution):
        return found.reason is NoFixReason.RESIDUALS
    return found.dof > 0 and found.chi2 > MISFIT * found.dof


def _solve(
    medians: Mapping[tuple[int, int], float],
    places_m: Mapping[int, Array],
    height_m: float | None,
    z_bounds_m: tuple[float, float] | None,
) -> Solution | NoSolution:
    joined = against_reference(list(medians), list(medians.values()), [START_STD_M**2] * len(medians))
    if not joined.anchors:
        return NoSolution(NoFixReason.TOO_FEW_ANCHORS, "no pair of anchors was heard")
    anchors_m = np.array([places_m[anchor] for anchor in joined.anchors])
    return locate(anchors_m, joined.tdoa_m, joined.covariance_m2, height_m=height_m, z_bounds_m=z_bounds_m)


class ReferencedTdoas(Struct, frozen=True, gc=False):
    """What ``locate`` wants, from measurements of pairs; empty where there are none."""

    anchors: tuple[int, ...]
    """Identifiers of the anchors that are connected, the reference first: n + 1, or none."""
    tdoa_m: Array
    """|p − anchor i + 1| − |p − reference|, shape (n,)."""
    covariance_m2: Array
    """Shape (n, n)."""


def against_reference(pairs: Sequence[tuple[int, int]], tdoa_m: ArrayLike, variances_m2: ArrayLike) -> ReferencedTdoas:
    """Best linear estimate of all TDoAs against one anchor from measurements ``|p − b| − |p − a|`` of pairs (a, b).

    ``tdoa_m`` and ``variances_m2``: shape (m,), errors independent. A pair may be measured more than once, in
    either direction. Of a graph in several parts the largest is taken, of equally large ones that with the most
    information. The anchor of most information serves as the reference (with the full covariance the choice does not
    change a position). Pairs of one anchor with itself, values that are not finite and variances that are not positive
    are left out.
    """
    measured, variances = np.array(tdoa_m, np.float64), np.array(variances_m2, np.float64)
    if not (len(pairs),) == measured.shape == variances.shape:
        raise ValueError(f"{len(pairs)} pairs, TDoAs {measured.shape}, variances {variances.shape}: expected one each")
    usable = np.isfinite(measured) & np.isfinite(variances) & (variances > 0.0)
    kept = [i for i, (a, b) in enumerate(pairs) if a != b and usable[i]]
    information: dict[int, float] = {}
    for i in kept:
        for anchor in pairs[i]:
            information[anchor] = information.get(anchor, 0.0) + float(1.0 / variances[i])
    part = _largest_part([pairs[i] for i in kept], information)
    if not part:
        return ReferencedTdoas((), np.empty(0), np.empty((0, 0)))
    reference = max(sorted(part), key=information.__getitem__)
    anchors = (reference, *sorted(part - {reference}))
    row = {anchor: i for i, anchor in enumerate(anchors)}
    edges = [i for i in kept if pairs[i][0] in part]
    sigma = np.sqrt(variances[edges])
    H = np.zeros((len(edges), len(anchors)))
    for k, i in enumerate(edges):
        H[k, row[pairs[i][0]]], H[k, row[pairs[i][1]]] = -1.0 / sigma[k], 1.0 / sigma[k]
    H = H[:, 1:]
    covariance = np.linalg.inv(H.T @ H)
    tdoa = covariance @ (H.T @ (measured[edges] / sigma))
    return ReferencedTdoas(anchors, tdoa, 0.5 * (covariance + covariance.T))


def _largest_part(pairs: Sequence[tuple[int, int]], information: dict[int, float]) -> set[int]:
    """The connected part with most anchors, then with most information, then with the smallest identifier."""
    part_of = {anchor: {anchor} for anchor in information}
    for a, b in pairs:
        joined, other = part_of[a], part_of[b]
        if joined is not other:
            joined |= other
            for anchor in other:
                part_of[anchor] = joined
    return max(
        part_of.values(),
        key=lambda part: (len(part), sum(sorted(information[anchor] for anchor in part)), -min(part)),
        default=set(),
    )
