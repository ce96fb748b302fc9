"""Everything in a world that is not ideal: crystals, channel, range errors, carrier phases, faults."""

import math
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.arrays import Array, Integers, Records
from skyless.core.ticks import CHANNEL_5_HZ, SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.streams import ANCHOR_KEY, TAG_KEY, stream
from skyless.site.channel import ChannelModel

# Errors of the ranges from anchors to tags that are no noise: each pair has its own, constant or changing slowly.
#
# Real pairs of radios have them from antennas, multipath, calibration and power. Those that change are Gauss–Markov
# processes (exponential correlation) along time or along the path of a tag, drawn at knots and interpolated.

_KNOTS: Final = 20
"""Knots per correlation length. Linear interpolation between them keeps at least 98.7 % of the standard deviation."""

SLOPE_MIDDLE_M: Final = 4.0
"""The slope's error is 0 at this distance and reaches its size at 0 and at twice the distance."""

_PURPOSE: Final = 2
"""Purpose of a tag's random stream beside its noise and its crystal."""


class RangeErrorModel(Struct, frozen=True, forbid_unknown_fields=True):
    """Range errors at tags in metres; positive: the tag receives the anchor late.

    Raises ValueError: changing errors have no correlation length, or two.
    """

    constant_m: float = 0.0
    """Each pair's constant is uniform within plus or minus this."""
    slope_m: float = 0.0
    """Same for all pairs: slope_m·clip((d − 4 m)/4 m, −1, 1) at the true distance d."""
    changing_m: float = 0.0
    """Standard deviation of each pair's changing error."""
    correlation_s: float | None = None
    """Time in which its correlation falls to 1/e …"""
    correlation_m: float | None = None
    """… or, instead, the path length in which it does."""

    def __post_init__(self) -> None:
        lengths = [one for one in (self.correlation_s, self.correlation_m) if one is not None]
        if len(lengths) > 1 or (self.changing_m > 0.0 and not lengths):
            raise ValueError("range errors that change should have either correlation_s or correlation_m")
        if any(not one > 0.0 for one in lengths):
            raise ValueError(f"the correlation of range errors is {lengths[0]:g}; it should be more than 0")


def slope_error_m(slope_m: float, distance_m: float) -> float:
    """Range error that depends on the true distance (``RangeErrorModel.slope_m``)."""
    return slope_m * min(max((distance_m - SLOPE_MIDDLE_M) / SLOPE_MIDDLE_M, -1.0), 1.0)


class RangeErrors:
    """The present errors of all pairs. A tag's errors depend only on the seed, its number and its path."""

    def __init__(self, model: RangeErrorModel, tags: int, anchors: int, seed: int, purpose: int = _PURPOSE) -> None:
        """``purpose`` of the tags' random streams."""
        self.present_m: Array = np.zeros((anchors + tags, anchors))
        """Shape (nodes, anchors) in the kernels' numbering, without the slope part; those of anchors stay as set."""
        self._model, self._anchors = model, anchors
        self._constant_m = np.zeros((tags, anchors))
        self._step = (model.correlation_s or model.correlation_m or math.inf) / _KNOTS
        self._travelled = np.zeros(tags)
        """Time or path length of each tag so far."""
        self._knots = np.zeros(tags, dtype=np.int64)
        self._positions_m: Array | None = None
        self._before_m, self._after_m = np.zeros((tags, anchors)), np.zeros((tags, anchors))
        self._draws: list[np.random.Generator] = []
        if model.constant_m > 0.0 or model.changing_m > 0.0:
            self._draws = [stream(seed, TAG_KEY, tag, purpose) for tag in range(tags)]
        for tag, draw in enumerate(self._draws):
            self._constant_m[tag] = draw.uniform(-model.constant_m, model.constant_m, anchors)
            self._before_m[tag] = model.changing_m * draw.standard_normal(anchors)
            self._after_m[tag] = self._next(tag)
        self.present_m[anchors:] = self._constant_m

    def _next(self, tag: int) -> Array:
        """Errors at the knot after the present one; the correlation over one step is exp(−1/_KNOTS)."""
        kept = math.exp(-1.0 / _KNOTS)
        gained_m = self._model.changing_m * math.sqrt(1.0 - kept**2)
        return np.asarray(kept * self._before_m[tag] + gained_m * self._draws[tag].standard_normal(self._anchors))

    def advance_to(self, t_s: float, stations: Records) -> None:
        """Advance the errors to a true time; ``stations`` contain the tags' motion."""
        if self._model.changing_m == 0.0:
            return
        if self._model.correlation_s is not None:
            self._travelled[:] = t_s
        else:
            self._walk(_positions_m(stations[self._anchors :], t_s))
        for tag in np.flatnonzero(self._travelled >= (self._knots + 1) * self._step).tolist():
            while self._travelled[tag] >= (self._knots[tag] + 1) * self._step:
                self._knots[tag] += 1
                self._before_m[tag] = self._after_m[tag]
                self._after_m[tag] = self._next(tag)
        part = (self._travelled / self._step - self._knots)[:, None]
        changing_m = self._before_m + part * (self._after_m - self._before_m)
        self.present_m[self._anchors :] = self._constant_m + changing_m

    def _walk(self, positions_m: Array) -> None:
        """Add up the path from frame to frame along straight lines."""
        if self._positions_m is not None:
            self._travelled += np.linalg.norm(positions_m - self._positions_m, axis=1)
        self._positions_m = positions_m


