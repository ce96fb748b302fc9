"""Positions from TDoAs in C and in the Python that it is made from: the same bits, with all that they leave behind."""

import shutil
from collections import Counter

import numpy as np
import pytest

from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS
from skyless.core.native.views import view
from skyless.core.tag.position import FOUND, IMPOSSIBLE, MIRROR, RESIDUALS, SINGULAR, UNCERTAIN, Found, find_position
from skyless.core.tag.search import FREE, HEIGHT, PLANE, LocateProblem

pytestmark = [pytest.mark.site, pytest.mark.skipif(not shutil.which("gcc"), reason="there is no gcc")]


def drawn_problem(draw):
    """Anchors in a room, in a plane, nearly in a line, or on a lattice; TDoAs with little, much or absurd noise."""
    anchors = int(draw.integers(3, 10)) if draw.random() < 0.95 else MAX_ANCHORS
    anchors_m = draw.uniform(0.0, [20.0, 10.0, 5.0], (anchors, 3))
    shape = int(draw.integers(5))
    if shape == 1:
        anchors_m[:, 2] = 2.5
    elif shape == 2:
        anchors_m[:, 2] = anchors_m[:, 0] + 10.0 ** draw.uniform(-9.0, 0.0) * draw.normal(size=anchors)
    elif shape == 3:
        anchors_m[:, 1:] = anchors_m[:, :1] + 10.0 ** draw.uniform(-7.0, 0.0) * draw.normal(size=(anchors, 2))
    elif shape == 4:
        anchors_m = np.round(anchors_m / 4.0) * 4.0
    tag_m, std_m = draw.uniform(-3.0, [23.0, 13.0, 8.0]), 10.0 ** draw.uniform(-4.0, 0.0)
    ranges_m = np.linalg.norm(anchors_m - tag_m, axis=1)
    ranges_m += std_m * draw.choice([0.0, 1.0, 10.0, 300.0]) * draw.normal(size=anchors)
    p = LocateProblem(
        anchors=anchors,
        knows_height=bool(draw.integers(2)),
        is_weighted=bool(draw.integers(2)),
        has_bounds=bool(draw.integers(2)),
        height_m=tag_m[2],
        low_m=0.0,
        high_m=5.0,
        residual_tail=draw.choice([0.0, 1e-9]),
    )
    view(p.anchors_m)[:anchors], view(p.tdoa_m)[: anchors - 1] = anchors_m, ranges_m[1:] - ranges_m[0]
    root = draw.normal(size=(anchors - 1, anchors - 1))
    covariance = std_m**2 * (1.0 + np.eye(anchors - 1) + 0.1 * root @ root.T)
    view(p.covariance)[: anchors * (anchors - 1) // 2] = covariance[np.tril_indices(anchors - 1)]
    return p


def bits(record):
    """A record's memory; what is no number has the same bits everywhere."""
    numbers = np.frombuffer(record, np.float64).copy()
    numbers[np.isnan(numbers)] = np.nan
    return numbers.tobytes()


def test_python_and_c_give_the_same_bits():
    draw, in_c, kinds, reasons = np.random.default_rng(6), compiled(find_position), Counter(), Counter()
    for _ in range(400):
        ours = drawn_problem(draw)
        theirs, found, found_in_c = LocateProblem.from_buffer_copy(ours), Found(), Found()
        reason = find_position(ours, found)
        assert in_c(theirs, found_in_c) == reason
        assert bits(found_in_c) == bits(found)
        assert bits(theirs) == bits(ours)
        kinds[ours.kind] += 1
        reasons[reason] += 1
    assert min(kinds[kind] for kind in (FREE, HEIGHT, PLANE)) > 50
    assert min(reasons[reason] for reason in (FOUND, IMPOSSIBLE, MIRROR, RESIDUALS, SINGULAR, UNCERTAIN)) > 2
