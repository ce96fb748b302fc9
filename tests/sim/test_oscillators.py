"""Oscillators against the theory of their noise, and counters against exact arithmetic."""

import math
from fractions import Fraction

import allantools
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.views import view
from skyless.core.ticks import TICK_RATE_HZ, TICK_S
from skyless.sim import oscillator
from skyless.sim.streams import Streams, draw_normal, draw_uniform, stream

_advance_clock = compiled(oscillator.advance, KERNELS)


def _nodes(model, count, seed=1):
    generators = [stream(seed, 0, node, 1) for node in range(count)]
    return oscillator.make_clocks(model, generators), Streams([stream(seed, 0, node) for node in range(count)])


def _advance(clocks, streams, node, ticks):
    noise = streams.noise[node]
    _advance_clock(clocks[node], noise, ticks, 0.0)
    streams.refill(noise.used)


def _phase_record_s(model, steps, tau_s):
    clocks, streams = _nodes(model, 1)
    clocks[0].local_ticks, clocks[0].local_fraction = 0, 0.0
    step = round(tau_s * TICK_RATE_HZ)
    phase = np.zeros(steps + 1)
    for k in range(1, steps + 1):
        _advance(clocks, streams, 0, k * step)
        phase[k] = (int(clocks[0].local_ticks) - k * step + float(clocks[0].local_fraction)) * TICK_S
    return phase


@pytest.mark.parametrize(
    ("white_fm", "random_walk_fm", "tau_s", "alpha"), [(2e-11, 0.0, 0.01, 0), (0.0, 1e-9, 0.1, -2)]
)
def test_allan_deviation_follows_the_theory(white_fm, random_walk_fm, tau_s, alpha):
    model = oscillator.OscillatorModel(offset_ppm=0.0, white_fm=white_fm, random_walk_fm=random_walk_fm)
    phase = _phase_record_s(model, 8192, tau_s)
    for m in (1, 4, 16, 64, 256):
        _, (deviation,), _, _ = allantools.oadev(phase, rate=1.0 / tau_s, data_type="phase", taus=[m * tau_s])
        tau = m * tau_s
        theory = white_fm**2 / tau + random_walk_fm**2 * tau / 3.0
        freedom = allantools.edf_simple(len(phase), m, alpha)
        low, high = chi2.ppf([1e-4, 1 - 1e-4], freedom) / freedom
        assert low < deviation**2 / theory < high


def test_noise_does_not_depend_on_how_an_interval_is_split():
    count, white, walk = 1500, 2e-9, 5e-9
    model = oscillator.OscillatorModel(offset_ppm=0.0, white_fm=white, random_walk_fm=walk)
    end = round(TICK_RATE_HZ)
    theory = np.array([[white**2 + walk**2 / 3.0, walk**2 / 2.0], [walk**2 / 2.0, walk**2]])
    whiten = np.linalg.inv(np.linalg.cholesky(theory))
    for stops in ([1.0], [0.01, 0.3, 0.35, 0.9, 1.0]):
        clocks, streams = _nodes(model, count)
        counters = view(clocks)
        counters["local_ticks"], counters["local_fraction"] = 0, 0.0
        for stop in stops:
            for node in range(count):
                _advance(clocks, streams, node, round(stop * end))
        pairs = np.stack([(counters["local_ticks"] - end + counters["local_fraction"]) * TICK_S, counters["rate"]])
        x, y = whiten @ pairs
        low, high = chi2.ppf([1e-4, 1 - 1e-4], count) / count
        assert low < np.mean(x * x) < high
        assert low < np.mean(y * y) < high
        assert abs(np.mean(x * y)) < 4.0 / math.sqrt(count)


def test_offsets_are_uniform_and_counters_start_anywhere():
    clocks = view(_nodes(oscillator.OscillatorModel(offset_ppm=10.0), 400)[0])
    assert np.abs(clocks["rate"]).max() < 10e-6
    assert np.std(clocks["rate"]) == pytest.approx(10e-6 / math.sqrt(3.0), rel=0.12)  # 4 standard errors
    assert clocks["local_ticks"].min() < 2**40 * 0.05
    assert clocks["local_ticks"].max() > 2**40 * 0.95


