"""The medium: true time, the nodes' clocks and radios, and the frames between them.

A frame has two events: its RMARKER leaves, and it ends, when the listeners get it. The emulated radio clears the low
nine bits of DX = TX stamp - configured antenna delay, as the DW1000 does, so a node that ignores the granularity
sends with a wrong stamp. Who sends what and when is decided by the medium's owner.
"""

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Generic, TypeVar

import numpy as np
from msgspec import Struct

from skyless.core.air.frame import Transmission, after_rmarker_s, preamble_s
from skyless.core.arrays import Records
from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.views import view
from skyless.core.site import Site
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ, TICK_S, difference, from_seconds, wrap
from skyless.sim.impairments import Carriers, Impairments, RangeErrors
from skyless.sim.listening import (
    OUTCOMES,
    OneFrame,
    Other,
    Row,
    TagSpec,
    displace,
    make_stations,
    receive_frame,
    set_delays,
    set_piece,
)
from skyless.sim.oscillator import advance, emit, foresee, make_clocks, restart_counter, warm_up
from skyless.sim.streams import ANCHOR_KEY, TAG_KEY, Streams, stream
from skyless.site.channel import POWER_BIAS_M, barriers_of

TURNAROUND_S: Final = 0.2e-3
"""Time that a host needs to pass a frame to its radio; a preamble due earlier is too late (HPDWARN).

Longer than any frame after its RMARKER (177 µs), so that all overlapping frames are known when the RMARKER leaves.
"""

_PREAMBLE_TICKS: Final = from_seconds(preamble_s())
_DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)

_advance = compiled(advance, KERNELS)
_foresee = compiled(foresee, KERNELS)
_emit = compiled(emit, KERNELS)
_receive_frame = compiled(receive_frame, KERNELS)

_KEPT_TICKS: Final = round(2e-3 * TICK_RATE_HZ)
_FARTHEST_TICKS: Final = round(10e-6 * TICK_RATE_HZ)
"""Flight times up to 10 µs (3 km) can make consecutive frames overlap."""

Result = TypeVar("Result")


class Timeline(Generic[Result]):
    """Events in order of true time (whole ideal ticks); those of the same tick in the order of planning."""

    def __init__(self) -> None:
        self.now_ticks = 0
        self._serial = 0
        self.until_ticks = 0
        """End of the present ``run``."""
        self._events: list[tuple[int, int, Callable[[], Result | None]]] = []

    @property
    def next_ticks(self) -> int | None:
        """Time of the next event; None if nothing is planned."""
        return self._events[0][0] if self._events else None

    def at(self, ticks: int, happen: Callable[[], Result | None]) -> None:
        """Plan an event; one in the past happens now."""
        self._serial += 1
        heapq.heappush(self._events, (max(ticks, self.now_ticks), self._serial, happen))

    def pass_to(self, ticks: int) -> bool:
        """Advance to ``ticks`` at once if no event and no end of ``run`` comes first. Returns True if advanced."""
        if ticks > self.until_ticks or (self._events and self._events[0][0] <= ticks):
            return False
        self.now_ticks = max(self.now_ticks, ticks)
        return True

    def run(self, until_ticks: int) -> Iterator[Result]:
        """Run all events up to a time, and yield their results."""
        self.until_ticks = until_ticks
        while self._events and self._events[0][0] <= until_ticks:
            self.now_ticks, _, happen = heapq.heappop(self._events)
            result = happen()
            if result is not None:
                yield result
        self.now_ticks = max(self.now_ticks, until_ticks)


@dataclass(slots=True, eq=False)
class Flight:
    """One frame in flight; times are true time in whole ticks."""

    sender: int
    """Node that sends."""
    boot: int
    """Number of times the sender had been switched off, so that a frame from before is not sent."""
    frame: bytes
    marker_local_ticks: int
    """Sender's unwrapped counter when the RMARKER leaves, without noise and delay error."""
    begin_ticks: int
    """Start of the preamble."""
    marker_ticks: int
    end_ticks: int
    emission_ticks: int = 0
    emission_fraction: float = 0.0
    """With ``emission_ticks``: the RMARKER's true emission."""


