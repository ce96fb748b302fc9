"""SPI and GPIO of a Linux board, with the two packages played: no such devices stand here."""

import enum
import sys
from types import ModuleType, SimpleNamespace

import pytest

from skyless.core.errors import SkylessError
from skyless.radio.dw1000 import radio as dw1000
from skyless.radio.dw1000.spi import SpiBus

pytestmark = pytest.mark.site

DEVICE_ID = b"\x30\x01\xca\xde"


class Value(enum.Enum):
    INACTIVE = 0
    ACTIVE = 1


class PlayedSpi:
    """As ``spidev.SpiDev`` behaves: lists in, lists out, attributes that are set."""

    def __init__(self, log):
        self.__dict__["log"] = log

    def __setattr__(self, name, value):
        self.log.append((name, value))

    def open(self, bus, device):
        self.log.append(("open", bus, device))
        if bus == 9:
            raise FileNotFoundError(2, "No such file or directory")

    def xfer2(self, values):
        assert isinstance(values, list)
        self.log.append(("xfer2", *values))
        return [0, *DEVICE_ID] if values[0] == 0 else [0x55] * len(values)

    def close(self):
        self.log.append(("close",))


class PlayedLine:
    def __init__(self, log, chip, config, consumer):
        self.log, self.offsets, self.fd, self.edges, self.value = log, list(config), 17, 3, Value.ACTIVE
        log.append((consumer, chip, config))

    def get_value(self, offset):
        assert offset in self.offsets
        return self.value

    def reconfigure_lines(self, config):
        self.log.append(("reconfigure", config))

    def wait_edge_events(self, timeout):
        assert timeout == 0
        return self.edges > 0

    def read_edge_events(self):
        self.edges -= 1

    def release(self):
        self.log.append(("release",))


@pytest.fixture
def log(monkeypatch):
    """The packages' names in ``sys.modules``, and what was asked of them."""
    log = []
    spidev, gpiod, line = ModuleType("spidev"), ModuleType("gpiod"), ModuleType("gpiod.line")
    spidev.SpiDev = lambda: PlayedSpi(log)
    gpiod.LineSettings = lambda **settings: settings
    gpiod.request_lines = lambda chip, config, consumer: request(log, chip, config, consumer)
    line.Direction = SimpleNamespace(INPUT="in", OUTPUT="out")
    line.Edge = SimpleNamespace(RISING="rising")
    line.Bias = SimpleNamespace(PULL_DOWN="down", DISABLED="none")
    line.Value = Value
    for module in (spidev, gpiod, line):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return log


def request(log, chip, config, consumer):
    if 99 in config:
        raise OSError(16, "Device or resource busy")
    return PlayedLine(log, chip, config, consumer)


def test_transactions_are_whole_and_at_the_right_speed(log):
    bus = SpiBus(0, 1, fast_hz=16_000_000)
    read = bus.transfer(bytes(5))
    bus.set_spi_fast(True)
    bus.transfer(b"\x8d\x40")
    bus.set_spi_fast(False)
    bus.close()
    bus.close()
    assert read[1:] == DEVICE_ID
    assert log == [
        ("open", 0, 1), ("mode", 0), ("max_speed_hz", 2_000_000), ("xfer2", 0, 0, 0, 0, 0),
        ("max_speed_hz", 16_000_000), ("xfer2", 0x8D, 0x40), ("max_speed_hz", 2_000_000), ("close",),
    ]  # fmt: skip


def test_the_reset_line_is_never_driven_high(log):
    bus = SpiBus(0, 0, reset_pin=24)
    floating = {24: {"direction": "in", "bias": "none"}}
    bus.reset_chip()
    assert ("skyless reset", "/dev/gpiochip0", floating) in log
    assert [entry[1] for entry in log if entry[0] == "reconfigure"] == [
        {24: {"direction": "out", "output_value": Value.INACTIVE}}, floating,
    ]  # fmt: skip
    entries = len(log)
    SpiBus(0, 0).reset_chip()
    assert "reconfigure" not in [entry[0] for entry in log[entries:]]


def test_the_interrupt_line_can_be_waited_for(log):
    bus = SpiBus(0, 0, irq_pin=25, gpio_chip="/dev/gpiochip4")
    settings = {"direction": "in", "edge_detection": "rising", "bias": "down"}
    assert ("skyless irq", "/dev/gpiochip4", {25: settings}) in log
    assert bus.fileno() == 17
    assert bus.is_raised()
    bus.forget_edges()
    assert bus._irq.edges == 0
    bus._irq.value = Value.INACTIVE
    assert not bus.is_raised()
    bus.close()
    assert log[-2:] == [("release",), ("close",)]


def test_a_line_that_rises_faster_than_it_is_read_is_not_waited_for(log):
    bus = SpiBus(0, 0, irq_pin=25)
    bus._irq.edges = 10**9
    bus.forget_edges()
    assert bus._irq.edges > 10**9 - 100


def test_without_an_interrupt_line_the_chip_is_always_asked(log):
    bus = SpiBus(0, 0)
    assert bus.fileno() is None
    assert bus.is_raised()
    bus.forget_edges()


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        ((9, 0), {}, "/dev/spidev9.0 cannot be opened (No such file or directory)"),
        ((0, 0), {"irq_pin": 99}, "GPIO lines 99 (irq) and None (reset) of /dev/gpiochip0 cannot be used"),
        ((0, 0), {"fast_hz": 21_000_000}, "SPI at 21000000 Hz: it should be 2000000 to 20000000"),
    ],
)
def test_what_cannot_be_opened_logs_why_and_what_would_be_right(log, arguments, options, words):
    with pytest.raises(SkylessError) as raised:
        SpiBus(*arguments, **options)
    assert words in str(raised.value)


@pytest.mark.parametrize(("package", "options"), [("spidev", {}), ("gpiod", {"irq_pin": 25})])
def test_a_missing_package_is_named(log, monkeypatch, package, options):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SkylessError, match=rf"needs {package}, which is not installed"):
        SpiBus(0, 0, **options)
    if package == "gpiod":
        assert log[-1] == ("close",)


def test_the_driver_finds_out_that_no_chip_follows(log):
    """What answers is the identifier alone; then the bus floats."""
    with pytest.raises(dw1000.ChipError, match="does not lock"):
        dw1000.DW1000(SpiBus(0, 0)).start(0, 0)
