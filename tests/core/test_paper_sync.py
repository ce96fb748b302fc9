"""The paper's two-message synchronisation on ideal and noisy linear clocks."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.protocol1.snapshots import relative_offset, relative_rate, synchronise, to_master
from skyless.core.ticks import TICK_M, TICK_RATE_HZ


@dataclass(frozen=True, slots=True)
class LinearClock:
    """A clock with constant offset and rate (``eq:TauMaster``, ``eq:TauAnchor``, ``eq:TauTag``)."""

    offset_ticks: float
    rate: float
    """Normalised rate ν, 1 for a perfect oscillator."""

    def read(self, true_ticks: float) -> float:
        """Reading, in ticks, at a true time counted in ticks."""
        return self.offset_ticks + self.rate * true_ticks


ppm = st.floats(-20e-6, 20e-6)
interval_s = st.floats(1e-3, 20.0)


@given(ppm, ppm, interval_s, st.floats(0.5, 200.0), st.floats(-1.0, 1.0))
def test_an_anchors_time_is_converted_up_to_the_systematic_error(rate_m, rate_i, spacing_s, range_m, later_s):
    """The error left is e_im = (1 - ν_i)·δ/ν̄ (eq:AnchorSync), 2 mm at 100 m and 20 ppm (docs/maths.md section 4)."""
    spacing = spacing_s * TICK_RATE_HZ
    tof = range_m / TICK_M
    master, anchor = LinearClock(0.0, 1.0 + rate_m), LinearClock(0.0, 1.0 + rate_i)
    rx1 = anchor.read(tof)
    tx2, rx2 = round(master.read(spacing)), round(anchor.read(spacing + tof) - rx1)
    rate, offset = synchronise(0, tx2, 0, rx2, tof)
    when = later_s * TICK_RATE_HZ
    converted = to_master(anchor.read(when) - rx1, rate, offset)
    systematic = (1.0 - anchor.rate) * tof / rate
    rounding = 3.0 * (1.0 + abs(later_s) / spacing_s)
    assert converted - master.read(when) == pytest.approx(systematic, abs=rounding)


@given(st.lists(st.integers(-1000, 1000), min_size=3, max_size=3), interval_s, st.floats(0, 1e5))
def test_averaging_the_two_offsets_changes_nothing(noise, spacing_s, tof):
    """docs/maths.md E2: with a single two-point rate both offsets are the same for any noise."""
    spacing = round(spacing_s * TICK_RATE_HZ)
    tx, rx = float(spacing + noise[0]), float(spacing + noise[1])
    rate = relative_rate(rx, tx)
    first = relative_offset(0.0, 0.0, rate, tof)
    delayed = relative_offset(rx, tx, rate, tof)
    assert delayed == pytest.approx(first, abs=1e-3)
    assert synchronise(0, int(tx), 0, int(rx), tof)[1] == pytest.approx(first, abs=1e-3)


@given(st.integers(0, 2**55), st.integers(0, 2**55))
def test_the_origin_of_the_counters_does_not_matter(epoch_master, epoch_anchor):
    near = synchronise(0, 959_000_000, 0, 959_003_000, 1234.5)
    far = synchronise(epoch_master, epoch_master + 959_000_000, epoch_anchor, epoch_anchor + 959_003_000, 1234.5)
    assert far == near


def test_rate_uncertainty_is_the_papers():
    """σ_β² = 2(σ_i² + ν̄²σ_m²)/(ν_m·D)², which the paper prints correctly."""
    generator = np.random.default_rng(5)
    draws, spacing, sigma_i, sigma_m = 200_000, 1e9, 6.0, 9.0
    rx = spacing + sigma_i * (generator.standard_normal(draws) - generator.standard_normal(draws))
    tx = spacing + sigma_m * (generator.standard_normal(draws) - generator.standard_normal(draws))
    measured = np.std(rx / tx)
    expected = np.sqrt(2.0 * (sigma_i**2 + sigma_m**2)) / spacing
    assert measured == pytest.approx(expected, rel=4.0 / np.sqrt(2.0 * draws))