class OnAir:
    """The frames that are, recently were or soon will be on the air."""

    def __init__(self) -> None:
        self._flights: deque[Flight] = deque()

    def add(self, flight: Flight, now_ticks: int) -> None:
        """Add a frame, and remove those that ended long ago."""
        while self._flights and self._flights[0].end_ticks < now_ticks - _KEPT_TICKS:
            self._flights.popleft()
        self._flights.append(flight)

    def withdraw(self, flight: Flight) -> None:
        """Remove a frame that will not be sent."""
        self._flights.remove(flight)

    def between(self, from_ticks: int, until_ticks: int) -> list[Flight]:
        """Frames whose RMARKER leaves after one time and before another."""
        return [flight for flight in self._flights if from_ticks < flight.marker_ticks < until_ticks]

    def others(self, flight: Flight) -> list[Other]:
        """Frames that may overlap this one."""
        first, last = flight.begin_ticks - _FARTHEST_TICKS, flight.end_ticks + _FARTHEST_TICKS
        return [
            Other(
                sender=other.sender,
                begin_s=(other.begin_ticks - flight.marker_ticks) * TICK_S,
                end_s=(other.end_ticks - flight.marker_ticks) * TICK_S,
            )
            for other in self._flights
            if other is not flight and other.begin_ticks <= last and other.end_ticks >= first
        ]


class Tally(Struct, frozen=True):
    """Counts of a world so far."""

    transmissions: int
    late_transmissions: int
    """Frames not sent because they came too late."""
    at_anchors: dict[str, int]
    """Frames at anchors that were on, by ``Outcome``."""
    at_tags: dict[str, int]


@dataclass(slots=True, eq=False)
class Delivery:
    """A frame that has just ended, with the rows (``Row``) of the nodes that received it."""

    flight: Flight
    by_anchors: Records
    by_tags: Records


