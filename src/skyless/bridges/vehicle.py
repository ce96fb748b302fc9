"""What a vehicle's estimator is given of fixes, and whether it follows them; without I/O and without MAVLink."""

from collections import deque
from contextlib import suppress
from math import exp, inf, isfinite, isnan, nan, sqrt
from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.earth import east_north_up
from skyless.core.equivalent import equivalent_measurement, predicted
from skyless.run.mqtt.messages import FixMessage, Matrix, Vector


def north_east_down(vector: Vector, heading_deg: float) -> Vector:
    """A vector of the site, whose y axis has the azimuth ``heading_deg``."""
    east, north, up = east_north_up(vector, heading_deg)
    return north, east, -up


def known_velocity(fix: FixMessage) -> tuple[Vector, Matrix] | None:
    """Velocity and its covariance, if both are known."""
    velocity, covariance = fix.velocity_mps, fix.velocity_covariance
    if velocity is None or covariance is None or not all(map(isfinite, (*velocity, *covariance))):
        return None
    return velocity, covariance


OUTAGE_S, DRIFT_MPS2, RETURN_S = 1.5, 0.3, 0.33
"""After a longer silence t, messages are stated as worse by DRIFT · t², several times a vehicle's usual drift, which
fades with RETURN: none moves the vehicle by more than a tenth of its drift."""


class NewInformation:
    """Turns the fixes of a filter into measurements with errors of their own."""

    def __init__(self) -> None:
        self._before: FixMessage | None = None
        self._drift_m, self._back_s = 0.0, -inf  # of the last outage, and when it ended

    def of(self, fix: FixMessage) -> FixMessage:
        """The fix with what is new since the previous one as its position, and that position's covariance.

        The fix's own covariance is added: it has the lasting errors of anchors, which are in every message alike.
        After an outage it is wide for a second, so that the vehicle returns without a jump.
        """
        before, self._before = self._before, fix
        position_m, covariance_m2 = np.array(fix.position_m), np.array(fix.covariance_m2).reshape(3, 3)
        if before is not None and before.serial < fix.serial:
            elapsed_s = fix.unix_s - before.unix_s
            if fix.unix_s < self._back_s:  # the clock was set
                self._drift_m, self._back_s = 0.0, -inf
            if elapsed_s > OUTAGE_S:
                self._drift_m, self._back_s = DRIFT_MPS2 * min(elapsed_s, 60.0) ** 2, fix.unix_s
            elif elapsed_s > 0.0 and (moving := known_velocity(before)) is not None:
                at = slice(2 if fix.height_known else 3)
                states = np.array([before.position_m, moving[0]])
                spreads = np.reshape([before.covariance_m2, moving[1]], (2, 3, 3))
                with suppress(np.linalg.LinAlgError):  # it states no covariance
                    x_m, P_m2 = predicted(states[:, at], spreads[:, at, at], elapsed_s)
                    position_m[at], new_m2 = equivalent_measurement(x_m, P_m2, position_m[at], covariance_m2[at, at])
                    covariance_m2[at, at] += new_m2
        covariance_m2 += np.eye(3) * self._drift_m**2 * exp(-max(fix.unix_s - self._back_s, 0.0) / RETURN_S)
        return replace(fix, position_m=tuple(position_m.tolist()), covariance_m2=tuple(covariance_m2.ravel().tolist()))


_Row = tuple[float, ...]
_NONE: Final = (0.0, 0.0, 0.0)

PARAMETERS: Final = {
    "px4": ("MAV_1_MODE 2", "EKF2_EV_CTRL 3", "EKF2_HGT_REF 3", "EKF2_EV_DELAY"),
    "ardupilot": ("SR2_POSITION 10", "VISO_TYPE 1 and EK3_SRC1_POSXY 6", "EK3_SRC1_POSZ 6", "VISO_DELAY_MS"),
}
"""By profile, of a vehicle that is to state its position, use ours, have its height, know its delay."""

