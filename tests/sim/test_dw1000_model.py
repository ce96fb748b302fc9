"""The register model of the DW1000, told octet by octet what the manual tells; no driver here."""

import cmath
import math
import struct

import dw1000_published as published
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.frame import Diagnostics, after_rmarker_s, fcs, preamble_s
from skyless.core.ticks import TICK_RATE_HZ, wrap
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.chip import Chip, Sensors
from skyless.sim.dw1000.registers import Access, Register, decode_header
from skyless.sim.dw1000.transceiver import AGC_LOSS_DB, HZ_PER_STEP, TUNED_TO_RECEIVE, TUNED_TO_SEND

TX_DELAY, RX_DELAY = 16_000, 17_000
SLOW, FAST = 3_000_000, 20_000_000
BODY = b"what is sent"
FRAME = BODY + fcs(BODY)


class Bench:
    """A chip, its air, and hands at its pins."""

    def __init__(self, begin_ticks=2**40 - 10**9, senses=None):
        self.begin_ticks, self.now_s, self.sent, self.withdrawn, self.in_time = begin_ticks, 0.0, [], 0, True
        self.chip = Chip(self, TX_DELAY, RX_DELAY, lambda: self.now_s, senses)

    def now_ticks(self):
        return wrap(self.begin_ticks + round(self.now_s * TICK_RATE_HZ))

    def transmit(self, frame, leaves_ticks):
        if self.in_time:
            self.sent.append((frame, leaves_ticks))
        return self.in_time

    def withdraw(self):
        self.withdrawn += 1

    def write(self, register, value, *, hz=SLOW, length=None):
        header = self.header(register, is_write=True)
        self.chip.transfer(header + value.to_bytes(length or register.length, "little"), hz)

    def read(self, register, *, hz=SLOW):
        header = self.header(register, is_write=False)
        reply = self.chip.transfer(header + bytes(register.length), hz)
        return int.from_bytes(reply[len(header) :], "little")

    def header(self, register, *, is_write):
        first = is_write << 7 | register.file
        if not register.sub:
            return bytes((first,))
        if register.sub < 128:
            return bytes((first | 0x40, register.sub))
        return bytes((first | 0x40, 0x80 | register.sub & 0x7F, register.sub >> 7))

    def configure(self, microcode=True):
        """As section 2.5.5 tells, for the emulated air."""
        self.now_s += 1e-3
        if microcode:
            self.write(r.PMSC_CTRL0, r.PMSC_FOR_LDE, length=2)
            self.write(r.OTP_CTRL, r.LDELOAD)
            self.now_s += 200e-6
            self.write(r.PMSC_CTRL0, 0x0200, length=2)
        for name, value in (*TUNED_TO_RECEIVE.items(), *TUNED_TO_SEND.items()):
            self.write(r.ALL_REGISTERS[name], value)
        self.write(r.CHAN_CTRL, 5 | 5 << 4 | 2 << 18 | 9 << 22 | 9 << 27)
        self.write(r.TX_ANTD, TX_DELAY)
        self.write(r.LDE_RXANTD, RX_DELAY)
        self.write(r.SYS_MASK, r.RXFCG | r.TXFRS)

    def send(self, ahead_s, frame=FRAME):
        """Start a delayed transmission so far ahead; the DX_TIME."""
        dx = wrap(self.now_ticks() + round(ahead_s * TICK_RATE_HZ))
        self.write(r.TX_BUFFER, int.from_bytes(frame, "little"), length=len(frame))
        self.write(r.TX_FCTRL, len(frame) | 2 << 13 | 2 << 16 | 1 << 18 | 1 << 20)
        self.write(r.DX_TIME, dx)
        self.write(r.SYS_CTRL, r.TXSTRT | r.TXDLYS)
        return dx

    def listen(self):
        self.write(r.SYS_CTRL, r.RXENAB)
        self.now_s += 1e-3

    def hear(self, frame=FRAME, told=None, fault=None, phase_cycles=None):
        """A frame ends now; its stamp and what became of it."""
        stamp = wrap(self.now_ticks() - round(after_rmarker_s(len(frame)) * TICK_RATE_HZ))
        told = told or Diagnostics(-80.0, -84.0, 2.0)
        return stamp, self.chip.receive(frame, stamp, told, fault, carrier_phase_cycles=phase_cycles)

    def sample(self, behind=1):
        """The accumulator's sample so far behind FP_INDEX, as a complex number."""
        at = 4 * ((self.read(r.FP_INDEX) >> 6) + behind)
        header = bytes((0x40 | r.ACC_MEM.file, 0x80 | at & 0x7F, at >> 7))
        reply = self.chip.transfer(header + bytes(5), SLOW)[len(header) + 1 :]
        return complex(*struct.unpack("<2h", reply))


