"""The world: anchors' machines on emulated radios, tags that listen, and true time that passes.

Three events make a transmission: its frame is fetched (the lead time before its RMARKER), the RMARKER leaves, and
the frame ends, when the listeners get it. The emulated radio takes the low nine bits off DX = TX stamp -
configured antenna delay, as the DW1000 does, so a machine that ignores the granularity sends with a wrong stamp.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.air.airtime import after_rmarker_s, preamble_s
from skyless.air.reception import Reception
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_S
from skyless.simulation.broadcast import Broadcast, Tally, diagnostics_of, make_tally
from skyless.simulation.channel import pack_channel, pack_walls
from skyless.simulation.ether import OUTCOMES, Flight, OnAir
from skyless.simulation.impairments import Impairments
from skyless.simulation.listening import RECEIVED, hear
from skyless.simulation.machines import AnchorFactory, AnchorMachine
from skyless.simulation.oscillator import advance, emit, foresee, make_clocks, restart_counter
from skyless.simulation.stations import TagSpec, make_stations, set_piece
from skyless.simulation.streams import ANCHOR_KEY, TAG_KEY, Streams, stream
from skyless.simulation.timeline import Timeline
from skyless.site.model import Site
from skyless.ticks import difference, from_seconds, wrap

TURNAROUND_S: Final = 0.2e-3
"""What a host needs to hand a frame to its radio; a preamble that should begin earlier is too late (HPDWARN).

