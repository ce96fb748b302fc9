"""The yardstick: the filter of pair differences as one would write it in plain NumPy, without a thought of speed."""

import numpy as np


class PlainFilter:
    """Constant velocity in three dimensions, extended Kalman filter, one difference at a time."""

    def __init__(self, position_m, qa=1.0, tdoa_std_m=0.22, gate=3.0):
        self.x = np.concatenate([position_m, np.zeros(3)])
        self.P = np.eye(6)
        self._qa, self._variance, self._gate = qa, tdoa_std_m**2, gate

    def hear(self, a_m, b_m, dt_s, tdoa_m):
        F = np.eye(6)
        F[:3, 3:] = dt_s * np.eye(3)
        Q = np.zeros((6, 6))
        Q[:3, :3] = np.eye(3) * dt_s**3 / 3
        Q[:3, 3:] = Q[3:, :3] = np.eye(3) * dt_s**2 / 2
        Q[3:, 3:] = np.eye(3) * dt_s
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + self._qa * Q
        to_a, to_b = self.x[:3] - a_m, self.x[:3] - b_m
        range_a, range_b = np.linalg.norm(to_a), np.linalg.norm(to_b)
        H = np.concatenate([to_b / range_b - to_a / range_a, np.zeros(3)])
        innovation = tdoa_m - (range_b - range_a)
        spread = H @ self.P @ H + self._variance
        if innovation**2 > self._gate**2 * spread:
            return False
        gain = self.P @ H / spread
        self.x = self.x + gain * innovation
        IKH = np.eye(6) - np.outer(gain, H)
        self.P = IKH @ self.P @ IKH.T + np.outer(gain, gain) * self._variance
        return True