def _positions_m(tags: NDArray[Any], t_s: float) -> Array:
    """Positions of tags at a true time, shape (tags, 3)."""
    dt_s = (t_s - tags["origin_s"])[:, None]
    turned = tags["velocity_mps"] + 0.5 * dt_s * tags["acceleration_mps2"]
    return np.asarray(tags["position_m"] + dt_s * turned, np.float64)


# The carrier's phase at each reception, as a DW1000 measures it besides its stamp.
#
#     phase = f·(X − R) + constants of both chips + reflections + noise      [cycles]
#
# X is the sender's counter when its frame leaves and R the receiver's when it arrives, both without the stamps'
# noise: one crystal drives a chip's counter and its carrier. Reflections change with the path of a tag, over
# centimetres. Constants are drawn when a radio is switched on. All draws are from streams of their own: stamps are
# the same with and without carrier.

PERIOD_TICKS: Final = 128
"""Ticks with a whole number of carrier cycles in every channel."""

_CYCLES_PER_TICK: Final = CHANNEL_5_HZ / TICK_RATE_HZ
_WAVELENGTH_M: Final = SPEED_OF_LIGHT_MPS / CHANNEL_5_HZ
_STEPS: Final = 2.0**16

# Purposes of streams of random numbers.
_REFLECTIONS: Final = 7
_NOISE: Final = 8
_CONSTANTS: Final = 9