class Medium(Generic[Result]):
    """A site's air, deterministic given the seed; memory use does not grow with time.

    Nodes are numbered: the site's anchors in the order of its file, then the tags; all start off. A node's noise
    depends only on the seed and its own key: more tags do not change what others receive.
    """

    def __init__(
        self,
        site: Site,
        tags: Sequence[TagSpec],
        impairments: Impairments,
        seed: int,
        deliver: Callable[[Delivery], Result | None],
        turnaround_s: float = TURNAROUND_S,
    ) -> None:
        """``deliver`` is called with every frame at its end; ``run`` yields its results.

        ``turnaround_s``: how long before its preamble a frame must be passed in (firmware/emulator).

        Raises ValueError if an impairment names an anchor that is not the site's.
        """
        self._anchors, self._tags, self._impairments = site.anchors, tuple(tags), impairments
        self.node_of = {anchor.id: node for node, anchor in enumerate(site.anchors)}
        """Nodes of the anchors by identifier."""
        self.stations = make_stations(site.anchors, self._tags, impairments)
        self._piece_ends_s = np.full(len(self._tags), -math.inf)
        self._nodes = len(site.anchors) + len(self._tags)
        self.boots = [0] * self._nodes
        """Number of times each node was switched off."""
        self._counts = np.zeros(2 * len(OUTCOMES), dtype=np.int64)
        self._transmissions = self._late = 0
        self._deliver = deliver
        self.timeline: Timeline[Result] = Timeline()
        self._least_ahead_ticks = _PREAMBLE_TICKS + from_seconds(turnaround_s)
        _check_names(impairments, self.node_of)
        keys = [(ANCHOR_KEY, anchor.id) for anchor in site.anchors] + [(TAG_KEY, tag) for tag in range(len(tags))]
        self._setups = [stream(seed, *key, purpose=1) for key in keys]
        self._streams = Streams([stream(seed, *key) for key in keys])
        self.clocks = make_clocks(impairments.oscillator, self._setups)
        every_tag = range(len(self._anchors), self._nodes)
        for one in self._impairments.warm_ups:
            for node in every_tag if one.anchor is None else (self.node_of[one.anchor],):
                warm_up(self.clocks[node], one.ppm, one.start_s, one.tau_s)
        self.range_errors = RangeErrors(impairments.range_errors, len(tags), len(site.anchors), seed)
        for error in impairments.anchor_pair_errors:
            a, b = self.node_of[error.a], self.node_of[error.b]
            self.range_errors.present_m[[a, b], [b, a]] += math.inf if error.blocked else error.late_m
        self._carriers: Carriers | None = None
        if impairments.carrier is not None:
            identifiers = [anchor.id for anchor in site.anchors]
            self._carriers = Carriers(impairments.carrier, identifiers, len(self._tags), seed)
        self._plan_changes()
        self._barriers = barriers_of(site.walls, site.storeys)
        self._power_biases_m = POWER_BIAS_M if impairments.channel.power_bias else np.zeros_like(POWER_BIAS_M)
        self._air = OnAir()
        self._missed_ticks = 0
        """Frames due before this are not sent."""
        self._frame = OneFrame(
            anchors=len(site.anchors),
            nodes=self._nodes,
            barriers=self._barriers.length,
            is_diagnosed=impairments.diagnostics,
            slope_m=impairments.range_errors.slope_m,
        )
        self._heard = (Row * self._nodes)()
        self._received: Records = view(self._heard)

    @property
    def tally(self) -> Tally:
        """Counts of what was sent, heard and lost so far, by reason."""
        names = [str(outcome) for outcome in OUTCOMES]
        at_anchors, at_tags = (dict(zip(names, row, strict=True)) for row in self._counts.reshape(2, -1).tolist())
        return Tally(self._transmissions, self._late, at_anchors, at_tags)

    @property
    def now_s(self) -> float:
        """The present true time."""
        return self.timeline.now_ticks * TICK_S

    def run(self, until_s: float) -> Iterator[Result]:
        """Advance true time to ``until_s``. Can be called repeatedly."""
        return self.timeline.run(from_seconds(until_s))

    def switch_off(self, node: int) -> None:
        """Switch a node off; its frame is not sent if the RMARKER has not left."""
        self.stations[node].is_on = False
        self.boots[node] += 1

    def switch_on(self, node: int) -> None:
        """Switch a node on, with a new counter except at time 0."""
        self.stations[node].is_on = True
        if self.timeline.now_ticks > 0:
            restart_counter(self.clocks[node], self._setups[node])
            if self._carriers is not None:
                self._carriers.restart(node)

    # Clocks

    def read_counter(self, node: int) -> int:
        """Advance a node to the present and return its unwrapped counter."""
        clock, noise = self.clocks[node], self._streams.noise[node]
        _advance(clock, noise, self.timeline.now_ticks, 0.0)
        self._streams.refill(noise.used)
        return clock.local_ticks

    def foresee(self, node: int, local_ticks: int) -> int:
        """True time in whole ticks at which a node's unwrapped counter will show a value."""
        return _foresee(self.clocks[node], local_ticks)

    # Anchors

    def _plan_changes(self) -> None:
        """Plan the displacements and errors of delays that begin later."""
        for shift in self._impairments.anchor_displacements:
            if shift.from_s > 0.0:
                node = self.node_of[shift.anchor]
                happen = partial(displace, self.stations[node], self._anchors[node], shift)
                self.timeline.at(from_seconds(shift.from_s), happen)
        for error in self._impairments.delay_errors:
            if error.from_s > 0.0:
                happen = partial(set_delays, self.stations[self.node_of[error.anchor]], error)
                self.timeline.at(from_seconds(error.from_s), happen)

    # Transmissions

    def transmit(self, node: int, transmission: Transmission) -> bool:
        """Plan the flight of a frame. Returns False, and counts it, if it comes too late."""
        local_ticks = self.read_counter(node)
        delay_ticks = self._anchors[node].tx_antenna_delay_ticks
        leaves = wrap(((transmission.tx_ticks - delay_ticks) & _DX_MASK) + delay_ticks)
        ahead = difference(leaves, wrap(local_ticks))
        if ahead < self._least_ahead_ticks:
            self._late += 1
            return False
        marker = self.foresee(node, local_ticks + ahead)
        end = marker + from_seconds(after_rmarker_s(len(transmission.frame)))
        begin = marker - _PREAMBLE_TICKS
        flight = Flight(node, self.boots[node], transmission.frame, local_ticks + ahead, begin, marker, end)
        self._air.add(flight, self.timeline.now_ticks)
        self.timeline.at(marker, partial(self._radiate, flight))
        return True

    def miss(self, until_s: float) -> tuple[int, ...]:
        """Withdraw all frames whose RMARKER would leave before ``until_s``, because the caller was too slow.

        Returns their senders.
        """
        self._missed_ticks = from_seconds(until_s)
        missed = self._air.between(self.timeline.now_ticks, self._missed_ticks)
        return tuple(flight.sender for flight in missed if flight.boot == self.boots[flight.sender])

    def _radiate(self, flight: Flight) -> None:
        """Emit the RMARKER, and stamp the frame at every node that can receive it."""
        node, streams = flight.sender, self._streams
        if flight.marker_ticks < self._missed_ticks or flight.boot != self.boots[node]:
            self._air.withdraw(flight)
            return
        local_ticks, station, clock = flight.marker_local_ticks, self.stations[node], self.clocks[node]
        noise = streams.noise[node]
        fraction = _emit(clock, noise, local_ticks, station.tx_noise_ticks, station.tx_error_ticks)
        streams.refill(noise.used)
        carry = math.floor(fraction)
        ticks, fraction = clock.true_ticks + carry, fraction - carry
        flight.emission_ticks, flight.emission_fraction = ticks, fraction
        t_s = ticks * TICK_S
        self._move_tags(t_s)
        self.range_errors.advance_to(t_s, view(self.stations))
        others, f = self._air.others(flight), self._frame
        f.sender, f.ticks, f.fraction, f.bias_m, f.others = node, ticks, fraction, self._bias_m(node, t_s), len(others)
        f.begin_s = (flight.begin_ticks - flight.marker_ticks) * TICK_S
        f.end_s = (flight.end_ticks - flight.marker_ticks) * TICK_S
        _receive_frame(
            f,
            self.clocks,
            streams.noise,
            self.stations,
            self._impairments.channel,
            self._power_biases_m,
            self._barriers.array,
            (Other * len(others))(*others),
            self.range_errors.present_m.reshape(-1),
            self._heard,
            self._counts,
        )
        streams.refill(f.most_used)
        anchors, count = f.heard_by_anchors, f.heard
        if self._carriers is not None:
            heard = self._received[:count]
            late_ticks = (ticks - clock.true_ticks) + (fraction - clock.true_fraction)
            self._carriers.advance_to(t_s, view(self.stations))
            heard["phase_cycles"] = self._carriers.phases_cycles(node, local_ticks, late_ticks, heard)
        self._transmissions += 1
        delivery = Delivery(flight, self._received[:anchors].copy(), self._received[anchors:count].copy())
        self.timeline.at(flight.end_ticks, partial(self._deliver, delivery))

    def _move_tags(self, t_s: float) -> None:
        """Set the next piece of every trajectory whose present one has ended."""
        for tag in np.flatnonzero(self._piece_ends_s <= t_s).tolist():
            piece = self._tags[tag].trajectory.piece(t_s)
            set_piece(self.stations[len(self._anchors) + tag], piece)
            self._piece_ends_s[tag] = piece.end_s

    def _bias_m(self, node: int, t_s: float) -> float:
        anchor = self._anchors[node].id
        return sum((b.active_m(t_s) for b in self._impairments.anchor_biases if b.anchor == anchor), 0.0)


def _check_names(faults: Impairments, node_of: dict[int, int]) -> None:
    named: dict[str, list[int | None]] = {
        "anchor_biases": [one.anchor for one in faults.anchor_biases],
        "delay_errors": [one.anchor for one in faults.delay_errors],
        "anchor_outages": [one.anchor for one in faults.anchor_outages],
        "anchor_displacements": [one.anchor for one in faults.anchor_displacements],
        "warm_ups": [one.anchor for one in faults.warm_ups],
        "anchor_pair_errors": [end for one in faults.anchor_pair_errors for end in (one.a, one.b)],
    }
    for name, anchors in named.items():
        unknown = {anchor for anchor in anchors if anchor is not None} - node_of.keys()
        if unknown:
            known = ", ".join(map(str, node_of))
            raise ValueError(f"{name} names anchor {min(unknown)}; it should be one of the site's: {known}")
