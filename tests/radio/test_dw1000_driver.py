"""The DW1000 driver in C on a scripted bus: bytes against the manual's, numbers against floating point."""

import ctypes
import math
import re
import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.errors import SkylessError
from skyless.radio.dw1000 import radio as dw1000
from skyless.radio.serial import link
from skyless.run.open_radio import open_radios

pytestmark = pytest.mark.site

DEVICE_ID = b"\x30\x01\xca\xde"
OTP = {0x04: 0x28, 0x06: 0x0A0B0C0D, 0x07: 0x01020304, 0x08: 0x7D, 0x09: 0x86, 0x1E: 0x11}
LISTEN_AGAIN = ["w f603 e0", "w f603 f0", "w 8d 0001"]
"""The receiver is reset whenever it was turned off in what may have been a frame."""
FORGET_ALL = ["w 8d 40", "w 8f f8ffff3707"]
DX, FRAME = 0xEFCDABFFFF, bytes(range(100, 240))
U16 = st.integers(0, 0xFFFF)
I16 = st.integers(-0x8000, 0x7FFF)


class ScriptedBus:
    """Registers that answer what was put in, SYS_STATUS cleared by writing ones; one line for each transaction."""

    def __init__(self):
        self.log = []
        self.files = {}
        self.locks = True
        self.after_start = self.after_off = b"\x02\0\0\0\0"
        self.put(0x00, 0, DEVICE_ID)

    def content(self, file):
        return self.files.setdefault(file, bytearray(0x2900 if file == 0x2E else 0x100))

    def put(self, file, sub, data):
        self.content(file)[sub : sub + len(data)] = data

    def take(self):
        lines, self.log = self.log, []
        return lines

    @staticmethod
    def place(head):
        file = head[0] & 0x3F
        if not head[0] & 0x40:
            return file, 0, 1
        if not head[1] & 0x80:
            return file, head[1], 2
        return file, head[1] & 0x7F | head[2] << 7, 3

    def transfer(self, out):
        file, sub, size = self.place(out)
        if out[0] & 0x80:
            self.write(file, sub, out[:size], out[size:])
            return bytes(len(out))
        assert not any(out[size:])
        self.log.append(f"r {out[:size].hex()} {len(out) - size}")
        return bytes(size) + bytes(self.content(file)[sub : sub + len(out) - size])

    def write(self, file, sub, header, data):
        self.log.append(f"w {header.hex()} {data.hex()}")
        if file == 0x0F:
            for at, byte in enumerate(data):
                self.content(file)[sub + at] &= ~byte & 0xFF
            return
        self.put(file, sub, data)
        if file == 0x0D and data[0] & 0x06:
            self.put(0x0F, 0, self.after_start)
        if file == 0x0D and data[0] & 0x40:
            self.put(0x0F, 0, self.after_off)
        if file == 0x2D and sub == 0x06 and data[0] & 2:
            self.put(0x2D, 0x0A, OTP.get(self.files[0x2D][4], 0).to_bytes(4, "little"))
        if file == 0x36 and sub == 0 and data == b"\x00\x02" and self.locks:
            self.put(0x0F, 0, b"\x02\x00\x80\x03\x00")

    def set_spi_fast(self, fast):
        self.log.append("fast" if fast else "slow")

    def reset_chip(self):
        self.log.append("reset")

    def pause_us(self, microseconds):
        self.log.append(f"pause {microseconds}")


def started():
    bus = ScriptedBus()
    chip = dw1000.DW1000(bus)
    chip.start(16436, 0x4042)
    return bus, chip


@pytest.fixture
def listening():
    bus, chip = started()
    chip.receive()
    bus.take()
    return bus, chip


def script_frame(bus, frame):
    """A frame that has come, with values for which the test knows the answers."""
    bus.put(0x11, 0, frame)
    bus.put(0x10, 0, bytes((len(frame), 0xC8, 0x66, 0x07)))  # RXPACC 0x076 = 118
    bus.put(0x12, 0, b"\x30\x00" + b"\x10\x27" + b"\x20\x28" + b"\x50\x46")  # F2 10000, F3 10272, CIR_PWR 18000
    bus.put(0x15, 0, b"\xfe\xff\xff\x12\xff" + b"\x00\x2e" + b"\x08\x25" + bytes(5))  # F1 9480
    bus.put(0x27, 0x28, b"\x00\xf0\xff\x00\x76\x00")  # -4096; NOSAT 118: 5 symbols of SFD
    bus.put(0x0F, 0, b"\x03\x6f\x00\x00\x00")


