"""``map → odom``: where the frame of a robot's odometry is on the site's map, from fixes and odometry; without ROS.

Points of the plane are complex numbers, x + iy in metres; headings are radians, anticlockwise from x. The antenna is
at B + exp(iθ)·m: B is the robot's base on the map, θ its heading in odom, m = exp(iψ)·l, ψ the heading of odom in map,
and l the antenna's place on the base (its lever arm), x forward and y left. The base moves by exp(iψ) times what the
odometry moves, so all is linear for a given ψ: Kalman filters begin at headings all around, Bayes' rule weighs them,
and once their mean is known they become one (Sorenson and Alspach, "Recursive Bayesian estimation using Gaussian sums",
1971). States: B, m, ψ, the drift of ψ [rad/s], and the fix's own error, which lasts for a second: without it as a
state, twenty fixes of one second would count as twenty.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_STATES: Final = 8  # Bx, By, mx, my, ψ, drift, error x, error y
_HEADINGS: Final = 24
_ERROR_LASTS_S: Final = 1.0
_WHITE_SHARE: Final = 0.16  # of a fix's variance that is new with each fix
_ALONG_M, _ACROSS_M = (
    0.05,
    0.01,
)  # odometry's error along its path, and across, after 1 m; grows with the root of the way
_SLIP_GAIN: Final = 20.0  # how much the first of them grows where fixes disagree with odometry
_HEADING_RAD, _TURN_RAD = math.radians(0.1), 0.003  # error of its heading after 1 m, and after a turn of 1 rad
_DRIFT_RADPS: Final = math.radians(0.5)  # bias of its gyroscope, which changes by a hundredth of that in a second
_STILL_M: Final = 0.001  # error after 1 s of standing
_GATE: Final = 16.0  # squared normalised innovation (two degrees of freedom) of an outlier: 3 in 10⁴ by chance
_LOST_S: Final = {False: 1.0, True: 5.0}  # outliers for so long are none: it starts again (True: map → odom is known)
_MOST_GAP_S, _MOST_LATE_S = 0.5, 2.0  # between two messages of odometry; between a fix and odometry
_JUMP_M, _JUMP_MPS, _JUMP_RAD, _JUMP_RADPS = 0.3, 4.0, 0.4, 6.0  # more than that, and that per second, is no motion
_LEAST_WAY_M: Final = 3.0
_BLEND_S, _STEP_M, _STEP_MPS, _STEP_RAD = 0.15, 0.03, 0.5, 0.017  # how fast what is published follows the estimate
_LOST: Final = 5.0  # times the limits at which it was given
_LARGEST: Final = 1e6  # metres, radians, square metres


@dataclass(frozen=True)
class MapOdomPose:
    """Odom in map, and the base in map with its covariance, at the time of the newest odometry."""

    unix_s: float
    odom_m: complex
    odom_yaw_rad: float
    base_m: complex
    base_yaw_rad: float
    covariance: Array
    """3 × 3 of the base: x, y [m²], heading [rad²]; how far the pose is behind the estimate is in it."""


class MapOdom:
    """Takes odometry and fixes as they come; reads no clock, raises nothing. ``pose`` is None until it is known.

    ``antenna_m``: the antenna on the base, each coordinate with that standard deviation. The limits are the standard
    deviations of heading and base (in the plane) up to which they count as known: of 2°, 5° are 2.5.
    """

    def __init__(
        self,
        antenna_m: complex = 0j,
        antenna_std_m: float = 0.25,
        heading_limit_deg: float = 2.0,
        base_limit_m: float = 0.2,
    ) -> None:
        self._antenna_m, self._antenna_std_m = antenna_m, antenna_std_m
        self._limit_rad, self._limit_m = math.radians(heading_limit_deg), base_limit_m
        self.counts = dict.fromkeys(("outliers", "unusable fixes", "fixes of another time", "unusable odometry"), 0)
        self._odometry: deque[tuple[float, complex, float]] = deque()
        self.restart("")

    def restart(self, why: str) -> None:
        """Forget all that was found: the antenna is anywhere, all headings are equally likely."""
        self._why = f" (started again: {why})" if why else ""
        self._waiting: deque[tuple[float, complex, Array]] = deque()
        self.pose: MapOdomPose | None = None
        self._last: tuple[float, complex, float] | None = None
        self._outliers_since_s: float | None = None
        self._way_m = self._slip = 0.0
        self.known = False
        self._x = np.zeros((_HEADINGS, _STATES))
        self._x[:, 4] = math.tau * np.arange(_HEADINGS) / _HEADINGS - math.pi
        arm_m = self._antenna_m * np.exp(1j * self._x[:, 4])
        self._x[:, 2], self._x[:, 3] = arm_m.real, arm_m.imag
        variances = [1e8] * 2 + [self._antenna_std_m**2] * 2 + [0.0, _DRIFT_RADPS**2, 0.0, 0.0]
        self._P = np.tile(np.diag(variances), (_HEADINGS, 1, 1))
        self._add_heading_variance((1.2 * math.pi / _HEADINGS) ** 2)
        self._weights = np.full(_HEADINGS, 1.0 / _HEADINGS)

    def add_odometry(self, unix_s: float, place_m: complex, yaw_rad: float) -> None:
        """Take the base's pose in odom. What is not finite, or not newer than the last, is counted and left."""
        if not _usable(unix_s, place_m.real, place_m.imag, yaw_rad):
            self.counts["unusable odometry"] += 1
            return
        if self._odometry:
            before_s, before_m, before_rad = self._odometry[-1]
            elapsed_s, turned_rad = unix_s - before_s, _wrapped(yaw_rad - before_rad)
            if -1.0 < elapsed_s <= 0.0:
                self.counts["unusable odometry"] += 1
                return
            jumped = abs(place_m - before_m) > _JUMP_M + _JUMP_MPS * elapsed_s
            if elapsed_s < 0.0 or jumped or abs(turned_rad) > _JUMP_RAD + _JUMP_RADPS * elapsed_s:
                self.restart("odometry's time went back" if elapsed_s < 0.0 else "odometry has jumped")
                self._odometry.clear()
            yaw_rad = before_rad + turned_rad
        self._odometry.append((unix_s, place_m, yaw_rad))
        while self._waiting and self._waiting[0][0] <= unix_s:
            self._take(*self._waiting.popleft())
        while len(self._odometry) > 2 and self._odometry[0][0] < unix_s - _MOST_LATE_S:
            self._odometry.popleft()
        self._follow()

    def add_fix(self, unix_s: float, place_m: complex, covariance_m2: tuple[float, float, float]) -> None:
        """Take the antenna on the map, with the covariance xx, xy, yy; a fix may be older than odometry, or newer."""
        xx, xy, yy = covariance_m2
        newest_s = self._waiting[-1][0] if self._waiting else self._last[0] if self._last else -math.inf
        if not _usable(unix_s, place_m.real, place_m.imag, xx, xy, yy) or min(xx, yy, xx * yy - xy * xy) <= 0.0:
            self.counts["unusable fixes"] += 1
        elif not self._odometry or abs(self._odometry[-1][0] - unix_s) > _MOST_LATE_S or unix_s <= newest_s:
            self.counts["fixes of another time"] += 1
        else:
            self._waiting.append((unix_s, place_m, np.array([[xx, xy], [xy, yy]])))
            while self._waiting and self._waiting[0][0] <= self._odometry[-1][0]:
                self._take(*self._waiting.popleft())

    def _take(self, unix_s: float, place_m: complex, covariance_m2: Array) -> None:
        """Use a fix from whose time on there is odometry."""
        times_s, places_m, yaws_rad = (np.array(column) for column in zip(*self._odometry, strict=True))
        after = int(np.searchsorted(times_s, unix_s))
        if after == 0 or times_s[after] - times_s[after - 1] > _MOST_GAP_S:
            self.counts["fixes of another time"] += 1
            return
        at_m, at_rad = complex(np.interp(unix_s, times_s, places_m)), float(np.interp(unix_s, times_s, yaws_rad))
        kept = self._predict(unix_s, at_m, at_rad)
        self._last = unix_s, at_m, at_rad
        self._P[:, 6:, 6:] += (1.0 - kept**2) * covariance_m2
        if self._update(at_rad, place_m, _WHITE_SHARE * covariance_m2):
            self._outliers_since_s = None
            self._judge()
            return
        self.counts["outliers"] += 1
        if self._outliers_since_s is None:
            self._outliers_since_s = unix_s
        elif unix_s - self._outliers_since_s > _LOST_S[self.known]:
            self.restart("fixes and odometry did not fit together")

    def _predict(self, unix_s: float, at_m: complex, at_rad: float) -> float:
        """Move the base as odometry has, in all filters; what is left of the last fix's error."""
        if self._last is None:
            return 0.0
        elapsed_s, moved_m, turned_rad = unix_s - self._last[0], at_m - self._last[1], at_rad - self._last[2]
        x, way_m, kept = self._x.copy(), abs(moved_m), math.exp(-elapsed_s / _ERROR_LASTS_S)
        step_m = moved_m * np.exp(1j * x[:, 4])
        F = np.tile(np.eye(_STATES), (len(x), 1, 1))
        F[:, 0, 4], F[:, 1, 4], F[:, 4, 5] = -step_m.imag, step_m.real, elapsed_s
        F[:, 2, 5], F[:, 3, 5] = -x[:, 3] * elapsed_s, x[:, 2] * elapsed_s
        F[:, 6, 6] = F[:, 7, 7] = kept
        arm_m = (x[:, 2] + 1j * x[:, 3]) * np.exp(1j * x[:, 5] * elapsed_s)
        x[:, 0] += step_m.real
        x[:, 1] += step_m.imag
        x[:, 2], x[:, 3] = arm_m.real, arm_m.imag
        x[:, 4] += x[:, 5] * elapsed_s
        x[:, 6:] *= kept
        P = F @ self._P @ F.transpose(0, 2, 1)
        along = np.column_stack([step_m.real, step_m.imag]) / max(way_m, 1e-9)
        along_m2 = (_ALONG_M**2 * (1.0 + _SLIP_GAIN * self._slip) - _ACROSS_M**2) * way_m
        P[:, :2, :2] += along_m2 * along[:, :, None] * along[:, None, :]
        P[:, :2, :2] += (_ACROSS_M**2 * way_m + _STILL_M**2 * elapsed_s) * np.eye(2)
        P[:, 5, 5] += (0.01 * _DRIFT_RADPS) ** 2 * elapsed_s
        self._x, self._P, self._way_m = x, P, self._way_m + way_m
        self._add_heading_variance(_HEADING_RAD**2 * way_m + _TURN_RAD**2 * abs(turned_rad))
        return kept

    def _add_heading_variance(self, variance_rad2: float) -> None:
        """Add variance to ψ, and with it to m, which turns with ψ."""
        turned = np.column_stack([-self._x[:, 3], self._x[:, 2], np.ones(len(self._x))])
        self._P[:, 2:5, 2:5] += variance_rad2 * turned[:, :, None] * turned[:, None, :]

    def _update(self, theta_rad: float, place_m: complex, white_m2: Array) -> bool:
        """Correct all filters by a fix and weigh them; False if it is an outlier to each of them."""
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        H = np.array([[1.0, 0.0, cos, -sin, 0.0, 0.0, 1.0, 0.0], [0.0, 1.0, sin, cos, 0.0, 0.0, 0.0, 1.0]])
        off_m = np.array([place_m.real, place_m.imag]) - self._x @ H.T
        PHt = self._P @ H.T
        S = H @ PHt + white_m2
        K = PHt @ np.linalg.inv(S)
        squares = np.einsum("ki,kij,kj->k", off_m, np.linalg.inv(S), off_m)
        if squares.min() > _GATE:
            return False
        likely = self._weights * np.exp(0.5 * (squares.min() - squares)) / np.sqrt(np.linalg.det(S))
        self._slip += 0.1 * (max(0.0, float(squares[likely.argmax()]) / 2.0 - 1.0) - self._slip)
        keep = likely > 1e-4 * likely.max()
        self._x = (self._x + np.einsum("kij,kj->ki", K, off_m))[keep]
        P = (self._P - K @ PHt.transpose(0, 2, 1))[keep]
        self._P = 0.5 * (P + P.transpose(0, 2, 1))
        self._weights = likely[keep] / likely[keep].sum()
        return True

    def _moments(self) -> tuple[Array, Array]:
        """Mean and covariance over all filters."""
        x = self._x.copy()
        mean_rad = np.angle(self._weights @ np.exp(1j * x[:, 4]))
        x[:, 4] = mean_rad + np.angle(np.exp(1j * (x[:, 4] - mean_rad)))
        mean = self._weights @ x
        off = x - mean
        return mean, np.einsum("k,kij->ij", self._weights, self._P) + (self._weights * off.T) @ off

    def _judge(self) -> None:
        """Whether heading and base are known now; for a known heading one filter is enough."""
        mean, covariance = self._moments()
        if covariance[4, 4] <= self._limit_rad**2:
            self._x, self._P, self._weights = mean[None], covariance[None], np.ones(1)
            self.known |= self._way_m >= _LEAST_WAY_M and np.trace(covariance[:2, :2]) <= self._limit_m**2

    def _follow(self) -> None:
        """Let what is published follow the estimate, at the newest odometry."""
        if not self.known:
            return
        (unix_s, place_m, theta_rad), kept = self._odometry[-1], (self._x, self._P, self._way_m)
        self._predict(unix_s, place_m, theta_rad)
        mean, covariance = self._moments()
        self._x, self._P, self._way_m = kept
        if (
            covariance[4, 4] > (_LOST * self._limit_rad) ** 2
            or np.trace(covariance[:2, :2]) > (_LOST * self._limit_m) ** 2
        ):
            self.restart("too few fixes for too long")
            return
        base_m, psi_rad = complex(mean[0], mean[1]), float(mean[4])
        if self.pose is not None:
            (before_s, before_m, _), out_rad = self._odometry[-2], self.pose.odom_yaw_rad
            out_m = self.pose.base_m + (place_m - before_m) * np.exp(1j * out_rad)
            share = 1.0 - math.exp((before_s - unix_s) / _BLEND_S)
            step_m, step_rad = share * (base_m - out_m), share * _wrapped(psi_rad - out_rad)
            step_m *= min(1.0, min(_STEP_M, _STEP_MPS * (unix_s - before_s)) / max(abs(step_m), 1e-9))
            base_m, psi_rad = complex(out_m + step_m), out_rad + min(max(step_rad, -_STEP_RAD), _STEP_RAD)
        behind = np.array([mean[0] - base_m.real, mean[1] - base_m.imag, _wrapped(mean[4] - psi_rad)])
        covariance = covariance[np.ix_([0, 1, 4], [0, 1, 4])] + np.outer(behind, behind)
        odom_m = complex(base_m - place_m * np.exp(1j * psi_rad))
        yaw_rad = _wrapped(psi_rad + theta_rad)
        self.pose = MapOdomPose(unix_s, odom_m, _wrapped(psi_rad), base_m, yaw_rad, covariance)

    def heading(self) -> tuple[float, float]:
        """The heading of odom in map and its standard deviation [rad], whether or not it counts as known."""
        mean, covariance = self._moments()
        return _wrapped(mean[4]), math.sqrt(covariance[4, 4])

    def reason(self) -> str:
        """Why map → odom is not known; empty if it is."""
        if self.known:
            return ""
        (_, covariance), limit_deg = self._moments(), math.degrees(self._limit_rad)
        heading_deg, base_m = math.degrees(math.sqrt(covariance[4, 4])), math.sqrt(np.trace(covariance[:2, :2]))
        checks = (
            (not self._odometry, "no odometry yet"),
            (self._last is None, "no fix that is within 2 s of odometry by its stamp: none came, or two clocks differ"),
            (self._way_m < _LEAST_WAY_M, f"the robot has moved {self._way_m:.1f} of {_LEAST_WAY_M:.0f} m"),
            (
                heading_deg > limit_deg,
                f"heading to {heading_deg:.1f} deg, should be {limit_deg:.1f}: drive straight on",
            ),
            (
                True,
                f"base to {base_m:.2f} m, should be {self._limit_m:.2f}: drive a turn, or state the antenna's place",
            ),
        )
        return next(text for wrong, text in checks if wrong) + self._why


def _usable(unix_s: float, *values: float) -> bool:
    """Whether all are finite, and none is larger than what a site has."""
    return math.isfinite(unix_s) and all(abs(one) < _LARGEST for one in values)


def _wrapped(angle_rad: float) -> float:
    """The same angle from −π to π."""
    return math.remainder(angle_rad, math.tau)
