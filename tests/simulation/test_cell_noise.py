"""Keyed random numbers and the clocks made of them: their statistics against closed forms."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from skyless.core.ticks import TICK_RATE_HZ, TICK_S
from skyless.sim.cells.reception import (
    CHECKPOINT_KNOTS,
    KNOT_TICKS,
    CellClocks,
    key_of,
    mixed,
    normal,
    normal_pair,
    own_time,
    purpose_key,
    true_time,
    uniform,
)
from skyless.sim.oscillator import OscillatorModel, Temperature

pytestmark = pytest.mark.site

COUNT = 20_000
Z = 5.0
"""Bounds are five standard deviations of what is measured."""


def keys(purpose):
    """Of neighbours in all three numbers, as nodes and frames are."""
    base = np.uint64(purpose_key(11, purpose))
    return [np.uint64(key_of(base, k % 20, k // 20 % 20, k // 400)) for k in range(COUNT)]


def test_uniforms_of_neighbouring_keys_are_uniform_and_independent():
    drawn = np.array([uniform(key) for key in keys(3)])
    assert kstest(drawn, "uniform").pvalue > 1e-6
    for lag in (1, 20, 400):
        assert abs(np.corrcoef(drawn[lag:], drawn[:-lag])[0, 1]) < Z / np.sqrt(COUNT - lag)


def test_normals_are_normal_and_those_of_a_pair_independent():
    pairs = np.array([normal_pair(key) for key in keys(4)])
    for column in pairs.T:
        assert kstest(column, "norm").pvalue > 1e-6
        assert abs(column.mean()) < Z / np.sqrt(COUNT)
        assert abs(column.var() - 1.0) < Z * np.sqrt(2.0 / COUNT)
    assert abs(np.corrcoef(pairs.T)[0, 1]) < Z / np.sqrt(COUNT)
    assert normal(np.uint64(5)) == normal_pair(np.uint64(5))[0]


def test_numbers_of_different_purposes_and_seeds_do_not_meet():
    one = np.array([uniform(key) for key in keys(3)])
    other = np.array([uniform(key) for key in keys(4)])
    assert abs(np.corrcoef(one, other)[0, 1]) < Z / np.sqrt(COUNT)
    assert purpose_key(1, 2) != purpose_key(2, 1)


@given(st.integers(0, (1 << 63) - 1), st.integers(-(1 << 40), 1 << 40))
def test_a_changed_bit_changes_half_of_the_key(key, value):
    """Binomial of 64 halves: six standard deviations are 24 bits."""
    flipped = int(mixed(np.uint64(key), value)) ^ int(mixed(np.uint64(key), value ^ 1))
    assert abs(flipped.bit_count() - 32) <= 24


def clocks_of(model, nodes, seed=5):
    return CellClocks(model, np.arange(nodes), seed)


@pytest.mark.parametrize("apart", [1, 4, 16, 64])
def test_allan_variance_is_that_of_the_two_state_model(apart):
    """One second difference a node, so that they are independent; a variance's own deviation is √(2/n)."""
    nodes, model = 3000, OscillatorModel(white_fm=2e-10, random_walk_fm=1e-9)
    knots = clocks_of(model, nodes).cover(0, 3 * apart * KNOT_TICKS)
    chosen = np.array([0, apart, 2 * apart])
    phase_s = ((knots.ticks[:, chosen] - knots.ticks[:, :1] - chosen * KNOT_TICKS) + knots.fraction[:, chosen]) * TICK_S
    tau_s = apart * KNOT_TICKS * TICK_S
    measured = np.mean((phase_s[:, 2] - 2.0 * phase_s[:, 1] + phase_s[:, 0]) ** 2) / (2.0 * tau_s**2)
    expected = model.white_fm**2 / tau_s + model.random_walk_fm**2 * tau_s / 3.0
    assert measured == pytest.approx(expected, rel=Z * np.sqrt(2.0 / nodes))


