"""The DW1000 driver on a scripted bus: bytes against the manual's, numbers against floating point."""

import math

import numpy as np
import pytest
import scripted_chip
from hypothesis import given
from hypothesis import strategies as st

from skyless.radios.dw1000 import driver as dw1000
from skyless.simulation.channel import power_bias_m

LISTEN_AGAIN = ["w f603 e0", "w f603 f0", "w 8d 0001"]
"""The receiver is reset whenever it was turned off in what may have been a frame."""
SPEED_OF_LIGHT = 299_702_547.0  # in air, as Decawave's notes have it
TICK_M = SPEED_OF_LIGHT / (128 * 499.2e6)


@pytest.fixture(scope="module")
def here():
    """What the driver does in its life, as lines by name."""
    return scripted_chip.Story().lines


def test_headers_are_those_of_the_manuals_examples():
    """UM figures 3, 5 and 7 (pp. 12-13)."""
    assert dw1000.header(False, 0x00, 0) == b"\x00"
    assert dw1000.header(False, 0x00, 2) == b"\x40\x02"
    assert dw1000.header(True, 0x09, 0x136) == b"\xc9\xb6\x02"


@given(st.booleans(), st.integers(0, 0x3F), st.integers(0, 0x7FFF))
def test_headers_can_be_read_back(is_write, file, sub):
    head = dw1000.header(is_write, file, sub)
    assert (head[0] >> 7, head[0] & 0x3F) == (is_write, file)
    assert len(head) == 1 + bool(head[0] & 0x40) + (len(head) > 1 and head[1] >> 7)
    assert sub == (0 if len(head) == 1 else head[1] & 0x7F | (head[2] << 7 if len(head) == 3 else 0))


def test_the_chip_is_started_slowly_and_configured_fast(here):
    """The manual's values, written out by hand low byte first."""
    lines = here["start"]
    fast = lines.index("fast")
    assert lines[:4] == ["slow", "reset", "pause 5000", "r 00 4"]
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
        "w 8e 80d03726", "w 8d 40", "w 8f f8ffff3707",
    ]  # fmt: skip


def test_what_the_maker_measured_is_read_from_otp_and_used(here):
    lines = here["start"]
    words = [line.split()[2] for line in lines if line.startswith("w ed04")]
    assert words == ["0400", "0800", "0900", "0600", "0700", "1e00"]
    assert lines[lines.index("w ed04 0400") : lines.index("w ed04 0800")] == [
        "w ed04 0400", "w ed06 03", "w ed06 00", "r 6d0a 4", "w ed12 02",
    ]  # fmt: skip
    assert "w eb0e 71" in lines  # crystal trim 0x11 with 011 before it
    assert here["state"] == ["1 0d0c0b0a04030201 0200000000"]


@pytest.mark.parametrize(
    ("given_trim", "stored", "written"), [(None, 0, 0x70), (None, 7, 0x67), (0, 7, 0x60), (31, 7, 0x7F)]
)
def test_the_crystals_trim_is_the_given_one_or_the_makers_or_the_middle(given_trim, stored, written, monkeypatch):
    monkeypatch.setitem(scripted_chip.OTP, 0x1E, stored)
    bus = scripted_chip.ScriptedBus()
    dw1000.DW1000(bus).start(0, 0, crystal_trim=given_trim)
    assert f"w eb0e {written:02x}" in bus.log


def test_a_frame_is_read_whole_before_the_receiver_goes_on(here):
    first, second = here["rx"][:8], here["rx"][8:]
    assert first == [
        "r 0f 5", "r 10 4", "r 11 12", "r 15 9", "r 12 8", "r 6728 6", "w 8f 006f000000", "w 8d 0001",
    ]  # fmt: skip
    assert second[2] == "r 11 127"
    assert here["quiet"] == ["0 ['r 0f 5']"]
    assert here["unmeasured"] == ["-32768 -32768 -32768"]
    assert here["short"] == ["1 ['r 0f 5', 'r 10 4', 'r 11 9', 'r 15 9', 'w 8f 006f000000', 'w 8d 0001']"]


