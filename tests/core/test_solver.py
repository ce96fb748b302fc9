"""The solver: on exact data with mirrors and every reason for no position; on noisy data against SciPy, dense matrices
and its own covariance, and how often it ends well.
"""

import math
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pseudoranges import located
from scipy.optimize import least_squares
from scipy.stats import chi2

from skyless.core.clock_filter import stamp_variances_m2
from skyless.core.fix import NoFixReason
from skyless.core.geometry import dilution_of_precision
from skyless.core.native.records import MAX_ANCHORS
from skyless.core.protocol1.snapshots import bracketed_covariance, literal_covariance, literal_delayed_covariance
from skyless.core.tag import position, search
from skyless.core.tag.position import UNSETTLED, NoSolution, Solution, locate
from skyless.core.tag.search import EXHAUSTED, GAIN_TOLERANCE
from support.dense_covariance import position_covariance

pytestmark = pytest.mark.site

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
LAB_3D = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
"""Alternating heights, as docs/maths.md section 5 advises."""
P1, P2 = np.array([3.0, 4.0, 0.0]), np.array([1.2, 1.6, 0.0])
LITERAL = (np.diag([5.0, 9, 13, 17, 21]) + 1) / 15
"""Shape of the paper's covariance: own variances that grow with the slot, and the tag's reference in common."""
KAPPA = np.arange(1, 6) / 6.0
SEEDS = st.integers(0, 2**32 - 1)


def tdoas(anchors, p):
    ranges = np.linalg.norm(anchors - p, axis=1)
    return ranges[1:] - ranges[0]


def sigma(n, std=1e-3):
    return std**2 * (np.eye(n) + 1)


def room(seed, n, *, outside=3.0):
    """Anchors in a room of some metres, somewhere; a tag in it or some metres outside."""
    draw = np.random.default_rng(seed)
    size, corner = draw.uniform([4, 4, 2.5], [20, 20, 8]), draw.uniform(-100, 100, 3)
    anchors, p = corner + draw.uniform(0, size, (n, 3)), corner + draw.uniform(-outside, size + outside)
    return anchors, p


def refused(solution, reason):
    assert isinstance(solution, NoSolution), solution
    assert solution.reason is reason, solution
    return solution


@settings(max_examples=600)
@given(seed=SEEDS, n=st.integers(5, 10), height_known=st.booleans(), weighted=st.booleans())
def test_exact_data_give_the_position(seed, n, height_known, weighted):
    n += not height_known
    anchors, p = room(seed, n)
    if dilution_of_precision(anchors, p, height_known=height_known).pdop > 30:
        return
    height_m = p[2] if height_known else None
    solution = locate(anchors, tdoas(anchors, p), sigma(n - 1), height_m=height_m, weighted=weighted)
    if isinstance(solution, NoSolution):
        _second_place_is_true(refused(solution, NoFixReason.MIRROR), p)
        return
    np.testing.assert_allclose(solution.position_m, p, atol=1e-6)
    assert solution.dof == n - 3 - (not height_known)
    assert solution.chi2 < 1e-9
    if height_known:
        assert solution.position_m[2] == pytest.approx(p[2], abs=1e-12)
        assert not solution.covariance_m2[2].any()
        assert not solution.covariance_m2[:, 2].any()


def _second_place_is_true(solution, p):
    """An ambiguity names the true position among the two."""
    assert "({:.2f}, {:.2f}, {:.2f}) m".format(*(p + 0.0)) in solution.detail


def _is_true_or_as_good(solution, anchors, p):
    """The place is true, or both are exact and within three sigmas of each other, which counts as one place."""
    off = solution.position_m - p
    if np.abs(off).max() > 1e-6:
        np.testing.assert_allclose(tdoas(anchors, solution.position_m), tdoas(anchors, p), atol=1e-9)
        assert off @ np.linalg.pinv(solution.covariance_m2) @ off < 9.0


