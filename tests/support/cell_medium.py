"""``CellMedium``: the air of up to a few hundred real machines, by the rules of several cells.

It gives bit for bit what the kernels of ``skyless.sim.cells.world`` compute for the same frames. All noise is keyed,
clocks are functions of true time, and one set of functions decides receptions.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar
from unittest.mock import patch

import numpy as np

from skyless.core.air.frame import Transmission, after_rmarker_s
from skyless.core.arrays import Array, Integers, Records
from skyless.core.site import Site
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_M, TICK_S, WRAP_TICKS, difference, from_seconds, wrap
from skyless.sim.cells.reception import (
    KNOT_TICKS,
    PREAMBLE_TICKS,
    RECEIVED,
    START,
    TAG_NODES,
    CellClocks,
    Frames,
    Knots,
    Rules,
    delivery_chance,
    disturb,
    emission,
    key_of,
    luck,
    own_time,
    pair_key,
    purpose_key,
    rules_of,
    rx_stamp,
    squared_m2,
    true_time,
    uniform,
)
from skyless.sim.impairments import Impairments
from skyless.sim.listening import RECEPTION_RECORD, TagSpec, coordinate_m
from skyless.sim.medium import TURNAROUND_S, Delivery, Flight, Medium
from skyless.sim.world import World
from skyless.site.kernels import kernel

_TURNAROUND_TICKS: Final = from_seconds(TURNAROUND_S)
_KEPT_TICKS: Final = from_seconds(2e-3)
_DX_MASK: Final = ~(DELAYED_TX_GRANULARITY_TICKS - 1)

Result = TypeVar("Result")


@kernel
def receive_in_cells(
    rules: Rules,
    knots: Knots,
    frames: Frames,
    stations: Records,
    positions_m: Array,
    keys: Integers,
    wanted: int,
    number: int,
    rows: Records,
    tally: Integers,
) -> tuple[int, int]:
    """Let every node that is on receive the frame ``wanted`` of those on the air, or lose it.

    ``number`` counts the sender's frames, ``positions_m`` has shape (anchors, 3). Fills ``rows``
    (``RECEPTION_RECORD``), counts into ``tally``, shape (2, outcomes); returns how many anchors and how many nodes
    received it.
    """
    sender, ticks, fraction = frames.sender[wanted], frames.ticks[wanted], frames.fraction[wanted]
    t_s = (ticks + fraction) * TICK_S
    anchors, count = 0, 0
    for node in range(stations.shape[0]):
        if node == sender or stations[node]["on"] == 0:
            continue
        x_m = coordinate_m(stations, node, 0, t_s)
        y_m = coordinate_m(stations, node, 1, t_s)
        z_m = coordinate_m(stations, node, 2, t_s)
        square_m2 = squared_m2(positions_m, sender, x_m, y_m, z_m)
        pair = pair_key(rules, keys[node], keys[sender])
        outcome = luck(rules, delivery_chance(rules, square_m2), pair, keys[node], keys[sender], number)
        if outcome == RECEIVED:
            listener = node if stations[node]["is_tag"] == 0 else -1
            outcome, early_ticks = disturb(
                rules,
                frames,
                0,
                frames.sender.shape[0],
                positions_m,
                listener,
                (x_m, y_m, z_m),
                (sender, ticks, fraction, frames.after_ticks[wanted], square_m2),
                (RECEIVED, 0.0),
            )
            if outcome == RECEIVED:
                arrival_ticks = fraction + np.sqrt(square_m2) / TICK_M - early_ticks
                row = rows[count]
                row["node"] = node
                row["position_m"][0], row["position_m"][1], row["position_m"][2] = x_m, y_m, z_m
                row["rx_ticks"] = rx_stamp(rules, knots, node, (keys[node], keys[sender], number), ticks, arrival_ticks)
                count += 1
                anchors += 1 - stations[node]["is_tag"]
        tally[stations[node]["is_tag"], outcome] += 1
    return anchors, count


@dataclass(slots=True, eq=False)
class NumberedFlight(Flight):
    """A frame on its way, with the number of its sender's frames before it."""

    number: int = 0
    after_ticks: int = 0
    """Length after its RMARKER."""


