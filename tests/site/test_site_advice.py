"""Warnings on valid sites, each on the geometry that deserves it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.site import EXACT, AccuracySite, AnchorSite, ScheduleSite, TagsSite
from skyless.sim.lab import lab_site
from skyless.site.file.advice import warnings_of


def site_of(points, height_m=None):
    anchors = tuple(
        AnchorSite(id=number, x_m=float(x), y_m=float(y), z_m=float(z)) for number, (x, y, z) in enumerate(points, 1)
    )
    return replace(lab_site(), anchors=anchors, tags=TagsSite(height_m))


CUBE = [(0, 0, 0), (6, 0, 3), (6, 8, 0), (0, 8, 3), (3, 0, 3), (3, 8, 0)]


def test_a_good_site_has_none():
    assert warnings_of(site_of(CUBE)) == []


@pytest.mark.parametrize(
    ("count", "height_m", "said"),
    [
        (2, 0.0, "2 anchors give no position: one at a known height needs 3"),
        (3, 0.0, "3 anchors are the fewest"),
        (4, 0.0, None),
        (3, None, "3 anchors give no position: one with its height needs 4"),
        (4, None, "4 anchors are the fewest"),
        (5, None, None),
    ],
)
def test_how_many_anchors(count, height_m, said):
    warnings = warnings_of(site_of(CUBE[:count], height_m))
    assert [said in warning for warning in warnings] == ([] if said is None else [True])


def rotated(points, angles):
    a, b = angles
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return np.array(points, dtype=float) @ about_z.T @ about_x.T


angle = st.floats(-3, 3)


@given(st.tuples(angle, angle), st.floats(-1e4, 1e4))
def test_one_plane_however_it_lies(angles, shift):
    flat = [(0, 0, 0), (6, 0, 0), (6, 8, 0.1), (0, 8, 0), (3, 4, 0), (1, 5, 0.05)]
    (warning,) = warnings_of(site_of(rotated(flat, angles) + shift))
    assert "one plane" in warning
    assert warnings_of(site_of(rotated(CUBE, angles) + shift)) == []


@given(angle, st.floats(-1e4, 1e4))
def test_one_line_on_the_floor(turn, shift):
    line = [(0, 0, 0), (5, 0.1, 0), (9, 0, 0), (12, -0.1, 0)]
    (warning,) = warnings_of(site_of(rotated(line, (turn, 0)) + shift, height_m=shift))
    assert "one line" in warning
    assert warning.endswith("hang one anchor away from it")


def test_one_plane_does_not_matter_at_a_known_height():
    assert warnings_of(site_of([(x, y, 2) for x, y, _ in CUBE], height_m=1.0)) == []


def test_short_guard():
    site = replace(site_of(CUBE), schedule=ScheduleSite(slot_s=2.5e-3, guard_s=1e-4))
    (warning,) = warnings_of(site)
    assert "guard of 100 µs" in warning


def test_survey_and_ranges_without_error():
    (warning,) = warnings_of(replace(site_of(CUBE), accuracy=EXACT))
    assert "states that survey and ranges are exact; no real site is" in warning
    for accuracy in (AccuracySite(survey_std_m=0.0), AccuracySite(range_std_m=0.0)):
        assert warnings_of(replace(site_of(CUBE), accuracy=accuracy)) == []
