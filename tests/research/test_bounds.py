"""Cramér–Rao bounds: against the textbook's matrices, against the published table, and against what methods reach."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from textbook_bound import ALL_BIASES, LAB, PHASES, RAISED, SLOT_S, STAMP_S, positions, settings_of, textbook, walk

from skyless.core.geometry import anchor_positions
from skyless.core.protocol1.snapshots import bracketed_covariance, literal_covariance
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.machine import cores
from skyless.research.studies.efficiency import EPISODE_SPEED_STD_MPS, EPISODE_SUPERFRAMES, WHITE_FM, random_path
from skyless.research.uncertainty import Biases, BoundSettings, Chain, tracking_bound
from skyless.sim.lab import paper_lab_site
from support.dense_covariance import position_covariance

STAMP_M = SPEED_OF_LIGHT_MPS * STAMP_S
TABLE = [
    (100e-12, 1e-9, 0.5, 0.02207, 0.01698, 500),
    (150e-12, 1e-9, 0.5, 0.02983, 0.02301, 500),
    (100e-12, 1e-9, 2.0, 0.02966, 0.02316, 2000),
    (100e-12, 1e-8, 0.5, 0.02339, 0.01732, 500),
]


def lab_tracking_bound_m(stamp_s, *, random_walk_fm=1e-9, qa=0.5, mesh=False, paths=400, seed=1):
    """Root mean square of the posterior bound of the position in the lab at the end of two seconds, in metres.

    Tags start in the middle half of the room, each component of their velocity normal with 0.4 m/s, and accelerate
    at random (``qa``). ``mesh``: anchors also relay when they heard each other.
    """
    site = paper_lab_site()
    anchors = anchor_positions(site)
    slot_s = site.schedule.slot_s
    settings = BoundSettings(
        stamp_s,
        white_fm=WHITE_FM,
        random_walk_fm=random_walk_fm,
        qa=qa,
        slot_s=slot_s,
        speed_std_mps=EPISODE_SPEED_STD_MPS,
        mesh=mesh,
    )
    low, high = anchors[:, :2].min(axis=0), anchors[:, :2].max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 4.0
    draw = np.random.default_rng(seed)
    walks = [random_path(draw, middle, half, slot_s, EPISODE_SUPERFRAMES * len(anchors), qa) for _ in range(paths)]

    def variance(path):
        return float(np.trace(tracking_bound(anchors, path, settings)[-20:], axis1=1, axis2=2).mean())

    with ThreadPoolExecutor(cores()) as pool:
        return float(np.sqrt(np.mean(list(pool.map(variance, walks)))))


def snapshot_bound(place, *, superframes=2, mesh=False):
    """Bound of a tag at rest from all raw stamps of these superframes; all clocks are unknown, straight lines."""
    settings = settings_of(white_fm=0.0, random_walk_fm=0.0, qa=0.0, speed_std_mps=0.0, mesh=mesh)
    return tracking_bound(LAB, np.tile(place, (superframes * len(LAB), 1)), settings)[-1]


"""Stamp, random walk, qa, bound without and with mesh; and how many paths average to well below 2 %."""


@pytest.mark.parametrize(("stamp_s", "walk", "qa", "without", "with_mesh", "paths"), TABLE)
@pytest.mark.statistical
def test_the_published_bounds_of_the_lab(stamp_s, walk, qa, without, with_mesh, paths):
    for mesh, expected in ((False, without), (True, with_mesh)):
        found = lab_tracking_bound_m(stamp_s, random_walk_fm=walk, qa=qa, mesh=mesh, paths=paths)
        assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "biases", "superframes", "rtol"),
    [
        ({"mesh": False}, Biases(), 30, 1e-4),
        ({"mesh": True}, Biases(), 30, 1e-4),
        ({}, ALL_BIASES, 40, 1e-3),
        (PHASES, Biases(), 8, 2e-3),
    ],
    ids=["plain", "mesh", "biases", "phases"],
)
@pytest.mark.parametrize("dims", [2, 3])
def test_the_recursion_is_the_textbooks(changes, biases, superframes, rtol, dims):
    anchors, path = (LAB, walk(superframes)) if dims == 2 else (RAISED, walk(superframes, 1.2))
    settings = settings_of(**changes, height_known=dims == 2)
    expected = positions(textbook(anchors, path, settings, biases), dims)
    found = tracking_bound(anchors, path, settings, biases)
    np.testing.assert_allclose(found[2:], expected, rtol=rtol, atol=1e-9)


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize("superframes", [2, 5])
def test_a_snapshots_bound_is_that_of_least_squares_with_all_clocks_as_unknowns(mesh, superframes):
    """One design matrix of every stamp, unknown lines for the clocks, one unknown per TX stamp with its own row."""
    n, place = 6, np.array([1.2, 1.6, 0.0])
    frames = n * superframes
    unknowns = 2 + 2 * n + frames
    rows = []
    for frame in range(frames):
        sender, t = frame % n, frame * SLOT_S
        row = np.zeros(unknowns)
        row[2 + 2 * n + frame] = 1.0
        rows.append(row.copy())
        for listener in [None, *range(n)]:
            if listener == sender or (listener is not None and sender != 0 and not mesh):
                continue
            row = np.zeros(unknowns)
            row[2 + 2 * n + frame] = -1.0
            if listener is None:
                row[:2] = ((place - LAB[sender]) / np.linalg.norm(place - LAB[sender]))[:2]
                row[2:4] = [1.0, t]
            elif listener > 0:
                row[2 + 2 * listener : 4 + 2 * listener] = [1.0, t]
            if sender > 0:
                row[2 + 2 * sender : 4 + 2 * sender] -= [1.0, t]
            rows.append(row)
    design = np.array(rows) / STAMP_M
    expected = np.linalg.inv(design.T @ design)[:2, :2]
    found = snapshot_bound(place, superframes=superframes, mesh=mesh)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("place", [(3.0, 4.0, 0.0), (1.2, 1.6, 0.0), (5.0, 7.0, 0.0)])
def test_no_snapshot_method_beats_its_bound(place):
    """The full-covariance methods use other parts of the same two superframes' stamps."""
    bound = snapshot_bound(place)
    kappa = np.arange(1, 6) / 6.0
    for covariance in (literal_covariance, bracketed_covariance):
        reached = position_covariance(
            LAB, [place], covariance(kappa, STAMP_M**2, STAMP_M**2), height_known=True, weighted=True
        )[0, :2, :2]
        assert np.linalg.eigvalsh(reached - bound).min() > 0.0


