"""Three tables of the DW1000's registers, made apart: the model's, the driver's, and a published one."""

import re

import dw1000_published as published
import pytest

from skyless.core.air.frame import Diagnostics, fcs
from skyless.core.ticks import wrap
from skyless.radio.dw1000 import radio as dw1000
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000 import transceiver
from skyless.sim.dw1000.chip import Chip, ModelBus, Sensors
from skyless.sim.dw1000.registers import decode_header

pytestmark = pytest.mark.site

NOT_PUBLISHED = {
    *("STD_NOISE", "FP_AMPL2", "FP_AMPL3", "CIR_PWR"),  # parts of RX_FQUAL, see below
    *("AGC_CTRL", "EXT_SYNC", "DRX_CONF", "TX_CAL", "FS_CTRL", "AON", "OTP_IF", "LDE_IF", "PMSC"),  # files
    *("TC_SARL", "RF_SENSOR_1", "RF_SENSOR_2", "AGC_TUNE3"),  # the manual's alone
}
"""Names of the model that have no line of their own there."""


def test_the_model_s_registers_are_where_they_are_published():
    here = {
        name: (r.ALL_REGISTERS[name].file, r.ALL_REGISTERS[name].sub, r.ALL_REGISTERS[name].length)
        for name in r.ALL_REGISTERS.keys() - NOT_PUBLISHED
    }
    assert here == {name: published.REGISTERS[name] for name in here}


def test_the_parts_of_the_frame_quality_lie_as_their_masks_say():
    shifts = {"STD_NOISE": 0, "FP_AMPL2": 16, "FP_AMPL3": 32, "CIR_PWR": 48}
    assert {name: 8 * r.ALL_REGISTERS[name].sub for name in shifts} == shifts
    assert {r.ALL_REGISTERS[name].length for name in shifts} == {2}


def test_the_model_s_bits_are_the_published_ones():
    bits = {**published.STATUS, **published.CONTROL, **published.CONFIG, **published.OTHER_BITS}
    here = {name: value for name, value in vars(r).items() if name in bits}
    assert len(here) >= 30
    assert here == {name: bits[name] for name in here}


def test_the_model_wants_the_published_tuning():
    for name, value in {**transceiver.TUNED_TO_RECEIVE, **transceiver.TUNED_TO_SEND}.items():
        assert name in r.ALL_REGISTERS
        assert value == published.VALUES[name], name
    assert r.DEV_ID.reset == published.DEVICE_ID
    assert transceiver.PRF_64_DB == published.POWER_A_DB
    assert {value >> 4 for value in published.RESETS.values()} == {
        r.SOFTRESET_ALL, r.SOFTRESET_RX, r.SOFTRESET_NONE
    }  # fmt: skip
    assert Sensors().otp().keys() <= set(published.OTP.values())


# The driver: by what it does on the bus, so that constants without a name count as well


class Tapped(ModelBus):
    """Writes down all transactions."""

    def __init__(self, chip, spend):
        super().__init__(chip, spend)
        self.seen = []

    def transfer(self, out):
        access = decode_header(out)
        self.seen.append((access, out[access.octets :]))
        return super().transfer(out)


class Air:
    def __init__(self):
        self.now = 0.0

    def now_ticks(self):
        return wrap(round(self.now * 63.8976e9))

    def transmit(self, frame, leaves_ticks):
        return True

    def withdraw(self):
        pass

    def spend(self, seconds):
        self.now += seconds


