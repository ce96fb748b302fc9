"""Tails of distributions against SciPy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtrc, erfcx, ndtr, ndtri

from skyless.core.native.arithmetic import FAR_TAIL, chi2_tail, mean_if_positive, normal_quantile, normal_tail


@given(z=st.floats(-9.0, 37.0))
def test_the_normal_tail(z):
    assert normal_tail(z) == pytest.approx(ndtr(-z), rel=1e-12)


@given(tail=st.floats(1e-300, 0.4999))
def test_the_quantile_of_the_normal_distribution(tail):
    assert normal_quantile(tail) == pytest.approx(-ndtri(tail), rel=1e-12, abs=1e-12)


@given(dof=st.integers(1, 100), chi2=st.floats(0.0, 1399.0))
def test_the_tail_of_chi2(dof, chi2):
    assert chi2_tail(dof, chi2) == pytest.approx(chdtrc(dof, chi2), rel=1e-11, abs=1e-250)


@pytest.mark.parametrize("chi2", [1400.0, 1e300, np.inf])
def test_far_tails_are_none(chi2):
    assert chi2_tail(3, chi2) == 0.0


@given(mean=st.floats(-60.0, 60.0), sigma=st.floats(1e-3, 1e3))
def test_the_mean_of_what_is_positive(mean, sigma):
    expected = mean + math.sqrt(2.0 / math.pi) / erfcx(-mean / math.sqrt(2.0))
    assert mean_if_positive(mean * sigma, sigma) == pytest.approx(sigma * expected, rel=1e-11)


@pytest.mark.parametrize("mean", [-FAR_TAIL, FAR_TAIL])
def test_series_and_fraction_meet(mean):
    assert normal_tail(mean) == pytest.approx(normal_tail(mean * (1.0 - 1e-14)), rel=1e-12)
