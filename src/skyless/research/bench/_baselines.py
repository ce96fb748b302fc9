"""The baselines of ``skyless bench``: ``joint`` in plain NumPy, matrix by matrix, by filterpy's EKF, and a plain loop.

The two filters process the same measurements as the kernels and reach the same states
(``tests/bench/test_benchmarks.py``). The loop is what plain loops under Numba take: nothing but the arithmetic, without
gate, running means, epochs in integers, and anchors that join or leave.
"""

from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.estimator.settings import MAX_CLOCK_RATE, TUNING, EstimatorSettings
from skyless.core.tag.joint import RELAY_AGE_S
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.site.kernels.compiled import threaded_kernel


class PlainJoint:
    """``joint`` as one would write it first: all anchors from the start, a wide prior, nothing exploited.

    The states are position and velocity (the height is given), then of every anchor the offset of its clock, then the
    rates, then the noise of each last TX stamp. Survey and ranges are assumed exact, no packet late, and of the
    process noise only that of the tag's clock adapts.
    """

    def __init__(
        self,
        settings: EstimatorSettings,
        anchors_m: Matrix,
        rx_ticks: int,
        start_m: Vector,
        variances: tuple[float, float],
    ) -> None:
        """``start_m``: (2,); ``variances``: of position and speed."""
        n = len(anchors_m)
        self._s, self._anchors_m, self._n, self._epoch = settings, anchors_m, n, rx_ticks
        self.x = np.concatenate([start_m, np.zeros(2 + 3 * n)])
        rate = (MAX_CLOCK_RATE * SPEED_OF_LIGHT_MPS) ** 2
        self.P = np.diag([variances[0]] * 2 + [variances[1]] * 2 + [1e8] * n + [rate] * n + [0.0] * n)
        self._whole: dict[int, int] = {}
        self._packets: dict[tuple[int, int], tuple[int, int]] = {}
        self._relayed: dict[tuple[int, int], int] = {}
        self._newest: dict[int, int] = {}
        self._range_m: dict[int, float] = {}
        self._walk_scale, self._common_mean, self._count = TUNING.start_walk_scale, 0.0, 0

    def process(self, anchor: int, sequence: int, rx: int, tx: int, relays: Integers) -> None:
        """Process one packet, as ``Estimator.process`` does."""
        self._time_update(rx)
        n, s = self._n, self._s
        noise = 4 + 2 * n + anchor
        self.P[noise, :] = self.P[:, noise] = 0.0
        self.P[noise, noise], self.x[noise] = s.tx_variance_m2, 0.0
        away = np.append(self.x[:2], s.height_m or 0.0) - self._anchors_m[anchor]
        range_m = float(np.linalg.norm(away))
        h = np.zeros(len(self.x))
        h[:2] = away[:2] / range_m
        h[4 + anchor] = h[noise] = 1.0
        whole = self._whole.setdefault(anchor, rx - tx)
        innovation = (rx - tx - whole) * TICK_M - range_m - self.x[4 + anchor]
        normalised = self._update(h, innovation, s.rx_variance_m2)
        if self._count > 2 * n:
            self._adapt(normalised)
        self._count += 1
        self._newest[anchor], self._range_m[anchor] = tx, range_m
        self._packets[anchor, sequence] = (tx, rx)
        for listener, of, number, heard in relays.tolist():
            self._process_relay(listener, of, number, heard)

    def _time_update(self, rx: int) -> None:
        n, s = self._n, self._s
        dt = (rx - self._epoch) * TICK_S
        self._epoch = rx
        b, f = slice(4, 4 + n), slice(4 + n, 4 + 2 * n)
        F, Q = np.eye(len(self.x)), np.zeros_like(self.P)
        F[0, 2] = F[1, 3] = dt
        F[b, f] = dt * np.eye(n)
        Q[:2, :2], Q[2:4, 2:4] = np.eye(2) * s.qa * dt**3 / 3, np.eye(2) * s.qa * dt
        Q[:2, 2:4] = Q[2:4, :2] = np.eye(2) * s.qa * dt**2 / 2
        white, walk = np.eye(n) + np.ones((n, n)), s.walk * (np.eye(n) + self._walk_scale * np.ones((n, n)))
        Q[b, b] = white * s.white * dt + walk * dt**3 / 3
        Q[b, f] = Q[f, b] = walk * dt**2 / 2
        Q[f, f] = walk * dt
        self._predict(F, Q)

    def _predict(self, F: Matrix, Q: Matrix) -> None:
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + Q

    def _adapt(self, normalised: float) -> None:
        """The process noise of the tag's clock, from an innovation over its standard deviation."""
        self._common_mean += TUNING.mean_gain * (normalised - self._common_mean)
        square = self._common_mean**2 * (2.0 - TUNING.mean_gain) / TUNING.mean_gain
        self._walk_scale = max(
            self._walk_scale * (TUNING.noise_growth if square > TUNING.suspect**2 else TUNING.noise_loss), 1.0
        )

    def _process_relay(self, listener: int, of: int, sequence: int, heard: int) -> None:
        n, s = self._n, self._s
        tx, rx = self._packets.get((of, sequence), (0, 0))
        known = tx > self._relayed.get((listener, of), -1) and listener in self._whole
        if not known or (self._epoch - rx) * TICK_S >= RELAY_AGE_S:
            return
        self._relayed[listener, of] = tx
        way_m = float(np.linalg.norm(self._anchors_m[listener] - self._anchors_m[of]))
        age = (self._epoch - rx) * TICK_S + (self._range_m[of] - way_m) / SPEED_OF_LIGHT_MPS
        h = np.zeros(len(self.x))
        h[4 + of], h[4 + listener] = 1.0, -1.0
        h[4 + n + of], h[4 + n + listener] = -age, age
        variance = s.rx_variance_m2 + 2.0 * age * (s.white + s.walk * age * age / 3.0)
        if self._newest[of] == tx:
            h[4 + 2 * n + of] = 1.0
        else:
            variance += s.tx_variance_m2
        measured = (heard - tx - self._whole[of] + self._whole[listener]) * TICK_M - way_m
        self._update(h, measured - h @ self.x, variance)

    def _update(self, h: Vector, innovation: float, variance: float) -> float:
        innovation_variance = float(h @ self.P @ h) + variance
        gain = self.P @ h / innovation_variance
        self.x = self.x + gain * innovation
        keep = np.eye(len(self.x)) - np.outer(gain, h)
        self.P = keep @ self.P @ keep.T + variance * np.outer(gain, gain)
        return innovation / float(np.sqrt(innovation_variance))


