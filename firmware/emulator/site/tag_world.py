"""Boards that are tags by themselves, in a simulated world: nothing is at their serial ports but what listens.

The anchors are their machines as they run on hosts, without boards.
"""

import random
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from emulator.site.emulated_site import Board, MakeBoard
from emulator.site.site_air import NodeAir
from skyless.core.air.reception import Diagnostics
from skyless.core.arrays import Array
from skyless.core.ticks import from_seconds
from skyless.radio.interface import AntennaDelays
from skyless.radio.serial.board_settings import BoardSettings
from skyless.radio.serial.link import Writer
from skyless.sim.dw1000.chip import Chip
from skyless.sim.world import Broadcast, World

DELAYS: Final = AntennaDelays()
_STARTED_S: Final = 10e-3
"""A board listens to its serial port by then."""


class TagBoard:
    """A board, its chip, and where it was at the newest beacon that reached it."""

    def __init__(self, chip: Chip, board: Board) -> None:
        self.chip, self.board = chip, board
        self.truth_m: Array | None = None


class TagWorld:
    """A world whose tags are boards."""

    def __init__(
        self,
        world: World,
        tags: int,
        make_board: MakeBoard,
        said: Callable[[int, float, bytes], None],
        settings: BoardSettings,
        jump_ppm: float = 0.0,
    ) -> None:
        """``said`` is called with tag, true time in s and bytes of its serial port; the boards get these settings.

        ``jump_ppm``: standard deviation by which a chip's crystal has changed each time that it wakes.
        """
        self._world, self._said, self._jump_ppm = world, said, jump_ppm
        first = len(world.medium.boots) - tags
        self.tags = [self._tag(index, first + index, make_board) for index in range(tags)]
        record, timeline = Writer().set_tag_config(settings, keep=True), world.medium.timeline
        for tag in self.tags:
            timeline.at(from_seconds(_STARTED_S), partial(tag.board.receive, record))

    def _tag(self, index: int, node: int, make_board: MakeBoard) -> TagBoard:
        medium = self._world.medium
        air = NodeAir(medium, node)
        chip = Chip(air, DELAYS.tx_ticks, DELAYS.rx_ticks, air.now_s)
        jumps = random.Random(f"crystal {node}")

        def wake() -> None:
            medium.switch_on(node)
            medium.clocks[node]["rate"] += 1e-6 * jumps.gauss(0.0, self._jump_ppm)

        chip.on_wake = wake
        board = make_board(
            medium.timeline,
            chip,
            lambda data: self._said(index, medium.now_s, data),
            can_transmit=False,
            identity=index.to_bytes(8, "little"),
        )
        return TagBoard(chip, board)

    def run(self, until_s: float) -> Iterator[Broadcast]:
        """Let true time pass; each beacon, when it has reached the boards that are in reach."""
        for broadcast in self._world.run(until_s):
            for index, reception, position_m in broadcast.receptions():
                tag = self.tags[index]
                tag.truth_m = position_m
                tag.chip.receive(reception.frame, reception.rx_ticks, reception.diagnostics or Diagnostics())
                tag.board.notify()
            yield broadcast
