"""The carrier's phase at each reception, as a DW1000 measures it besides its stamp.

    phase = f·(X − R) + constants of both chips + reflections + noise      [cycles]

X is the sender's counter when its frame leaves and R the receiver's when it arrives, both without the stamps' noise:
one crystal drives a chip's counter and its carrier. Reflections change with the path of a tag, over centimetres.
Constants are drawn when a radio is switched on. All draws are from streams of their own: stamps are the same with and
without carrier.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Records
from skyless.core.ticks import CHANNEL_5_HZ, SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.sim.range_errors import RangeErrorModel, RangeErrors
from skyless.sim.streams import ANCHOR_KEY, TAG_KEY, stream

PERIOD_TICKS: Final = 128
"""Ticks that hold whole cycles of each channel's carrier."""

_CYCLES_PER_TICK: Final = CHANNEL_5_HZ / TICK_RATE_HZ
_WAVELENGTH_M: Final = SPEED_OF_LIGHT_MPS / CHANNEL_5_HZ
_STEPS: Final = 2.0**16

# Purposes of streams of random numbers.
_REFLECTIONS: Final = 7
_NOISE: Final = 8
_CONSTANTS: Final = 9


class CarrierModel(Struct, frozen=True, forbid_unknown_fields=True):
    """What phases err by; sizes as far as four recorded DW1000s show them (``docs/phases.md``)."""

    noise_rad: float = 0.05
    """Gaussian noise of each phase, standard deviation."""
    reflections: RangeErrorModel = RangeErrorModel(changing_m=0.003, correlation_m=0.05)
    """What reflections change in the carrier's path to a tag."""
    obstructed: float = 8.0 / 3.0
    """How many times as much they do where a wall or something else is in the way."""
    slips: float = 0.0
    """Chance that a tag's phase is half a cycle off from this reception on."""
    wild: float = 0.0
    """Chance that a tag's phase is random."""


class Carriers:
    """The carriers of a site's radios; phases are in cycles, multiples of 2⁻¹⁶ in [0, 1) as drivers give them."""

    def __init__(self, model: CarrierModel, anchors: list[int], tags: int, seed: int) -> None:
        """``anchors``: their identifiers, in the order of the nodes."""
        self._model, self._anchors = model, len(anchors)
        self._reflections = RangeErrors(model.reflections, tags, len(anchors), seed, _REFLECTIONS)
        keys = [(ANCHOR_KEY, anchor) for anchor in anchors] + [(TAG_KEY, tag) for tag in range(tags)]
        self._noise = [stream(seed, *key, _NOISE) for key in keys]
        self._powering = [stream(seed, *key, _CONSTANTS) for key in keys]
        self._constants = np.array([draw.random(2) for draw in self._powering])
        """Of each node as sender and as receiver, shape (nodes, 2)."""
        self._slipped = np.zeros((len(keys), len(anchors)))

    def restart(self, node: int) -> None:
        """A node was switched on again."""
        self._constants[node] = self._powering[node].random(2)

    def advance_to(self, t_s: float, stations: Records) -> None:
        """Bring reflections to a true time; ``stations`` hold the tags' motion."""
        self._reflections.advance_to(t_s, stations)

    def phases_cycles(self, sender: int, tx_ticks: int, late_ticks: float, heard: Records) -> Array:
        """Phases of a frame at the nodes that received it (``RECEPTION_RECORD``), shape (n,).

        ``tx_ticks``: the sender's counter when it left, ``late_ticks`` by how much later than that it really did.
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
