"""Crystal oscillators and the 40-bit counters driven by them.

A node's state is its counter's value at one instant of true time. Both are a whole number of ticks and a fraction: true
time counts ideal ticks from the start of the world; the counter is kept unwrapped, so that no precision is lost over
months (``docs/maths.md`` section 3).

The noise is the two-state model, sampled exactly between any two instants dt apart: phase and fractional frequency gain
a normal pair of covariance [[q_w dt + q_rw dt³/3, q_rw dt²/2], [q_rw dt²/2, q_rw dt]], with q_w = white_fm² and q_rw =
random_walk_fm². Allan deviation: σ_y(τ)² = q_w/τ + q_rw τ/3.
"""

from math import cos, exp, expm1, pi, sin, sqrt

import numpy as np
from msgspec import Struct

from skyless.core.native.arithmetic import floor
from skyless.core.native.records import Array, Record, Ticks, record
from skyless.core.ticks import TICK_RATE_HZ, TICK_S, WRAP_TICKS
from skyless.sim.streams import Noise, draw_normal


@record
class Clock(Record):
    """One node's oscillator and counter."""

    true_ticks: Ticks
    true_fraction: float
    local_ticks: Ticks
    local_fraction: float
    rate: float
    """Fractional frequency without the temperature's part."""
    white_fm: float
    random_walk_fm: float
    per_kelvin: float
    warm_up_k: float
    warm_up_s: float
    swing_k: float
    swing_rad_per_s: float
    swing_phase_rad: float
    drift: float
    """Fractional frequency that a warm-up adds in the end."""
    drift_start_s: float
    drift_tau_s: float


class Temperature(Struct, frozen=True, forbid_unknown_fields=True):
    """A node's temperature and its effect on the crystal.

    The deviation from the start is warm_up_k·(1 − exp(−t/warm_up_s)) + swing_k·sin(2πt/swing_period_s + φ), with
    a random phase φ for each node.
    """

    coefficient_ppm_per_k: float = 0.1
    warm_up_k: float = 10.0
    warm_up_s: float = 60.0
    swing_k: float = 1.0
    swing_period_s: float = 1800.0


class OscillatorModel(Struct, frozen=True, forbid_unknown_fields=True):
    """The crystals of a site (defaults: the lab of docs/maths.md section 5)."""

    offset_ppm: float = 10.0
    """Each crystal's constant offset is uniform within plus or minus this."""
    white_fm: float = 2e-11
    """Allan deviation at 1 s."""
    random_walk_fm: float = 1e-9
    """In 1/√s: standard deviation of the fractional frequency gained in 1 s."""
    temperature: Temperature | None = None


def make_clocks(model: OscillatorModel, generators: list[np.random.Generator]) -> Array[Clock]:
    """Clocks at true time 0 with random counters and offsets, one for each generator."""
    clocks: Array[Clock] = (Clock * len(generators))()
    for clock, generator in zip(clocks, generators, strict=True):
        clock.rate = generator.uniform(-model.offset_ppm, model.offset_ppm) * 1e-6
        restart_counter(clock, generator)
        clock.white_fm = model.white_fm
        clock.random_walk_fm = model.random_walk_fm
        _set_temperature(clock, model.temperature, generator.uniform(0.0, 2.0 * pi))
    return clocks


def _set_temperature(clock: Clock, temperature: Temperature | None, phase_rad: float) -> None:
    clock.warm_up_s = 1.0
    if temperature is None:
        return
    clock.per_kelvin = temperature.coefficient_ppm_per_k * 1e-6
    clock.warm_up_k = temperature.warm_up_k
    clock.warm_up_s = temperature.warm_up_s
    clock.swing_k = temperature.swing_k
    clock.swing_rad_per_s = 2.0 * pi / temperature.swing_period_s
    clock.swing_phase_rad = phase_rad


def warm_up(clock: Clock, ppm: float, start_s: float, tau_s: float) -> None:
    """Warm a crystal up from ``start_s`` on, with the time constant ``tau_s``, by ``ppm`` in the end."""
    clock.drift = ppm * 1e-6
    clock.drift_start_s = start_s
    clock.drift_tau_s = tau_s


def restart_counter(clock: Clock, generator: np.random.Generator) -> None:
    """Give a node that is switched on a new counter; its crystal stays what it was."""
    clock.local_ticks = int(generator.integers(WRAP_TICKS))
    clock.local_fraction = generator.random()