@pytest.fixture
def bench():
    made = Bench()
    made.configure()
    return made


def test_the_manual_s_examples_of_headers():
    """Figures 3, 5 and 7 (UM pp. 12-13)."""
    assert decode_header(bytes((0x00, 0, 0, 0, 0))) == Access(False, 0x00, 0, 1)
    assert decode_header(bytes((0x40, 0x02, 0, 0))) == Access(False, 0x00, 2, 2)
    assert decode_header(bytes((0xC9, 0xB6, 0x02, 0xFF))) == Access(True, 0x09, 310, 3)
    assert [decode_header(cut) for cut in (b"", b"\x40", b"\x49\x80")] == [None] * 3


def test_identity_and_reset_values():
    bench = Bench()
    assert bench.read(r.DEV_ID) == 0xDECA0130
    assert bench.read(r.TX_FCTRL) == 0x0015400C
    assert bench.read(r.CHAN_CTRL) == 0x21040055
    bench.write(r.DEV_ID, 0)
    assert bench.read(r.DEV_ID) == 0xDECA0130


def test_spi_is_limited_to_3_mhz_until_the_pll_has_locked():
    bench = Bench()
    assert bench.read(r.DEV_ID, hz=FAST) != 0xDECA0130
    bench.write(r.CHAN_CTRL, 0x12345678, hz=FAST)
    assert bench.read(r.CHAN_CTRL) == 0x21040055
    assert bench.chip.misuse["spi-too-fast"] == 2
    assert not bench.read(r.SYS_STATUS) & r.CPLOCK
    bench.now_s += 1e-4
    assert bench.read(r.DEV_ID, hz=FAST) == 0xDECA0130
    assert bench.read(r.SYS_STATUS) & r.CPLOCK
    assert bench.read(r.DEV_ID, hz=FAST + 1) != 0xDECA0130
    bench.write(r.PMSC_CTRL0, r.SYSCLKS_XTI, length=1)
    assert bench.read(r.DEV_ID, hz=FAST) != 0xDECA0130


def test_status_is_cleared_by_ones_but_for_what_is_read_only(bench):
    bench.listen()
    bench.hear()
    status = bench.read(r.SYS_STATUS)
    assert status & (r.RXFCG | r.RXDFR | r.LDEDONE) == r.RXFCG | r.RXDFR | r.LDEDONE
    bench.write(r.SYS_STATUS, r.RXFCG)
    assert bench.read(r.SYS_STATUS) == status & ~(r.RXFCG | r.IRQS)
    bench.send(100e-6)
    bench.write(r.SYS_STATUS, (1 << 40) - 1)
    assert bench.read(r.SYS_STATUS) == r.HPDWARN


def test_the_interrupt_line_follows_status_and_mask_with_the_polarity_that_is_set(bench):
    assert not bench.chip.irq
    bench.listen()
    bench.hear()
    assert bench.chip.irq
    assert bench.read(r.SYS_STATUS) & r.IRQS
    bench.write(r.SYS_MASK, r.TXFRS)
    assert not bench.chip.irq
    bench.write(r.SYS_CFG, 0x1000)
    assert bench.chip.irq


