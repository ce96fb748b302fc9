"""What each path of the firmware costs on the emulated processor, and how long an interrupt waits at worst.

One board hears frames of 100 bytes, gets commands and sends, alone in an air of its own; the paths are those of
``paths.py``. The table is that of docs/hardware.md.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from emulator.processor.lone_board import DELAYS, LoneBoard
from emulator.processor.paths import BYTE, COMMAND, END_OF_TRANSMISSION, IDLE, POLL, RECEPTION, TRANSMISSION, PathCost
from skyless.core.air.frame import Diagnostics, after_rmarker_s, fcs
from skyless.core.ticks import from_seconds, wrap
from skyless.radio.serial.link import RX_ON, WANTS_PHASES, Writer

FRAME: Final = bytes(range(98)) + fcs(bytes(range(98)))
_LEAD_S: Final = 5e-3
_STEP_S: Final = 4e-6
"""Between the instants at which an interrupt is tried; shorter than any path."""


class _Bench(LoneBoard):
    """A board that has started, and what is done with it."""

    def __init__(self, elf: Path) -> None:
        super().__init__(elf)
        self._writer = Writer()
        self.run(10e-3)

    def start(self, flags: int = 0) -> None:
        """Configure the board, have it receive, and let it measure temperature and supply."""
        self.write(self._writer.config(DELAYS.tx_ticks, DELAYS.rx_ticks, flags))
        self.run(12e-3)
        self.write(self._writer.record(RX_ON))
        self.run(10e-3)

    def ask_for_frame(self, ahead_s: float) -> None:
        """A frame is to leave so long from now."""
        self.write(self._writer.tx_at(wrap(self.now_ticks() + from_seconds(ahead_s)), FRAME))

    def arrive(self) -> None:
        """A frame has just ended."""
        stamp = wrap(self.now_ticks() - from_seconds(after_rmarker_s(len(FRAME))))
        self.chip.receive(FRAME, stamp, Diagnostics(-80.0, -83.0, 1.0), carrier_phase_cycles=0.7)
        self.image.notify()

    def end_transmission(self) -> None:
        """The own frame has left."""
        self.chip.transceiver.finish()
        self.image.notify()

    def costs(self, act: Callable[[], None], seconds: float) -> dict[str, PathCost]:
        """Costs by path while something happens."""
        self.image.forget_paths()
        act()
        self.run(seconds)
        return self.image.paths.costs

    def worst_latency_s(self) -> float:
        """Let receptions end at instants all over a command's reception and a frame's hand-over."""
        worst_s = 0.0
        for step in range(int(1.6e-3 / _STEP_S)):
            self.image.forget_paths()
            self.ask_for_frame(1.5e-3)
            self.run(step * _STEP_S)
            self.arrive()
            self.run(2.2e-3 - step * _STEP_S)
            self.end_transmission()
            self.run(2e-3)
            worst_s = max(worst_s, self.image.worst_latency_s)
        return worst_s


def cycle_table(elf: Path) -> str:
    """Run a board through its paths; the table as Markdown. Raises EmulationError where the image fails."""
    bench = _Bench(elf)
    started = bench.costs(bench.start, 0.0)
    heard = bench.costs(bench.arrive, 3e-3)
    held = bench.costs(lambda: bench.ask_for_frame(_LEAD_S + 2e-3), _LEAD_S + 2.5e-3)
    ended = bench.costs(bench.end_transmission, 2e-3)
    worst_latency_s = bench.worst_latency_s()
    bench.start(WANTS_PHASES)
    with_phase = bench.costs(bench.arrive, 3e-3)
    rows = (
        ("idle: a turn of the loop with nothing to do", held[IDLE]),
        ("reception of 100 bytes, to the UART", heard[RECEPTION]),
        ("reception of 100 bytes with the phase of its carrier", with_phase[RECEPTION]),
        ("a byte of a command", held[BYTE]),
        ("the end of a command with 100 bytes: checked and held", held[f"{COMMAND} + {POLL}"]),
        ("transmission: the frame to the chip", held[TRANSMISSION]),
        ("its end, reported", ended[END_OF_TRANSMISSION]),
        ("temperature and supply, in free slots", started[POLL]),
        ("configuration, with the chip's start", started[f"{COMMAND} + {POLL}"]),
    )
    lines = ["| path | µs at 64 MHz | computing | SPI |", "|---|---|---|---|"]
    for name, cost in rows:
        lines.append(f"| {name} | {cost.most_us:.0f} | {cost.most_us - cost.spi_us:.0f} | {cost.spi_us:.0f} |")
    lines.append(f"| worst case interrupt latency in operation | {1e6 * worst_latency_s:.0f} | | |")
    return "\n".join(lines) + "\n"