# Starting


def test_the_chip_is_started_slowly_and_configured_fast():
    """The manual's values, written out by hand low byte first."""
    bus, chip = started()
    lines = bus.log
    fast = lines.index("fast")
    assert lines[:5] == ["slow", "r 00 4", "reset", "pause 5000", "r 00 4"]
    microcode = lines.index("w b6 0103")
    assert lines[microcode : microcode + 7] == [
        "w b6 0103", "w ed06 0080", "pause 300", "w b6 0002", "pause 100", "r 0f 5", "fast",
    ]  # fmt: skip
    assert lines.index("w f603 00") < lines.index("w f603 f0") < microcode
    assert lines[fast + 1 :] == [
        "r 00 4",
        "w 84 00120000", "w 9f 5500484a", "w 88 00c01600",
        "w e304 9b88", "w e30c 07a90225", "w e312 3500",
        "w e702 0100", "w e704 8d00", "w e706 2000", "w e708 6b003b31", "w e720 8100", "w e726 2800",
        "w e80b d8", "w e80c e03f1e00", "w ea0b c0", "w eb07 1d040008", "w eb0b be",
        "w ee8610 6d", "w ee8630 0706", "w ee8450 f428",
        "w 9e 85654525", "w 98 3440", "w ee8430 4240",
        "w 8e 80d03726", *FORGET_ALL,
    ]  # fmt: skip
    assert chip.state == dw1000.IDLE
    assert bus.content(0x0F)[:5] == b"\x02\0\0\0\0"
    bus.take()
    chip.receive()
    assert bus.log == ["w 84 00120000", *FORGET_ALL, *LISTEN_AGAIN]


def test_what_the_maker_measured_is_read_from_otp_and_used():
    lines = started()[0].log
    words = [line.split()[2] for line in lines if line.startswith("w ed04")]
    assert words == ["0400", "0800", "0900", "1e00"]
    assert lines[lines.index("w ed04 0400") : lines.index("w ed04 0800")] == [
        "w ed04 0400", "w ed06 03", "w ed06 00", "r 6d0a 4", "w ed12 02",
    ]  # fmt: skip
    assert "w eb0e 71" in lines  # crystal trim 0x11 with 011 before it


@pytest.mark.parametrize(("stored", "written"), [(0, 0x70), (7, 0x67), (0xFF, 0x7F)])
def test_the_crystals_trim_is_the_makers_or_the_middle(stored, written, monkeypatch):
    monkeypatch.setitem(OTP, 0x1E, stored)
    assert f"w eb0e {written:02x}" in started()[0].log


class SlowOnlyBus(ScriptedBus):
    def set_spi_fast(self, fast):
        super().set_spi_fast(fast)
        self.put(0x00, 0, b"\x98\x80\x65\x6f" if fast else DEVICE_ID)


@pytest.mark.parametrize(
    ("bus", "device", "locks", "words"),
    [
        (ScriptedBus, b"\xff\xff\xff\xfe", True, "no DW1000: its identifier is DECA0130, read was FEFFFFFF"),
        (ScriptedBus, DEVICE_ID, False, "the DW1000's clock does not lock: is its crystal or supply sound?"),
        (SlowOnlyBus, DEVICE_ID, True, "no DW1000 at full speed: its identifier is DECA0130, read was 6F658098"),
    ],
)
def test_what_does_not_start_says_why(bus, device, locks, words):
    bus = bus()
    bus.put(0, 0, device)
    bus.locks = locks
    chip = dw1000.DW1000(bus)
    for _ in range(2):
        with pytest.raises(dw1000.ChipError, match=f"^{re.escape(words)}$"):
            chip.start(0, 0)
    assert chip.state == dw1000.OFF


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()])
def test_what_a_bus_raises_ends_the_call_and_leaves_the_chip_off(listening, error, monkeypatch):
    bus, chip = listening
    calls = []

    def fail(out):
        calls.append(out)
        raise error

    monkeypatch.setattr(bus, "transfer", fail)
    for call in (lambda: chip.transmit_at(0, FRAME[:20]), lambda: chip.start(1, 2)):
        with pytest.raises(type(error)):
            call()
        assert chip.state == dw1000.OFF
    assert len(calls) == 2
    monkeypatch.undo()
    assert chip.poll() == dw1000.LOST
    chip.start(1, 2)
    assert chip.state == dw1000.IDLE


