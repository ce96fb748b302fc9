"""How many beacons a board loses while it computes, with one receive buffer of the DW1000 and with both.

python benchmarks/receive_buffers.py

The driver in C on the register model, at the SPI's and processor's speed of a DWM1001. Anchors send at the random
instants of protocol 2; of frames that overlap, a receiver gets the first, unless a stronger one follows. The board
computes for so long after each reading, without a look at the chip or with one every 0.25 ms; up to 16 frames wait in
RAM.
"""

import random
from collections.abc import Iterator

from skyless.core.air.almanac import gap_ticks, period_code
from skyless.core.air.frame import Diagnostics, after_rmarker_s, air_time_s, fcs, preamble_s
from skyless.core.ticks import TICK_S, from_seconds, wrap
from skyless.radio.dw1000 import driver
from skyless.sim.dw1000.chip import Chip

FRAME = bytes(125) + fcs(bytes(125))
TRANSFER_S = 10e-6
"""Of the processor for each transfer, so that a reception takes the 0.29 ms of docs/hardware.md in all."""
REPORT_S = 50e-6
LOOK_S = 2e-6
SECONDS = 20.0
QUEUE = 16


def receivable(rate_hz: float, anchors: int, seed: int) -> Iterator[tuple[float, bool]]:
    """RMARKER of each frame that a receiver which is on would begin to receive, and whether it would be good."""
    chance, sent = random.Random(seed), []
    code = period_code(anchors / rate_hz)
    for anchor in range(anchors):
        at_s, power, sequence = chance.random() * anchors / rate_hz, chance.random(), chance.randrange(256)
        while at_s < SECONDS:
            sent.append((at_s, power))
            at_s += gap_ticks(anchor, sequence, code) * TICK_S
            sequence += 1
    sent.sort()
    until_s = 0.0
    for number, (at_s, power) in enumerate(sent):
        if at_s >= until_s:
            until_s = at_s + air_time_s(len(FRAME))
            others = sent[number + 1 : number + 4]
            yield at_s + preamble_s(), not any(other_s < until_s and other > power for other_s, other in others)


class Board:
    """Chip, driver and processor in one time."""

    def __init__(self, frames: Iterator[tuple[float, bool]], uses_both_buffers: bool) -> None:
        self.now_s, self._frames, self.offered = 0.0, frames, 0
        self._next = next(frames)
        self.chip = Chip(self, 0, 0, lambda: self.now_s)
        self.driver = driver.DW1000(self)
        self.driver.uses_both_buffers = uses_both_buffers
        self.driver.start(0, 0)
        self.driver.receive()

    def now_ticks(self) -> int:
        return wrap(from_seconds(self.now_s))

    def transmit(self, _frame: bytes, _leaves_ticks: int) -> bool:
        return False

    def withdraw(self) -> None:
        pass

    def spend(self, seconds: float) -> None:
        """Let time pass, in which frames end."""
        until_s = self.now_s + seconds
        while self._next[0] + after_rmarker_s(len(FRAME)) <= until_s:
            marker_s, is_good = self._next
            self.now_s = max(self.now_s, marker_s + after_rmarker_s(len(FRAME)))
            fault = None if is_good else "parity"
            self.chip.receive(FRAME, wrap(from_seconds(marker_s)), Diagnostics(), fault)
            self.offered += is_good
            self._next = next(self._frames, (1e9, False))
        self.now_s = until_s

    def transfer(self, out: bytes) -> bytes:
        self.spend(TRANSFER_S + len(out) / self._octets_per_s)
        return self.chip.transfer(out, round(8 * self._octets_per_s))

    def set_spi_fast(self, fast: bool) -> None:
        self._octets_per_s = 1e6 if fast else 0.25e6

    def reset_chip(self) -> None:
        self.chip.pull_reset()

    def pause_us(self, microseconds: int) -> None:
        self.spend(1e-6 * microseconds)


def lost_share(rate_hz: float, anchors: int, computing_s: float, look_every_s: float, both: bool) -> float:
    """Share of the good frames that the board never computes with."""
    board, used, waiting, left_s = Board(receivable(rate_hz, anchors, 1), both), 0, 0, 0.0
    while board.now_s < SECONDS:
        if board.chip.irq and (left_s <= 0.0 or look_every_s < computing_s):
            if board.driver.poll() & driver.RECEIVED:
                board.spend(REPORT_S)
                waiting = min(waiting + 1, QUEUE)
        elif left_s <= 0.0 and waiting:
            waiting, used, left_s = waiting - 1, used + 1, computing_s
        else:
            step_s = min(left_s, look_every_s) if left_s > 0.0 else 20e-6
            board.spend(step_s + (LOOK_S if left_s > 0.0 else 0.0))
            left_s -= step_s
    return 1.0 - used / board.offered


def main() -> None:
    """Print the table of docs/dw1000.md."""
    print("| beacons/s, anchors | computing | one buffer | both | one, a look every 0.25 ms | both, a look |")
    print("|---|---|---|---|---|---|")
    for rate_hz, anchors in ((100.0, 6), (400.0, 6), (476.0, 12)):
        for computing_s in (1.5e-3, 2.0e-3, 2.3e-3):
            shares = [
                lost_share(rate_hz, anchors, computing_s, look_s, both)
                for look_s in (1.0, 0.25e-3)
                for both in (False, True)
            ]
            row = " | ".join(f"{100 * share:.1f} %" for share in shares)
            print(f"| {rate_hz:.0f}, {anchors} | {1e3 * computing_s:.1f} ms | {row} |")


if __name__ == "__main__":
    main()
