"""What a vehicle's estimator is given of fixes, and whether it follows them; without I/O and without MAVLink."""

from cmath import phase
from collections import deque
from math import degrees, exp, inf, isnan, nan, sqrt
from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.earth import east_north_up
from skyless.core.equivalent import equivalent_measurement, predicted
from skyless.run.mqtt.messages import FixMessage, Vector


def north_east_down(vector: Vector, heading_deg: float) -> Vector:
    """A vector of the site, whose y axis has the azimuth ``heading_deg``."""
    east, north, up = east_north_up(vector, heading_deg)
    return north, east, -up


# What it is given

OUTAGE_S: Final = 1.5
"""After a longer silence there is no prior, and the vehicle has dead-reckoned …"""
DRIFT_MPS2: Final = 0.2
"""… by up to this · t², 13 m after 8 s; generous, as that only slows its return …"""
RETURN_S: Final = 0.33
"""… in which that variance fades with this time constant: each of 30 messages a second moves it by a tenth."""


class NewInformation:
    """Turns the fixes of a filter into measurements with errors of their own."""

    def __init__(self) -> None:
        self._before: FixMessage | None = None
        self._drift_m, self._back_s = 0.0, -inf
        """After the last outage, which ended at ``_back_s``, as ``unix_s``."""

    def of(self, fix: FixMessage) -> FixMessage:
        """The fix with what is new since the previous one as its position, and that position's covariance.

        The fix's own covariance is added: it has the lasting errors of anchors, which are in every message alike.
        After an outage it is wide for a second, so that the vehicle returns without a jump.
        """
        before, self._before = self._before, fix
        if before is not None and before.serial < fix.serial:
            elapsed_s = fix.unix_s - before.unix_s
            if elapsed_s > OUTAGE_S:
                self._drift_m, self._back_s = DRIFT_MPS2 * min(elapsed_s, 60.0) ** 2, fix.unix_s
            elif elapsed_s > 0.0:
                fix = _new(before, fix, elapsed_s)
        wide_m2 = self._drift_m**2 * exp(-max(fix.unix_s - self._back_s, 0.0) / RETURN_S)
        xx, xy, xz, yx, yy, yz, zx, zy, zz = fix.covariance_m2
        return replace(fix, covariance_m2=(xx + wide_m2, xy, xz, yx, yy + wide_m2, yz, zx, zy, zz + wide_m2))


def _new(before: FixMessage, fix: FixMessage, elapsed_s: float) -> FixMessage:
    """What a fix has that the one before it had not; methods without a velocity filter nothing, and all is new."""
    dim = 2 if fix.height_known else 3
    moving = before.velocity_mps, before.velocity_covariance
    if moving[0] is None or moving[1] is None:
        return fix
    vectors_m = [np.array(one)[:dim] for one in (before.position_m, fix.position_m, moving[0])]
    spreads = [np.array(one).reshape(3, 3)[:dim, :dim] for one in (before.covariance_m2, fix.covariance_m2, moving[1])]
    try:
        prior = predicted(vectors_m[0], spreads[0], vectors_m[2], spreads[2], elapsed_s)
        measured_m, new_m2 = equivalent_measurement(*prior, vectors_m[1], spreads[1])
    except np.linalg.LinAlgError:
        return fix  # it states no covariance
    covariance_m2 = np.array(fix.covariance_m2).reshape(3, 3)
    covariance_m2[:dim, :dim] += new_m2
    position_m = np.append(measured_m, fix.position_m[dim:])
    return replace(fix, position_m=tuple(position_m.tolist()), covariance_m2=tuple(covariance_m2.ravel().tolist()))


# Whether it follows

_Row = tuple[float, ...]
_NONE: Final = (0.0, 0.0, 0.0)