class CellMedium(Medium[Result]):
    """A site's air by the rules of several cells. Only noise, losses, outages and displacements are modelled."""

    def __init__(
        self,
        site: Site,
        tags: Sequence[TagSpec],
        impairments: Impairments,
        seed: int,
        deliver: Callable[[Delivery], Result | None],
    ) -> None:
        super().__init__(site, tags, impairments, seed, deliver)
        keys = [*self.node_of, *(TAG_NODES + tag for tag in range(len(tags)))]
        self._keys = np.array(keys, dtype=np.int64)
        self._start_key = np.uint64(purpose_key(seed, START))
        self._rules = rules_of(impairments.channel, impairments.tx_stamp_ps, impairments.rx_stamp_ps, seed)
        self._clocks = CellClocks(impairments.oscillator, self._keys, seed)
        self._positions_m = self.stations["position_m"][: len(site.anchors)].copy()
        self._numbers = [0] * len(keys)
        self._on_air: deque[NumberedFlight] = deque()
        self._rows = np.zeros(len(keys), dtype=RECEPTION_RECORD)

    def _restart_counter(self, node: int) -> None:
        key = np.uint64(key_of(self._start_key, int(self._keys[node]), self.boots[node], 3))
        self._clocks.shift(node, int(uniform(key) * WRAP_TICKS))

    def read_counter(self, node: int) -> int:
        """A node's unwrapped counter at present."""
        return int(own_time(self._knots(0), node, self.timeline.now_ticks, 0.0)[0])

    def foresee(self, node: int, local_ticks: int) -> int:
        """True time in whole ticks at which a node's unwrapped counter will show a value."""
        return int(true_time(self._knots(local_ticks - self.read_counter(node)), node, local_ticks)[0])

    def transmit(self, node: int, transmission: Transmission) -> bool:
        """Plan the flight of a frame; False, and a count, if it comes too late."""
        local_ticks = self.read_counter(node)
        delay_ticks = self._anchors[node].tx_antenna_delay_ticks
        leaves = wrap(((transmission.tx_ticks - delay_ticks) & _DX_MASK) + delay_ticks)
        ahead = difference(leaves, wrap(local_ticks))
        if ahead < PREAMBLE_TICKS + _TURNAROUND_TICKS:
            self._late += 1
            return False
        number = self._numbers[node]
        self._numbers[node] += 1
        instant = true_time(self._knots(ahead), node, local_ticks + ahead)
        ticks, fraction = emission(self._rules, int(self._keys[node]), number, *instant)
        after = from_seconds(after_rmarker_s(len(transmission.frame)))
        flight = NumberedFlight(
            node,
            self.boots[node],
            transmission.frame,
            local_ticks + ahead,
            ticks - PREAMBLE_TICKS,
            ticks,
            ticks + after,
            ticks,
            fraction,
            number,
            after,
        )
        while self._on_air and self._on_air[0].end_ticks < self.timeline.now_ticks - _KEPT_TICKS:
            self._on_air.popleft()
        self._on_air.append(flight)
        self.timeline.at(ticks, partial(self._radiate, flight))
        return True

    def _knots(self, ahead_ticks: int) -> Knots:
        """Clocks from a little before the present to a node's counter that much later."""
        now = self.timeline.now_ticks
        return self._clocks.cover(now - KNOT_TICKS, now + max(ahead_ticks, 0) + KNOT_TICKS)

    def _radiate(self, flight: NumberedFlight) -> None:
        """Let the RMARKER leave, and every node that can receive the frame stamp it."""
        if flight.boot != self.boots[flight.sender]:
            self._on_air.remove(flight)
            return
        self._move_tags((flight.emission_ticks + flight.emission_fraction) * TICK_S)
        frames = Frames(
            np.array([one.sender for one in self._on_air]),
            np.array([one.emission_ticks for one in self._on_air]),
            np.array([one.emission_fraction for one in self._on_air]),
            np.array([float(one.after_ticks) for one in self._on_air]),
        )
        anchors, count = receive_in_cells(
            self._rules,
            self._knots(0),
            frames,
            self.stations,
            self._positions_m,
            self._keys,
            self._on_air.index(flight),
            flight.number,
            self._rows,
            self._counts,
        )
        self._transmissions += 1
        delivery = Delivery(flight, self._rows[:anchors].copy(), self._rows[anchors:count].copy())
        self.timeline.at(flight.end_ticks, partial(self._deliver, delivery))


def cell_world(*arguments, **options) -> World:
    """A ``World`` whose air is a ``CellMedium``."""
    with patch("skyless.sim.world.Medium", CellMedium):
        return World(*arguments, **options)