class FilterpyJoint(PlainJoint):
    """The same through filterpy's extended Kalman filter.

    It raises ImportError at the first packet where filterpy is not installed.
    """

    @cached_property
    def filter(self) -> Any:  # noqa: ANN401 - filterpy has no types
        """Made at the first use."""
        return import_module("filterpy.kalman").ExtendedKalmanFilter(dim_x=len(self.x), dim_z=1)

    def _predict(self, F: Matrix, Q: Matrix) -> None:
        ekf = self.filter
        ekf.x, ekf.P, ekf.F, ekf.Q = self.x.reshape(-1, 1), self.P, F, Q
        ekf.predict()
        self.x, self.P = ekf.x[:, 0], ekf.P

    def _update(self, h: Vector, innovation: float, variance: float) -> float:
        ekf = self.filter
        ekf.x, ekf.P = self.x.reshape(-1, 1), self.P
        ekf.R[0, 0] = variance
        ekf.update(np.array([[innovation]]), lambda _: h.reshape(1, -1), lambda _: np.zeros((1, 1)))
        self.x, self.P = ekf.x[:, 0], ekf.P
        return innovation / float(np.sqrt(ekf.S[0, 0]))


@threaded_kernel
def joint_filter(
    x: Vector,
    P: Matrix,
    anchors_m: Matrix,
    senders: Integers,
    dt_s: Vector,
    pseudoranges_m: Vector,
    sync_m: Vector,
    variance: float,
    noise: Vector,
) -> float:
    """Four states of motion and an offset and a rate of seven anchors: own reception, and the sender's of anchor 0.

    ``pseudoranges_m`` are those of the tag, ``sync_m`` the sender's clock less anchor 0's as the sender measured it.
    ``x`` is [x, y, vx, vy, (offset, rate) of each], shape (18,), ``P`` (18, 18).
    """
    n = 18
    h, ph = np.zeros(n), np.zeros(n)
    for k in range(len(dt_s)):
        _loop_time_update(x, P, 2, 7, dt_s[k], noise)
        sender = senders[k]
        dx, dy = x[0] - anchors_m[sender, 0], x[1] - anchors_m[sender, 1]
        dz = anchors_m[sender, 2]
        range_m = np.sqrt(dx * dx + dy * dy + dz * dz)
        for state in range(n):
            h[state] = 0.0
        h[0], h[1] = dx / range_m, dy / range_m
        h[4 + 2 * sender] = 1.0
        _loop_update(x, P, h, ph, pseudoranges_m[k] - range_m - x[4 + 2 * sender], variance)
        if sender != 0:
            h[0] = h[1] = 0.0
            h[4] = -1.0
            _loop_update(x, P, h, ph, sync_m[k] - (x[4 + 2 * sender] - x[4]), variance)
    return float(x[0])


@threaded_kernel
def _loop_time_update(x: Vector, P: Matrix, dim: int, clocks: int, dt: float, noise: Vector) -> None:
    """F·P·Fᵀ + Q, pair by pair of a value and its rate."""
    n = len(x)
    for pair in range(dim + clocks):
        value = pair if pair < dim else 2 * dim + 2 * (pair - dim)
        rate = dim + pair if pair < dim else value + 1
        x[value] += dt * x[rate]
        for column in range(n):
            P[value, column] += dt * P[rate, column]
        for row in range(n):
            P[row, value] += dt * P[row, rate]
        white = 0.0 if pair < dim else noise[1]
        walk = noise[0] if pair < dim else noise[2]
        P[value, value] += white * dt + walk * dt * dt * dt / 3.0
        P[value, rate] += walk * dt * dt / 2.0
        P[rate, value] += walk * dt * dt / 2.0
        P[rate, rate] += walk * dt


@threaded_kernel
def _loop_update(x: Vector, P: Matrix, h: Vector, ph: Vector, innovation: float, variance: float) -> None:
    n = len(x)
    ph[:] = 0.0
    for row in range(n):
        if h[row] != 0.0:  # of P, symmetric, the few rows that count
            for column in range(n):
                ph[column] += h[row] * P[row, column]
    innovation_variance = variance
    for row in range(n):
        innovation_variance += h[row] * ph[row]
    for row in range(n):
        gain = ph[row] / innovation_variance
        x[row] += gain * innovation
        for column in range(n):
            P[row, column] -= gain * ph[column]