Longer than any frame after its RMARKER (177 µs), so that all that overlap it are known when the RMARKER leaves.
"""

_TURNAROUND_TICKS: Final = from_seconds(TURNAROUND_S)
_RETRY_TICKS: Final = from_seconds(5e-3)
_PREAMBLE_TICKS: Final = from_seconds(preamble_s())
_DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)


class World:
    """A site on the air, deterministic by its seed; memory stays flat however long it runs.

    An anchor's noise depends on the seed and on the anchors alone, a tag's also on its own index: more tags do not
    change what the others hear.
    """

    def __init__(
        self,
        site: Site,
        anchor_factory: AnchorFactory,
        tags: Sequence[TagSpec],
        impairments: Impairments,
        seed: int,
        *,
        lead_s: float = 1e-3,
        on_tag_restart: Callable[[int], None] | None = None,
    ) -> None:
        """``lead_s``: how long before its RMARKER a frame is fetched; ``on_tag_restart`` is given a tag's index.

        Raises ValueError when an impairment names an anchor that the site has not.
        """
        self._anchors, self._tags, self._impairments = site.anchors, tuple(tags), impairments
        self._factory, self._on_tag_restart = anchor_factory, on_tag_restart
        self._node_of = {anchor.id: node for node, anchor in enumerate(site.anchors)}
        self._check_names()
        keys = [(ANCHOR_KEY, anchor.id) for anchor in site.anchors] + [(TAG_KEY, tag) for tag in range(len(tags))]
        self._setups = [stream(seed, *key, purpose=1) for key in keys]
        self._streams = Streams([stream(seed, *key) for key in keys])
        self._clocks = make_clocks(impairments.oscillator, self._setups)
        self._stations = make_stations(site.anchors, self._tags, impairments)
        self._channel, self._walls = pack_channel(impairments.channel), pack_walls(site.walls)
        self._piece_ends_s = np.full(len(self._tags), -math.inf)
        self._lead_ticks = from_seconds(lead_s)
        self._machines: list[AnchorMachine | None] = [None] * len(keys)
        self._boots = [0] * len(keys)
        self._reasons_off = [1] * len(keys)
        self._air = OnAir()
        self._heard = np.zeros(len(keys), dtype=RECEIVED)
        self._counts = np.zeros((2, len(OUTCOMES)), dtype=np.int64)
        self._transmissions = self._late = 0
        self._timeline: Timeline[Broadcast] = Timeline()
        self._plan_power()

    @property
    def tally(self) -> Tally:
        """What was sent, heard and lost so far, by reason."""
        return make_tally(self._transmissions, self._late, self._counts)

    @property
    def now_s(self) -> float:
        """True time that has passed."""
        return self._timeline.now_ticks * TICK_S

    def run(self, until_s: float) -> Iterator[Broadcast]:
        """Let true time pass up to ``until_s``; every frame is told when it ended, in order. Can be called again."""
        return self._timeline.run(from_seconds(until_s))

    def _check_names(self) -> None:
        faults = self._impairments
        for name, values in (
            ("anchor_biases", faults.anchor_biases),
            ("delay_errors", faults.delay_errors),
            ("anchor_outages", faults.anchor_outages),
        ):
            unknown = {value.anchor for value in values} - self._node_of.keys()
            if unknown:
                known = ", ".join(map(str, self._node_of))
                raise ValueError(f"{name} names anchor {min(unknown)}; it should be one of the site's: {known}")

    # Power

    def _plan_power(self) -> None:
        outages = [(self._node_of[planned.anchor], planned.outage) for planned in self._impairments.anchor_outages]
        for index, tag in enumerate(self._tags):
            outages += [(len(self._anchors) + index, outage) for outage in tag.outages]
        for node, outage in outages:
            self._timeline.at(from_seconds(outage.off_s), partial(self._switch_off, node))
            if math.isfinite(outage.on_s):
                self._timeline.at(from_seconds(outage.on_s), partial(self._switch_on, node))
        for node in range(len(self._boots)):
            self._timeline.at(0, partial(self._switch_on, node))

    def _switch_off(self, node: int) -> None:
        self._reasons_off[node] += 1
        self._stations[node]["on"] = 0
        self._machines[node] = None
        self._boots[node] += 1

    def _switch_on(self, node: int) -> None:
        """Start a node, with a new counter and a new machine if it ran before."""
        self._reasons_off[node] -= 1
        if self._reasons_off[node] > 0:
            return
        tag = node - len(self._anchors)
        self._stations[node]["on"] = 1
        if self._timeline.now_ticks > 0:
            restart_counter(self._clocks, node, self._setups[node])
            if tag >= 0 and self._on_tag_restart is not None:
                self._on_tag_restart(tag)
        if tag < 0:
            self._machines[node] = self._factory(self._anchors[node].id)
            self._timeline.at(self._timeline.now_ticks, partial(self._ask, node, self._boots[node]))

    # Transmissions

    def _ask(self, node: int, boot: int) -> None:
        """Ask an anchor's machine when it wants to send next."""
        machine = self._machines[node]
        if machine is None or boot != self._boots[node]:
            return
        local_ticks = self._read_counter(node)
        tx_ticks = machine.next_transmission_ticks(wrap(local_ticks))
        if tx_ticks is None:
            self._timeline.at(self._timeline.now_ticks + _RETRY_TICKS, partial(self._ask, node, boot))
            return
        ahead = difference(tx_ticks, wrap(local_ticks))
        fetch_ticks = foresee(self._clocks, node, local_ticks + ahead - self._lead_ticks)
        self._timeline.at(fetch_ticks, partial(self._fetch, node, boot, tx_ticks))

    def _fetch(self, node: int, boot: int, tx_ticks: int) -> None:
        """Fetch a frame from its machine and plan its flight, unless it is too late."""
        machine = self._machines[node]
        if machine is None or boot != self._boots[node]:
            return
        transmission = machine.transmission(tx_ticks)
        local_ticks = self._read_counter(node)
        delay_ticks = self._anchors[node].tx_antenna_delay_ticks
        leaves = wrap(((transmission.tx_ticks - delay_ticks) & _DX_MASK) + delay_ticks)
        ahead = difference(leaves, wrap(local_ticks))
        if ahead < _PREAMBLE_TICKS + _TURNAROUND_TICKS:
            self._late += 1
            self._timeline.at(self._timeline.now_ticks + _RETRY_TICKS, partial(self._ask, node, boot))
            return
        marker = foresee(self._clocks, node, local_ticks + ahead)
        end = marker + from_seconds(after_rmarker_s(len(transmission.frame)))
        begin = marker - _PREAMBLE_TICKS
        flight = Flight(node, boot, transmission.frame, local_ticks + ahead, begin, marker, end)
        self._air.add(flight, self._timeline.now_ticks)
        self._timeline.at(marker, partial(self._radiate, flight))

    def _radiate(self, flight: Flight) -> None:
        """Let the RMARKER leave, and every node that can hear the frame stamp it."""
        node, streams = flight.sender, self._streams
        if flight.boot != self._boots[node]:
            self._air.withdraw(flight)
            return
        normals, cursors = streams.normals, streams.cursors
        local_ticks, noise_ticks = flight.marker_local_ticks, float(self._stations[node]["tx_noise_ticks"])
        error_ticks = float(self._stations[node]["tx_error_ticks"])
        ticks, fraction = emit(self._clocks, normals, cursors, node, local_ticks, noise_ticks, error_ticks)
        streams.refill(int(cursors[node]))
        flight.emission_ticks, flight.emission_fraction = ticks, fraction
        t_s = ticks * TICK_S
        self._move_tags(t_s)
        anchors, count, highest = hear(
            self._clocks,
            normals,
            cursors,
            self._stations,
            self._channel,
            self._walls,
            self._air.others(flight),
            node,
            ticks,
            fraction,
            ((flight.begin_ticks - flight.marker_ticks) * TICK_S, (flight.end_ticks - flight.marker_ticks) * TICK_S),
            self._bias_m(node, t_s),
            self._impairments.diagnostics,
            self._heard,
            self._counts,
        )
        streams.refill(highest)
        self._transmissions += 1
        by_anchors, by_tags = self._heard[:anchors].copy(), self._heard[anchors:count].copy()
        self._timeline.at(flight.end_ticks, partial(self._deliver, flight, by_anchors, by_tags))

    def _deliver(self, flight: Flight, by_anchors: NDArray[np.void], by_tags: NDArray[np.void]) -> Broadcast:
        """Hand the frame to the anchors that heard it, and tell of the tags that did."""
        end_s, diagnostics = self.now_s, self._impairments.diagnostics
        rows = zip(by_anchors, by_anchors["node"].tolist(), by_anchors["rx_ticks"].tolist(), strict=True)
        for row, node, rx_ticks in rows:
            machine = self._machines[node]
            if machine is not None:
                measured = diagnostics_of(row) if diagnostics else None
                machine.hear(Reception(flight.frame, rx_ticks, end_s, measured))
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
            by_tags["velocity_mps"],
            tuple(diagnostics_of(row) for row in by_tags) if diagnostics else None,
        )

    # Nodes

    def _read_counter(self, node: int) -> int:
        """Bring a node to the present and return its unwrapped counter."""
        cursors = self._streams.cursors
        advance(self._clocks, self._streams.normals, cursors, node, self._timeline.now_ticks, 0.0)
        self._streams.refill(int(cursors[node]))
        return int(self._clocks[node]["local_ticks"])

    def _move_tags(self, t_s: float) -> None:
        """Take the next piece of every trajectory whose present one has ended."""
        for tag in np.flatnonzero(self._piece_ends_s <= t_s).tolist():
            piece = self._tags[tag].trajectory.piece(t_s)
            set_piece(self._stations, len(self._anchors) + tag, piece)
            self._piece_ends_s[tag] = piece.end_s

    def _bias_m(self, node: int, t_s: float) -> float:
        anchor = self._anchors[node].id
        return sum((b.active_m(t_s) for b in self._impairments.anchor_biases if b.anchor == anchor), 0.0)
