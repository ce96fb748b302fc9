"""What a motion sensor on a simulated tag shows: an accelerometer and a gyroscope, or wheels, with stated errors."""

from collections.abc import Iterator
from copy import deepcopy
from math import atan2, cos, exp, remainder, sin, sqrt
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.estimator.motion import GRAVITY_MPS2
from skyless.core.motion_sample import MotionSample
from skyless.sim.streams import stream
from skyless.sim.trajectory import Trajectory

_MOTION_KEY: Final = 6
_UP_MPS2: Final = np.array([0.0, 0.0, GRAVITY_MPS2])
_FASTEST_RPS: Final = 8.0
"""Rate at which a robot turns into its course."""
_MOST_MPS2, _MOST_RPS, _MOST_MPS = 157.0, 35.0, 100.0
"""Where sensors saturate: 16 g, 2000 degrees per second."""
_SWAY_RAD: Final = 0.25
_SWAY_RPS: Final = (1.7, 2.3, 0.9)
"""Amplitude and rates of a hand's roll, pitch and heading."""


class MotionErrors(Struct, frozen=True):
    """The errors of a motion sensor, and how often it is read."""

    has_wheels: bool = False
    """Whether it is a robot's odometer and gyroscope; otherwise an accelerometer and a gyroscope in a hand."""
    rate_hz: float = 100.0
    bias_mps2: float = 0.1
    """Standard deviation of the accelerometer's bias on each axis …"""
    bias_s: float = 5.0
    """… and the time in which it is forgotten: it also stands for tilt."""
    noise_mps2: float = 0.05
    drift_rps: float = 0.01
    """Standard deviation of the gyroscope's bias on each axis."""
    noise_rps: float = 0.005
    scale: float = 0.02
    """Standard deviation of the wheels' scale …"""
    noise_mps: float = 0.02
    """… and of each speed."""


class MotionSensor:
    """The sensor of one tag."""

    def __init__(self, path: Trajectory, errors: MotionErrors, seed: int, tag: int) -> None:
        """``seed`` and ``tag`` choose the errors."""
        self._path, self._errors = deepcopy(path), errors  # paths are asked in order of time
        self._draw = stream(seed, _MOTION_KEY, tag)
        self._index = 0
        self._heading = self._draw.uniform(-np.pi, np.pi)
        self._phases = self._draw.uniform(-np.pi, np.pi, 3)
        self._bias_mps2 = errors.bias_mps2 * self._draw.standard_normal(3)
        self._drift_rps = errors.drift_rps * self._draw.standard_normal(3)
        self._scale = 1.0 + errors.scale * float(self._draw.standard_normal())
        self._turned = self._attitude(0.0)

    def until(self, time_s: float) -> Iterator[MotionSample]:
        """The samples up to a true time, from the last one on."""
        while self._index / self._errors.rate_hz <= time_s:
            yield self._sample(self._index / self._errors.rate_hz)
            self._index += 1

    def attitude(self) -> Array:
        """The matrix that turns the sensor's frame into the site's, at the newest sample, shape (3, 3)."""
        return self._turned

    def _sample(self, time_s: float) -> MotionSample:
        errors, draw, dt = self._errors, self._draw, 1.0 / self._errors.rate_hz
        before, self._turned = self._turned, self._attitude(time_s)
        turn = before.T @ self._turned
        rate = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (2.0 * dt)
        rate = np.clip(rate + self._drift_rps + errors.noise_rps * draw.standard_normal(3), -_MOST_RPS, _MOST_RPS)
        if errors.has_wheels:
            velocity_mps = self._path.velocity(time_s) @ self._turned[:, 0]
            speed_mps = self._scale * float(velocity_mps) + errors.noise_mps * float(draw.standard_normal())
            return MotionSample(time_s, (0.0, 0.0, float(rate[2])), None, max(min(speed_mps, _MOST_MPS), -_MOST_MPS))
        kept = exp(-dt / errors.bias_s)
        self._bias_mps2 = kept * self._bias_mps2 + errors.bias_mps2 * sqrt(1.0 - kept**2) * draw.standard_normal(3)
        force = self._turned.T @ (self._path.piece(time_s).acceleration_mps2 + _UP_MPS2)
        force = force + self._bias_mps2 + errors.noise_mps2 * draw.standard_normal(3)
        force = np.clip(force, -_MOST_MPS2, _MOST_MPS2)
        return MotionSample(time_s, (float(rate[0]), float(rate[1]), float(rate[2])), tuple(force.tolist()))

    def _attitude(self, time_s: float) -> Array:
        """Of a robot that looks where it goes, or of a hand that sways."""
        if self._errors.has_wheels:
            x, y, _ = self._path.velocity(time_s).tolist()
            if x or y:
                step = remainder(atan2(y, x) - self._heading, 2.0 * np.pi)
                most = _FASTEST_RPS / self._errors.rate_hz
                self._heading += max(min(step, most), -most)
            return _turned(self._heading, 0.0, 0.0)
        roll, pitch, yaw = (
            _SWAY_RAD * sin(rate * time_s + phase) for rate, phase in zip(_SWAY_RPS, self._phases, strict=True)
        )
        return _turned(self._heading + 2.0 * yaw, pitch, roll)


def _turned(yaw: float, pitch: float, roll: float) -> Array:
    a, b, c, d, e, f = cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)
    return np.array([
        [a * c, a * d * f - b * e, a * d * e + b * f],
        [b * c, b * d * f + a * e, b * d * e - a * f],
        [-d, c * f, c * e],
    ])  # fmt: skip
