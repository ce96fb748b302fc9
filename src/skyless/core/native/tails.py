"""Tails of the normal and the chi2 distribution."""

from typing import Final

from skyless.core.native.arithmetic import exp, log, sqrt

SQRT_2_PI: Final = 2.5066282746310002
FAR_TAIL: Final = 3.0
"""From here on the normal tail's continued fraction converges faster than its series."""
TERMS: Final = 60
NEWTON_STEPS: Final = 10
"""The logarithm is concave, and the first z too large: each step doubles the right digits."""


def normal_tail(z: float) -> float:
    """Probability that a standard normal variable exceeds z, to 10⁻¹² of itself.

    With its density φ it is ½ − φ(z)·Σ z²ⁿ⁺¹/(1·3·…·(2n + 1)), or φ(z)/(z + 1/(z + 2/(z + …))) after Laplace.
    """
    size = abs(z)
    density = exp(-0.5 * size * size) / SQRT_2_PI
    if size < FAR_TAIL:
        term, total = size, size
        for n in range(1, TERMS):
            term *= size * size / (2 * n + 1)
            total += term
        tail = 0.5 - density * total
    else:
        tail = density / _continued_fraction(size, 1)
    return tail if z >= 0.0 else 1.0 - tail


def normal_quantile(tail: float) -> float:
    """What a standard normal variable exceeds with a probability below ½, by Newton's method for its logarithm."""
    z = sqrt(-2.0 * log(tail))
    for _ in range(NEWTON_STEPS):
        found = normal_tail(z)
        z += (log(found) - log(tail)) * found * SQRT_2_PI / exp(-0.5 * z * z)
    return z


def _continued_fraction(z: float, first: int) -> float:
    """The value of z + n/(z + (n + 1)/(z + …)) for the first n."""
    fraction = z
    for n in range(TERMS, first - 1, -1):
        fraction = z + n / fraction
    return fraction


def chi2_tail(dof: int, chi2: float) -> float:
    """Probability that chi2 with at least one degree of freedom exceeds a value, by the finite sum."""
    half = 0.5 * chi2
    if not half < 700.0:
        return 0.0
    is_odd = dof % 2 == 1
    term = 2.0 * sqrt(chi2) / SQRT_2_PI if is_odd else 1.0
    total = 0.0
    for k in range(dof // 2):
        total += term
        term *= half / (k + (1.5 if is_odd else 1.0))
    return (2.0 * normal_tail(sqrt(chi2)) if is_odd else 0.0) + exp(-half) * total


def mean_if_positive(mean: float, sigma: float) -> float:
    """Mean of a normal variable given that it is positive: E[w²], where w² was measured and may be near 0."""
    z = mean / sigma
    if z < -FAR_TAIL:  # where the mean and what is added to it would cancel
        return sigma / _continued_fraction(-z, 2)
    return mean + sigma * exp(-0.5 * z * z) / (SQRT_2_PI * normal_tail(-z))