def test_temperature_phase_is_the_integral_of_the_rate():
    warm = oscillator.Temperature(
        coefficient_ppm_per_k=0.2, warm_up_k=12.0, warm_up_s=40.0, swing_k=3.0, swing_period_s=200.0
    )
    model = oscillator.OscillatorModel(offset_ppm=0.0, white_fm=0.0, random_walk_fm=0.0, temperature=warm)
    clocks, streams = _nodes(model, 1)

    def rate(t_s):
        clocks[0].true_ticks = round(t_s * TICK_RATE_HZ)
        return oscillator.clock_rate(clocks[0])

    assert rate(0.0) == pytest.approx(0.2e-6 * 3.0 * math.sin(clocks[0].swing_phase_rad))
    for from_s, to_s in ((0.0, 1.0), (7.0, 300.0), (1000.0, 1000.0025)):
        integral, _ = quad(rate, from_s, to_s, epsabs=1e-18, limit=200)
        assert oscillator.temperature_phase_s(clocks[0], from_s, to_s) == pytest.approx(integral, rel=1e-7, abs=1e-18)
    clocks[0].true_ticks, start = 0, int(clocks[0].local_ticks)
    for second in range(1, 101):
        _advance(clocks, streams, 0, round(second * TICK_RATE_HZ))
    gained_s = (int(clocks[0].local_ticks) - start - int(clocks[0].true_ticks)) * TICK_S
    assert gained_s == pytest.approx(quad(rate, 0.0, 100.0, limit=200)[0], abs=2 * TICK_S)


def test_counter_stays_exact_over_months():
    clocks, streams = _nodes(oscillator.OscillatorModel(offset_ppm=0.0, white_fm=0.0, random_walk_fm=0.0), 1)
    rate = 2.0**-20 + 2.0**-30
    clocks[0].rate, clocks[0].local_fraction = rate, 0.25
    start = int(clocks[0].local_ticks)
    hour = round(3600 * TICK_RATE_HZ) + 12345
    for k in range(1, 24 * 180 + 1):
        _advance(clocks, streams, 0, k * hour)
    exact = start + Fraction(1, 4) + 24 * 180 * hour * (1 + Fraction(rate))
    found = int(clocks[0].local_ticks) + Fraction(float(clocks[0].local_fraction))
    assert abs(found - exact) < Fraction(1, 1000)


def test_emission_is_where_the_counter_shows_the_time():
    clocks, streams = _nodes(oscillator.OscillatorModel(offset_ppm=0.0, white_fm=0.0, random_walk_fm=0.0), 1)
    clocks[0].rate, clocks[0].local_fraction = -7.25e-6, 0.75
    start = int(clocks[0].local_ticks) + Fraction(3, 4)
    target = int(clocks[0].local_ticks) + 63_897_601
    foreseen = oscillator.foresee(clocks[0], target)
    fraction = oscillator.emit(clocks[0], streams.noise[0], target, 0.0, 0.0)
    exact = (target - start) / (1 + Fraction(-7.25e-6))
    assert abs(clocks[0].true_ticks + Fraction(fraction) - exact) < Fraction(1, 10**5)
    assert abs(foreseen - exact) <= 2
    assert (clocks[0].local_ticks, clocks[0].local_fraction) == (target, 0.0)


def test_emission_noise_is_that_of_the_interval():
    """Variance of the true time that a counter needs to a mark: q_w dt + q_rw dt³/3, as for the counter itself."""
    count, white, walk = 2000, 1e-9, 1e-6
    clocks, streams = _nodes(oscillator.OscillatorModel(offset_ppm=0.0, white_fm=white, random_walk_fm=walk), count)
    dt = 63_897_600
    late = np.empty(count)
    for node in range(count):
        clocks[node].local_fraction = 0.0
        target = int(clocks[node].local_ticks) + dt
        fraction = oscillator.emit(clocks[node], streams.noise[node], target, 0.0, 0.0)
        late[node] = (clocks[node].true_ticks - dt + fraction) * TICK_S
    dt_s = dt * TICK_S
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count) / count
    assert low < np.mean(late**2) / (white**2 * dt_s + walk**2 * dt_s**3 / 3.0) < high


def test_streams_refill_without_a_trace_of_their_neighbours():
    """A node's numbers come in the order of its generator, whatever other nodes use up."""
    alone, crowded = Streams([stream(5, 0, 1)]), Streams([stream(5, 0, 1), stream(5, 0, 2)])
    first, second = [], []
    for k in range(3000):
        first.append(draw_normal(alone.noise[0]))
        alone.refill()
        second.append(draw_normal(crowded.noise[0]))
        for _ in range(k % 3):
            draw_normal(crowded.noise[1])
        crowded.refill()
    assert first == second


def test_uniform_draws_are_uniform():
    streams = Streams([stream(3, 0, 1)])
    values = np.array([draw_uniform(streams.noise[0]) for _ in range(1000)])
    worst = np.abs(np.sort(values) - np.arange(1, 1001) / 1000).max()
    assert worst < 1.95 / math.sqrt(1000)  # Kolmogorov–Smirnov at 0.1 %
    assert 0.0 < values.min() < values.max() < 1.0