def test_what_was_measured_of_a_frame_is_the_manuals_formulas(here):
    stamp, frame, *counts = here["got"][0].split()
    assert stamp == "feffff12ff"
    assert frame == bytes(range(12)).hex()
    assert counts == ["1", "0"]
    symbols = 118 - 5
    total = 10 * math.log10(18000 * 2**17 / symbols**2) - 121.74
    first = 10 * math.log10((9480**2 + 10000**2 + 10272**2) / symbols**2) - 121.74
    offset = 4096 * 998.4e6 / 2 / 1024 / 131072 / 6489.6e6 * 1e9
    power, path, integrator, ppb = map(int, here["got"][1].split())
    assert (power, path) == (round(100 * total), round(100 * first))
    assert (integrator, ppb) == (-4096, round(offset))
    late_m = power_bias_m(power / 100)
    assert here["corrected"] == [f"1 {((0xFF12FFFFFE - round(late_m / TICK_M)) % 2**40).to_bytes(5, 'little').hex()}"]


def test_a_frame_is_handed_over_before_the_receiver_goes_off_and_its_time_loses_nine_bits(here):
    assert here["queued"] == ["0 3"]
    assert here["tx"] == [
        "w 89 " + bytes(range(103, 121)).hex(),  # the chip appends the FCS
        "w 88 14c01600", "w 8a 00feabcdef", "w 8d 40", "w 8f f8ffff3707", "w 8d 06", "r 0f 5",
    ]  # fmt: skip
    assert here["busy"] == ["2 []"]
    assert here["waiting"] == ["0 ['r 0f 5']"]
    assert here["sent"] == ["2 343eaccdef 1 2"]
    assert here["done"] == ["r 0f 5", "r 17 5", "w 8f f000000000", *LISTEN_AGAIN]


def test_a_frame_that_comes_too_late_is_taken_back(here):
    taken_back = ["r 0f 5", "w 8d 40", "r 0f 5", "w 8d 40", "w 8f f8ffff3707", *LISTEN_AGAIN]
    assert here["late"] == ["1 2 1", *taken_back]
    assert here["unready"] == ["1 2 2", *taken_back]


def test_a_frame_that_has_left_is_not_called_late(here):
    """Neither when it was out before the status was read, nor when it was out before it could be taken back."""
    assert here["gone"] == ["0 3 2", "r 0f 5"]
    assert here["race"] == ["0 3 2 2 3"]


def test_each_error_resets_the_receiver_and_listens_on(here):
    told = [line for line in here["failed"] if line[0].isdigit()]
    assert [line.split()[2:] for line in told] == [["4", str(count), "2"] for count in range(1, 10)]
    recovery = ["r 0f 5", "w 8d 40", "w 8f f8ffff3707", *LISTEN_AGAIN]
    assert [line for line in here["failed"] if not line[0].isdigit()] == 9 * recovery


def test_a_chip_that_forgot_or_does_not_answer_is_lost(here):
    assert here["still"] == ["there 0 2"]
    assert here["lost"] == ["16 0 16 3"]
    assert here["slip"] == ["8 ['r 0f 5', 'w 8f 0000000200']"]


@pytest.mark.parametrize("octet", [0x00, 0xFF])
def test_a_bus_with_nothing_on_it_is_a_lost_chip(octet):
    bus, chip = scripted_chip.started()
    chip.receive()
    for file in (0x0F, 0x1F):
        bus.put(file, 0, bytes([octet]) * 5)
    assert chip.poll() == dw1000.LOST
    assert chip.state == dw1000.OFF
    bus.put(0x0F, 0, bytes(5))
    chip.start(1, 2)
    assert chip.state == dw1000.IDLE


def test_what_does_not_start_says_why(here):
    assert here["refused"][0].startswith("no DW1000: its identifier is DECA0130, read was FFFFFFFF 3")
    assert "does not lock" in here["refused"][1]
    assert [line.split()[0] for line in here["refused"][2:]] == ["0", "2", "128"]