WINDOW_S, GAP_S, ROWS = 20.0, 0.2, 20_000
"""How long, and how many of the vehicle's messages are compared; longest step between two of them, or to a fix."""
APART_M, HEIGHT_M, LATE_S, MOVING_MPS = 1.0, 0.5, 0.15, 0.3
"""A vehicle that is farther from the fixes, horizontally or vertically, has its position from elsewhere; one that is
farther behind takes them for newer than they are, which is seen from this speed on."""
NORTH_DEG, LEAST_TRAVEL_M, DEGREE, KEPT = 5.0, 0.2, 5, 0.95
"""Norths agree within this: the anchors' lasting errors turned recorded flights by up to 4°. Least deviation of the
motion from a polynomial of this degree, which is what an unknown start, a wrong level and biases of the vehicle's
sensors do to its path. Weight of a window that is a second older."""


def rotations(vectors_rad: Array) -> Array:
    """Rotations about vectors by their length (Rodrigues): shape (n, 3) to (n, 3, 3)."""
    half = np.linalg.norm(vectors_rad, axis=1)[:, None, None] / (2.0 * np.pi)
    cross: Array = np.cross(vectors_rad[:, None], -np.eye(3))
    return np.asarray(np.eye(3) + np.sinc(2.0 * half) * cross + 0.5 * np.sinc(half) ** 2 * cross @ cross)


def north_sums(given: Array, motion: Array) -> tuple[complex, float]:
    """Two sums: the first over the second turns a vehicle's inertial path into given positions; zeros without motion.

    The angle is by how much the site's azimuths are larger. ``given``, shape (n, 4): time in s, north and east in m,
    standard deviation. ``motion``, shape (m, 11): time of arrival and of sending, specific force in m/s² and rate in
    rad/s along forward, right, down; roll, pitch, yaw, of which only the first count: later ones hold the positions.
    """
    time_s = motion[:, 1] + (motion[:, 0] - motion[:, 1]).min()  # the quickest message has the least delay
    step_s = np.diff(time_s)
    roll, pitch, yaw = rotations(np.diag(motion[0, 8:]))
    attitudes = [yaw @ pitch @ roll]
    for turn in rotations(motion[:-1, 5:8] * step_s[:, None]):
        attitudes.append(attitudes[-1] @ turn)
    force_mps2 = np.einsum("nij,nj->in", attitudes[:-1], motion[:-1, 2:5])
    path_m = np.cumsum(np.cumsum((force_mps2[0] + 1j * force_mps2[1]) * step_s) * step_s)
    at_s, north_m, east_m, std_m = given[(given[:, 0] >= time_s[1]) & (given[:, 0] <= time_s[-1])].T
    if len(at_s) > 2 * DEGREE:
        basis, _ = np.linalg.qr(np.vander((at_s - at_s[0]) / WINDOW_S, DEGREE + 1) / std_m[:, None])
        both = np.array([north_m + 1j * east_m, np.interp(at_s, time_s[1:], path_m)]) / std_m
        measured, travelled = both - (both @ basis) @ basis.T
        if (power := float(np.vdot(travelled, travelled).real)) > LEAST_TRAVEL_M**2 * np.sum(std_m**-2.0):
            return complex(np.vdot(travelled, measured)), power
    return 0j, 0.0


