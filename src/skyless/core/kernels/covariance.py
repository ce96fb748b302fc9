"""Covariances of Kalman filters in place: time update, scalar measurement update, states that decay or are reset.

Each step works on the leading n × n block of a symmetric matrix P; what stands behind it stays as it is. They change
the covariance only. The filter of two states, value and rate, which plain Python runs as well, is
``core/kernels/filter.py``.
"""

import numpy as np

from skyless.core.kernels.arrays import Indices, Matrix, Vector
from skyless.core.kernels.compiled import step


@step
def integrate_rates(P: Matrix, n: int, values: int, dt: float) -> None:
    """F·P·Fᵀ where the first ``values`` states gain dt·(their rates), which follow them in the same order."""
    for row in range(n):
        for value in range(values):
            P[row, value] += dt * P[row, values + value]
    for value in range(values):
        for column in range(n):
            P[value, column] += dt * P[values + value, column]
    for value in range(values):
        for other in range(value):
            P[value, other] = P[other, value]


@step
def add_process_noise(
    P: Matrix, value: int, rate: int, other: int, other_rate: int, dt: float, white: float, walk: float
) -> None:
    """Q of a value and its rate, or what two such pairs have in common: white noise of the value, walk of the rate."""
    P[value, other] += white * dt + walk * dt**3 / 3.0
    P[value, other_rate] += walk * dt**2 / 2.0
    P[rate, other] += walk * dt**2 / 2.0
    P[rate, other_rate] += walk * dt


@step
def decay_state(P: Matrix, n: int, state: int, kept: float, variance: float) -> None:
    """Gauss–Markov: a state keeps this part of itself and, in the long run, that variance."""
    for column in range(n):
        P[state, column] *= kept
    for row in range(n):
        P[row, state] = P[state, row]
    P[state, state] = kept * P[state, state] + (1.0 - kept * kept) * variance


@step
def reset_covariance(P: Matrix, n: int, state: int, variance: float) -> None:
    """Make a state uncorrelated with all others, with that variance."""
    for column in range(n):
        P[state, column] = 0.0
    for row in range(n):
        P[row, state] = 0.0
    P[state, state] = variance


@step
def multiply_ph(P: Matrix, n: int, h: Vector, h_index: Indices, terms: int, ph: Vector) -> float:
    """Write P·h into ``ph``; h is zero but for ``terms`` elements, which stand in ``h``. Returns hᵀ·P·h."""
    for column in range(n):
        ph[column] = 0.0
    total = 0.0
    for term in range(terms):
        row, weight = h_index[term], h[term]
        if row < n:
            for column in range(n):
                ph[column] += weight * P[row, column]
    for term in range(terms):
        if h_index[term] < n:
            total += h[term] * ph[h_index[term]]
    return total


@step
def subtract_information(P: Matrix, n: int, ph: Vector, innovation_variance: float) -> float:
    """Measurement update: P ← P − u·uᵀ with u = P·h/√S, symmetric to the bit. ``ph`` becomes u; returns √S."""
    root = np.sqrt(innovation_variance)
    for state in range(n):
        ph[state] /= root
    for state in range(n):
        factor = ph[state]
        for column in range(n):
            P[state, column] -= factor * ph[column]
    return float(root)
