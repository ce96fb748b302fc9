"""Crystal oscillators and the 40-bit counters driven by them.

A node's state is its counter's value at one instant of true time. Both are a whole number of ticks and a fraction: true
time counts ideal ticks from the start of the world; the counter is kept unwrapped, so that no precision is lost over
months (``docs/maths.md`` section 3).

The noise is the two-state model, sampled exactly between any two instants dt apart: phase and fractional frequency gain
a normal pair of covariance [[q_w dt + q_rw dt³/3, q_rw dt²/2], [q_rw dt²/2, q_rw dt]], with q_w = white_fm² and q_rw =
random_walk_fm². Allan deviation: σ_y(τ)² = q_w/τ + q_rw τ/3.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Records
from skyless.core.ticks import TICK_RATE_HZ, TICK_S, WRAP_TICKS
from skyless.sim.streams import draw_normal
from skyless.site.kernels import kernel, part

CLOCK: Final = np.dtype(
    [
        ("true_ticks", np.int64),
        ("true_fraction", np.float64),
        ("local_ticks", np.int64),
        ("local_fraction", np.float64),
        ("rate", np.float64),  # fractional frequency without the temperature's part
        ("white_fm", np.float64),
        ("random_walk_fm", np.float64),
        ("per_kelvin", np.float64),
        ("warm_up_k", np.float64),
        ("warm_up_s", np.float64),
        ("swing_k", np.float64),
        ("swing_rad_per_s", np.float64),
        ("swing_phase_rad", np.float64),
        ("drift", np.float64),  # fractional frequency that a warm-up adds in the end
        ("drift_start_s", np.float64),
        ("drift_tau_s", np.float64),
    ],
    align=True,
)
"""One node's oscillator and counter; kernels work on an array of them."""


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


def make_clocks(model: OscillatorModel, generators: list[np.random.Generator]) -> Records:
    """Clocks, shape (len(generators),), at true time 0 with random counters and offsets, one generator each."""
    clocks = np.zeros(len(generators), dtype=CLOCK)
    for clock, generator in zip(clocks, generators, strict=True):
        clock["rate"] = generator.uniform(-model.offset_ppm, model.offset_ppm) * 1e-6
        clock["local_ticks"] = generator.integers(WRAP_TICKS)
        clock["local_fraction"] = generator.random()
        clock["white_fm"] = model.white_fm
        clock["random_walk_fm"] = model.random_walk_fm
        _set_temperature(clock, model.temperature, generator.uniform(0.0, 2.0 * math.pi))
    return clocks


def _set_temperature(clock: np.void, temperature: Temperature | None, phase_rad: float) -> None:
    clock["warm_up_s"] = 1.0
    if temperature is None:
        return
    clock["per_kelvin"] = temperature.coefficient_ppm_per_k * 1e-6
    clock["warm_up_k"] = temperature.warm_up_k
    clock["warm_up_s"] = temperature.warm_up_s
    clock["swing_k"] = temperature.swing_k
    clock["swing_rad_per_s"] = 2.0 * math.pi / temperature.swing_period_s
    clock["swing_phase_rad"] = phase_rad


def warm_up(clocks: Records, node: int, ppm: float, start_s: float, tau_s: float) -> None:
    """Warm a node's crystal up from ``start_s`` on, with the time constant ``tau_s``, by ``ppm`` in the end."""
    clocks[node]["drift"] = ppm * 1e-6
    clocks[node]["drift_start_s"] = start_s
    clocks[node]["drift_tau_s"] = tau_s


def restart_counter(clocks: Records, node: int, generator: np.random.Generator) -> None:
    """Give a node that was switched on again a new counter; its crystal stays what it was."""
    clocks[node]["local_ticks"] = generator.integers(WRAP_TICKS)
    clocks[node]["local_fraction"] = generator.random()


@part
def clock_rate(clocks: Records, node: int) -> float:
    """Fractional frequency of the node's counter at its last instant, temperature included, dimensionless."""
    clock = clocks[node]
    rate: float = clock["rate"]
    if clock["per_kelvin"] != 0.0:
        t_s = clock["true_ticks"] * TICK_S
        warm_up_k = clock["warm_up_k"] * (1.0 - math.exp(-t_s / clock["warm_up_s"]))
        swing_k = clock["swing_k"] * math.sin(clock["swing_rad_per_s"] * t_s + clock["swing_phase_rad"])
        rate += clock["per_kelvin"] * (warm_up_k + swing_k)
    if clock["drift"] != 0.0:
        since_s = max(clock["true_ticks"] * TICK_S - clock["drift_start_s"], 0.0)
        rate += clock["drift"] * (1.0 - math.exp(-since_s / clock["drift_tau_s"]))
    return rate


