"""What a tag without a computer needs of its processor: long sleep, settings, Bluetooth, a receiver in windows."""

import random

import pytest
from processor_stage import build_board, needs_processor

from skyless.core.air.frame import Diagnostics, after_rmarker_s, fcs
from skyless.core.ticks import from_seconds, wrap

pytest.importorskip("unicorn")

from emulator.build import build
from emulator.processor.lone_board import LoneBoard

pytestmark = [pytest.mark.site, needs_processor]

RECEIVED, NOTHING = 0x01, 0x20
DATA = bytes((2, 1, 6, 17, 0xFF, 0xFF, 0xFF)) + bytes(range(14))
FRAME = bytes(98) + fcs(bytes(98))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


def words(data):
    return [int.from_bytes(data[at : at + 4], "little") for at in range(0, len(data), 4)]


def is_sound(stage):
    return stage.image.misuse.total() == stage.chip.misuse.total() == len(stage.image.core.faults) == 0


# Sleep


@pytest.mark.parametrize("milliseconds", [1, 1000, 3_600_000])
def test_the_clock_goes_on_over_long_sleeps_in_which_nothing_draws_current(folder, milliseconds):
    """Within the slow clock's period of 31 us at both ends; two sleeps of an hour, which the clock's wrap allows."""
    stage = LoneBoard(build_board(folder, "LONG_SLEEP", MILLISECONDS=f"{milliseconds}u"))
    stage.run(0.301)
    for _ in range(20):
        stage.run(2e-3 * milliseconds / 20)
        if stage.image.is_asleep and milliseconds > 1 and len(stage.sent) < 16:
            assert not stage.image.drawing
    stage.run(0.1)
    before, after, again, end = words(stage.sent)
    for begin, over in ((before, after), (again, end)):
        assert 0 <= (over - begin - 1000 * milliseconds + 100) % 2**32 <= 100 + 600  # the crystal starts in 360 us
    begin_us, end_us = stage.lines[0][0], stage.lines[-1][0]  # a word may come in two parts
    assert (end - before) % 2**32 == pytest.approx((end_us - begin_us) % 2**32, abs=150.0)
    stage.write(b"x")
    stage.run(1e-3)
    assert stage.sent[-1:] == b"x"  # the serial port works again
    assert stage.image.resets == {}
    assert is_sound(stage)


def test_a_chip_that_sleeps_when_the_processor_restarts_is_woken():
    stage = LoneBoard(build("all"))
    stage.run(5e-3)
    for octets in ("ec0a0000", "ec0605", "ec0202"):  # no counter; SLEEP_EN and WAKE_SPI; SAVE
        stage.chip.transfer(bytes.fromhex(octets), 2_000_000)
    stage.run(0.1)
    stage.image.pull_reset_pin()
    stage.run(5e-3)
    assert stage.chip.asleep_s == pytest.approx(0.1, abs=5e-3)  # until the driver has started
    assert is_sound(stage)


# Settings


def test_settings_survive_restarts_and_a_cut_at_any_write(folder):
    """After a cut there are the new ones, or none; never half of them."""
    elf = build_board(folder, "SETTINGS")
    stage = LoneBoard(elf)
    stage.run(5e-3)
    assert stage.sent[0] == 0
    write(stage, 0x11)
    assert stage.sent[-1] == 0x11
    assert restarted(stage) == b"\1\x11"
    seen = set()
    for cut_us in [1000.0, 60_000.0, *(85_000.0 + 20.0 + 56.0 * number for number in range(19))]:
        stage = LoneBoard(elf)
        stage.run(5e-3)
        write(stage, 0x11)
        write(stage, 0x22, seconds=1e-6 * cut_us)
        if cut_us < 85_000.0:  # what a page holds that was not erased completely, nobody knows
            garbage = random.Random(cut_us)
            stage.image.settings.registers |= {at: garbage.getrandbits(32) for at in range(0, 4096, 4)}
        found = restarted(stage)
        assert found[0] == 0 or found == b"\1\x22"
        seen.add(found[0])
        write(stage, 0x33)
        assert restarted(stage) == b"\1\x33"
    assert seen == {0, 1}
    assert is_sound(stage)


def write(stage, value, seconds=0.1):
    stage.write(bytes((value,)))
    stage.run(10e-6 + seconds)


def restarted(stage):
    """What is sent after the supply was off."""
    sent = len(stage.sent)
    stage.image.power_cycle()
    stage.run(0.1)  # an erasure that was cut off is over by then
    return stage.sent[sent:]


# Bluetooth, by the Core Specification (vol. 6, part B, 2 and 3)


