"""What the root folder ``firmware`` brings: the nRF52832's UART and SPI in MicroPython, and the board's definition."""

import csv
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from board_bench import values

FIRMWARE = Path(__file__).parents[2] / "firmware"
BOARD = FIRMWARE / "boards" / "SKYLESS_DWM1001"
FILES = Path(__file__).parents[2] / "src" / "skyless" / "firmware"
MICROPYTHON = shutil.which("micropython", path=Path(sys.executable).parent) or shutil.which("micropython")

DWM1001 = {
    "UART_TX": 5, "UART_RX": 11, "DW_SCK": 16, "DW_CS": 17, "DW_MISO": 18, "DW_IRQ": 19, "DW_MOSI": 20, "DW_RST": 24,
}  # fmt: skip
"""How the module is wired, by its data sheet."""


@pytest.fixture(scope="module")
def told():
    if MICROPYTHON is None:
        pytest.skip("MicroPython's unix port is only on PyPI for x86-64")
    program = Path(__file__).with_name("nrf52_vectors.py")
    done = subprocess.run(
        [MICROPYTHON, str(program), str(FILES), str(FIRMWARE)], capture_output=True, text=True, timeout=100, check=True
    )
    return dict(line.split(" ", 1) for line in done.stdout.splitlines())


def test_the_uart_is_set_up_for_dma_at_one_megabaud(told):
    """Values of the product specification: 1M is 0x10000000, UARTE is enabled with 8, RTS and CTS are not connected."""
    assert told["pins"] == "5 11 0xffffffff 0xffffffff"
    assert told["line"] == "0x10000000 0 8 0xffffffff"
    assert told["ring"] == f"True 255 {1 << 5} 1"
    assert told["crystal"] == "1 1"
    assert told["timer"] == "1 3 1 1"
    assert told["route"] == f"True True {1 << 7}"


def test_all_that_comes_is_read_in_order_and_overruns_are_left_out(told):
    assert told["received"] == "1415 True"
    assert told["overrun"] == "[] 1"
    assert told["after"] == "7 True"
    assert told["wrapped"] == "60 1"


def test_what_is_written_goes_out_once_in_order_or_is_refused(told):
    assert told["sent"] == "True True True 0"
    assert told["restart"].split()[1] == "0"


def test_each_write_to_the_chip_is_one_transfer(told):
    assert "('cs', 0), b'\\x8d@', ('cs', 1), ('cs', 0), b'\\xee\\x8404@', ('cs', 1)" in told["spi"]
    assert "('rst', 'out', 0), 100, ('rst', 'in', None), (8000000" in told["spi"]


def test_neither_uart_nor_spi_allocates(told):
    assert told["allocated"] == "0"


def test_all_files_agree_about_the_pins():
    rows = {name: int(pin.removeprefix("P")) for name, pin in csv.reader((BOARD / "pins.csv").open())}
    assert {name: rows[name] for name in DWM1001} == DWM1001
    assert len(set(rows.values())) == len(rows)
    header = dict(re.findall(r"#define (MICROPY_HW_\w+)\s+\((\d+)\)", (BOARD / "mpconfigboard.h").read_text()))
    for name, row in (("UART1_TX", "UART_TX"), ("UART1_RX", "UART_RX"), ("SPI0_SCK", "DW_SCK"),
                      ("SPI0_MOSI", "DW_MOSI"), ("SPI0_MISO", "DW_MISO")):  # fmt: skip
        assert int(header["MICROPY_HW_" + name]) == rows[row]
    code = (FIRMWARE / "main.py").read_text()
    used = set(re.findall(r'Pin\("(\w+)"', code))
    assert used <= set(rows)
    assert {"DW_CS", "DW_IRQ", "DW_RST", "ROLE"} <= used
    registers = (FIRMWARE / "nrf52.py").read_text()
    assert f"uarte[_PSEL_TXD] = {rows['UART_TX']}\n" in registers
    assert f"uarte[_PSEL_RXD] = {rows['UART_RX']}\n" in registers


def test_the_manifest_freezes_all_that_is_imported():
    """By the build's own words, played."""
    frozen = {}

    def freeze(folder, files, opt):
        for file in files:
            path = Path(folder.replace("$(BOARD_DIR)", str(BOARD))) / file
            frozen[path.stem] = path

    words = {"include": lambda path: None, "freeze": freeze}
    exec(compile((BOARD / "manifest.py").read_text(), "manifest.py", "exec"), words)
    assert all(path.is_file() for path in frozen.values())
    assert set(frozen) == {"link", "dw1000", "board", "nrf52", "main"}
    ports = {"gc", "time", "machine", "micropython"}
    for path in frozen.values():
        imported = set(re.findall(r"^\s*import (\w+)", path.read_text(), re.MULTILINE))
        assert imported <= set(frozen) | ports


MAIN_ON_STANDINS = """
import sys
sys.path[0:0] = sys.argv[1:3]

class Done(Exception):
    pass

class Pin:
    IN, OUT, PULL_UP, PULL_DOWN = range(4)
    def __init__(self, name, mode, pull=None, value=None):
        self.level = value
        print("pin", name, mode, value)
    def __call__(self, value):
        pass
    def init(self, mode, value=None):
        pass
    def value(self):
        return int(sys.argv[3])

class Spi:
    def __init__(self, number, baudrate):
        print("spi", number, baudrate)

class Machine:
    SPI, Pin = Spi, Pin
    def reset():
        print("reset")

class Nrf52:
    SLOW_HZ = 2000000
    class SpiBus:
        def __init__(self, *parts):
            import dw1000
            pass
    class Uarte:
        turns = 0
        def __init__(self, pause):
            pass
        def write(self, line, end):
            print("said", "".join("%02x" % byte for byte in line[:end]))
            return True
        def read(self, into):
            self.turns += 1
            if self.turns > 3:
                raise Done()
            return 0

sys.modules["machine"], sys.modules["nrf52"] = Machine, Nrf52
import link
copy = link.copy
link.copy = lambda source, *rest: 8 if source == 0x10000060 else copy(source, *rest)
import main
"""


@pytest.mark.skipif(MICROPYTHON is None, reason="MicroPython's unix port is only on PyPI for x86-64")
@pytest.mark.parametrize(
    ("role_pin", "file", "capabilities"), [("1", "", 1), ("0", "", 0), ("1", "tag\n", 0), ("0", "anchor", 1)]
)
def test_main_starts_and_resets_when_something_goes_wrong(role_pin, file, capabilities, tmp_path):
    if file:
        (tmp_path / "role.txt").write_text(file)
    program = tmp_path / "play.py"
    program.write_text(MAIN_ON_STANDINS)
    done = subprocess.run(
        [MICROPYTHON, str(program), str(FILES), str(FIRMWARE), role_pin],
        capture_output=True, text=True, timeout=60, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert "reset" in done.stdout
    assert "Done" in done.stderr + done.stdout
    assert "pin DW_CS 1 1" in done.stdout
    assert "spi 1 2000000" in done.stdout
    said = b"".join(bytes.fromhex(line[5:]) for line in done.stdout.splitlines() if line.startswith("said "))
    assert [hello.can_transmit for hello in values(said)] == [bool(capabilities)]