def test_system_time_steps_by_512_ticks_and_wraps(bench):
    readings = []
    for _ in range(2000):
        bench.now_s += 20e-6
        readings.append(bench.read(r.SYS_TIME))
    assert all(reading % 512 == 0 for reading in readings)
    assert min(readings) < 2**38 < 2**39 < max(readings)  # begun 16 ms before the wrap


def test_a_delayed_frame_leaves_at_dx_time_without_its_low_bits_and_is_stamped_so(bench):
    dx = bench.send(2e-3)
    ((frame, leaves),) = bench.sent
    assert frame == FRAME
    assert leaves == wrap((dx & ~0x1FF) + TX_DELAY)
    assert not bench.read(r.SYS_STATUS) & r.OF_SENDING
    bench.now_s += 2e-3 - preamble_s() + 1e-6
    assert bench.read(r.SYS_STATUS) & r.OF_SENDING == r.TXFRB
    bench.now_s += preamble_s()
    assert bench.read(r.SYS_STATUS) & r.OF_SENDING == r.TXFRB | r.TXPRS
    bench.now_s += after_rmarker_s(len(FRAME))
    assert bench.chip.irq
    assert bench.read(r.TX_STAMP) == leaves
    assert bench.read(r.SYS_STATUS) & r.TXFRS


def test_the_chip_makes_the_fcs(bench):
    bench.send(2e-3, BODY + b"??")
    assert bench.sent[-1][0] == FRAME


def test_the_warning_of_half_a_period_is_judged_on_the_preamble_s_start(bench):
    edge_s = preamble_s()
    for ahead_s, late in ((edge_s + 20e-6, False), (edge_s - 20e-6, True), (-1e-3, True), (8.5, False), (8.7, True)):
        begun = len(bench.sent)
        bench.send(ahead_s)
        assert bool(bench.read(r.SYS_STATUS) & r.HPDWARN) is late, ahead_s
        assert len(bench.sent) == begun + (not late)
        bench.write(r.SYS_CTRL, r.TRXOFF)
        assert not bench.read(r.SYS_STATUS) & r.HPDWARN
    bench.send(edge_s + 3e-6)
    assert bench.read(r.SYS_STATUS) & r.TXPUTE
    assert not +bench.chip.misuse


def test_what_the_air_refuses_is_late_too_and_what_is_turned_off_is_withdrawn(bench):
    bench.in_time = False
    bench.send(2e-3)
    assert bench.read(r.SYS_STATUS) & r.HPDWARN
    bench.write(r.SYS_CTRL, r.TRXOFF)
    bench.in_time = True
    bench.send(2e-3)
    bench.write(r.SYS_CTRL, r.TRXOFF)
    assert bench.withdrawn == 1
    bench.now_s += 5e-3
    assert not bench.read(r.SYS_STATUS) & r.TXFRS


def test_a_received_frame_its_stamp_and_what_was_measured(bench):
    bench.listen()
    told = Diagnostics(-81.0, -86.5, -3.25)
    stamp, outcome = bench.hear(told=told)
    assert outcome == "heard"
    info = bench.read(r.RX_FINFO)
    assert bench.chip.memory.octets(r.RX_BUFFER)[: info & 0x7F] == FRAME
    assert bench.read(r.RX_STAMP) == stamp
    counted = info >> 20
    symbols = counted - 5 if counted == bench.read(r.RXPACC_NOSAT) else counted
    power_db = 10.0 * math.log10(bench.read(r.CIR_PWR) * 2**17 / symbols**2) - 121.74
    squares = sum(bench.read(f) ** 2 for f in (r.FP_AMPL1, r.FP_AMPL2, r.FP_AMPL3))
    assert power_db == pytest.approx(told.rx_power_dbm, abs=0.01)
    assert 10.0 * math.log10(squares / symbols**2) - 121.74 == pytest.approx(told.first_path_power_dbm, abs=0.01)
    integrator = bench.read(r.DRX_CAR_INT)
    hertz = (integrator - (integrator >> 20 << 21)) * HZ_PER_STEP
    assert -hertz / 6489.6 == pytest.approx(told.carrier_offset_ppm, abs=0.0003)