@settings(max_examples=300)
@example(seed=920117, height_known=True)
@given(seed=SEEDS, height_known=st.booleans())
def test_exactly_determined_gives_the_position_or_names_both(seed, height_known):
    """Three hyperbolas' anchors, or four hyperboloids', may meet twice; the truth is always one of the places."""
    anchors, p = room(seed, 3 if height_known else 4)
    if dilution_of_precision(anchors, p, height_known=height_known).pdop > 30:
        return
    height = p[2] if height_known else None
    solution = locate(anchors, tdoas(anchors, p), sigma(len(anchors) - 1), height_m=height)
    if isinstance(solution, NoSolution):
        _second_place_is_true(refused(solution, NoFixReason.MIRROR), p)
    else:
        _is_true_or_as_good(solution, anchors, p)
        assert solution.dof == 0


def test_both_roots_of_an_exactly_determined_case_solve_it():
    anchors = np.array([(0, 0, 0), (6, 0, 0), (0, 6, 0)], float)
    p = np.array([-1.5, -1.0, 0])
    solution = refused(locate(anchors, tdoas(anchors, p), sigma(2), height_m=0), NoFixReason.MIRROR)
    _second_place_is_true(solution, p)
    places = [place.strip("( ").split(",") for place in solution.detail.split(") m")[:2]]
    for place in [[float(x.replace("and (", "")) for x in place] for place in places]:
        np.testing.assert_allclose(tdoas(anchors, place), tdoas(anchors, p), atol=0.02)  # printed with two digits


def coplanar_room(seed, n):
    """Anchors in a plane of any tilt, a tag at least a metre off it, bounds that hold only the tag."""
    draw = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(draw.normal(size=(3, 3)))
    flat = np.column_stack([draw.uniform(-6, 6, (n, 2)), np.zeros(n)])
    local = np.append(draw.uniform(-4, 4, 2), draw.uniform(1, 4))
    mirrored = local * [1, 1, -1]
    return flat @ axes + 10, local @ axes + 10, mirrored @ axes + 10


@settings(max_examples=300)
@given(seed=SEEDS, n=st.integers(4, 9), weighted=st.booleans())
def test_coplanar_anchors_have_a_mirror_image(seed, n, weighted):
    anchors, p, image = coplanar_room(seed, n)
    apart = abs(p[2] - image[2])
    if dilution_of_precision(anchors, p, height_known=False).pdop > 200 or apart < 0.1:
        return
    measured, covariance = tdoas(anchors, p), sigma(n - 1, 1e-4)
    _second_place_is_true(refused(locate(anchors, measured, covariance, weighted=weighted), NoFixReason.MIRROR), p)
    low, high = p[2] - 0.4 * apart, p[2] + 0.4 * apart
    solution = locate(anchors, measured, covariance, weighted=weighted, z_bounds_m=(low, high))
    assert isinstance(solution, Solution), solution
    np.testing.assert_allclose(solution.position_m, p, atol=1e-6)
    np.testing.assert_allclose(solution.mirror_m, image, atol=1e-6)
    wide = locate(anchors, measured, covariance, weighted=weighted, z_bounds_m=(-1000, 1000))
    refused(wide, NoFixReason.MIRROR)


def test_the_bounds_decide_for_the_nearer_only_if_it_is_near():
    p = np.array([2.0, 3.0, 1.5])
    measured, covariance = tdoas(LAB, p), sigma(5, 0.01)
    std = math.sqrt(locate(LAB, measured, covariance, z_bounds_m=(0, 5)).covariance_m2[2, 2])
    solution = locate(LAB, measured, covariance, z_bounds_m=(-0.5, 1.5 - 2 * std))
    assert solution.position_m[2] == pytest.approx(1.5)
    assert solution.mirror_m[2] == pytest.approx(-1.5)
    refused(locate(LAB, measured, covariance, z_bounds_m=(-0.5, 1.5 - 4 * std)), NoFixReason.MIRROR)
    refused(locate(LAB, measured, covariance, z_bounds_m=(-0.5, 0.5)), NoFixReason.MIRROR)


