"""All that is not ideal in a world, as one value."""

import math

from msgspec import Struct

from skyless.simulation.channel import ChannelModel
from skyless.simulation.oscillator import OscillatorModel


class AnchorBias(Struct, frozen=True, forbid_unknown_fields=True):
    """An obstacle near an anchor: the tags hear it late, always or in bursts."""

    anchor: int
    bias_m: float
    burst_s: float | None = None
    """Length of a burst; None for a bias that is always there."""
    pause_s: float = 5.0
    """Time between bursts; the first burst begins after one pause."""

    def active_m(self, t_s: float) -> float:
        """Bias at a true time, 0 between bursts."""
        if self.burst_s is None or t_s % (self.burst_s + self.pause_s) >= self.pause_s:
            return self.bias_m
        return 0.0


class DelayError(Struct, frozen=True, forbid_unknown_fields=True):
    """True minus configured antenna delays of an anchor: a bias of all its stamps."""

    anchor: int
    tx_ticks: float = 0.0
    rx_ticks: float = 0.0


class Outage(Struct, frozen=True, forbid_unknown_fields=True):
    """A node is off in [off_s, on_s); when it comes back its counter and its machine are new."""

    off_s: float
    on_s: float = math.inf


class AnchorOutage(Struct, frozen=True, forbid_unknown_fields=True):
    """An anchor that stops, and perhaps restarts."""

    anchor: int
    outage: Outage


class Impairments(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise, losses and faults of a world."""

    tx_stamp_ps: float = 100.0
    """Gaussian noise of every emission against its TX stamp, standard deviation."""
    rx_stamp_ps: float = 100.0
    """Gaussian noise of every RX stamp, standard deviation."""
    oscillator: OscillatorModel = OscillatorModel()
    channel: ChannelModel = ChannelModel()
    anchor_biases: tuple[AnchorBias, ...] = ()
    delay_errors: tuple[DelayError, ...] = ()
    anchor_outages: tuple[AnchorOutage, ...] = ()
    diagnostics: bool = False
    """Whether receptions carry power and carrier offset."""
