"""The firmware's driver against the one of the Raspberry Pi: constants, arithmetic, and every transaction."""

import re

from board_stage import needs_compiler
from emulator.board_library import CChip, library
from emulator.build import FIRMWARE
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scripted_chip import ScriptedBus, script_frame

from skyless.radios.dw1000 import driver
from skyless.radios.serial import link

REGISTERS = FIRMWARE / "source" / "dw1000_registers.h"
U16 = st.integers(0, 0xFFFF)


def constants(header):
    """Names and values of a header's ``#define`` lines."""
    known = {}
    for name, text in re.findall(r"^#define (\w+) (.+?)(?: */\*.*)?$", header.read_text("utf-8"), re.MULTILINE):
        known[name] = eval(re.sub(r"\b(0x[0-9A-Fa-f]+|\d+)(?:u|ull)\b", r"\1", text), {}, known)
    return known


# Constants


def test_registers_have_the_same_values_in_both_drivers():
    here = {name: value for name, value in constants(REGISTERS).items() if name not in ("DEVICE_ID", "CHAN_CTRL")}
    assert len(here) >= 40
    assert here == {name: getattr(driver, name) for name in here}
    assert constants(REGISTERS)["DEVICE_ID"].to_bytes(4, "little") == driver.DEVICE_ID
    assert (0x1F, 0, 4, constants(REGISTERS)["CHAN_CTRL"]) in driver.CONFIGURATION


def test_results_and_reasons_have_the_same_values():
    header = (FIRMWARE / "source" / "dw1000.h").read_text("utf-8")
    known = dict(re.findall(r"#define DW1000_(\w+) \(?(-?\w+?)u?\)?$", header, re.MULTILINE))
    known |= dict(re.findall(r"DW1000_(\w+) = (\d)", header))
    shared = {name: int(value, 0) for name, value in known.items() if name != "MAX_TRANSFER_BYTES"}
    assert len(shared) > 10
    assert shared == {name: getattr(driver, name) for name in shared}
    assert (driver.LATE, driver.BUSY, driver.NOT_READY) == (
        link.LATE_FOR_RADIO, link.LATE_BUSY, link.LATE_NOT_READY
    )  # fmt: skip


def test_the_link_has_the_same_values_at_both_ends():
    here = {name.removeprefix("LINK_"): value for name, value in constants(FIRMWARE / "source" / "link.h").items()}
    only_here = ("IDENTITY_BYTES", "STAMP_BYTES", "MAX_LINE_BYTES")
    shared = {name: value for name, value in here.items() if name not in only_here and name != "LINK_H"}
    assert len(shared) > 30
    assert shared == {name: getattr(link, name) for name in shared}


# Arithmetic


@needs_compiler
@given(st.integers(1, 2**30 - 1))
def test_the_logarithm_is_the_same(value):
    assert library().dw1000_log10(value) == driver.log10(value)


@needs_compiler
@given(U16, U16, U16, U16, st.integers(0, 0xFFF))
def test_powers_are_the_same(cir_power, f1, f2, f3, symbols):
    level = library().dw1000_accumulated(symbols)
    assert level == driver.accumulated(symbols)
    assert library().dw1000_power_cdbm(cir_power, level) == driver.power_cdbm(cir_power, level)
    assert library().dw1000_first_path_cdbm(f1, f2, f3, level) == driver.first_path_cdbm(f1, f2, f3, level)


@needs_compiler
@given(st.integers(-(2**20), 2**20 - 1))
def test_carrier_offsets_are_the_same(integrator):
    assert library().dw1000_carrier_offset_ppb(integrator) == driver.carrier_offset_ppb(integrator)


@needs_compiler
@given(st.integers(0, 2**40 - 1), st.integers(-(2**39) + 2**17, 2**39 - 2**17))
def test_the_time_to_a_stamp_goes_the_short_way_round(now, distance):
    steps = library().dw1000_micros_until(now, (now + distance) % 2**40)
    assert abs(steps - distance / 65536) < 1


# Transactions


class Scripted(ScriptedBus):
    """A scripted chip as C's hardware, too."""

    def set_spi_fast(self, fast):
        (self.fast if fast else self.slow)()

    def reset_chip(self):
        self.reset()

    def now_us(self):
        return 0

    def interrupt_line(self):
        return False

    def read_line(self, size):
        return b""

    def write_line(self, line):
        return True

    def restart_line(self):
        """There is no line."""

    def show(self, lights):
        """There are no lights."""


