"""The vectors' board, chip and wire for tests in CPython, and what a board said as values."""

import bisect
import importlib.util
import re
import subprocess
import sys
import types
from pathlib import Path

from cobs import cobs

from skyless.firmware import board, dw1000, link
from skyless.radios.serial.link_records import decode

VECTORS = Path(__file__).with_name("board_vectors.py")
FOLDER = Path(board.__file__).parent
NRF52 = Path(__file__).parents[2] / "firmware" / "nrf52.py"


def module_of_vectors():
    """The vectors as a module, over the board that tests import."""
    spec = importlib.util.spec_from_file_location("board_vectors_here", VECTORS)
    module = importlib.util.module_from_spec(spec)
    arguments, sys.argv = sys.argv, [str(VECTORS), str(FOLDER)]
    sys.modules["board"] = board
    try:
        spec.loader.exec_module(module)
    finally:
        sys.argv = arguments
        sys.path.remove(str(FOLDER))
        del sys.modules["board"]
    return module


vectors = module_of_vectors()


def records(said):
    """Raw records of what a board has sent, by the package ``cobs``."""
    return [cobs.decode(piece)[:-2] for piece in bytes(said).split(b"\0") if piece]


def values(said):
    return [decode(record) for record in records(said)]


class Nrf52Line:
    """What the functions of ``nrf52.py`` that boards compile do for a ``Wire``; the UART sends at once."""

    def __init__(self, wire):
        self.wire, self.taken = wire, 0

    def received(self, timer):
        return self.taken + self.wire.in_end - self.wire.in_at

    def copy_from_ring(self, ring, at, size, out):
        into = bytearray(size)
        self.taken += self.wire.read(into)
        out[:size] = into
        return (at + size) % 255

    def join(self, header, begin, data, end, out):
        out[:end] = bytes(header) + bytes(data)

    def send(self, uarte, data, at, size):
        assert self.wire.write(data[at : at + size], size)

    def is_sent(self, uarte):
        return True


class Nrf52Spi:
    """``machine.SPI`` to the chip that the vectors play."""

    def __init__(self, chip):
        self.chip, self.octets = chip, 0

    def write_readinto(self, out, into):
        self.octets += len(out)
        if out[0] & 0x80:
            size = 1 if not out[0] & 0x40 else 2 if not out[1] & 0x80 else 3
            self.chip.write(out[:size], out[size:])
        else:
            self.chip.transfer(out, into)

    def init(self, baudrate, polarity, phase):
        pass


def on_nrf52(bench):
    """Put ``nrf52.py`` between a bench's board and its wire and chip; the SPI, and all files that boards run."""
    line = Nrf52Line(bench.wire)
    plain = types.ModuleType("micropython")
    plain.const = lambda value: value
    plain.viper = lambda function: getattr(line, function.__name__, lambda *_: None)
    namespace = {"ptr8": object, "ptr32": object, "__name__": "nrf52"}
    modules = {"micropython": plain, "dw1000": dw1000, "link": link}
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        exec(compile(NRF52.read_text(encoding="utf-8"), str(NRF52), "exec"), namespace)
    finally:
        for name, module in before.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    spi = Nrf52Spi(bench.bus)
    pin = types.SimpleNamespace(init=lambda *_, **__: None, OUT=1, IN=0)
    bench.chip._bus = namespace["SpiBus"](spi, lambda value: None, pin, bench.bus.pause_us)
    bench.board._uart = namespace["Uarte"](lambda us: None)
    return spi, {module.__file__ for module in (board, dw1000, link)} | {str(NRF52)}


def bytecodes_of_lines(micropython, file):
    """How many bytecodes MicroPython's compiler makes of each line of a file, from what it dumps."""
    program = f"import sys; sys.path[0:0] = {[str(FOLDER), str(NRF52.parent)]}; import {Path(file).stem}"
    dump = subprocess.run(
        [micropython, *3 * ["-v"], "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    counts, begins, lines, is_wanted = {}, [], [], False
    for row in dump.stdout.splitlines():
        if block := re.match(r"File (\S+), code block", row):
            is_wanted, begins, lines = Path(block[1]).name == Path(file).name, [], []
        elif is_wanted and (mark := re.match(r"  bc=(\d+) line=(\d+)", row)):
            begins.append(int(mark[1]))
            lines.append(int(mark[2]))
        elif is_wanted and (code := re.match(r"(\d+) [A-Z_]+", row)):
            line = lines[bisect.bisect_right(begins, int(code[1])) - 1]
            counts[line] = counts.get(line, 0) + 1
    return counts