def test_more_information_never_makes_the_bound_worse():
    path = np.tile([2.0, 3.0, 0.0], (6 * 20, 1))

    def last(**changes):
        return tracking_bound(LAB, path, settings_of(**({"mesh": False} | changes)))[-1]

    base = last()
    for better in ({"stamp_s": 50e-12}, {"mesh": True}, {"qa": 0.1}, {"random_walk_fm": 1e-10}):
        assert np.linalg.eigvalsh(base - last(**better)).min() > 0.0


def test_a_path_must_have_whole_superframes():
    with pytest.raises(ValueError, match="7 positions, no multiple of 6 anchors"):
        tracking_bound(LAB, np.zeros((7, 3)), settings_of())


def test_stamps_of_perfect_anchors_are_the_masters_readings_when_they_sent():
    """Nothing is left by the synchronisation of anchors whose clocks run at the true rate."""
    delay_s, spacing_s = np.array([0.01, 0.02]), np.array([0.1, 0.3])
    one = np.ones(2)
    chain = Chain(
        master_offset_s=3.0, master_rate=1.5, tag_offset_s=0.0, tag_rate=1.0, anchor_offset_s=7.0 * one,
        anchor_rate=one, anchor_tof_s=0.1 * one, tag_tof_s=0.2 * one, tag_master_tof_s=0.3, sync_s=1.0,
        sync_spacing_s=0.5, reference_s=2.0, delay_s=delay_s, spacing_s=spacing_s, sigma_master_s=1e-10,
        sigma_anchor_s=1e-10, sigma_tag_s=1e-10,
    )  # fmt: skip
    sent_s = 2.0 + delay_s + np.array([0.0 * one, spacing_s])
    np.testing.assert_allclose([chain.X1, chain.X2], 3.0 + 1.5 * sent_s)