# Receptions


def test_a_frame_is_read_whole_before_the_receiver_goes_on(listening):
    bus, chip = listening
    assert (chip.poll(), bus.take()) == (0, ["r 0f 5"])
    for received, size in enumerate((12, 127), start=1):
        script_frame(bus, bytes(range(size)))
        assert chip.poll() == dw1000.RECEIVED
        assert bus.take() == [
            "r 0f 5", "r 6728 6", "r 10 4", f"r 11 {size}", "r 15 9", "r 12 8", "w 8f 006f000000", "w 8d 0001",
        ]  # fmt: skip
        assert (chip.rx_ticks, chip.frame) == (0xFF12FFFFFE, bytes(range(size)))
        assert (chip.received, chip.errors, chip.state) == (received, 0, dw1000.LISTENING)


def test_what_was_measured_of_a_frame_is_the_manuals_formulas(listening):
    bus, chip = listening
    script_frame(bus, bytes(range(12)))
    chip.poll()
    symbols = 118 - 5
    total = 10 * math.log10(18000 * 2**17 / symbols**2) - 121.74
    first = 10 * math.log10((9480**2 + 10000**2 + 10272**2) / symbols**2) - 121.74
    offset = 4096 * 998.4e6 / 2 / 1024 / 131072 / 6489.6e6 * 1e9
    assert (chip.rx_power_cdbm, chip.first_path_cdbm) == (round(100 * total), round(100 * first))
    assert chip.offset_ppb == round(offset)


ERRORS = {"RXPHE": 12, "RXFCE": 15, "RXRFSL": 16, "RXRFTO": 17, "LDEERR": 18, "RXOVRR": 20, "RXPTO": 21, "RXSFDTO": 26}


@pytest.mark.parametrize("bit", [*ERRORS.values(), 29], ids=[*ERRORS, "AFFREJ"])
def test_after_an_error_the_receiver_is_reset_and_goes_on(listening, bit):
    bus, chip = listening
    bus.put(0x0F, 0, (0x0303 | 1 << bit).to_bytes(5, "little"))
    assert (chip.poll(), chip.errors, chip.state) == (dw1000.FAILED, 1, dw1000.LISTENING)
    assert bus.log == ["r 0f 5", *FORGET_ALL, *LISTEN_AGAIN]


@pytest.mark.parametrize(
    ("status", "size"), [(b"\x03\x4b\0\0\0", 12), (b"\x03\x6f\0\0\0", 2)], ids=["no search", "too short"]
)
def test_a_frame_without_a_stamp_or_an_fcs_is_an_error(listening, status, size):
    bus, chip = listening
    script_frame(bus, bytes(size))
    bus.put(0x0F, 0, status)
    assert (chip.poll(), chip.errors, chip.received) == (dw1000.FAILED, 1, 0)
    assert bus.log.count("pause 20") == (10 if size > 2 else 0)


def test_a_clock_that_slips_is_reported_and_nothing_else_is_cleared(listening):
    bus, chip = listening
    bus.put(0x0F, 0, b"\x02\0\0\x02\0")
    assert chip.poll() == dw1000.CLOCK_SLIPPED
    assert bus.log == ["r 0f 5", "w 8f 0000000200"]


def test_a_chip_that_was_reset_is_lost_and_starts_again(listening):
    bus, chip = listening
    bus.put(0x0F, 0, bytes(5))
    assert (chip.poll(), chip.state) == (0, dw1000.LISTENING)  # its settings are there
    for octet in (0, 0xFF):
        for file in (0x0F, 0x1F):
            bus.put(file, 0, bytes([octet]) * 5)
        assert [chip.poll(), chip.poll()] == [dw1000.LOST, dw1000.LOST]
        assert chip.state == dw1000.OFF
        assert chip.transmit_at(0, bytes(9)) == dw1000.NOT_READY
        bus.put(0x0F, 0, bytes(5))
        chip.start(1, 2)
        assert chip.state == dw1000.IDLE


# Transmissions