def test_offsets_and_counters_start_anywhere():
    nodes, quiet = 2000, OscillatorModel(white_fm=0.0, random_walk_fm=0.0)
    knots = clocks_of(quiet, nodes).cover(0, 4 * KNOT_TICKS)
    offset_ppm = ((knots.ticks[:, 4] - knots.ticks[:, 0]) / (4 * KNOT_TICKS) - 1.0) * 1e6
    assert kstest(offset_ppm, "uniform", (-10.0, 20.0)).pvalue > 1e-6
    assert kstest(knots.ticks[:, 0] / 2.0**40, "uniform").pvalue > 1e-6


@settings(max_examples=50)
@given(st.integers(0, 19), st.integers(KNOT_TICKS, 60 * KNOT_TICKS), st.floats(0.0, 0.999))
def test_the_time_at_which_a_counter_shows_a_value_is_the_inverse(node, ticks, fraction):
    knots = clocks_of(OscillatorModel(random_walk_fm=1e-7), 20).cover(0, 61 * KNOT_TICKS)
    own, own_fraction = own_time(knots, node, ticks, fraction)
    back, back_fraction = true_time(knots, node, own)
    assert (ticks - back) + fraction - back_fraction == pytest.approx(own_fraction, abs=1e-4)
    again, again_fraction = own_time(knots, node, back, back_fraction)
    assert (again - own) + again_fraction == pytest.approx(0.0, abs=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3 * CHECKPOINT_KNOTS), st.integers(1, 300)), min_size=1, max_size=6))
def test_clocks_are_the_same_in_whatever_order_they_are_asked_for(spans):
    asked, whole = clocks_of(OscillatorModel(), 3), clocks_of(OscillatorModel(), 3).cover(0, 1100 * KNOT_TICKS)
    for first, length in spans:
        knots = asked.cover(first * KNOT_TICKS, (first + length) * KNOT_TICKS)
        assert knots.first <= first
        assert knots.first + knots.ticks.shape[1] > first + length + 1
        columns = slice(knots.first, knots.first + knots.ticks.shape[1])
        assert (knots.ticks == whole.ticks[:, columns]).all()
        assert (knots.fraction == whole.fraction[:, columns]).all()


def test_a_shifted_counter_stays_shifted():
    clocks, plain = clocks_of(OscillatorModel(), 2), clocks_of(OscillatorModel(), 2)
    clocks.cover(0, KNOT_TICKS)
    clocks.shift(1, 12345)
    late = round(20.0 * TICK_RATE_HZ)
    moved, still = (one.cover(late, late + KNOT_TICKS) for one in (clocks, plain))
    assert own_time(moved, 1, late, 0.0)[0] - own_time(still, 1, late, 0.0)[0] == 12345
    assert own_time(moved, 0, late, 0.0) == own_time(still, 0, late, 0.0)


def test_temperatures_are_refused():
    with pytest.raises(ValueError, match="temperature should be None"):
        clocks_of(OscillatorModel(temperature=Temperature()), 1)


PLAIN = """
import numpy as np
from skyless.core.air.almanac import period_code
from skyless.sim.cells.world import CellAnchors, CellWorld
from skyless.sim.impairments import Impairments
from skyless.sim.trajectory import Static
positions_m = np.array([(15.0 * x, 15.0 * y, 3.0) for y in range(3) for x in range(3)])
codes = np.full(len(positions_m), period_code(1 / 30))
anchors = CellAnchors(np.arange(9), positions_m, np.full(9, 16_436))
world = CellWorld(anchors, codes, [Static(12.0, 9.0, 1.0)], Impairments(), 5)
received = world.receptions(0, 0.1, 0.15)
print(len(received), received.rx_ticks.tolist(), received.relay_rx_ticks.tolist())
"""


@pytest.mark.statistical
def test_plain_python_computes_the_same_world():
    """NumPy warns of the keys' overflow, which is wanted."""
    printed = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        command = [sys.executable, "-W", "ignore::RuntimeWarning", "-c", PLAIN]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        printed.append(run.stdout)
    assert printed[0] == printed[1]
    assert not printed[0].startswith("0 ")