def clock_rate(clock: Clock) -> float:
    """Fractional frequency of a counter at its last instant, temperature included, dimensionless."""
    rate = clock.rate
    if clock.per_kelvin != 0.0:
        t_s = clock.true_ticks * TICK_S
        warm_up_k = clock.warm_up_k * (1.0 - exp(-t_s / clock.warm_up_s))
        swing_k = clock.swing_k * sin(clock.swing_rad_per_s * t_s + clock.swing_phase_rad)
        rate += clock.per_kelvin * (warm_up_k + swing_k)
    if clock.drift != 0.0:
        since_s = max(clock.true_ticks * TICK_S - clock.drift_start_s, 0.0)
        rate += clock.drift * (1.0 - exp(-since_s / clock.drift_tau_s))
    return rate


def temperature_phase_s(clock: Clock, from_s: float, to_s: float) -> float:
    """Phase in seconds added by temperature between two true times: the closed-form integral of its rate."""
    tau_s = clock.warm_up_s
    warmed = (to_s - from_s) + tau_s * (exp(-to_s / tau_s) - exp(-from_s / tau_s))
    swing = 0.0
    omega, phase = clock.swing_rad_per_s, clock.swing_phase_rad
    if omega != 0.0:
        swing = (cos(omega * from_s + phase) - cos(omega * to_s + phase)) / omega
    return clock.per_kelvin * (clock.warm_up_k * warmed + clock.swing_k * swing)


def drift_phase_s(clock: Clock, from_s: float, to_s: float) -> float:
    """Phase in seconds added by a warm-up between two true times: the closed-form integral of its rate."""
    start_s, tau_s = clock.drift_start_s, clock.drift_tau_s
    since_s, until_s = max(from_s - start_s, 0.0), max(to_s - start_s, 0.0)
    warmed_s = until_s - since_s
    bent_s = tau_s * exp(-since_s / tau_s) * expm1(-warmed_s / tau_s)
    return clock.drift * (warmed_s + bent_s)


def advance(clock: Clock, noise: Noise, true_ticks: Ticks, true_fraction: float) -> None:
    """Advance a counter to a true time, drawing two normals for the noise of the interval.

    A step backwards by at most a flight time (two frames in flight at once) is extrapolated without noise.
    """
    whole = true_ticks - clock.true_ticks
    part = true_fraction - clock.true_fraction
    gain = clock.rate * (whole + part)
    dt_s = (whole + part) * TICK_S
    from_s = clock.true_ticks * TICK_S
    if clock.per_kelvin != 0.0:
        gain += temperature_phase_s(clock, from_s, from_s + dt_s) * TICK_RATE_HZ
    if clock.drift != 0.0:
        gain += drift_phase_s(clock, from_s, from_s + dt_s) * TICK_RATE_HZ
    if dt_s > 0.0:
        white, walk = clock.white_fm, clock.random_walk_fm
        rate_gain = walk * sqrt(dt_s) * draw_normal(noise)
        own_std_s = sqrt(dt_s * (white * white + walk * walk * dt_s * dt_s / 12.0))
        gain += (0.5 * rate_gain * dt_s + own_std_s * draw_normal(noise)) * TICK_RATE_HZ
        clock.rate += rate_gain
    fraction = clock.local_fraction + part + gain
    carry = floor(fraction)
    clock.local_ticks += whole + carry
    clock.local_fraction = fraction - carry
    clock.true_ticks = true_ticks
    clock.true_fraction = true_fraction


def foresee(clock: Clock, local_ticks: Ticks) -> Ticks:
    """True time, in whole ticks, at which an unwrapped counter will show a value if its rate stays."""
    ahead = (local_ticks - clock.local_ticks) / (1.0 + clock_rate(clock))
    return clock.true_ticks + floor(ahead)


def emit(clock: Clock, noise: Noise, local_ticks: Ticks, tx_noise_ticks: float, tx_error_ticks: float) -> float:
    """Advance a counter to the instant at which it shows a value. Returns when its frame really leaves.

    The instant is predicted, the oscillator's noise sampled up to there, and the remaining error removed to first
    order. The result is in ticks from the clock's ``true_ticks``: the instant's fraction, the antenna delay error
    ``tx_error_ticks``, and emission noise of standard deviation ``tx_noise_ticks``.
    """
    forecast = foresee(clock, local_ticks)
    advance(clock, noise, forecast, 0.0)
    error = (clock.local_ticks - local_ticks) + clock.local_fraction
    instant = -error / (1.0 + clock_rate(clock))
    shift = floor(instant)
    clock.true_ticks += shift
    clock.true_fraction = instant - shift
    clock.local_ticks = local_ticks
    clock.local_fraction = 0.0
    fraction = clock.true_fraction + tx_error_ticks
    return fraction + tx_noise_ticks * draw_normal(noise)