@given(st.floats(0.0, 1.0, exclude_max=True), st.binary(min_size=1, max_size=20), st.floats(-95.0, -75.0))
def test_the_sample_behind_the_first_path_less_rcphase_has_the_carrier_s_phase(phase_cycles, body, power_dbm):
    bench = Bench()
    bench.configure()
    bench.listen()
    bench.hear(body + fcs(body), Diagnostics(power_dbm, power_dbm, 0.0), phase_cycles=phase_cycles)
    bench.write(r.PMSC_CTRL0, 0x8248, length=2)
    turned = bench.read(r.RX_TTCKO) >> 32
    assert (turned + 4) % 128 <= 8
    found = [cmath.phase(bench.sample(behind)) / (2.0 * math.pi) - turned / 128 for behind in range(4)]
    errors = [abs((phase - phase_cycles + 0.5) % 1.0 - 0.5) for phase in found]
    assert errors[1] < 0.5 / abs(bench.sample())  # half a step of the sample's parts
    assert all(error > 0.1 for error in (errors[0], *errors[2:]))
    sizes = [abs(bench.sample(behind)) for behind in (1, 2, 3)]
    assert sizes == pytest.approx([bench.read(one) for one in (r.FP_AMPL3, r.FP_AMPL2, r.FP_AMPL1)], abs=1)
    assert not +bench.chip.misuse


def test_without_a_phase_the_accumulator_is_empty(bench):
    for phase_cycles in (0.25, None):
        bench.listen()
        bench.hear(phase_cycles=phase_cycles)
        bench.write(r.PMSC_CTRL0, 0x8248, length=2)
        assert (bench.sample() == 0) is (phase_cycles is None)


def test_the_accumulator_needs_its_clock_and_is_overwritten_when_the_receiver_is_on_again(bench):
    bench.listen()
    bench.hear(phase_cycles=0.25)
    for clocks in (0x0200, 0x0240, 0x8200):
        bench.write(r.PMSC_CTRL0, clocks, length=2)
        assert bench.sample() == 0
    assert bench.chip.misuse == {"accumulator-without-its-clock": 3}
    bench.write(r.PMSC_CTRL0, 0x8248, length=2)
    bench.write(r.SYS_CTRL, r.RXENAB)
    bench.sample()
    assert bench.chip.misuse["accumulator-while-receiving"] == 1


def test_the_stamp_is_less_the_antenna_delay_that_is_set(bench):
    bench.write(r.LDE_RXANTD, RX_DELAY - 100)
    bench.listen()
    stamp, _ = bench.hear()
    assert bench.read(r.RX_STAMP) == wrap(stamp + 100)


def test_one_buffer_one_frame_until_the_receiver_is_turned_on_again(bench):
    assert bench.hear()[1] == "receiver-off"
    bench.write(r.SYS_CTRL, r.RXENAB)
    assert bench.hear()[1] == "preamble-missed"
    bench.now_s += 1e-3
    first, _ = bench.hear()
    bench.now_s += 1e-3
    assert bench.hear()[1] == "receiver-off"
    assert bench.read(r.RX_STAMP) == first
    bench.listen()
    assert not bench.read(r.SYS_STATUS) & r.OF_RECEIVING
    assert bench.hear()[1] == "heard"


