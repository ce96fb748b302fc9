"""What each path of the firmware costs on the emulated processor, and how long an interrupt waits at worst.

One board hears frames of 100 bytes, gets commands and sends, alone in an air of its own; the paths are those of
``paths.py``. The table is that of docs/hardware.md.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec import Struct

from emulator.processor.cycles import CPU_HZ
from emulator.processor.lone_board import DELAYS, LoneBoard
from emulator.processor.paths import BYTE, COMMAND, END_OF_TRANSMISSION, IDLE, POLL, RECEPTION, TRANSMISSION, PathCost
from skyless.core.air.ieee802154 import after_rmarker_s, fcs
from skyless.core.air.reception import Diagnostics
from skyless.core.ticks import from_seconds, wrap
from skyless.radio.serial.link import WANTS_PHASES, Writer

FRAME: Final = bytes(range(98)) + fcs(bytes(range(98)))
_MHZ: Final = CPU_HZ / 1e6
_LEAD_S: Final = 5e-3
_STEP_S: Final = 4e-6
"""Between the instants at which an interrupt is tried; shorter than any path."""


class PathRow(Struct, frozen=True):
    """One path. Times in µs at 64 MHz."""

    name: str
    most_us: float
    instructions_us: float
    """Of these, what the processor computes."""
    transfers_us: float
    """What it waits for the SPI at 8 MHz, or 2 MHz while the chip starts."""


class CycleTable(Struct, frozen=True):
    """All paths, and the longest wait of an interrupt."""

    rows: tuple[PathRow, ...]
    worst_latency_us: float
    """From the interrupt line's rise until the chip's status is read, in operation."""


class _Bench:
    """The board after its start, receiving."""

    def __init__(self, elf: Path) -> None:
        self.board, self.writer = LoneBoard(elf), Writer()
        self.board.run(10e-3)

    def start(self, flags: int = 0) -> None:
        """Configure the board, have it receive, and let it measure temperature and supply."""
        self.send(self.writer.config(DELAYS.tx_ticks, DELAYS.rx_ticks, flags))
        self.board.run(12e-3)
        self.send(self.writer.rx_on())
        self.board.run(10e-3)

    def send(self, line: bytes) -> None:
        """Bytes from the host, each in 10 µs."""
        self.board.write(line)

    def ask_for_frame(self, ahead_s: float) -> None:
        """A frame is to leave so long from now."""
        dx_ticks = wrap(self.board.air.now_ticks() + from_seconds(ahead_s))
        self.send(self.writer.tx_at(dx_ticks, FRAME))

    def arrive(self) -> None:
        """A frame has just ended."""
        chip, air = self.board.chip, self.board.air
        stamp = wrap(air.now_ticks() - from_seconds(after_rmarker_s(len(FRAME))))
        chip.receive(FRAME, stamp, Diagnostics(-80.0, -83.0, 1.0), carrier_phase_cycles=0.7)
        self.board.image.notify()

    def end_transmission(self) -> None:
        """The own frame has left."""
        self.board.chip.transceiver.finish()
        self.board.image.notify()

    def costs(self, act: Callable[[], None], seconds: float) -> dict[str, PathCost]:
        """Costs by path while something happens."""
        self.board.image.forget_paths()
        act()
        self.board.run(seconds)
        return self.board.image.cycles_by_path()


def _row(name: str, costs: dict[str, PathCost], path: str) -> PathRow:
    cost = costs[path]
    transfers_us = cost.mean_transfer / _MHZ
    return PathRow(name, cost.most_us, cost.most_us - transfers_us, transfers_us)


def measure_cycles(elf: Path) -> CycleTable:
    """Run the board through its paths. Raises EmulationError where the image fails."""
    bench = _Bench(elf)
    started = bench.costs(bench.start, 0.0)
    heard = bench.costs(bench.arrive, 3e-3)
    held = bench.costs(lambda: bench.ask_for_frame(_LEAD_S + 2e-3), _LEAD_S + 2.5e-3)
    ended = bench.costs(bench.end_transmission, 2e-3)
    worst_latency_us = _worst_latency_us(bench)
    bench.start(WANTS_PHASES)
    with_phase = bench.costs(bench.arrive, 3e-3)
    rows = (
        _row("idle: a turn of the loop with nothing to do", held, IDLE),
        _row("reception of 100 bytes, to the UART", heard, RECEPTION),
        _row("reception of 100 bytes with the phase of its carrier", with_phase, RECEPTION),
        _row("a byte of a command", held, BYTE),
        _row("the end of a command with 100 bytes: checked and held", held, f"{COMMAND} + {POLL}"),
        _row("transmission: the frame to the chip", held, TRANSMISSION),
        _row("its end, reported", ended, END_OF_TRANSMISSION),
        _row("temperature and supply, in free slots", started, POLL),
        _row("configuration, with the chip's start", started, f"{COMMAND} + {POLL}"),
    )
    return CycleTable(rows, worst_latency_us)


def _worst_latency_us(bench: _Bench) -> float:
    """Let receptions end at instants all over a command's reception and a frame's hand-over."""
    worst_s = 0.0
    for step in range(int(1.6e-3 / _STEP_S)):
        bench.board.image.forget_paths()
        bench.ask_for_frame(1.5e-3)
        bench.board.run(step * _STEP_S)
        bench.arrive()
        bench.board.run(2.2e-3 - step * _STEP_S)
        bench.end_transmission()
        bench.board.run(2e-3)
        worst_s = max(worst_s, bench.board.image.interrupt_latency.most_s)
    return 1e6 * worst_s


def markdown(table: CycleTable) -> str:
    """The table of docs/hardware.md."""
    lines = ["| path | µs at 64 MHz | computing | SPI |", "|---|---|---|---|"]
    lines += [
        f"| {row.name} | {row.most_us:.0f} | {row.instructions_us:.0f} | {row.transfers_us:.0f} |" for row in table.rows
    ]
    lines.append(f"| worst case interrupt latency in operation | {table.worst_latency_us:.0f} | | |")
    return "\n".join(lines) + "\n"