def whitening(channel, count):
    """The sequence of x^7 + x^4 + 1: each bit is the sum of those three and seven before it."""
    p = [1, *(channel >> at & 1 for at in reversed(range(6)))]
    bits = [p[6], p[5], p[4], p[3] ^ p[6], p[2] ^ p[5], p[1] ^ p[4], p[0] ^ p[3] ^ p[6]]
    while len(bits) < count:
        bits.append(bits[-3] ^ bits[-7])
    return bits


def octets(bits):
    return bytes(sum(bit << at for at, bit in enumerate(bits[begin : begin + 8])) for begin in range(0, len(bits), 8))


def heard(packet):
    """What a phone gets of a packet: channel, header, address and data; None where it is not for it."""
    bits = list(packet.bits)
    channel = {2402: 37, 2426: 38, 2480: 39}.get(packet.frequency_mhz)
    if channel is None or octets(bits[:40]) != bytes.fromhex("aad6be898e"):  # the preamble begins as the address does
        return None
    bits = [bit ^ white for bit, white in zip(bits[40:], whitening(channel, len(bits)), strict=False)]
    header = octets(bits[:16])
    end = 16 + 8 * header[1]
    if len(bits) != end + 24:
        return None
    value, polynomial = int("".join(map(str, bits[:end])), 2) ^ 0x555555 << end - 24, 0x100065B
    value <<= 24
    for at in reversed(range(24, end + 24)):
        value ^= polynomial << at - 24 if value >> at & 1 else 0
    if value != int("".join(map(str, bits[end:])), 2):
        return None
    return channel, header[0], octets(bits[16:64]), octets(bits[64:end])


def test_the_whitening_is_that_of_published_captures():
    assert octets(whitening(37, 128)).hex() == "8dd257a13da766b07531114896" + "77f8e3"


def test_an_advertisement_is_sent_on_three_channels_as_a_phone_expects_it(folder):
    stage = LoneBoard(build_board(folder, "ADVERTISE", DATA=",".join(map(str, DATA))))
    stage.run(10e-3)
    assert words(stage.sent) == [1, 0, 1]
    packets = stage.image.advertised
    assert [heard(packet) for packet in packets] == [
        (channel, 0x42, bytes.fromhex("efcdab8923c1"), DATA) for channel in (37, 38, 39, 37, 38, 39)
    ]
    assert {packet.txpower for packet in packets} == {0}
    begins_us = [packet.begin_cycles / 64 for packet in packets[:3]]
    assert begins_us[2] - begins_us[0] < 2 * (len(packets[0].bits) + 60)
    assert is_sound(stage)


@pytest.mark.parametrize(
    ("register", "wrong"),
    [
        (0x508, 3),
        (0x514, 0x008),
        (0x518, 0x00030025),
        (0x51C, 0),
        (0x524, 0x8F),
        (0x534, 3),
        (0x538, 0x65A),
        (0x53C, 0),
        (0x554, 36),
    ],
)
def test_a_wrong_register_is_a_packet_that_no_phone_receives(folder, register, wrong):
    stage = LoneBoard(build_board(folder, "ADVERTISE", DATA=",".join(map(str, DATA))))
    set_up = stage.image.radio.enable

    def enable():
        stage.image.radio.registers[register] = wrong
        set_up()

    stage.image.radio.tasks[0] = enable
    stage.run(5e-3)
    assert len(stage.image.advertised) == 3
    assert all(heard(packet) is None for packet in stage.image.advertised)


# A receiver in windows


@pytest.mark.parametrize("comes", [True, False])
def test_a_window_on_the_emulated_board(folder, comes):
    """The interrupt of the frame, or of the window's end, wakes the processor; what each step takes is the page's."""
    stage = LoneBoard(build_board(folder, "WINDOW"))
    stage.run(1.3)
    while len(stage.sent) < 16:
        stage.run(0.01e-3)
    start_us, sleep_us, wake_us, ask_us = words(stage.sent[:16])
    assert wake_us < 6800 < start_us < 8500
    assert sleep_us < 150
    assert ask_us < 150
    assert stage.chip.asleep_s == pytest.approx(1.0, abs=5e-3)
    if comes:
        stage.run(3.2e-3 - ask_us * 1e-6)
        stamp = wrap(stage.timeline.now_ticks - from_seconds(after_rmarker_s(len(FRAME))))
        stage.chip.receive(FRAME, stamp, Diagnostics())
        stage.image.notify()
    stage.run(4e-3)
    came_us, events, *more = words(stage.sent[16:])
    assert events == (RECEIVED if comes else NOTHING)
    assert more[1::2] in ([], [0])  # the line falls some us after the poll
    assert comes or came_us == pytest.approx(3077 + 410, abs=40)
    assert is_sound(stage)