def test_without_the_microcode_there_is_no_stamp_and_without_its_run_bit_none_is_looked_for():
    bench = Bench()
    bench.configure(microcode=False)
    bench.listen()
    assert bench.hear()[1] == "without-microcode"
    assert not bench.read(r.SYS_STATUS) & (r.RXFCG | r.LDEDONE)
    bench.write(r.PMSC_CTRL1, r.PMSC_CTRL1.reset & ~r.LDERUNE)
    bench.listen()
    assert bench.hear()[1] == "heard"
    assert bench.read(r.SYS_STATUS) & (r.RXFCG | r.LDEDONE) == r.RXFCG
    assert bench.read(r.RX_STAMP) == 0
    bench.write(r.OTP_CTRL, r.LDELOAD)
    assert bench.chip.misuse == {"microcode-without-its-clock": 1}


@pytest.mark.parametrize(
    ("register", "value", "why"),
    [
        (r.CHAN_CTRL, 2 | 2 << 4 | 2 << 18 | 9 << 22 | 9 << 27, "channel"),
        (r.CHAN_CTRL, 5 | 5 << 4 | 1 << 18 | 9 << 22 | 9 << 27, "prf"),
        (r.CHAN_CTRL, 5 | 5 << 4 | 2 << 18 | 10 << 22 | 10 << 27, "code"),
        (r.SYS_CFG, 0x1200 | r.RXM110K, "rate"),
        (r.DRX_TUNE2, 0x311A002D, "tuning"),
        (r.FS_PLLTUNE, 0x46, "tuning"),
    ],
)
def test_with_another_setting_it_hears_nothing_and_is_not_heard(bench, register, value, why):
    bench.write(register, value)
    bench.listen()
    assert bench.hear()[1] == "other-settings"
    assert not bench.chip.irq
    bench.write(r.SYS_CTRL, r.TRXOFF)
    bench.send(2e-3)
    assert len(bench.sent) == (why in ("rate", "prf") or register is r.DRX_TUNE2)  # these concern the receiver alone


