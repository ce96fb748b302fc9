"""The paper's two-message synchronisation, its TDoA and the bracketed one, on ideal and noisy clocks.

Exact on ideal ones, and as noisy as the corrected theory says on others.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.protocol1 import snapshots
from skyless.core.ticks import TICK_M, TICK_RATE_HZ

pytestmark = pytest.mark.site

SUPERFRAME = round(15e-3 * TICK_RATE_HZ)


def stamps(rates, epochs, delay, range_im, range_i, range_m, noise=(0.0,) * 10):
    """Stamps of two rounds: master at 0 and Δ, anchor ``delay`` later; true times in ticks, noise in ticks."""
    tof_im, tof_i, tof_m = range_im / TICK_M, range_i / TICK_M, range_m / TICK_M

    def clock(which, true, extra):
        return epochs[which] + round(true * rates[which] + extra)

    times = (0.0, float(SUPERFRAME))
    m = [clock(0, t, 0.0) for t in times]
    emitted_m = [t + noise[k] for k, t in enumerate(times)]
    s = [clock(1, t + tof_im, noise[2 + k]) for k, t in enumerate(emitted_m)]
    a = [clock(1, t + delay, 0.0) for t in times]
    r = [clock(2, t + delay + noise[4 + k] + tof_i, noise[6 + k]) for k, t in enumerate(times)]
    rm = [clock(2, t + tof_m, noise[8 + k]) for k, t in enumerate(emitted_m)]
    return m, s, a, r, rm, tof_im


ppm = st.floats(-20e-6, 20e-6)
metres = st.floats(0.5, 30.0)


@given(ppm, ppm, ppm, st.integers(1, 5), metres, metres, metres, st.integers(0, 2**50))
def test_ideal_clocks_give_the_difference_of_ranges(rm, ri, rt, slot, range_im, range_i, range_m, epoch):
    """What is left is ν(ρ_i - ρ_m) - c·ν̄·e_im (eq:GPSTDoA), below 2.5 mm here, and the rounding of ten stamps."""
    delay = slot * SUPERFRAME / 6
    m, s, a, r, tag_m, tof = stamps(
        (1 + rm, 1 + ri, 1 + rt), (epoch, 3 * epoch + 7, 5), delay, range_im, range_i, range_m
    )
    first, delayed = snapshots.literal_tdoa(*m, *s, *a, *r, *tag_m, tof)
    bracketed = snapshots.bracketed_tdoa(*m, *s, *a, *r, tag_m[1], tof)
    expected = (range_i - range_m) / TICK_M
    for value in (first, delayed, bracketed):
        assert value == pytest.approx(expected, abs=6.0)


def test_standard_deviations_are_the_corrected_theorys():
    """Monte Carlo of the exact algorithm against docs/maths.md section 2, for three places of the anchor's slot."""
    generator = np.random.default_rng(11)
    draws, sigma = 20_000, 60.0
    sigma_m2 = (sigma * TICK_M) ** 2
    for slot in (1, 3, 5):
        kappa = np.array([slot / 6])
        values = np.empty((draws, 3))
        for k in range(draws):
            noise = tuple(sigma * generator.standard_normal(10))
            m, s, a, r, tag_m, tof = stamps((1.0, 1.0, 1.0), (0, 0, 0), slot * SUPERFRAME / 6, 5.0, 4.0, 3.0, noise)
            values[k, :2] = snapshots.literal_tdoa(*m, *s, *a, *r, *tag_m, tof)
            values[k, 2] = snapshots.bracketed_tdoa(*m, *s, *a, *r, tag_m[1], tof)
        theory = [
            np.sqrt(covariance(kappa, sigma_m2, sigma_m2)[0, 0])
            for covariance in (
                snapshots.literal_covariance,
                snapshots.literal_delayed_covariance,
                snapshots.bracketed_covariance,
            )
        ]
        np.testing.assert_allclose(values.std(axis=0) * TICK_M, theory, rtol=4.0 / np.sqrt(2 * draws))


def test_covariance_of_two_anchors_is_the_shared_stamp_of_the_reference():
    sigma2 = 0.01
    covariance = snapshots.literal_covariance(np.array([1 / 6, 5 / 6]), sigma2, sigma2)
    assert covariance[0, 1] == sigma2
    assert covariance[0, 0] == pytest.approx(2 * sigma2 * ((7 / 6) ** 2 + (1 / 6) ** 2 + 1))


interval_s = st.floats(1e-3, 20.0)


@given(ppm, ppm, interval_s, st.floats(0.5, 200.0), st.floats(-1.0, 1.0))
def test_an_anchors_time_is_converted_up_to_the_systematic_error(rate_m, rate_i, spacing_s, range_m, later_s):
    """The error left is e_im = (1 - ν_i)·δ/ν̄ (eq:AnchorSync), 2 mm at 100 m and 20 ppm (docs/maths.md section 4)."""
    spacing = spacing_s * TICK_RATE_HZ
    tof = range_m / TICK_M
    master, anchor = 1.0 + rate_m, 1.0 + rate_i
    tx2, rx2 = round(master * spacing), round(anchor * spacing)
    rate, offset = snapshots.synchronise(0, tx2, 0, rx2, tof)
    when = later_s * TICK_RATE_HZ
    converted = snapshots.to_master(anchor * (when - tof), rate, offset)
    systematic = (1.0 - anchor) * tof / rate
    rounding = 3.0 * (1.0 + abs(later_s) / spacing_s)
    assert converted - master * when == pytest.approx(systematic, abs=rounding)


@given(st.lists(st.integers(-1000, 1000), min_size=3, max_size=3), interval_s, st.floats(0, 1e5))
def test_averaging_the_two_offsets_changes_nothing(noise, spacing_s, tof):
    """docs/maths.md E2: with a single two-point rate both offsets are the same for any noise."""
    spacing = round(spacing_s * TICK_RATE_HZ)
    tx, rx = float(spacing + noise[0]), float(spacing + noise[1])
    rate = snapshots.relative_rate(rx, tx)
    first = snapshots.relative_offset(0.0, 0.0, rate, tof)
    delayed = snapshots.relative_offset(rx, tx, rate, tof)
    assert delayed == pytest.approx(first, abs=1e-3)
    assert snapshots.synchronise(0, int(tx), 0, int(rx), tof)[1] == pytest.approx(first, abs=1e-3)


@given(st.integers(0, 2**55), st.integers(0, 2**55))
def test_the_origin_of_the_counters_does_not_matter(epoch_master, epoch_anchor):
    near = snapshots.synchronise(0, 959_000_000, 0, 959_003_000, 1234.5)
    far = snapshots.synchronise(
        epoch_master, epoch_master + 959_000_000, epoch_anchor, epoch_anchor + 959_003_000, 1234.5
    )
    assert far == near