@part
def temperature_phase_s(clocks: Records, node: int, from_s: float, to_s: float) -> float:
    """Phase in seconds added by temperature between two true times: the closed-form integral of its rate."""
    clock = clocks[node]
    tau_s = clock["warm_up_s"]
    warm_up = (to_s - from_s) + tau_s * (math.exp(-to_s / tau_s) - math.exp(-from_s / tau_s))
    swing = 0.0
    omega, phase = clock["swing_rad_per_s"], clock["swing_phase_rad"]
    if omega != 0.0:
        swing = (math.cos(omega * from_s + phase) - math.cos(omega * to_s + phase)) / omega
    phase_s: float = clock["per_kelvin"] * (clock["warm_up_k"] * warm_up + clock["swing_k"] * swing)
    return phase_s


@kernel
def drift_phase_s(clocks: Records, node: int, from_s: float, to_s: float) -> float:
    """Phase in seconds added by a warm-up between two true times: the closed-form integral of its rate."""
    clock = clocks[node]
    start_s, tau_s = clock["drift_start_s"], clock["drift_tau_s"]
    since_s, until_s = max(from_s - start_s, 0.0), max(to_s - start_s, 0.0)
    warmed_s = until_s - since_s
    bent_s = tau_s * math.exp(-since_s / tau_s) * math.expm1(-warmed_s / tau_s)
    phase_s: float = clock["drift"] * (warmed_s + bent_s)
    return phase_s


@kernel
def advance(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    node: int,
    true_ticks: int,
    true_fraction: float,
) -> None:
    """Advance a node to a true time, drawing two normals for the noise of the interval.

    A step backwards by at most a flight time (two frames in flight at once) is extrapolated without noise.
    """
    clock = clocks[node]
    whole = true_ticks - clock["true_ticks"]
    part = true_fraction - clock["true_fraction"]
    gain = clock["rate"] * (whole + part)
    dt_s = (whole + part) * TICK_S
    if clock["per_kelvin"] != 0.0:
        from_s = clock["true_ticks"] * TICK_S
        gain += temperature_phase_s(clocks, node, from_s, from_s + dt_s) * TICK_RATE_HZ
    if clock["drift"] != 0.0:
        from_s = clock["true_ticks"] * TICK_S
        gain += drift_phase_s(clocks, node, from_s, from_s + dt_s) * TICK_RATE_HZ
    if dt_s > 0.0:
        white, walk = clock["white_fm"], clock["random_walk_fm"]
        rate_gain = walk * math.sqrt(dt_s) * draw_normal(normals, cursors, node)
        own_std_s = math.sqrt(dt_s * (white * white + walk * walk * dt_s * dt_s / 12.0))
        gain += (0.5 * rate_gain * dt_s + own_std_s * draw_normal(normals, cursors, node)) * TICK_RATE_HZ
        clock["rate"] += rate_gain
    fraction = clock["local_fraction"] + part + gain
    carry = math.floor(fraction)
    clock["local_ticks"] += whole + int(carry)
    clock["local_fraction"] = fraction - carry
    clock["true_ticks"] = true_ticks
    clock["true_fraction"] = true_fraction


@kernel
def foresee(clocks: Records, node: int, local_ticks: int) -> int:
    """True time, in whole ticks, at which the node's unwrapped counter will show a value if its rate stays."""
    clock = clocks[node]
    ahead = (local_ticks - clock["local_ticks"]) / (1.0 + clock_rate(clocks, node))
    forecast: int = clock["true_ticks"] + math.floor(ahead)
    return forecast


@kernel
def emit(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    node: int,
    local_ticks: int,
    tx_noise_ticks: float,
    tx_error_ticks: float,
) -> tuple[int, float]:
    """Advance a node to the instant at which its counter shows a value. Returns when its frame really left.

    The instant is predicted, the oscillator's noise sampled up to there, and the remaining error removed to first
    order. Returns true ticks and fraction, later by ``tx_error_ticks`` (antenna delay error) and by emission noise of
    standard deviation ``tx_noise_ticks``.
    """
    clock = clocks[node]
    advance(clocks, normals, cursors, node, foresee(clocks, node, local_ticks), 0.0)
    error = (clock["local_ticks"] - local_ticks) + clock["local_fraction"]
    instant = -error / (1.0 + clock_rate(clocks, node))
    shift = math.floor(instant)
    clock["true_ticks"] += int(shift)
    clock["true_fraction"] = instant - shift
    clock["local_ticks"] = local_ticks
    clock["local_fraction"] = 0.0
    fraction = clock["true_fraction"] + tx_error_ticks + tx_noise_ticks * draw_normal(normals, cursors, node)
    carry = math.floor(fraction)
    return clock["true_ticks"] + int(carry), fraction - carry