class CarrierModel(Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of carrier phases; sizes from four recorded DW1000s as far as they show them (``docs/phases.md``)."""

    noise_rad: float = 0.05
    """Gaussian noise of each phase, standard deviation."""
    reflections: RangeErrorModel = RangeErrorModel(changing_m=0.003, correlation_m=0.05)
    """Change of the carrier's path to a tag by reflections."""
    obstructed: float = 8.0 / 3.0
    """Factor on that if a wall or another obstacle is in the way."""
    slips: float = 0.0
    """Probability, at each reception, that a tag's phase shifts by half a cycle for good."""
    wild: float = 0.0
    """Probability that a tag's phase is random."""


class Carriers:
    """The carriers of a site's radios; phases in cycles, multiples of 2⁻¹⁶ in [0, 1) as from drivers."""

    def __init__(self, model: CarrierModel, anchors: list[int], tags: int, seed: int) -> None:
        """``anchors``: identifiers in the order of the nodes."""
        self._model, self._anchors = model, len(anchors)
        self._reflections = RangeErrors(model.reflections, tags, len(anchors), seed, _REFLECTIONS)
        keys = [(ANCHOR_KEY, anchor) for anchor in anchors] + [(TAG_KEY, tag) for tag in range(tags)]
        self._noise = [stream(seed, *key, _NOISE) for key in keys]
        self._powering = [stream(seed, *key, _CONSTANTS) for key in keys]
        self._constants = np.array([draw.random(2) for draw in self._powering])
        """Of each node as sender and as receiver, shape (nodes, 2)."""
        self._slipped = np.zeros((len(keys), len(anchors)))

    def restart(self, node: int) -> None:
        """Draw new constants for a node that was switched on again."""
        self._constants[node] = self._powering[node].random(2)

    def advance_to(self, t_s: float, stations: Records) -> None:
        """Advance reflections to a true time; ``stations`` contain the tags' motion."""
        self._reflections.advance_to(t_s, stations)

    def phases_cycles(self, sender: int, tx_ticks: int, late_ticks: float, heard: Records) -> Array:
        """Phases of a frame at the nodes that received it (``sim.listening.Row``), shape (n,).

        ``tx_ticks``: the sender's counter at emission; ``late_ticks``: how much later it really left.
        """
        model, nodes = self._model, heard["node"]
        factors = np.where(heard["extra_m"] > 0.0, model.obstructed, 1.0)
        reflected_m = factors * self._reflections.present_m[nodes, sender]
        flown_ticks = (heard["reading_ticks"] - late_ticks) - tx_ticks % PERIOD_TICKS
        cycles = -_CYCLES_PER_TICK * flown_ticks - reflected_m / _WAVELENGTH_M
        cycles += self._constants[sender, 0] + self._constants[nodes, 1] + self._errors(sender, nodes)
        return np.asarray(np.round(cycles * _STEPS) % _STEPS / _STEPS, np.float64)

    def _errors(self, sender: int, nodes: Integers) -> Array:
        """Noise, and slips of tags, in cycles."""
        model, errors = self._model, np.empty(len(nodes))
        for place, node in enumerate(nodes.tolist()):
            draw = self._noise[node]
            errors[place] = model.noise_rad / (2.0 * math.pi) * draw.standard_normal()
            if node >= self._anchors and model.slips + model.wild > 0.0:
                chances = draw.random(3)
                self._slipped[node, sender] += 0.5 * (chances[0] < model.slips)
                errors[place] += self._slipped[node, sender] + chances[2] * (chances[1] < model.wild)
        return errors


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
    """… and its end."""
    creep_mps: float = 0.0
    """Growth of the bias from ``from_s`` on."""

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
    """True time from which these apply; an earlier error of the same anchor may apply before."""


class AnchorDisplacement(Struct, frozen=True, forbid_unknown_fields=True):
    """True minus configured position of an anchor: frames travel from and to the true one."""

    anchor: int
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    from_s: float = 0.0
    """True time of the move; an earlier displacement of the same anchor may apply before."""


class PairError(Struct, frozen=True, forbid_unknown_fields=True):
    """An error of the range between two anchors, the same in both directions. Errors of one pair add up."""

    a: int
    b: int
    late_m: float = 0.0
    """Delay of each one's reception of the other."""
    blocked: bool = False
    """Whether neither receives the other."""


class WarmUp(Struct, frozen=True, forbid_unknown_fields=True):
    """A crystal whose frequency also changes by ppm·(1 − exp(−(t − start_s)/tau_s)) from a time on."""

    ppm: float
    tau_s: float
    start_s: float = 0.0
    anchor: int | None = None
    """The crystal's anchor; None for those of all tags. A second warm-up of a crystal replaces the first."""


class Body(Struct, frozen=True, forbid_unknown_fields=True):
    """A person who carries each tag: anchors in a sector that turns with the tag's motion are received late."""

    delay_m: float = 0.2
    sector_rad: float = math.radians(100.0)
    """Full width of the sector, on the floor plan."""
    direction_rad: float = math.pi
    """Middle of the sector, from the direction of motion; by default behind the tag. A tag at rest faces along x."""


class Outage(Struct, frozen=True, forbid_unknown_fields=True):
    """A node is off in [off_s, on_s); afterwards its counter and its machine are new."""

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
    """Carrier phases; None if radios do not measure them."""
    diagnostics: bool = False
    """Whether receptions include power and carrier offset."""


def lab_impairments(noise_ps: float) -> Impairments:
    """The world of the scenario ``lab`` (``docs/maths.md`` section 5), for the site of ``skyless.sim.world``.

    Crystals of ±10 ppm with white FM 2·10⁻¹¹ and random-walk FM 10⁻⁹/√s, Gaussian noise of ``noise_ps`` on every TX
    and every RX stamp, stamps rounded to ticks, no loss and no obstacle.
    """
    return Impairments(tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps)
