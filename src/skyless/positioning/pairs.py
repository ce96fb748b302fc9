"""TDoAs of arbitrary pairs of anchors, brought against one reference: systems without a master."""

from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray


class ReferencedTdoas(Struct, frozen=True, gc=False):
    """What ``locate`` wants, from measurements of pairs; empty where there are none."""

    anchors: tuple[int, ...]
    """Identifiers of the anchors that are connected, the reference first: n + 1, or none."""
    tdoa_m: NDArray[np.float64]
    """|p − anchor i + 1| − |p − reference|, shape (n,)."""
    covariance_m2: NDArray[np.float64]
    """Shape (n, n)."""
    chi2: float
    """Of the loops that the pairs form: how well the measurements agree among themselves."""
    dof: int
    """Number of independent loops."""


def against_reference(
    pairs: Sequence[tuple[int, int]],
    tdoa_m: ArrayLike,
    variances_m2: ArrayLike,
    *,
    reference: int | None = None,
) -> ReferencedTdoas:
    """Best linear estimate of all TDoAs against one anchor from measurements ``|p − b| − |p − a|`` of pairs (a, b).

    ``tdoa_m`` and ``variances_m2``: shape (m,), errors independent. A pair may be measured more than once, in
    either direction. Of a graph in several parts the largest is taken, of equally large ones that with the most
    information. ``reference``: taken if it lies in that part; else the anchor of most information serves (with the
    full covariance the choice does not change a position). Pairs of one anchor with itself, values that are not
    finite and variances that are not positive are left out.
    """
    measured, variances = np.array(tdoa_m, np.float64), np.array(variances_m2, np.float64)
    if not (len(pairs),) == measured.shape == variances.shape:
        raise ValueError(f"{len(pairs)} pairs, TDoAs {measured.shape}, variances {variances.shape}: expected one each")
    usable = np.isfinite(measured) & np.isfinite(variances) & (variances > 0.0)
    kept = [i for i, (a, b) in enumerate(pairs) if a != b and usable[i]]
    weights = {i: float(1.0 / variances[i]) for i in kept}
    information: dict[int, float] = {}
    for i in kept:
        for anchor in pairs[i]:
            information[anchor] = information.get(anchor, 0.0) + weights[i]
    part = _largest_part([pairs[i] for i in kept], information)
    if not part:
        return ReferencedTdoas((), np.empty(0), np.empty((0, 0)), 0.0, 0)
    if reference not in part:
        reference = max(sorted(part), key=information.__getitem__)
    anchors = (reference, *sorted(part - {reference}))
    edges = [i for i in kept if pairs[i][0] in part]
    return _least_squares(anchors, [pairs[i] for i in edges], measured[edges], variances[edges])


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


def _least_squares(
    anchors: tuple[int, ...],
    pairs: Sequence[tuple[int, int]],
    measured: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> ReferencedTdoas:
    """Solve for the anchors' ranges beyond the reference's; the rows of H are differences of unit vectors."""
    row = {anchor: i for i, anchor in enumerate(anchors)}
    sigma = np.sqrt(variances)
    ends = np.array([(row[a], row[b]) for a, b in pairs])
    each = np.arange(len(pairs))
    H = np.zeros((len(pairs), len(anchors)))
    H[each, ends[:, 1]] = 1.0 / sigma
    H[each, ends[:, 0]] = -1.0 / sigma
    H = H[:, 1:]
    covariance = np.linalg.inv(H.T @ H)
    whitened = measured / sigma
    tdoa = covariance @ (H.T @ whitened)
    residuals = whitened - H @ tdoa
    return ReferencedTdoas(
        anchors, tdoa, 0.5 * (covariance + covariance.T), float(residuals @ residuals), len(pairs) - len(anchors) + 1
    )
