"""The covariance of a filter of two states, a value and its rate, as plain arithmetic (``docs/maths.md`` section 6).

For clocks: the value is an offset with white frequency noise, the rate walks. Any units that fit each other will do.
So little arithmetic takes no longer in Python than the call of a kernel; kernels use it through ``compiled.jitted``.
"""

TwoState = tuple[float, float, float]
"""Variance of the value, covariance, variance of the rate."""


def predicted_value_variance(P: TwoState, dt: float, white: float, walk: float) -> float:
    """Variance of the value ``dt`` later, or earlier: the process noise grows both ways."""
    variance, covariance, rate_variance = P
    span = abs(dt)
    variance += dt * (2.0 * covariance + dt * rate_variance)
    return variance + span * (white + walk * span * span / 3.0)


def predict(P: TwoState, dt: float, white: float, walk: float) -> TwoState:
    """Time update F·P·Fᵀ + Q over ``dt``, 0 or later."""
    variance, covariance, rate_variance = P
    variance += dt * (2.0 * covariance + dt * rate_variance)
    variance += dt * (white + walk * dt * dt / 3.0)
    return variance, covariance + dt * (rate_variance + walk * dt / 2.0), rate_variance + walk * dt


def update(P: TwoState, noise: float) -> tuple[float, float, TwoState]:
    """Measure the value with that variance: the gains of value and rate, and P.

    Joseph form, which keeps P positive whatever the rounding.
    """
    variance, covariance, rate_variance = P
    innovation_variance = variance + noise
    gain = variance / innovation_variance
    rate_gain = covariance / innovation_variance
    keep = 1.0 - gain
    updated = (
        keep * keep * variance + gain * gain * noise,
        keep * (covariance - rate_gain * variance) + gain * rate_gain * noise,
        rate_variance + rate_gain * (rate_gain * (variance + noise) - 2.0 * covariance),
    )
    return gain, rate_gain, updated
