"""Everything that is not ideal in a world, as one value."""

import math

from msgspec import Struct

from skyless.sim.carrier import CarrierModel
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.range_errors import RangeErrorModel
from skyless.site.channel import ChannelModel


class AnchorBias(Struct, frozen=True, forbid_unknown_fields=True):
    """An obstacle near an anchor: tags receive it late, always or in bursts."""

    anchor: int
    bias_m: float
    burst_s: float | None = None
    """Length of a burst; None for a bias that is always there."""
    pause_s: float = 5.0
    """Time between bursts; the first burst begins after one pause."""
    from_s: float = 0.0
    to_s: float = math.inf
    """With ``from_s``: the interval of true time that has a bias, or bursts of it."""
    creep_mps: float = 0.0
    """By how much the bias grows from ``from_s`` on."""

    def active_m(self, t_s: float) -> float:
        """Bias at a true time, 0 between bursts."""
        if not self.from_s <= t_s < self.to_s:
            return 0.0
        if self.burst_s is None or t_s % (self.burst_s + self.pause_s) >= self.pause_s:
            return self.bias_m + self.creep_mps * (t_s - self.from_s)
        return 0.0


class DelayError(Struct, frozen=True, forbid_unknown_fields=True):
    """True minus configured antenna delays of an anchor: a bias of all its stamps."""

    anchor: int
    tx_ticks: float = 0.0
    rx_ticks: float = 0.0
    from_s: float = 0.0
    """True time at which the delays become these; another error of the same anchor may hold before."""


class AnchorDisplacement(Struct, frozen=True, forbid_unknown_fields=True):
    """True minus configured position of an anchor: frames travel from and to the true one, machines know the other."""

    anchor: int
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    from_s: float = 0.0
    """True time at which the anchor moves there; another displacement of the same anchor may hold before."""


class PairError(Struct, frozen=True, forbid_unknown_fields=True):
    """An error of the range between two anchors, the same in both directions. Errors of one pair add up."""

    a: int
    b: int
    late_m: float = 0.0
    """What either receives the other late."""
    blocked: bool = False
    """Neither receives the other at all."""


class WarmUp(Struct, frozen=True, forbid_unknown_fields=True):
    """A crystal whose frequency also changes by ppm·(1 − exp(−(t − start_s)/tau_s)) from a time on."""

    ppm: float
    tau_s: float
    start_s: float = 0.0
    anchor: int | None = None
    """Whose crystal; None for those of all tags. A second one of the same crystal replaces the first."""


class Body(Struct, frozen=True, forbid_unknown_fields=True):
    """A person who carries each tag: anchors in a sector that turns with the tag's motion are received late."""

    delay_m: float = 0.2
    sector_rad: float = math.radians(100.0)
    """Full width of the sector, on the floor plan."""
    direction_rad: float = math.pi
    """Middle of the sector, from the direction of motion; by default behind the tag. A tag at rest faces along x."""


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
    anchor_displacements: tuple[AnchorDisplacement, ...] = ()
    anchor_pair_errors: tuple[PairError, ...] = ()
    range_errors: RangeErrorModel = RangeErrorModel()
    body: Body | None = None
    warm_ups: tuple[WarmUp, ...] = ()
    carrier: CarrierModel | None = None
    """Phases of the carrier; None where radios do not measure them."""
    diagnostics: bool = False
    """Whether receptions carry power and carrier offset."""


def lab_impairments(noise_ps: float) -> Impairments:
    """Return the world of the scenario ``lab`` (``docs/maths.md`` section 5), for the site of ``skyless.sim.lab``.

    Crystals of ±10 ppm with white FM 2·10⁻¹¹ and random-walk FM 10⁻⁹/√s, Gaussian noise of ``noise_ps`` on every TX
    and every RX stamp, stamps rounded to ticks, no loss and no obstacle.
    """
    return Impairments(tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps)
