"""A textbook's extended Kalman filter with the estimator's states and measurements, in whole matrices; no monitor.

F·P·Fᵀ + Q and Joseph's update; ranges are linearised at held points. All anchors have their states from the
beginning; an offset comes in by the Jacobian of the equation that makes it.
"""

from itertools import pairwise, permutations

import numpy as np

from skyless.core.estimator.settings import TUNING
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S


class Newest:
    """An anchor's newest packet."""

    def __init__(self, tx, rx, walked_m, range_m, has_tx_noise):
        self.tx, self.rx, self.walked_m, self.range_m, self.has_tx_noise = tx, rx, walked_m, range_m, has_tx_noise


class TextbookFilter:
    def __init__(self, settings, anchors_m, rx_ticks, position_m, covariance_m2, speed_variance):
        self.settings, self.anchors_m, self.ticks = settings, anchors_m, rx_ticks
        dim, n = settings.dim, len(anchors_m)
        self.dim, self.n = dim, n
        edges = np.cumsum([0, dim, n, dim, n, n, n, n, 1, 3 - dim, dim * n])
        blocks = [np.arange(*ends) for ends in pairwise(edges)]
        self.p, self.b, self.v, self.f, self.w, *others = blocks
        self.change, self.constant, self.slope, self.height, self.surveys = others
        self.size = edges[-1]
        self.x, variances = np.zeros(self.size), np.zeros(self.size)
        variances[self.v] = speed_variance
        variances[self.change], variances[self.constant] = settings.place_std_m**2, settings.range_std_m**2
        variances[self.slope], variances[self.surveys] = settings.slope_std_m**2, settings.survey_std_m**2
        variances[self.height] = settings.height_std_m**2
        self.P = np.diag(variances)
        self.x[self.p], self.P[: self.dim, : self.dim] = position_m, covariance_m2
        self.held_m = {}
        self.whole, self.newest, self.packets, self.relayed, self.walked_m = {}, {}, {}, set(), 0.0
        pair_variance = TUNING.open_pair_std_m**2 if settings.range_std_m or settings.survey_std_m else 0.0
        self.pairs = {frozenset((i, j)): [0.0, pair_variance] for i in range(n) for j in range(i)}
        self.relays = dict.fromkeys(permutations(range(n), 2), 0)

    def update(self, packet, q_scale, own_walk_scale, walk_scales):
        """``packet`` as ``Estimator.process`` takes it; what the process noise is multiplied by is told."""
        anchor, sequence, rx, tx, relays = packet
        walks = np.ones(self.n)
        walks[list(walk_scales)] = list(walk_scales.values())
        self._predict(rx, q_scale, own_walk_scale, walks)
        self.packets[anchor, sequence] = tx, rx
        if anchor not in self.newest:
            self._join(anchor, rx, tx)
            return
        self._own_reception(anchor, rx, tx)
        for sender, number, stamp in relays:
            if (sender, number) in self.packets:
                self._relay(anchor, sender, *self.packets[sender, number], stamp, max(walks[[anchor, sender]]))
                self.relayed.add(sender)

    def _predict(self, rx, q_scale, own_walk_scale, walks):
        s, dt = self.settings, (rx - self.ticks) * TICK_S
        self.ticks = rx
        self.walked_m += float(np.linalg.norm(self.x[self.v])) * dt
        F, Q = np.eye(self.size), np.zeros((self.size, self.size))
        F[np.r_[self.p, self.b], np.r_[self.v, self.f]] = dt
        common = np.ones((self.n, self.n))
        motion = s.qa * q_scale * np.eye(self.dim)
        clocks = s.walk * (own_walk_scale * common + np.diag(walks))
        for value, rate, density in ((self.p, self.v, motion), (self.b, self.f, clocks)):
            Q[np.ix_(value, value)] = density * dt**3 / 3
            Q[np.ix_(value, rate)] = Q[np.ix_(rate, value)] = density * dt**2 / 2
            Q[np.ix_(rate, rate)] = density * dt
        Q[np.ix_(self.b, self.b)] += s.white * dt * (common + np.eye(self.n))
        self._go(F, Q)

    def _go(self, F, Q):
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def _reset(self, state, variance):
        self.x[state] = self.P[state] = self.P[:, state] = 0.0
        self.P[state, state] = variance

    def _range(self, anchor, variance):
        """Jacobian of the range and its errors, the range, what it is longer by on average, and all that together."""
        h, survey = np.zeros(self.size), self.surveys[self.dim * anchor : self.dim * (anchor + 1)]
        given_m = [] if self.dim == 3 else [self.settings.height_m]
        place_m, trace = np.append(self.x[self.p], given_m), np.trace(self.P[: self.dim, : self.dim])
        step_m = max(TUNING.held_step_m, min(TUNING.suspect * trace**0.5, TUNING.held_max_m))
        if not any((self.settings.survey_std_m, self.settings.range_std_m, self.settings.height_std_m)):
            step_m = 0.0  # exact ranges leave nothing open
        if not np.linalg.norm(place_m - self.held_m.get(anchor, np.nan)) <= step_m:
            self.held_m[anchor] = place_m
        held_m = self.held_m[anchor] - self.anchors_m[anchor]
        held_range_m = np.linalg.norm(held_m)
        away = place_m - self.anchors_m[anchor]
        away[: self.dim] -= self.x[survey]
        away[self.dim :] += self.x[self.height]
        range_m = float(np.linalg.norm(away))
        direction = held_m[: self.dim] / held_range_m
        errors = [self.w[anchor], self.change[anchor], self.constant[anchor]]
        h[errors], h[self.slope] = 1.0, np.clip((held_range_m - 4.0) / 4.0, -1.0, 1.0)
        expected = range_m + h @ self.x
        h[self.p], h[survey], h[self.height] = direction, -direction, held_m[self.dim :] / held_range_m
        place = self.P[: self.dim, : self.dim]
        widest, curvature_m = np.trace(place) / range_m, (np.trace(place) - direction @ place @ direction) / range_m / 2
        if min(widest**2 / 2, 2 * curvature_m**2) < 0.01 * variance:
            curvature_m = 0.0
        return h, range_m, curvature_m, expected + curvature_m

    def _join(self, anchor, rx, tx):
        s, offset = self.settings, self.b[anchor]
        self._reset(self.w[anchor], s.tx_variance_m2)
        self._reset(self.f[anchor], (50e-6 * SPEED_OF_LIGHT_MPS) ** 2)
        self.whole[anchor] = rx - tx
        h, range_m, curvature_m, expected_m = self._range(anchor, s.rx_variance_m2)
        J, R = np.eye(self.size), np.zeros((self.size, self.size))
        J[offset] = -h
        R[offset, offset] = s.rx_variance_m2 + 2 * curvature_m**2
        self._go(J, R)
        self.x[offset] = -expected_m
        self.newest[anchor] = Newest(tx, rx, self.walked_m, range_m, True)

    def _own_reception(self, anchor, rx, tx):
        s, newest, state = self.settings, self.newest[anchor], self.change[anchor]
        way_m, time_s = self.walked_m - newest.walked_m, (rx - newest.rx) * TICK_S
        F, Q = np.eye(self.size), np.zeros((self.size, self.size))
        F[state, state] = np.exp(-way_m / s.place_distance_m - time_s / s.place_time_s)
        Q[state, state] = (1 - F[state, state] ** 2) * s.place_std_m**2
        self._go(F, Q)
        self._reset(self.w[anchor], s.tx_variance_m2)
        has_tx_noise = anchor in self.relayed
        h, range_m, curvature_m, expected_m = self._range(
            anchor, s.rx_variance_m2 + (0.0 if has_tx_noise else s.tx_variance_m2)
        )
        h[self.b[anchor]] = 1.0
        z = (rx - tx - self.whole[anchor]) * TICK_M
        self._update(h, z - expected_m - self.x[self.b[anchor]], s.rx_variance_m2 + 2 * curvature_m**2)
        self.newest[anchor] = Newest(tx, rx, self.walked_m, range_m, has_tx_noise)

    def _relay(self, listener, sender, tx, rx, stamp, walk_scale):
        s, h, newest = self.settings, np.zeros(self.size), self.newest[sender]
        way_m = np.linalg.norm(self.anchors_m[listener] - self.anchors_m[sender])
        age_s = (self.ticks - rx) * TICK_S + (newest.range_m - way_m) / SPEED_OF_LIGHT_MPS
        h[self.b[[sender, listener]]], h[self.f[[sender, listener]]] = (1.0, -1.0), (-age_s, age_s)
        R = s.rx_variance_m2 + 2 * age_s * (s.white + s.walk * walk_scale * age_s**2 / 3)
        if newest.tx == tx and newest.has_tx_noise:
            h[self.w[sender]] = 1.0
        else:
            R += s.tx_variance_m2
        pair = self.pairs[frozenset((listener, sender))]
        z = (stamp - tx - self.whole[sender] + self.whole[listener]) * TICK_M
        innovation = z - way_m - pair[0] - h @ self.x
        share = pair[1] / (h @ self.P @ h + R + pair[1])
        self._update(h, innovation, R + pair[1])
        pair[0] += share * innovation
        pair[1] *= 1 - share
        self.relays[listener, sender] += 1
        if self.relays[listener, sender] == TUNING.pair_relays and self.relays[sender, listener] >= TUNING.pair_relays:
            self._pair_range(listener, sender, *pair)

    def _pair_range(self, one, other, longer_m, variance):
        h, towards = np.zeros(self.size), self.anchors_m[one] - self.anchors_m[other]
        towards = towards[: self.dim] / np.linalg.norm(towards)
        for anchor, sign in ((one, 1.0), (other, -1.0)):
            h[self.surveys[self.dim * anchor : self.dim * (anchor + 1)]] = sign * towards
        self._update(h, longer_m - h @ self.x, variance + self.settings.pair_std_m**2)

    def _update(self, h, innovation, R):
        gain = self.P @ h / (h @ self.P @ h + R)
        keep = np.eye(self.size) - np.outer(gain, h)
        self.x = self.x + gain * innovation
        self.P = keep @ self.P @ keep.T + R * np.outer(gain, gain)