def test_a_frame_is_handed_over_before_the_receiver_goes_off_and_its_time_loses_nine_bits(listening):
    bus, chip = listening
    assert (chip.transmit_at(DX, FRAME[3:23]), chip.state) == (dw1000.QUEUED, dw1000.SENDING)
    assert bus.take() == [
        "w 89 " + FRAME[3:21].hex(),  # the chip appends the FCS
        "w 88 14c01600", "w 8a 00feabcdef", *FORGET_ALL, "w 8d 06", "r 0f 5",
    ]  # fmt: skip
    assert (chip.transmit_at(DX, FRAME[:20]), bus.take()) == (dw1000.BUSY, [])
    assert (chip.poll(), bus.take()) == (0, ["r 0f 5"])
    bus.put(0x17, 0, b"\x34\x3e\xac\xcd\xef")
    bus.put(0x0F, 0, b"\xf3\x00\x00\x00\x00")
    assert (chip.poll(), chip.tx_ticks, chip.sent, chip.state) == (dw1000.SENT, 0xEFCDAC3E34, 1, dw1000.LISTENING)
    assert bus.take() == ["r 0f 5", "r 17 5", "w 8f f000000000", *LISTEN_AGAIN]


@pytest.mark.parametrize("status", [b"\x02\0\0\x08\0", b"\x02\0\0\0\x04"], ids=["HPDWARN", "TXPUTE"])
def test_a_frame_that_comes_too_late_is_taken_back(listening, status):
    bus, chip = listening
    bus.after_start = status
    assert (chip.transmit_at(DX, FRAME[:127]), chip.state) == (dw1000.LATE, dw1000.LISTENING)
    assert bus.log[6:] == ["r 0f 5", "w 8d 40", "r 0f 5", *FORGET_ALL, *LISTEN_AGAIN]


@pytest.mark.parametrize(
    ("after_start", "after_off"), [(b"\x82\0\0\0\x04", b"\x02\0\0\0\0"), (b"\x02\0\0\0\x04", b"\x82\0\0\0\0")]
)
def test_a_frame_that_has_left_is_not_called_late(listening, after_start, after_off):
    """Neither when it was out before the status was read, nor when it was out before it could be taken back."""
    bus, chip = listening
    bus.after_start, bus.after_off = after_start, after_off
    assert (chip.transmit_at(DX, FRAME[:3]), chip.state) == (dw1000.QUEUED, dw1000.SENDING)
    assert (chip.poll(), chip.sent) == (dw1000.SENT, 1)


def test_waiting_frames_outlive_receive_and_can_be_taken_back():
    _, chip = started()
    assert chip.transmit_at(0, bytes(20)) == dw1000.QUEUED
    chip.receive()
    assert chip.state == dw1000.SENDING
    assert chip.cancel()
    assert chip.state == dw1000.LISTENING
    assert chip.cancel()
    assert chip.sent == 0


@pytest.mark.parametrize("size", [0, 2, 128])
def test_no_psdu_has_such_a_length(listening, size):
    bus, chip = listening
    with pytest.raises(ValueError, match="3 to 127 bytes"):
        chip.transmit_at(0, bytes(size))
    assert bus.log == []


def test_transactions_per_frame_are_few(listening):
    """Each costs a Raspberry Pi 20 to 100 µs, and 8 octets the board 10 µs."""
    bus, chip = listening
    octets, transfer = [], bus.transfer
    bus.transfer = lambda out: octets.append(len(out)) or transfer(out)
    chip._hardware = dw1000.Hardware(bus)
    chip._functions = ctypes.addressof(chip._hardware)
    costs = []
    script_frame(bus, bytes(100))
    for call in (chip.poll, lambda: chip.transmit_at(0, bytes(100)), chip.poll):
        call()
        costs.append((len(octets), sum(octets)))
        octets.clear()
        bus.put(0x0F, 0, b"\x83\0\0\0\0")
    assert costs[:2] == [(8, 148), (7, 126)]
    assert costs[2][0] == 6
    chip.reads_phases = True
    script_frame(bus, bytes(100))
    assert chip.poll() == dw1000.RECEIVED
    assert (len(octets), sum(octets)) == (12, 165)


# Arithmetic


@given(st.integers(1, 2**30 - 1))
def test_the_logarithm_is_that_of_floating_point(value):
    assert abs(dw1000.library().dw1000_log10(value) - 1e5 * math.log10(value)) < 8


