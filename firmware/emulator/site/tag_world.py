"""A board that is a tag by itself, in a simulated world: nothing is at its serial port but what listens.

The anchors are their machines as they run on hosts, without boards.
"""

import random
from collections.abc import Callable
from functools import partial
from typing import Final

from emulator.seat import MakeBoard, Seat
from emulator.site.site_air import NodeAir
from skyless.core.air.frame import Diagnostics
from skyless.core.arrays import Array
from skyless.core.ticks import from_seconds
from skyless.radio.interface import AntennaDelays
from skyless.radio.serial.link import BoardSettings, Writer
from skyless.sim.dw1000.chip import Chip
from skyless.sim.world import World

DELAYS: Final = AntennaDelays()
_STARTED_S: Final = 10e-3
"""A board listens to its serial port by then."""


class TagWorld:
    """A world whose only tag is a board."""

    def __init__(
        self,
        world: World,
        make_board: MakeBoard,
        said: Callable[[float, bytes], None],
        settings: BoardSettings,
        jump_ppm: float,
    ) -> None:
        """``said`` is called with true time in s and bytes of the board's serial port; the board gets these settings.

        ``jump_ppm``: standard deviation by which the chip's crystal has changed each time that it wakes.
        """
        self._world, medium, node = world, world.medium, len(world.medium.boots) - 1
        air, jumps = NodeAir(medium, node), random.Random(f"crystal {node}")
        self.chip = Chip(air, DELAYS.tx_ticks, DELAYS.rx_ticks, air.now_s)
        self.truth_m: Array | None = None
        """Where the tag was at the newest beacon that reached it."""

        def wake() -> None:
            medium.switch_on(node)
            medium.clocks[node].rate += 1e-6 * jumps.gauss(0.0, jump_ppm)

        self.chip.on_wake = wake
        self.board = make_board(Seat(medium.timeline, self.chip, lambda data: said(medium.now_s, data)))
        record = Writer().set_tag_config(settings, keep=True)
        medium.timeline.at(from_seconds(_STARTED_S), partial(self.board.receive, record))

    def run(self, until_s: float) -> None:
        """Let true time pass."""
        for broadcast in self._world.run(until_s):
            for _, reception, position_m in broadcast.receptions():
                self.truth_m = position_m
                self.chip.receive(reception.frame, reception.rx_ticks, reception.diagnostics or Diagnostics())
                self.board.notify()
