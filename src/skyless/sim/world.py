"""The world: anchors' machines on the simulated medium, listening tags, and true time.

A transmission has three events: its frame is fetched (the lead time before its RMARKER), the RMARKER leaves, and the
frame ends, when the listeners get it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_anchor import BeaconSender
from skyless.core.arrays import Array, Integers
from skyless.core.site import Site
from skyless.core.ticks import TICK_S, difference, from_seconds, wrap
from skyless.sim.impairments import Impairments
from skyless.sim.listening import TagSpec
from skyless.sim.medium import Delivery, Medium, Tally

_LEAD_TICKS: Final = from_seconds(1e-3)  # how long before its RMARKER a frame is fetched
_RETRY_TICKS: Final = from_seconds(5e-3)


@dataclass(slots=True, eq=False)
class Broadcast:
    """One frame at its end, with the tags that received it and their true motion."""

    anchor: int
    """Identifier of the sender."""
    frame: bytes
    emission_ticks: int
    """True time, in ideal ticks since the start, at which the RMARKER left the antenna …"""
    emission_fraction: float
    end_s: float
    """True time of the frame's end, the host's time in receptions."""
    tags: Integers
    """Indices of the tags that received it, shape (n,)."""
    rx_ticks: Integers
    """Their RX stamps, 40 bits, shape (n,)."""
    positions_m: Array
    """Their true positions at the emission, shape (n, 3)."""
    diagnostics: tuple[Diagnostics, ...] | None
    """Their radios' measurements, if the impairments require them."""
    phases_cycles: Array | None = None
    """Carrier phases, shape (n,), if simulated."""

    @property
    def emission_s(self) -> float:
        """True time of the RMARKER's emission in seconds since the start."""
        return (self.emission_ticks + self.emission_fraction) * TICK_S

    def receptions(self) -> Iterator[tuple[int, Reception, Array]]:
        """Tag index, reception and true position, shape (3,), of every tag that received the frame."""
        frame, host_s = self.frame, self.end_s
        measured = self.diagnostics or (None,) * len(self.tags)
        phases = (None,) * len(self.tags) if self.phases_cycles is None else self.phases_cycles.tolist()
        rows = zip(self.tags.tolist(), self.rx_ticks.tolist(), self.positions_m, measured, phases, strict=True)
        for tag, rx_ticks, position_m, diagnostics, phase in rows:
            yield tag, Reception(frame, rx_ticks, host_s, diagnostics, phase), position_m


def diagnostics_of(row: np.void) -> Diagnostics:
    """Diagnostics of a node's row (``listening.Row``)."""
    return Diagnostics(float(row["rx_power_dbm"]), float(row["first_path_power_dbm"]), float(row["carrier_offset_ppm"]))