def test_the_logarithm_is_right_where_its_pieces_meet():
    log10 = dw1000.library().dw1000_log10
    for value in [base + step for base in range(0x8000, 0x10000, 0x400) for step in (-1, 0, 1)]:
        assert abs(log10(value) - 1e5 * math.log10(value)) < 8
    meeting = [log10(value) for value in range(0x8000, 0x10001, 0x400)]
    assert meeting == [round(1e5 * math.log10(1 + at / 32)) + 15 * 30103 for at in range(33)]
    assert all(low < high for low, high in pairwise(meeting))


@given(U16, U16, U16, U16, st.integers(0, 0xFFF))
def test_powers_are_the_manuals_formulas(cir_power, f1, f2, f3, symbols):
    c = dw1000.library()
    level = c.dw1000_accumulated(symbols)
    power, first = c.dw1000_power_cdbm(cir_power, level), c.dw1000_first_path_cdbm(f1, f2, f3, level)
    if cir_power == 0 or symbols == 0:
        assert power == dw1000.NOT_MEASURED
    else:
        assert abs(power / 100 - (10 * math.log10(cir_power * 2**17 / symbols**2) - 121.74)) < 0.0081
    if f1 == f2 == f3 == 0 or symbols == 0:
        assert first == dw1000.NOT_MEASURED
    else:
        assert abs(first / 100 - (10 * math.log10((f1**2 + f2**2 + f3**2) / symbols**2) - 121.74)) < 0.012


@given(st.integers(-(2**20), 2**20 - 1))
def test_carrier_offset_is_the_manuals_formula(integrator):
    exact = -integrator * 998.4e6 / 2 / 1024 / 131072 / 6489.6e6 * 1e9
    ppb = dw1000.library().dw1000_carrier_offset_ppb(integrator)
    if ppb == dw1000.NOT_MEASURED:
        assert abs(exact) > 32_760
    else:
        assert abs(ppb - exact) < 0.51 + 2e-5 * abs(exact)
        assert abs(ppb) < 2**15


def turns(vector):
    return math.atan2(vector.imag, vector.real) / (2.0 * math.pi)


def distance_turns(one, other):
    return abs((one - other + 0.5) % 1.0 - 0.5)


@given(I16, I16)
def test_the_angle_is_that_of_floating_point(x, y):
    angle = dw1000.library().dw1000_angle(x, y)
    assert 0 <= angle < 2**16
    if x or y:
        assert distance_turns(angle / 2**16, turns(complex(x, y))) <= 2**-15


def test_the_angle_is_right_where_its_pieces_meet():
    at_45 = [(9, 0, 0), (9, 9, 1), (0, 9, 2), (-9, 9, 3), (-9, 0, 4), (-9, -9, 5), (0, -9, 6), (9, -9, 7)]
    steps = [(dw1000.library().dw1000_angle(x, y) - k * 2**13 + 2**15) % 2**16 - 2**15 for x, y, k in at_45]
    assert max(map(abs, steps)) <= 1
    assert all(
        distance_turns(dw1000.library().dw1000_angle(x, y) / 2**16, turns(complex(x, y))) <= 2**-15
        for x in (-32768, 32767) for step in range(33) for y in range(1024 * step - 2, min(1024 * step + 3, 32768))
    )  # fmt: skip


@given(I16, I16, st.integers(0, 127), U16, st.one_of(U16, st.integers(0, 200)))
def test_the_phase_is_the_angle_of_the_sample_behind_the_first_path_less_rcphase(x, y, rcphase, first_path, noise):
    bus, chip = started()
    chip.reads_phases = True
    chip.receive()
    bus.take()
    script_frame(bus, FRAME[:20])
    at = (first_path >> 6) + 1
    bus.put(0x12, 0, noise.to_bytes(2, "little"))
    bus.put(0x14, 4, bytes((rcphase,)))
    bus.put(0x15, 5, first_path.to_bytes(2, "little"))
    bus.files[0x25] = bytearray(b"\x55" * 0x1100)
    bus.put(0x25, 4 * at, b"\xff" + struct.pack("<2h", x, y))
    assert chip.poll() == dw1000.RECEIVED
    log = bus.take()
    assert log[-1] == "w 8d 0001"  # the receiver comes on at last
    if at >= 1016:
        assert chip.phase == dw1000.NO_PHASE
        assert not any(line.startswith("w b6") for line in log)
    else:
        begin = log.index("w b6 4882")
        assert log[begin + 1].startswith("r 65") and log[begin + 2] == "w b6 0002"
        if x * x + y * y <= 9 * noise * noise:
            assert chip.phase == dw1000.NO_PHASE
        else:
            assert distance_turns(chip.phase / 2**16, turns(complex(x, y)) - rcphase / 128) <= 2**-15
    assert 0 <= chip.phase < 2**16 or chip.phase == dw1000.NO_PHASE


