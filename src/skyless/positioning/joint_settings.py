"""What ``joint`` assumes of tag, clocks and stamps."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.positioning.joint_state import Vector
from skyless.positioning.protection import RISK

MAX_RATE: Final = 50e-6
"""Two crystals of ±20 ppm, and room."""


class JointSettings(Struct, frozen=True):
    """What the filter assumes."""

    qa: float = 0.5
    """Spectral density of the acceleration, m²/s³ per axis."""
    white: float = 3.6e-5
    """Of each oscillator, m²/s."""
    walk: float = 0.09
    """Of each oscillator's rate, m²/s³."""
    tx_variance_m2: float = 9e-4
    rx_variance_m2: float = 9e-4
    """Of one stamp each."""
    gate: float = 4.0
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""
    drop_s: float = 2.0
    """Anchors that are silent for longer are out of view."""
    most_clock_agility: float = 1e4
    """At most so many times ``walk`` counts where innovations show that oscillators wander more."""
    integrity_risk: float = RISK
    """Probability, for each fix, that an error exceeds its protection level."""
    alert_limit_m: float | None = None
    """Fixes with a higher horizontal protection level say so."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        rate_variance = (MAX_RATE * SPEED_OF_LIGHT_MPS) ** 2
        stamps = (self.tx_variance_m2, self.rx_variance_m2)
        noises = (self.qa, self.white, self.walk, *stamps)
        rest = (self.gate, height_m, rate_variance, self.drop_s, self.most_clock_agility)
        return np.array([self.dim, *noises, *rest])