def test_nearly_coplanar_anchors_have_a_mirror_image_too():
    anchors = LAB + np.column_stack([np.zeros((6, 2)), [0.02, -0.02, 0.01, 0.02, -0.01, 0]])
    p = np.array([1.2, 1.6, 1.5])
    refused(locate(anchors, tdoas(anchors, p), sigma(5, 0.1)), NoFixReason.MIRROR)
    solution = locate(anchors, tdoas(anchors, p), sigma(5, 0.03), z_bounds_m=(0, 3))
    np.testing.assert_allclose(solution.position_m, p, atol=1e-6)
    np.testing.assert_allclose(solution.mirror_m, [1.2, 1.6, -1.5], atol=0.3)
    # A tenth of a millimetre of noise tells the sides apart.
    np.testing.assert_allclose(locate(anchors, tdoas(anchors, p), sigma(5, 1e-4)).position_m, p, atol=1e-6)


def in_two_orders(seed, n, height_known):
    """Solutions from noisy pseudoranges to the same anchors, in two orders; None for bad geometry."""
    anchors, p = room(seed, n, outside=0.0)
    if dilution_of_precision(anchors, p, height_known=height_known).pdop > 10:
        return None
    draw = np.random.default_rng(seed)
    pseudoranges = np.linalg.norm(anchors - p, axis=1) + 1234.5 + draw.normal(0, 0.05, n)
    variances = draw.uniform(0.03**2, 0.08**2, n)
    order, height = draw.permutation(n), p[2] if height_known else None
    options = {"height_m": height, "residual_tail": 0}
    straight = located(anchors, pseudoranges, variances, **options)
    return straight, located(anchors[order], pseudoranges[order], variances[order], **options)