PARAMETERS: Final = {
    "px4": ("MAV_1_MODE 2", "EKF2_EV_CTRL 3", "EKF2_HGT_REF 3", "EKF2_EV_DELAY"),
    "ardupilot": ("SR2_POSITION 10", "VISO_TYPE 1 and EK3_SRC1_POSXY 6", "EK3_SRC1_POSZ 6", "VISO_DELAY_MS"),
    "gps": ("", "", "", ""),
}
"""Of each profile's vehicles: so that they state their position, use ours, have its height, know its delay."""

WINDOW_S: Final = 20.0
"""What the vehicle says is compared over this time."""
GAP_S: Final = 0.2
"""Longest time between two samples of an inertial sensor, and between a fix and a position compared with it."""
APART_M, HEIGHT_M, LATE_S, MOVING_MPS = 1.0, 0.5, 0.15, 0.3
"""A vehicle that is farther from the fixes, horizontally or vertically, has its position from elsewhere; one that is
farther behind takes them for newer than they are, which is seen from this speed on."""
NORTH_DEG: Final = 5.0
"""Norths agree within this: the anchors' lasting errors turned recorded flights by up to 4°."""
LEAST_TRAVEL_M, DEGREE = 0.2, 5
"""Standard deviation of the motion that tells directions from those errors, beside a polynomial of this degree: what an
unknown start, a wrong level and biases of the vehicle's sensors do to its path."""
KEPT: Final = 0.95
"""Weight of a window that is a second older."""


def rotations(vectors_rad: Array) -> Array:
    """Rotations about vectors by their length (Rodrigues): shape (n, 3) to (n, 3, 3)."""
    half = np.linalg.norm(vectors_rad, axis=1)[:, None, None] / (2.0 * np.pi)
    cross: Array = np.cross(vectors_rad[:, None], -np.eye(3))
    turns: Array = np.eye(3) + np.sinc(2.0 * half) * cross + 0.5 * np.sinc(half) ** 2 * cross @ cross
    return turns


def inertial_path(motion: Array) -> tuple[Array, Array]:
    """Times in s, shape (n − 1,), and the vehicle's path, north + i·east in m, but for start and speed.

    ``motion``, shape (n, 11): time of arrival and of sending, specific force in m/s² and rate in rad/s along forward,
    right, down; roll, pitch, yaw. Only the first attitude is used, as later ones depend on the positions given.
    """
    time_s = motion[:, 1] + (motion[:, 0] - motion[:, 1]).min()  # the quickest message has the least delay
    step_s = np.diff(time_s)
    roll, pitch, yaw = rotations(np.diag(motion[0, 8:]))
    attitudes = [yaw @ pitch @ roll]
    for turn in rotations(motion[:-1, 5:8] * step_s[:, None]):
        attitudes.append(attitudes[-1] @ turn)
    force_mps2 = np.einsum("nij,nj->in", attitudes[:-1], motion[:-1, 2:5])
    speed_mps = np.cumsum((force_mps2[0] + 1j * force_mps2[1]) * step_s)
    return time_s[1:], np.cumsum(speed_mps * step_s)


def north_sums(given: Array, time_s: Array, path_m: Array) -> tuple[complex, float]:
    """Two sums: the first over the second turns an inertial path into given positions. Zeros if there is no motion.

    ``given``, shape (n, 4): time in s, north and east in m, standard deviation. The angle of the turn is by how much
    the site's azimuths are larger than the vehicle's. Both paths are taken beside a polynomial.
    """
    at_s, north_m, east_m, std_m = given[(given[:, 0] >= time_s[0]) & (given[:, 0] <= time_s[-1])].T
    if len(at_s) > 2 * DEGREE:
        basis, _ = np.linalg.qr(np.vander((at_s - at_s[0]) / WINDOW_S, DEGREE + 1) / std_m[:, None])
        both = np.array([north_m + 1j * east_m, np.interp(at_s, time_s, path_m)]) / std_m
        measured, travelled = both - (both @ basis) @ basis.T
        if (power := float(np.vdot(travelled, travelled).real)) > LEAST_TRAVEL_M**2 * np.sum(std_m**-2.0):
            return complex(np.vdot(travelled, measured)), power
    return 0j, 0.0