@pytest.mark.parametrize("driver", published.WRITTEN)
def test_with_what_drivers_on_real_boards_write_it_receives_and_sends(driver):
    bench, words = Bench(), published.WRITTEN[driver].split()
    for place, value in zip(words[::2], words[1::2], strict=True):
        bench.now_s += 200e-6
        file, sub = (int(part, 16) for part in place.split(":"))
        bench.write(Register(file, sub, len(value) // 2), int(value, 16))
    bench.listen()
    assert bench.hear()[1] == "heard"
    dx = bench.send(2e-3)
    assert bench.sent == [(FRAME, wrap((dx & ~0x1FF) + TX_DELAY))]
    assert not +bench.chip.misuse


def test_without_agc_tune3_all_is_weaker_what_was_weak_is_lost_and_the_receiver_stays_on(bench):
    readings = []
    for tune, power_dbm in ((0x35, -80.0 - AGC_LOSS_DB), (0, -80.0)):
        bench.write(r.AGC_TUNE3, tune)
        bench.listen()
        assert bench.hear(told=Diagnostics(power_dbm, power_dbm - 4.0, 0.0))[1] == "heard"
        readings.append([bench.read(one) for one in (r.CIR_PWR, r.FP_AMPL1, r.RX_FINFO)])
    assert readings[0] == readings[1]
    bench.listen()
    assert bench.hear(told=Diagnostics(-92.0, -93.0, 0.0))[1] == "too-weak"
    assert bench.hear(told=Diagnostics())[1] == "heard"  # where the air knows no power


def test_a_start_together_with_off_aborts_both_and_sends_nothing(bench):
    """UM 5.3.1.2, as drivers cite it: it only sets the transmitter's delimiter up."""
    bench.send(2e-3)
    bench.write(r.SYS_CTRL, r.TXSTRT | r.TRXOFF)
    assert (bench.withdrawn, len(bench.sent), bench.chip.transceiver.sending) == (1, 1, None)


@pytest.mark.parametrize(
    ("fault", "event"), [("header", r.RXPHE), ("parity", r.RXRFSL), ("delimiter", r.RXSFDTO), ("first-path", r.LDEERR)]
)
def test_errors_show_and_want_a_reset_of_the_receiver(bench, fault, event):
    bench.listen()
    bench.hear(fault=fault)
    assert bench.read(r.SYS_STATUS) & event
    assert not (bench.read(r.SYS_STATUS) & r.LDEDONE)
    if fault == "first-path":
        return
    bench.listen()
    stamp, outcome = bench.hear()
    assert outcome == "suspect"
    assert bench.read(r.RX_STAMP) != stamp
    bench.chip.transfer(bytes((0xF6, 0x03, 0xE0)), SLOW)
    bench.chip.transfer(bytes((0xF6, 0x03, 0xF0)), SLOW)
    bench.listen()
    stamp, outcome = bench.hear()
    assert (outcome, bench.read(r.RX_STAMP)) == ("heard", stamp)


def test_a_wrong_fcs_is_an_error(bench):
    bench.listen()
    bench.hear(BODY + b"??")
    assert bench.read(r.SYS_STATUS) & (r.RXFCE | r.RXFCG) == r.RXFCE
    bench.listen()
    assert bench.hear()[1] == "suspect"


def test_a_soft_reset_forgets_everything_but_the_counter(bench):
    bench.listen()
    before = bench.read(r.SYS_TIME)
    bench.write(r.PMSC_CTRL0, r.SYSCLKS_XTI, length=1)
    bench.chip.transfer(bytes((0xF6, 0x03, 0x00)), SLOW)
    bench.write(r.CHAN_CTRL, 1)
    assert bench.chip.misuse["write-in-reset"] == 1
    bench.chip.transfer(bytes((0xF6, 0x03, 0xF0)), SLOW)
    assert bench.read(r.CHAN_CTRL) == r.CHAN_CTRL.reset
    assert not bench.chip.clocking.microcode_loaded
    assert bench.read(r.SYS_TIME) == before
    bench.now_s += 1e-3
    assert bench.read(r.SYS_STATUS) == r.CPLOCK | r.SLP2INIT
    assert bench.hear()[1] == "receiver-off"


def test_temperature_and_supply_need_their_switches_and_refer_to_what_is_in_the_otp():
    bench = Bench(senses=Sensors(temperature_c=45.8, supply_v=3.0))
    bench.write(r.TC_SARC, 1)
    assert bench.read(r.TC_SARL) == 0
    bench.write(r.TC_SARC, 0)
    bench.write(r.RF_SENSOR_1, 0x80)
    bench.write(r.RF_SENSOR_2, 0x0A)
    bench.write(r.RF_SENSOR_2, 0x0F)
    bench.write(r.TC_SARC, 1)
    reading = bench.read(r.TC_SARL)
    references = []
    for address in (0x08, 0x09):
        bench.write(r.OTP_ADDR, address)
        bench.write(r.OTP_CTRL, r.OTPREAD)
        references.append(bench.read(r.OTP_RDAT) & 0xFF)
    assert ((reading >> 8 & 0xFF) - references[1]) * 1.14 + 23.0 == pytest.approx(45.8, abs=0.6)
    assert ((reading & 0xFF) - references[0]) / 173 + 3.3 == pytest.approx(3.0, abs=0.003)


def test_what_the_manual_forbids_is_counted(bench):
    bench.chip.transfer(b"", SLOW)
    bench.write(r.TX_ANTD, 0, length=3)
    bench.read(r.TX_BUFFER)
    bench.send(5e-3)
    bench.send(5e-3)
    bench.listen()
    bench.write(r.PMSC_CTRL0, r.SYSCLKS_XTI, length=1)
    bench.write(r.SYS_CTRL, r.RXENAB)
    assert bench.chip.misuse == {
        "transaction-without-header": 1,
        "write-beyond-register": 1,
        "tx-buffer-read": 1,
        "txstrt-while-busy": 1,
        "rxenab-while-busy": 1,
        "radio-without-pll": 1,
    }