class Python:
    """The Raspberry Pi's driver."""

    def __init__(self):
        self.bus = Scripted()
        self.chip = driver.DW1000(self.bus)

    def start(self, *delays):
        try:
            self.chip.start(*delays)
        except driver.ChipError:
            return False
        return True

    @property
    def state(self):
        return ("OFF", "IDLE", "LISTENING", "SENDING")[self.chip.state]


class C:
    """The firmware's driver."""

    def __init__(self):
        self.bus = Scripted()
        self.chip = CChip(self.bus)

    def start(self, *delays):
        return self.chip.start(*delays)

    @property
    def state(self):
        return self.chip.state


NUMBERS = (
    "received", "errors", "sent", "late", "rx_ticks", "tx_ticks", "rx_power_cdbm", "first_path_cdbm", "offset_ppb",
)  # fmt: skip
"""And those of the measurement, once there is one."""

OCTETS = st.binary(min_size=1, max_size=16)
STATUSES = st.one_of(
    st.binary(min_size=5, max_size=5),
    st.sampled_from(
        [b"\x03\x6f\0\0\0", b"\xf3\0\0\0\0", b"\x02\0\0\0\0", b"\x02\0\0\x08\0", b"\x02\0\x04\0\0", bytes(5)]
    ),
)
STEPS = st.one_of(
    st.tuples(st.just("start"), U16, U16),
    st.sampled_from([("receive",), ("poll",), ("poll",), ("cancel",), ("check",), ("now",), ("measure",)]),
    st.tuples(st.just("transmit_at"), st.integers(0, 2**40 - 1), st.binary(min_size=3, max_size=127)),
    st.tuples(st.just("frame"), st.binary(min_size=1, max_size=127)),
    st.tuples(st.just("status"), STATUSES),
    st.tuples(st.just("after_start"), STATUSES),
    st.tuples(st.just("after_off"), STATUSES),
    st.tuples(st.just("content"), st.sampled_from([0x06, 0x10, 0x11, 0x12, 0x15, 0x17, 0x1F, 0x27, 0x2A]), OCTETS),
    st.tuples(st.just("locks"), st.booleans()),
    st.tuples(st.just("device"), st.sampled_from([driver.DEVICE_ID, bytes(4), b"\xff" * 4])),
)


def perform(side, step):
    """One step: something happens to the chip, or the driver is called; what it returns."""
    name, *arguments = step
    bus = side.bus
    if name == "frame":
        script_frame(bus, *arguments)
    elif name == "status":
        bus.put(0x0F, 0, *arguments)
    elif name == "content":
        file, octets = arguments
        bus.put(file, 0x28 if file == 0x27 else 0, octets)
    elif name == "device":
        bus.put(0x00, 0, *arguments)
    elif name in ("after_start", "after_off", "locks"):
        setattr(bus, name, *arguments)
    elif name == "start":
        return side.start(*arguments)
    elif name != "now" or side.state != "OFF":
        return getattr(side.chip, name)(*arguments)
    return None


@needs_compiler
@given(st.lists(STEPS, max_size=40))
@example([("start", 16436, 16436), ("receive",), ("frame", bytes(range(127))), ("poll",), ("measure",)])
@example(
    [("start", 1, 2), ("receive",), ("transmit_at", 2**40 - 1, bytes(127)), ("status", b"\xf3\0\0\0\0"), ("poll",)]
)
@settings(max_examples=300, deadline=None)
def test_both_drivers_send_the_same_octets_and_return_the_same_whatever_the_chip_does(steps):
    python, c = Python(), C()
    for step in [("start", 16436, 16436), ("receive",), *steps]:
        assert perform(python, step) == perform(c, step), step
        assert python.bus.take() == c.bus.take(), step
        assert python.state == c.state, step
        assert [getattr(python.chip, name) for name in NUMBERS] == [getattr(c.chip, name) for name in NUMBERS], step
        assert python.chip.frame == c.chip.frame
        if python.chip.temperature_cc != driver.NOT_MEASURED:
            assert (python.chip.temperature_cc, python.chip.millivolts) == (c.chip.temperature_cc, c.chip.millivolts)