@pytest.fixture(scope="module")
def life():
    """All that a driver says in its life on the air: start, reception, errors, transmission, late one, measurement."""
    air = Air()
    chip = Chip(air, 0, 0, lambda: air.now)
    bus = Tapped(chip, air.spend)
    driver = dw1000.DW1000(bus)
    driver.reads_phases = True
    driver.start(0x1234, 0x4321)
    started = {name: chip.memory.get(register) for name, register in r.ALL_REGISTERS.items()}
    driver.receive()
    frame = b"some frame"
    frame += fcs(frame)
    for fault in (None, "header", "delimiter", None, "first-path"):
        air.spend(1e-3)
        chip.receive(frame, air.now_ticks(), Diagnostics(-80.0, -82.0, 1.0), fault)
        driver.poll()
    for ahead_s in (2e-3, 0.1e-3):
        driver.transmit_at(wrap(air.now_ticks() + round(ahead_s * 63.8976e9)), frame)
        air.spend(3e-3)
        driver.poll()
    driver.now()
    driver.measure()
    assert not +chip.misuse
    return bus.seen, started, chip


def test_all_that_the_driver_touches_is_a_published_register_or_the_manual_s(life):
    seen, _, _ = life
    places = [*published.REGISTERS.values(), *((one.file, one.sub, one.length) for one in r.ALL_REGISTERS.values())]
    touched = set()
    for access, data in seen:
        fits = [
            place for place in places if place[0] == access.file and place[1] <= access.sub
            and access.sub + len(data) <= place[1] + place[2]
        ]  # fmt: skip
        assert fits, f"{access.file:02x}:{access.sub:04x} has no {len(data)} octets"
        touched.add((access.file, access.sub))
    assert len(touched) > 35


def test_the_driver_sets_the_published_values(life):
    _, started, _ = life
    for name, value in published.VALUES.items():
        assert started[name] == value, name
    assert started["TX_FCTRL"] & 0xFFFFFC00 == published.TX_FCTRL
    assert (started["TX_ANTD"], started["LDE_RXANTD"]) == (0x1234, 0x4321)
    assert started["FS_XTALT"] == 0x60 | Sensors().crystal_trim  # bits 7 to 5: 011 (UM 7.2.44.5)
    assert started["DRX_SFDTOC"] == 128 + 1 + 8 - 8  # UM 7.2.40.7


def defined():
    """Names and values of the driver's ``#define`` lines."""
    known = {}
    header = (dw1000.SOURCES / "dw1000_registers.h").read_text("utf-8")
    for name, text in re.findall(r"^#define (\w+) (.+?)(?: */\*.*)?$", header, re.MULTILINE):
        known[name] = eval(re.sub(r"\b(0x[0-9A-Fa-f]+|\d+)(?:u|ull)\b", r"\1", text), {}, known)
    return known


def test_the_driver_s_names_are_the_published_bits():
    here = defined()
    named = here.keys() & published.STATUS.keys()
    assert {name: here[name] for name in named} == {name: published.STATUS[name] for name in named}
    assert len(named) >= 13
    assert published.CONTROL["TXSTRT"] | published.CONTROL["TXDLYS"] == here["TXSTRT_TXDLYS"]
    assert published.CONTROL["TRXOFF"] == here["TRXOFF"]
    assert published.CONTROL["RXENAB"] == here["RXENAB"]
    assert here["DEVICE_ID"] == published.DEVICE_ID
    read = {name.removeprefix("OTP_"): address for name, address in here.items() if name.startswith("OTP_")}
    assert len(read) == 4
    assert read.items() <= published.OTP.items()
    assert here["POWER_A"] / 1e4 == published.POWER_A_DB
    assert not here["CLEARED"] & (published.STATUS["IRQS"] | published.STATUS["CPLOCK"] | published.STATUS["HPDWARN"])


def test_the_driver_resets_as_published(life):
    seen, _, _ = life
    written = [data[0] for access, data in seen if access.is_write and (access.file, access.sub) == (0x36, 3)]
    assert set(written) == set(published.RESETS.values())


def test_the_interrupt_mask_has_what_the_driver_looks_at(life):
    _, started, _ = life
    wanted = ("TXFRS", "RXFCG", "RXPHE", "RXRFSL", "RXSFDTO", "RXFCE", "LDEERR")
    assert all(started["SYS_MASK"] & published.STATUS[name] for name in wanted)
    known = sum(published.STATUS.values())
    assert not started["SYS_MASK"] & ~known
