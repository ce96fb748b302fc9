"""Your own estimator on recordings and at simulated sites, in one line each: least squares, and a Kalman filter.

An observation is a ``skyless.PairTdoa``: ``time_s``, the anchors ``anchor_a`` and ``anchor_b``, their positions ``a_m``
and ``b_m`` in metres, and ``tdoa_m``, the range to b less the range to a. The same from a shell, for your recordings:

    skyless replay flight_tdoa.csv --anchors anchors.csv --truth pose.csv --estimator own_estimator.py:Filter
    skyless simulate --scenario room --estimator own_estimator.py:Filter
"""

import numpy as np
from scipy.optimize import least_squares

import skyless


class LeastSquares:
    """The position that fits 60 differences, at the height of 1.2 m."""

    def __init__(self):
        self.heard = []

    def hear(self, one):
        """Process one observation."""
        self.heard.append(one)
        if len(self.heard) < 60:
            return None
        a_m, b_m, tdoa_m = (np.array([getattr(o, name) for o in self.heard]) for name in ("a_m", "b_m", "tdoa_m"))
        self.heard.clear()
        ranges = lambda p, anchors_m: np.linalg.norm(np.append(p, 1.2) - anchors_m, axis=1)  # noqa: E731
        found = least_squares(lambda p: ranges(p, b_m) - ranges(p, a_m) - tdoa_m, a_m.mean(axis=0)[:2])
        return skyless.Fix.of(one.time_s, [*found.x, 1.2])


class Filter:
    """An extended Kalman filter of position and velocity, with a gate of three standard deviations."""

    tdoa_std_m, acceleration, gate = 0.15, 1.0, 3.0

    def __init__(self):
        self.x, self.P, self.time_s, self.refused = None, np.diag([9.0] * 3 + [1.0] * 3), 0.0, 0

    def hear(self, one):
        """Process one observation."""
        a_m, b_m = np.array(one.a_m), np.array(one.b_m)
        if self.x is None:
            self.x, self.time_s = np.append((a_m + b_m) / 2, np.zeros(3)), one.time_s
        dt, self.time_s = one.time_s - self.time_s, one.time_s
        F = np.eye(6) + dt * np.eye(6, k=3)
        Q = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], self.acceleration * np.eye(3))
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q
        to_a, to_b = self.x[:3] - a_m, self.x[:3] - b_m
        H = np.append(to_b / np.linalg.norm(to_b) - to_a / np.linalg.norm(to_a), np.zeros(3))
        innovation = one.tdoa_m - (np.linalg.norm(to_b) - np.linalg.norm(to_a))
        S = H @ self.P @ H + self.tdoa_std_m**2
        if innovation**2 > self.gate**2 * S and self.refused < 20:
            self.refused += 1
            return None
        self.refused, K = 0, self.P @ H / S
        self.x, self.P = self.x + K * innovation, self.P - np.outer(K, H @ self.P)
        return skyless.Fix.of(one.time_s, self.x[:3], self.P[:3, :3])


if __name__ == "__main__":
    for estimator in (LeastSquares, Filter):
        result = skyless.simulate(scenario="room", estimator=estimator, duration_s=5.0, seed=2)
        print(f"{estimator.__name__}: {100 * result.report.rmse_m:.1f} cm in a simulated room")