@settings(max_examples=200)
@given(seed=SEEDS, n=st.integers(6, 9), height_known=st.booleans())
@example(seed=2826940130, n=7, height_known=True)
@example(seed=2697390792, n=8, height_known=False)
def test_the_order_of_the_anchors_does_not_move_the_position(seed, n, height_known):
    """To what the iterations leave over.

    The last of k steps promises to gain less than the part t of the cost, so it is below √(t·χ²) standard deviations.
    Where residuals are curved, steps shrink by a factor ρ only, and ρ/(1 − ρ) times the last is still missing. From a
    first one of a standard deviation or more, k steps at ρ came down by 10⁶ at least, so 1/(1 − ρ) is below k/14.
    """
    both = in_two_orders(seed, n, height_known)
    if both is None or any(isinstance(s, NoSolution) for s in both):
        return
    straight, shuffled = both
    if np.abs(shuffled.position_m - straight.position_m).max() > 0.1:
        return  # two minima within one error ellipse: either is right
    std_m = np.linalg.eigvalsh(straight.covariance_m2)[-1] ** 0.5
    last_m = std_m * (GAIN_TOLERANCE * max(straight.chi2, shuffled.chi2)) ** 0.5
    left_m = 1e-6 + last_m * (straight.iterations + shuffled.iterations) / 14.0
    np.testing.assert_allclose(shuffled.position_m, straight.position_m, rtol=0.0, atol=left_m)
    np.testing.assert_allclose(shuffled.covariance_m2, straight.covariance_m2, rtol=1e-4, atol=1e-9)
    assert shuffled.chi2 == pytest.approx(straight.chi2, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("height_known", [True, False])
@pytest.mark.statistical
def test_the_order_of_the_anchors_hardly_ever_decides_whether_a_rival_is_found(height_known):
    """Rivals are searched from starts that depend on the reference: 1 in 1000 rooms may differ."""
    both = [pair for seed in range(1000) if (pair := in_two_orders(seed, 5 + seed % 4, height_known)) is not None]
    different = [pair for pair in both if isinstance(pair[0], NoSolution) != isinstance(pair[1], NoSolution)]
    apart = [
        pair
        for pair in both
        if all(isinstance(s, Solution) for s in pair) and np.abs(pair[0].position_m - pair[1].position_m).max() > 1e-6
    ]
    assert len(both) > 500
    assert len(different) <= 3
    assert len(apart) <= 3


@pytest.mark.parametrize(("count", "height"), [(3, None), (2, 0.0), (1, 0.0), (0, None)])
def test_too_few_anchors(count, height):
    solution = refused(
        locate(LAB[:count], np.zeros(max(count - 1, 0)), sigma(max(count - 1, 0)), height_m=height),
        NoFixReason.TOO_FEW_ANCHORS,
    )
    assert f"{4 if height is None else 3} anchors are needed, {count} are there" in solution.detail


@pytest.mark.parametrize(
    ("anchors", "place", "heights", "std"),
    [
        (np.column_stack([np.arange(6), 2 * np.arange(6), np.zeros(6)]), (1, 5, 2), (None, 0.0), 1e-3),
        (np.full((6, 3), 4), (1, 5, 2), (None, 0.0), 1e-3),
        (np.array([(1, 2, 0)] * 3 + [(4, 5, 0)] * 3), (1, 5, 2), (None, 0.0), 1e-3),
        (LAB[[0, 1, 3, 4]], (3, 4, 0), (None,), 1e-3),
        *((LAB, (3, 4 + distance, 0), (0.0,), 0.1) for distance in (1e4, 1e6, 1e8)),
    ],
    ids=["line", "point", "two points", "centre of a circle", "far", "farther", "farthest"],
)
def test_bad_geometry(anchors, place, heights, std):
    measured = tdoas(anchors.astype(float), np.array(place, float))
    for height in heights:
        covariance = sigma(len(measured), std)
        refused(locate(anchors.astype(float), measured, covariance, height_m=height), NoFixReason.BAD_GEOMETRY)


def test_an_impossible_tdoa_is_no_fix():
    """|TDoA| beyond the anchors' distance: no hyperbola at all."""
    refused(locate(LAB[:3], [20.0, 20.0], sigma(2, 0.1), height_m=0), NoFixReason.RESIDUALS)


@pytest.mark.parametrize("anchor", range(5))
@pytest.mark.parametrize("late", [-5.0, 2.0, 30.0])
def test_gross_outliers_do_not_pass(anchor, late):
    measured = tdoas(LAB, np.array([3.0, 3.0, 0.0]))
    measured[anchor] += late
    refused(locate(LAB, measured, sigma(5, 0.05), height_m=0), NoFixReason.RESIDUALS)
    assert isinstance(locate(LAB, measured, sigma(5, 10.0), height_m=0), (Solution, NoSolution))
    everything = locate(LAB, measured, sigma(5, 0.05), height_m=0, residual_tail=0)
    if isinstance(everything, NoSolution) and late < 30:  # 30 m between anchors 10 m apart belong to no position
        assert everything.reason is not NoFixReason.RESIDUALS


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("where", ["anchors", "tdoa", "covariance", "height"])
@pytest.mark.parametrize("height", [None, 0.0])
def test_values_that_are_no_measurement_are_refused_in_silence(bad, where, height):
    anchors, measured, covariance = LAB.copy(), tdoas(LAB, np.array([2.0, 3.0, 0.0])), sigma(5)
    if where == "height":
        height = bad
    else:
        {"anchors": anchors, "tdoa": measured, "covariance": covariance}[where].flat[2] = bad
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(locate(anchors, measured, covariance, height_m=height), NoFixReason.BAD_GEOMETRY)


@pytest.mark.parametrize(
    "covariance", [np.ones((5, 5)), *(np.diag([1, 1, bad, 1, 1]) for bad in (0.0, -1.0, math.nan, math.inf))]
)
def test_matrices_that_are_no_covariance_are_refused(covariance):
    refused(locate(LAB, np.zeros(5), covariance, height_m=0), NoFixReason.BAD_GEOMETRY)


def test_iterations_that_do_not_settle_are_told(monkeypatch):
    monkeypatch.setattr(position, "_find_position", lambda *_: UNSETTLED)
    refused(locate(LAB, np.zeros(5), sigma(5), height_m=0), NoFixReason.NOT_CONVERGED)
    monkeypatch.setattr(position, "_find_position", position.find_position)
    monkeypatch.setattr(search, "descend", lambda _: EXHAUSTED)
    refused(locate(LAB, np.zeros(5), sigma(5), height_m=0), NoFixReason.NOT_CONVERGED)


@settings(max_examples=20)
@given(seed=SEEDS, height_known=st.booleans(), weighted=st.booleans())
def test_as_many_anchors_as_there_is_room_for(seed, height_known, weighted):
    anchors, p = room(seed, MAX_ANCHORS)
    height_m = p[2] if height_known else None
    found = locate(anchors, tdoas(anchors, p), sigma(MAX_ANCHORS - 1), height_m=height_m, weighted=weighted)
    np.testing.assert_allclose(found.position_m, p, atol=1e-6)
    one_more = np.vstack([anchors, p + 1.0])
    with pytest.raises(ValueError, match="at most 32"):
        locate(one_more, tdoas(one_more, p), sigma(MAX_ANCHORS), height_m=height_m, weighted=weighted)


def test_arrays_that_do_not_fit_each_other_raise():
    with pytest.raises(ValueError, match="expected"):
        locate(LAB[:5], np.zeros(5), sigma(5), height_m=0)
    with pytest.raises(ValueError, match="expected"):
        locate(LAB, np.zeros(5), sigma(4), height_m=0)


@settings(max_examples=500)
@given(seed=SEEDS, height_known=st.booleans(), weighted=st.booleans(), tail=st.sampled_from([0.0, 1e-9]))
def test_no_numbers_at_all_make_it_raise_or_warn(seed, height_known, weighted, tail):
    draw = np.random.default_rng(seed)
    n = int(draw.integers(1, 9))
    scale = 10.0 ** draw.integers(-6, 9)
    anchors = np.round(scale * draw.normal(size=(n + 1, 3)), int(draw.integers(-2, 9)))
    measured = 10.0 ** draw.integers(-6, 9) * draw.normal(size=n)
    covariance = sigma(n, 10.0 ** draw.integers(-5, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = locate(
            anchors,
            measured,
            covariance,
            height_m=0.0 if height_known else None,
            weighted=weighted,
            residual_tail=tail,
            z_bounds_m=(-scale, scale),
        )
    if isinstance(result, Solution):
        assert np.isfinite(result.position_m).all()
        assert np.isfinite(result.covariance_m2).all()
        assert np.isfinite(result.chi2)


AS_PLAIN_PYTHON = """
import sys, warnings
warnings.simplefilter("error")
import numpy as np
from skyless.core.tag.position import locate, NoSolution
from skyless.core.geometry import dops_at
draw = np.random.default_rng(9)
anchors = draw.uniform(0, 8, (7, 3))
for kind in range(4):
    used = anchors * [1, 1, 0] if kind == 3 else anchors
    for _ in range(5):
        p = draw.uniform(1, 7, 3)
        r = np.linalg.norm(used - p, axis=1)
        tdoa = r[1:] - r[0] + draw.normal(0, 0.02, 6)
        s = locate(used, tdoa, 4e-4 * (np.eye(6) + 1), height_m=p[2] if kind < 2 else None,
                   weighted=kind % 2 == 0, z_bounds_m=(0, 8) if kind == 3 else None)
        if isinstance(s, NoSolution):
            print(s.reason)
        else:
            print(*s.position_m, *s.covariance_m2.ravel(), s.chi2, s.dof)
print(*dops_at(anchors, draw.uniform(0, 8, (3, 3)), height_known=False).ravel())
print(locate(anchors[:4] * [1, 1, 0], [1e8, -1e8, 3], np.eye(3)).reason)
"""


def test_as_plain_python_the_same_bits():
    outputs = []
    for uncompiled in ("0", "1"):
        run = subprocess.run(
            [sys.executable, "-c", AS_PLAIN_PYTHON],
            env=os.environ | {"SKYLESS_UNCOMPILED": uncompiled},
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr
        outputs.append(run.stdout.split())
    assert outputs[0] == outputs[1]


# Noisy data


def draws(seed, anchors, p, covariance, count):
    noise = np.random.default_rng(seed).normal(size=(count, len(anchors) - 1)) @ np.linalg.cholesky(covariance).T
    return tdoas(anchors, p) + noise


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(("anchors", "height"), [(LAB, 0.0), (LAB_3D, None), (LAB_3D, 1.0)])
def test_the_minimum_is_the_one_that_scipy_finds(anchors, height, weighted):
    covariance = 0.1**2 * LITERAL
    p = np.array([2.2, 3.1, 1.0 if height is None else height])
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if weighted else np.eye(5)
    dims = 3 if height is None else 2
    for measured in draws(11, anchors, p, covariance, 60):
        solution = locate(anchors, measured, covariance, height_m=height, weighted=weighted, z_bounds_m=(0, 3))
        assert isinstance(solution, Solution), solution
        here = [solution.position_m]
        dense = position_covariance(anchors, here, covariance, height_known=height is not None, weighted=weighted)[0]
        np.testing.assert_allclose(solution.covariance_m2, dense, rtol=1e-7, atol=1e-12)

        def residuals(x, measured=measured):
            return whiten @ (measured - tdoas(anchors, np.append(x, p[dims:])))

        peer = least_squares(residuals, p[:dims], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(solution.position_m[:dims], peer.x, atol=2e-6)
        np.testing.assert_allclose(solution.residuals_m, measured - tdoas(anchors, solution.position_m), atol=1e-9)
        at_minimum = np.linalg.solve(np.linalg.cholesky(covariance), solution.residuals_m)
        assert solution.chi2 == pytest.approx(at_minimum @ at_minimum, rel=1e-9)
        if weighted:
            normal = peer.jac.T @ peer.jac
            np.testing.assert_allclose(
                solution.covariance_m2[:dims, :dims], np.linalg.inv(normal), rtol=1e-4, atol=1e-9
            )


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(
    ("anchors", "p", "height", "std"),
    [
        (LAB, P1, 0.0, 0.02),
        (LAB, P2, 0.0, 0.02),
        (LAB_3D, np.array([2.0, 3.0, 1.2]), None, 0.01),
        (LAB_3D, np.array([1.7, 2.9, 1.0]), 1.0, 0.01),
        (LAB, np.array([2.0, 3.0, 1.5]), None, 0.01),  # one plane: the unfolded covariance
    ],
)
@pytest.mark.statistical
def test_the_covariance_is_that_of_the_estimates(anchors, p, height, std, weighted):
    """4000 draws: N·S of a normal sample is Wishart, so each variance has a relative error of √(2/N) = 2.2 %."""
    count, covariance = 4000, std**2 * LITERAL
    z_bounds = (0.0, 3.0)
    solutions = [
        locate(anchors, measured, covariance, height_m=height, weighted=weighted, z_bounds_m=z_bounds)
        for measured in draws(7, anchors, p, covariance, count)
    ]
    assert all(isinstance(s, Solution) for s in solutions)
    dims = 3 if height is None else 2
    errors = np.array([s.position_m - p for s in solutions])[:, :dims]
    at_truth = locate(anchors, tdoas(anchors, p), covariance, height_m=height, weighted=weighted, z_bounds_m=z_bounds)
    root = np.linalg.inv(np.linalg.cholesky(at_truth.covariance_m2[:dims, :dims]))
    whitened = errors @ root.T
    scatter = whitened.T @ whitened / count
    np.testing.assert_allclose(np.diag(scatter), 1.0, atol=5 * math.sqrt(2 / count))
    np.testing.assert_allclose(scatter - np.diag(np.diag(scatter)), 0.0, atol=5 / math.sqrt(count))
    np.testing.assert_allclose(
        np.mean([s.covariance_m2[:dims, :dims] for s in solutions], axis=0),
        at_truth.covariance_m2[:dims, :dims],
        rtol=0.05,
        atol=0.02 * at_truth.covariance_m2.max(),
    )
    dof = len(anchors) - 1 - dims
    chi2s = np.array([s.chi2 for s in solutions])
    assert {s.dof for s in solutions} == {dof}
    if weighted:
        assert chi2s.mean() == pytest.approx(dof, abs=5 * math.sqrt(2 * dof / count))
    else:
        assert chi2s.mean() > dof  # only the weighted estimate minimises it


@pytest.mark.parametrize("std", [0.1, 0.5])
@pytest.mark.statistical
def test_it_always_converges_in_the_lab(std):
    """Tags anywhere in the lab. With 0.5 m of noise the two sides of a wall of anchors can fit equally well."""
    covariance = std**2 * (np.eye(5) + 1)
    draw = np.random.default_rng(21)
    inside = covered = mirrors = 0
    count = 2500
    for _ in range(count):
        p = np.append(draw.uniform([0.3, 0.3], [5.7, 7.7]), 0.0)
        measured = tdoas(LAB, p) + np.linalg.cholesky(covariance) @ draw.normal(size=5)
        solution = locate(LAB, measured, covariance, height_m=0)
        if isinstance(solution, NoSolution):
            assert solution.reason is NoFixReason.MIRROR, solution
            mirrors += 1
            continue
        inside += 1
        off = (solution.position_m - p)[:2]
        covered += off @ np.linalg.solve(solution.covariance_m2[:2, :2], off) < chi2.isf(0.01, 2)
    assert mirrors == 0 if std < 0.2 else mirrors < 0.02 * count
    # Half a metre bends the hyperbolas within one sigma; the ellipse still holds what it promises, nearly.
    assert covered > (0.98 if std < 0.2 else 0.96) * inside


@pytest.mark.parametrize("across", [0.0, 0.05, 0.2, 0.5, 1.0, 2.0])
@pytest.mark.statistical
def test_near_the_anchors_plane_the_reported_height_error_is_honest(across):
    """Merged or apart, the height is known about as well as claimed: its mean normalised square is 1, or less.

    What is measured is the height's square s, with a sigma of 0.85 m² here: merged is s < 1.7 m².
    """
    covariance = 0.03**2 * (np.eye(5) + 1)
    p = np.array([1.7, 2.6, across])
    solutions = [locate(LAB, m, covariance, z_bounds_m=(-1e-9, 3)) for m in draws(31, LAB, p, covariance, 2000)]
    assert all(isinstance(s, Solution) for s in solutions)
    merged = [s for s in solutions if s.mirror_m is None]
    assert all(abs(s.position_m[2]) < 1e-12 for s in merged)
    assert len(merged) > 1800 if across < 0.7 else len(merged) < 800
    assert len(merged) == 0 if across == 2.0 else merged
    normalised = [(s.position_m[2] - across) ** 2 / s.covariance_m2[2, 2] for s in solutions]
    assert 0.3 < np.mean(normalised) < 1.3
    if across == 2.0:
        assert np.mean(normalised) == pytest.approx(1.0, abs=0.2)


@pytest.mark.statistical
def test_chi2_rejects_about_as_often_as_it_says():
    count, tail, covariance = 4000, 0.05, 0.05**2 * (np.eye(5) + 1)
    rejected = [
        isinstance(locate(LAB, measured, covariance, height_m=0, residual_tail=tail), NoSolution)
        for measured in draws(41, LAB, P1, covariance, count)
    ]
    assert np.mean(rejected) == pytest.approx(tail, abs=5 * math.sqrt(tail * (1 - tail) / count))


@pytest.mark.parametrize(
    ("covariance", "weighted", "at_p1_cm", "at_p2_cm"),
    [
        (literal_covariance, False, 5.36, 5.46),
        (literal_delayed_covariance, False, 3.60, 3.63),
        (literal_covariance, True, 5.16, 5.29),
        (bracketed_covariance, True, 3.41, 3.59),
    ],
    ids=["literal", "literal-delayed", "weighted", "bracketed"],
)
def test_the_covariance_predicts_the_simulated_lab(covariance, weighted, at_p1_cm, at_p2_cm):
    """The column "predicted σ" of docs/maths.md section 5: 100 ps, one fix per superframe."""
    tx, rx = stamp_variances_m2(100e-12, 100e-12)
    predicted = position_covariance(LAB, [P1, P2], covariance(KAPPA, tx, rx), height_known=True, weighted=weighted)
    sigma_cm = 100.0 * np.sqrt(np.trace(predicted, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma_cm, [at_p1_cm, at_p2_cm], atol=0.008)