class Following:
    """Compares what a vehicle says of itself with what it is given; north, east, down in m; times in s since 1970."""

    def __init__(self, parameters: tuple[str, str, str, str]) -> None:
        self._parameters = parameters
        self.attitude_rad: _Row = ()
        """The vehicle's newest roll, pitch and yaw."""
        self.is_used = True
        """Whether the vehicle says that it knows its horizontal position."""
        self._begin_s, self._turn, self._power = inf, 0j, 0.0
        """When it was given the first position; of ``north_sums``, with earlier windows."""
        self._fix: tuple[float, Vector, Vector] = (-inf, _NONE, _NONE)
        """The newest fix: time, position and velocity."""
        self._given, self._motion, self._apart = deque[_Row](), deque[_Row](), deque[_Row]()
        """What ``north_sums`` and ``inertial_path`` take; time, the vehicle's position less the fix, north and east
        velocity of the fix."""

    def on_given(self, given: FixMessage, fix: FixMessage, heading_deg: float) -> None:
        """The vehicle was given what is new in a fix."""
        at, velocity = (north_east_down(one, heading_deg) for one in (fix.position_m, fix.velocity_mps or _NONE))
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

    def verdict(self, now_s: float, heading_deg: float) -> tuple[str, str] | None:
        """Once a second: its subject and its words; None while there is nothing to compare."""
        for rows in (self._given, self._motion, self._apart):
            while rows and now_s - rows[0][0] > WINDOW_S:
                rows.popleft()
        states, use, height, delay = self._parameters
        if now_s - self._fix[0] > 1.0 or now_s - self._begin_s < 0.5 * WINDOW_S:
            return None
        if not self._apart:
            return "silent", f"the vehicle does not send LOCAL_POSITION_NED: set {states}"
        _, north, east, down, north_mps, east_mps = np.array(self._apart).T
        apart_m, height_m = sqrt(np.mean(north**2 + east**2)), abs(float(np.mean(down)))
        square = float(np.mean(north_mps**2 + east_mps**2))
        late_s = -float(np.mean(north * north_mps + east * east_mps)) / max(square, MOVING_MPS**2)
        off_deg = self._north_deg()
        follows = f"the vehicle follows, {100.0 * apart_m:.0f} cm; north"
        for subject, applies, words in (
            ("use", not self.is_used or apart_m > APART_M, f"the vehicle is {apart_m:.1f} m off: set {use}"),
            ("height", height_m > HEIGHT_M, f"the vehicle's height is {height_m:.1f} m off: set {height}"),
            ("delay", late_s > LATE_S, f"the vehicle is {1e3 * late_s:.0f} ms late: set {delay}"),
            ("unseen", isnan(off_deg), f"{follows} is seen after 20 s of motion with ATTITUDE and HIGHRES_IMU"),
            ("follows", abs(off_deg) <= NORTH_DEG, f"{follows} agrees within {NORTH_DEG:.0f}°"),
        ):
            if applies:
                return subject, words
        return "north", (
            f"north is {abs(off_deg):.0f}° off; if the vehicle's compass is right, set the site's heading_deg "
            f"(or heading= of this target) to {(heading_deg - off_deg) % 360.0:.0f}"
        )

    def _north_deg(self) -> float:
        """By how much the site's azimuths are larger than the vehicle's; NaN until it is seen."""
        if len(self._given) > 1 and self._motion and self._motion[-1][0] - self._motion[0][0] > WINDOW_S - 1.0:
            turn, power = north_sums(np.array(self._given), *inertial_path(np.array(self._motion)))
            self._turn, self._power = KEPT * self._turn + turn, KEPT * self._power + power
        return degrees(phase(self._turn)) if self._power else nan