class World:
    """A site on the air, deterministic given the seed; memory use does not grow with time."""

    def __init__(
        self,
        site: Site,
        anchor_factory: Callable[[int], BeaconSender],
        tags: Sequence[TagSpec],
        impairments: Impairments,
        seed: int,
    ) -> None:
        """``anchor_factory`` creates the machine of an anchor by identifier, again when that anchor restarts.

        Raises ValueError if an impairment names an anchor that is not the site's.
        """
        self._anchors, self._tags, self._impairments = site.anchors, tuple(tags), impairments
        self._factory = anchor_factory
        self.medium: Medium[Broadcast] = Medium(site, self._tags, impairments, seed, self._deliver)
        self._timeline = self.medium.timeline
        nodes = len(self._anchors) + len(self._tags)
        self._machines: list[BeaconSender | None] = [None] * nodes
        self._reasons_off = [1] * nodes
        self._plan_power()

    @property
    def tally(self) -> Tally:
        """Counts of what was sent, heard and lost so far, by reason."""
        return self.medium.tally

    @property
    def now_s(self) -> float:
        """The present true time."""
        return self.medium.now_s

    def run(self, until_s: float) -> Iterator[Broadcast]:
        """Advance true time to ``until_s`` and yield every frame at its end, in order. Can be called repeatedly."""
        return self.medium.run(until_s)

    # Power

    def _plan_power(self) -> None:
        node_of = self.medium.node_of
        outages = [(node_of[planned.anchor], planned.outage) for planned in self._impairments.anchor_outages]
        for index, tag in enumerate(self._tags):
            outages += [(len(self._anchors) + index, outage) for outage in tag.outages]
        for node, outage in outages:
            self._timeline.at(from_seconds(outage.off_s), partial(self._switch_off, node))
            if math.isfinite(outage.on_s):
                self._timeline.at(from_seconds(outage.on_s), partial(self._switch_on, node))
        for node in range(len(self._machines)):
            self._timeline.at(0, partial(self._switch_on, node))

    def _switch_off(self, node: int) -> None:
        self._reasons_off[node] += 1
        self.medium.switch_off(node)
        self._machines[node] = None

    def _switch_on(self, node: int) -> None:
        """Start a node, with a new counter and a new machine if it ran before."""
        self._reasons_off[node] -= 1
        if self._reasons_off[node] > 0:
            return
        self.medium.switch_on(node)
        if node < len(self._anchors):
            self._machines[node] = self._factory(self._anchors[node].id)
            self._timeline.at(self._timeline.now_ticks, partial(self._ask, node, self.medium.boots[node]))

    # Transmissions

    def _ask(self, node: int, boot: int) -> None:
        """Ask an anchor's machine for the time of its next frame."""
        machine, medium = self._machines[node], self.medium
        if machine is None or boot != medium.boots[node]:
            return
        local_ticks = medium.read_counter(node)
        tx_ticks = machine.next_transmission_ticks(wrap(local_ticks))
        if tx_ticks is None:
            self._timeline.at(self._timeline.now_ticks + _RETRY_TICKS, partial(self._ask, node, boot))
            return
        ahead = difference(tx_ticks, wrap(local_ticks))
        fetch_ticks = medium.foresee(node, local_ticks + ahead - _LEAD_TICKS)
        self._timeline.at(fetch_ticks, partial(self._fetch, node, boot, tx_ticks))

    def _fetch(self, node: int, boot: int, tx_ticks: int) -> None:
        """Fetch a frame from its machine and plan its flight, unless it is too late."""
        machine = self._machines[node]
        if machine is None or boot != self.medium.boots[node]:
            return
        if not self.medium.transmit(node, machine.transmission(tx_ticks)):
            self._timeline.at(self._timeline.now_ticks + _RETRY_TICKS, partial(self._ask, node, boot))

    def _deliver(self, delivery: Delivery) -> Broadcast:
        """Pass the frame to the anchors that received it. Returns the tags' receptions."""
        flight, by_anchors, by_tags = delivery.flight, delivery.by_anchors, delivery.by_tags
        end_s, diagnostics = self.now_s, self._impairments.diagnostics
        has_phases = self._impairments.carrier is not None
        rows = zip(by_anchors, by_anchors["node"].tolist(), by_anchors["rx_ticks"].tolist(), strict=True)
        for row, node, rx_ticks in rows:
            machine = self._machines[node]
            if machine is not None:
                measured = diagnostics_of(row) if diagnostics else None
                phase = float(row["phase_cycles"]) if has_phases else None
                machine.hear(Reception(flight.frame, rx_ticks, end_s, measured, phase))
        self._timeline.at(self._timeline.now_ticks, partial(self._ask, flight.sender, flight.boot))
        return Broadcast(
            self._anchors[flight.sender].id,
            flight.frame,
            flight.emission_ticks,
            flight.emission_fraction,
            end_s,
            by_tags["node"] - len(self._anchors),
            by_tags["rx_ticks"],
            by_tags["position_m"],
            tuple(diagnostics_of(row) for row in by_tags) if diagnostics else None,
            by_tags["phase_cycles"] if has_phases else None,
        )