def test_phases_are_read_only_where_they_are_asked_for(listening):
    bus, chip = listening
    script_frame(bus, FRAME[:20])
    assert chip.poll() == dw1000.RECEIVED
    assert chip.phase == dw1000.NO_PHASE
    assert not any(line.startswith(("w b6", "r 65", "r 54")) for line in bus.take())


@given(st.integers(0, 2**40 - 1), st.integers(-(2**39) + 2**17, 2**39 - 2**17))
def test_the_time_to_a_stamp_goes_the_short_way_round(now, distance):
    steps = dw1000.library().dw1000_micros_until(now, (now + distance) % 2**40)
    assert abs(steps - distance / 65536) < 1


@pytest.mark.parametrize("references", [(0x7D, 0x86), (0, 0)])
def test_temperature_and_supply_are_the_manuals_formulas(references, monkeypatch):
    """UM pp. 158-159; with typical values where the chip has none of its own."""
    for address, value in zip((0x08, 0x09), references, strict=True):
        monkeypatch.setitem(OTP, address, value)
    bus, chip = started()
    chip.receive()
    bus.take()
    bus.put(0x2A, 0x03, bytes((175, 122)))
    assert chip.measure()
    assert bus.take() == [
        *FORGET_ALL, "w e811 80", "w e812 0a", "w e812 0f", "w aa 00", "w aa 01", "pause 1000", "r 6a03 1", "r 6a04 1",
        "w aa 00", *FORGET_ALL, *LISTEN_AGAIN,
    ]  # fmt: skip
    if any(references):
        expected = math.floor(1000 * ((175 - 0x7D) / 173 + 3.3)), round(100 * ((122 - 0x86) * 1.14 + 23))
        assert (chip.millivolts, chip.temperature_cc) == expected
    else:
        assert (chip.millivolts, chip.temperature_cc) == pytest.approx((3300, 2486), abs=100)


# Between Python and C


def test_results_and_reasons_have_the_same_values_in_python_and_on_the_link():
    header = (dw1000.SOURCES / "dw1000.h").read_text("utf-8")
    known = dict(re.findall(r"#define DW1000_(\w+) \(?(-?\w+?)u?\)?$", header, re.MULTILINE))
    known |= dict(re.findall(r"DW1000_(\w+) = (\d)", header))
    states = re.search(r"enum dw1000_state \{(.+?)\}", header)[1].split(", ")
    known |= {name.strip().removeprefix("DW1000_"): str(number) for number, name in enumerate(states)}
    assert len(known) > 14
    assert {name: getattr(dw1000, name) for name in known} == {name: int(value, 0) for name, value in known.items()}
    assert (dw1000.LATE, dw1000.BUSY, dw1000.NOT_READY) == (
        link.LATE_FOR_RADIO, link.LATE_BUSY, link.LATE_NOT_READY
    )  # fmt: skip


@pytest.fixture
def uncompiled(monkeypatch, tmp_path):
    """As on a computer where the driver has never been used."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    dw1000.library.cache_clear()
    yield tmp_path
    dw1000.library.cache_clear()


def test_the_driver_is_compiled_once(uncompiled, monkeypatch):
    dw1000.library()
    (made,) = uncompiled.rglob("*.so")
    dw1000.library.cache_clear()
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("it is compiled again"))
    dw1000.library()
    assert list((uncompiled / "skyless").iterdir()) == [made]


@pytest.mark.parametrize(
    ("compiler", "words"),
    [
        ("cc-of-nobody", r"there is no C compiler cc-of-nobody: install one \(.*sudo apt install gcc"),
        ("false", r"does not compile \(false\)"),
    ],
)
def test_a_compiler_that_is_missing_or_fails_is_named(uncompiled, monkeypatch, compiler, words):
    monkeypatch.setenv("CC", compiler)
    with pytest.raises(SkylessError, match=words):
        open_radios("model:127.0.0.1", "tag", ("tag1",))


def test_a_cache_folder_that_cannot_be_made_is_named(uncompiled, monkeypatch):
    (uncompiled / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(uncompiled / "file"))
    with pytest.raises(SkylessError, match=r"file/skyless .*XDG_CACHE_HOME should name a folder"):
        dw1000.library()