def test_waiting_frames_outlive_receive_and_can_be_taken_back():
    _, chip = scripted_chip.started()
    assert chip.transmit_at(0, bytes(20)) == dw1000.QUEUED
    chip.receive()
    assert chip.state == dw1000.SENDING
    assert chip.cancel()
    assert chip.state == dw1000.LISTENING
    assert chip.cancel()
    chip.stop()
    assert chip.state == dw1000.IDLE
    assert chip.late == chip.sent == 0


def test_transactions_per_frame_are_few(here):
    """Each costs a Raspberry Pi 20 to 100 µs, and 8 octets the board 10 µs."""
    counts = [int(line.split()[1]) for name in ("received", "finished") for line in here[name]]
    assert counts == [8, 6]
    assert here["handed"] == ["over in 7 transactions 126 octets"]


U16 = st.integers(0, 0xFFFF)


@given(st.integers(1, 2**30 - 1))
def test_the_logarithm_is_that_of_floating_point(value):
    assert abs(dw1000.log10(value) - 1e5 * math.log10(value)) < 8


def test_the_logarithm_is_right_where_its_pieces_meet():
    for value in [base + step for base in range(0x8000, 0x10000, 0x400) for step in (-1, 0, 1)]:
        assert abs(dw1000.log10(value) - 1e5 * math.log10(value)) < 8


@given(U16, st.integers(-5, 0xFFF))
def test_received_power_is_the_manuals_formula(cir_power, symbols):
    power = dw1000.power_cdbm(cir_power, dw1000.accumulated(symbols))
    if cir_power == 0 or symbols <= 0:
        assert power == dw1000.NOT_MEASURED
    else:
        assert abs(power / 100 - (10 * math.log10(cir_power * 2**17 / symbols**2) - 121.74)) < 0.0081


@given(U16, U16, U16, st.integers(0, 0xFFF))
def test_first_path_power_is_the_manuals_formula(f1, f2, f3, symbols):
    power = dw1000.first_path_cdbm(f1, f2, f3, dw1000.accumulated(symbols))
    if f1 == f2 == f3 == 0 or symbols == 0:
        assert power == dw1000.NOT_MEASURED
    else:
        exact = 10 * math.log10((f1**2 + f2**2 + f3**2) / symbols**2) - 121.74
        assert abs(power / 100 - exact) < 0.012


@given(st.integers(-(2**20), 2**20 - 1))
def test_carrier_offset_is_the_manuals_formula(integrator):
    exact = -integrator * 998.4e6 / 2 / 1024 / 131072 / 6489.6e6 * 1e9
    ppb = dw1000.carrier_offset_ppb(integrator)
    if ppb == dw1000.NOT_MEASURED:
        assert abs(exact) > 32_760
    else:
        assert abs(ppb - exact) < 0.51 + 2e-5 * abs(exact)
        assert abs(ppb) < 2**15


@given(st.integers(-32768, 0))
def test_the_bias_is_that_of_the_note(power_cdbm):
    """Within half a tick of the table that the emulation has, 2.3 mm."""
    assert abs(dw1000.bias_ticks(power_cdbm) - power_bias_m(power_cdbm / 100) / TICK_M) < 0.55


def test_temperature_and_supply_are_the_manuals_formulas(here):
    """UM pp. 158-159; with typical values where the chip has none of its own."""
    assert here["measured"] == [
        f"{round(100 * ((0 - 0x86) * 1.14 + 23))} {math.floor(1000 * ((0 - 0x7D) / 173 + 3.3))}"
    ]
    chip = dw1000.DW1000(scripted_chip.ScriptedBus())
    chip._convert(175, 122)
    assert (chip.millivolts, chip.temperature_cc) == pytest.approx((3300, 2486), abs=100)


def test_the_tables_pieces_are_logarithms():
    assert list(dw1000._LOG10) == [round(1e5 * value) for value in np.log10(1 + np.arange(33) / 32)]