class Following:
    """Compares what a vehicle says of itself with what it is given; north, east, down in m; times in s since 1970."""

    def __init__(self, profile: str) -> None:
        self._parameters = PARAMETERS.get(profile, ("",) * 4)
        self.attitude_rad: _Row = ()  # the vehicle's newest roll, pitch and yaw
        self.is_used = True  # whether the vehicle says that it knows its horizontal position
        self._subjects = "", ""  # of the newest verdict, and of the one that was said last
        self._begin_s, self._turn, self._power = inf, 0j, 0.0
        self._fix: tuple[float, Vector, Vector] = (-inf, _NONE, _NONE)  # newest: time, position and velocity
        self._given, self._motion, self._apart = (deque[_Row](maxlen=ROWS) for _ in range(3))
        """Rows of ``north_sums``, and of time, the vehicle's position less the fix, and its north and east velocity."""

    def on_given(self, given: FixMessage, fix: FixMessage, heading_deg: float) -> None:
        """The vehicle was given what is new in a fix."""
        at, velocity = (north_east_down(one, heading_deg) for one in (fix.position_m, fix.velocity_mps or _NONE))
        at = (*at[:2], nan) if fix.height_known else at
        self._begin_s, self._fix = min(self._begin_s, fix.unix_s), (fix.unix_s, at, velocity)
        std_m = sqrt(max(0.5 * (given.covariance_m2[0] + given.covariance_m2[4]), 1e-4))
        self._given.append((fix.unix_s, *north_east_down(given.position_m, heading_deg)[:2], std_m))

    def on_position(self, time_s: float, position: _Row) -> None:
        """The vehicle's position."""
        then_s, fix, velocity = self._fix
        if abs(age_s := time_s - then_s) < GAP_S:
            apart = (p - q - age_s * v for p, q, v in zip(position, fix, velocity, strict=True))
            self._apart.append((time_s, *apart, *velocity[:2]))

    def on_motion(self, time_s: float, sent_s: float, sample: _Row) -> None:
        """Specific force and rate that the vehicle's inertial sensors measured."""
        if self._motion and not 0.0 < sent_s - self._motion[-1][1] < GAP_S:
            self._motion.clear()
        if self.attitude_rad:
            self._motion.append((time_s, sent_s, *sample, *self.attitude_rad))

    def verdict(self, now_s: float, heading_deg: float) -> str | None:
        """What there is to say, called once a second; None if it was said last, or is not yet sure."""
        for rows in (self._given, self._motion, self._apart):
            while rows and now_s - rows[0][0] > WINDOW_S:
                rows.popleft()
        if now_s - self._fix[0] > 1.0 or now_s - self._begin_s < 0.5 * WINDOW_S:
            return None
        (subject, words), (newest, said) = self._found(heading_deg), self._subjects
        is_sure = subject == newest != said  # twice in a row
        self._subjects = subject, subject if is_sure else said
        return words if is_sure else None

    def _found(self, heading_deg: float) -> tuple[str, str]:
        """What is wrong, or that nothing is: its subject and its words."""
        states, use, height, delay = self._parameters
        if not self._apart:
            return "silent", f"no LOCAL_POSITION_NED, or the clocks of tag and bridge differ: set {states}"
        _, north, east, down, north_mps, east_mps = np.array(self._apart).T
        apart_m, height_m = sqrt(np.mean(north**2 + east**2)), abs(float(np.mean(down)))
        square = max(float(np.mean(north_mps**2 + east_mps**2)), MOVING_MPS**2)
        late_s, off_deg = -float(np.mean(north * north_mps + east * east_mps)) / square, self._north_deg()
        follows = f"the vehicle follows, {100.0 * apart_m:.0f} cm; north"
        for subject, applies, words in (
            ("unused", not self.is_used, f"the vehicle says that it does not use the positions: set {use}"),
            ("use", apart_m > APART_M, f"the vehicle is {apart_m:.1f} m off: set {use}"),
            ("height", height_m > HEIGHT_M, f"the vehicle's height is {height_m:.1f} m off: set {height}"),
            ("delay", late_s > LATE_S, f"the vehicle is {1e3 * late_s:.0f} ms late: raise {delay} by that"),
            ("unseen", isnan(off_deg), f"{follows} is seen after 20 s of motion with ATTITUDE and HIGHRES_IMU"),
            ("follows", abs(off_deg) <= NORTH_DEG, f"{follows} agrees within {NORTH_DEG:.0f}°"),
        ):
            if applies:
                return subject, words
        what = f"north is {abs(off_deg):.0f}° off; if the vehicle's compass is right, set the site's heading_deg"
        return "north", f"{what} (or heading= of this target) to {(heading_deg - off_deg) % 360.0:.0f}"

    def _north_deg(self) -> float:
        """By how much the site's azimuths are larger than the vehicle's; NaN until it is seen."""
        if len(self._given) > 1 and self._motion and self._motion[-1][0] - self._motion[0][0] > WINDOW_S - 2.0:
            turn, power = north_sums(np.array(self._given), np.array(self._motion))
            self._turn, self._power = KEPT * self._turn + turn, KEPT * self._power + power
        return float(np.angle(self._turn, deg=True)) if self._power else nan
