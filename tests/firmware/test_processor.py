"""The emulated nRF52832 and the firmware on it.

Small programs whose behaviour is known by the processor's specification, counted by hand; what a tag without a computer
needs: long sleep, settings, Bluetooth, a receiver in windows; and the whole firmware.
"""

import random
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest
from cobs import cobs
from emulator.build import FIRMWARE, build
from firmware_stage import ASK_STATUS, CONFIG, RX_ON, STACK_BYTES, TX_AT, frame_of, line_of, needs_processor
from msgspec.structs import replace

from skyless.core.air.frame import Diagnostics, after_rmarker_s
from skyless.core.native.library import SOURCE
from skyless.core.ticks import TICK_S, from_seconds, wrap
from skyless.radio.dw1000.radio import SOURCES
from skyless.radio.serial.link import BoardSettings, decode, pack
from skyless.sim.dw1000 import registers as r
from support.bench import ROOM, tape

pytest.importorskip("unicorn")

from emulator.processor import peripherals
from emulator.processor.cortex_m4 import EmulationError
from emulator.processor.lone_board import DELAYS, IDENTITY, LoneBoard
from emulator.processor.nrf52832 import LED_PINS

pytestmark = [pytest.mark.site, needs_processor]

AWAKE_PIN = 15
RECEIVED, NOTHING = 0x01, 0x20
DATA = bytes((2, 1, 6, 17, 0xFF, 0xFF, 0xFF)) + bytes(range(14))
WATCHDOG, SOFTWARE, LOCKUP = 2, 4, 8
"""Bits of RESETREAS."""


HARDWARE = ("startup", "main", "clock", "serial_port", "flash", "bluetooth", "link", "settings")
OF_BOARD = [*((FIRMWARE / "source" / name).with_suffix(".c") for name in HARDWARE), SOURCES / "dw1000.c"]
"""The firmware's hardware functions, with which board_programs.c is linked."""
COMMAND = [
    "arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-O2", "-std=gnu11",
    "-ffreestanding", "-nostdlib", "-w", "-fno-tree-loop-distribute-patterns", "-DSKYLESS_FLOAT",
    '-DSKYLESS_VERSION="0"',
    "-include", FIRMWARE / "source" / "core_sizes.h", "-T", FIRMWARE / "dwm1001.ld",
    *(f"-I{folder}" for folder in (FIRMWARE / "source", SOURCES, SOURCE.parent)),
]  # fmt: skip
FRAME = frame_of(range(100))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """A function that compiles one of the programs beside this file, once with the same macros."""
    folder, begin = tmp_path_factory.mktemp("programs"), Path(__file__).with_name

    @cache
    def make(name, **macros):
        is_of_board = name in {"LONG_SLEEP", "SETTINGS", "ADVERTISE", "WINDOW"}
        files = [begin("board_programs.c"), *OF_BOARD] if is_of_board else [begin("processor_programs.c")]
        elf = folder / f"{name}-{len(list(folder.iterdir()))}.elf"
        definitions = [f"-D{key}={value}" for key, value in {"PROGRAM": name, **macros}.items()]
        subprocess.run([*COMMAND, *definitions, *files, "-lgcc", "-o", elf], check=True)
        return elf

    return make


@pytest.fixture
def start(program):
    """A function that makes a board with a program, or with the firmware, and lets so much time pass."""

    def make(seconds=None, name=None, clock_ppm=0.0, can_transmit=True, revision=5, baud=1_000_000, **macros):
        elf = build("all") if name is None else program(name, **macros)
        stage = LoneBoard(elf, clock_ppm=clock_ppm, can_transmit=can_transmit, revision=revision, baud=baud)
        if seconds:
            stage.run(seconds)
        return stage

    return make


def words(data):
    return [int.from_bytes(data[at : at + 4], "little") for at in range(0, len(data), 4)]


def receive(stage):
    """The end of a frame is now; its stamp."""
    stamp = wrap(stage.timeline.now_ticks - from_seconds(after_rmarker_s(len(FRAME))))
    stage.chip.receive(FRAME, stamp, Diagnostics())
    stage.image.notify()
    return stamp


def ask_to_send(stage, ahead_s, number, before=b""):
    """A frame to be sent; its time, as the chip takes it."""
    dx = wrap(stage.timeline.now_ticks + from_seconds(ahead_s)) & ~0x1FF
    stage.write(before + line_of(TX_AT, dx.to_bytes(5, "little") + FRAME, number))
    return dx


def end_sending(stage):
    stage.chip.transceiver.finish()
    stage.image.notify()
    stage.run(1e-3)


def is_sound(stage):
    return stage.image.misuse.total() == stage.chip.misuse.total() == len(stage.image.core.faults) == 0


# The line


def test_bytes_take_their_time_both_ways(start):
    stage = start(1e-3, "START")
    assert stage.sent == b"\0"
    for value in (10, 20, 255):
        arrived_us = stage.write(bytes((value,)))
        stage.run(1e-3)
        came_us, data = stage.lines[-1]
        assert data == bytes(((value + 1) & 0xFF,))
        assert 13.0 < came_us - arrived_us < 16.0  # 3 µs to wake up, some instructions, 10 µs on the line
    assert stage.image.misuse.total() == 0


def test_a_long_transfer_arrives_record_by_record(start):
    (zero_us, zero), (hello_us, hello) = start(5e-3).lines
    assert zero == b"\0"
    assert hello[-1] == 0
    assert 0 not in hello[:-1]
    assert hello_us - zero_us >= 10.0 * len(hello) - 0.1


def test_the_ring_goes_round_without_the_processor(start):
    stage = start(1e-3, "RING")
    total = 0
    for length in (3, 254, 255, 256, 700):
        data = bytes(1 + at % 250 for at in range(length - 1)) + b"\0"
        stage.write(data)
        stage.run(length * 10e-6 + 1e-3)
        total += length
        assert stage.sent[-7:] == total.to_bytes(4, "little") + data[-3:]
        assert len(stage.lines[-1][1]) >= 1
    assert stage.image.misuse.total() == 0


def test_what_comes_to_a_receiver_that_is_off_is_lost_and_counted(start):
    stage = start(1e-3, "SLEEP")
    stage.write(b"abc")
    stage.run(1e-3)
    assert stage.image.misuse == {"uarte-byte-lost": 3}


# The chip


def test_the_chip_answers_over_spi_and_its_line_wakes_the_processor(start):
    stage = start(2e-3, "CHIP")
    assert stage.sent == r.DEV_ID.reset.to_bytes(4, "little")
    (came_us, _), *_ = stage.lines
    assert came_us > 8 * 5 / 2.0 + 40.0  # five bytes at 2 Mbit/s, four on the line
    assert stage.image.is_asleep
    assert not stage.chip.irq
    stage.chip.memory.set(r.SYS_CFG, r.HIRQ_POL)
    stage.chip.memory.set(r.SYS_MASK, r.CPLOCK)
    stage.chip.transceiver.raise_bits(r.CPLOCK)
    stage.image.notify()
    stage.run(1e-3)
    assert stage.sent[4:6] == b"\1\1"
    assert int.from_bytes(stage.sent[6:], "little") & r.CPLOCK
    assert 23e-6 < stage.image.worst_latency_s < 30e-6  # two bytes are sent before the transfer
    assert stage.chip.misuse.total() == stage.image.misuse.total() == 0


# Time


@pytest.mark.parametrize("clock_ppm", [0.0, 40.0])
def test_the_timer_ends_sleeps(start, clock_ppm):
    stage = start(10e-3, "SLEEP", clock_ppm=clock_ppm)
    slept = words(stage.sent)
    assert 1003 <= slept[0] <= 1006  # 3 µs to wake up
    assert 53 <= slept[1] <= 56 + 51  # and the first word on the line
    (first_us, _), *_ = stage.lines
    assert first_us > (1000 + 50) * (1 + 1e-6 * clock_ppm)
    busy = stage.image.busy_share
    assert 0.0 < busy < 0.03


@pytest.mark.parametrize("macros", [{}, {"AWAKE": 1}])
def test_a_watchdog_that_is_not_fed_resets_and_a_power_cycle_leaves_no_cause(start, macros):
    stage = start(36e-3, "WATCHDOG", **macros)
    assert stage.sent == b"\0"
    stage.run(36e-3)
    assert stage.sent == bytes((0, WATCHDOG))
    (start_us, _), (again_us, _) = stage.lines
    assert again_us - start_us == pytest.approx(27e3 + 328 / 32768 * 1e6, abs=60.0)
    assert stage.image.resets == {"watchdog": 1}
    stage.image.power_cycle()
    stage.run(5e-3)
    assert stage.sent == bytes((0, WATCHDOG, 0))


# Faults

UNDEFINED = '__asm volatile("udf #0")'


@pytest.mark.parametrize(
    ("forbidden", "address"),
    [
        ("(void)REGISTER(0x90000000u)", "0x90000000"),
        (UNDEFINED, "PC 0x"),
        ("REGISTER(0x00000100u)=1u", "0x00000100"),
        ("((void(*)(void))0x60000001u)()", "0x60000000"),
        ('__asm volatile("vmov.f32 s0, #1.0")', "PC 0x"),  # with the floating-point unit still off
    ],
)
def test_a_fault_ends_in_its_handler(start, forbidden, address):
    stage = start(5e-3, "FAULT", FORBIDDEN=forbidden)
    assert stage.sent[0] == 0
    assert stage.sent[2:] == bytes((SOFTWARE, 0x77))
    (fault,) = stage.image.core.faults
    assert "PC 0x" in fault
    assert address in fault


def test_a_fault_in_the_handler_is_a_lockup(start):
    stage = start(5e-3, "FAULT", FORBIDDEN=UNDEFINED, FAULT_IN_HANDLER=1)
    assert stage.sent[2:] == bytes((LOCKUP, 0x77))
    assert len(stage.image.core.faults) == 2


def test_a_stack_that_is_too_long_changes_no_variable(start):
    """Below it is nothing: the processor can neither go on nor enter its handler."""
    beyond = f'__asm volatile("ldr r0, =stack_top-{STACK_BYTES - 8}\\n mov sp, r0\\n push {{r0-r3}}")'
    stage = start(100e-6, "FAULT", FORBIDDEN=beyond)
    assert stage.sent[2] == LOCKUP
    assert set(stage.image.resets) == {"lockup"}


@pytest.mark.parametrize(
    ("forbidden", "message"),
    [
        ("(void)REGISTER(0x40005000u)", r"0x40005000 \(in the block at PC 0x[0-9a-f]+\): no peripheral is modelled"),
        ("(void)REGISTER(0x40008999u&~3u)", "Timer has no register 0x998"),
        ("*(volatile uint8_t*)0x40008544u=1u", "access of 1 bytes at 0x40008544"),
        ("UARTE_TXD_PTR=256u;UARTE_TXD_MAXCNT=9u;start_line();UARTE_STARTTX=1u", "DMA of 9 bytes at 0x00000100"),
        ('__asm volatile("cpsie i\\nwfi")', "PRIMASK"),
    ],
)
def test_what_is_not_modelled_is_an_error_that_names_it(start, forbidden, message):
    stage = start(None, "SILENT", FORBIDDEN=forbidden)
    with pytest.raises(EmulationError, match=message):
        stage.run(1e-3)


# Instructions


def test_conditional_instructions_around_peripherals(start):
    stage = start(None, "CONDITIONAL")
    for _ in range(400):
        stage.run(7.3e-6)  # many stops within the program
    stage.run(5e-3)
    assert words(stage.sent) == [250, 750, 999]


def cycles_of_a_turn(program, body, cached):
    """Of a loop, by two counts of turns; the count is a word in the image."""
    elf = program("LOOP", COUNT='"0x5A5B5C5D"', BODY=f'"{body}"', FPU=1, **({"CACHED": 1} if cached else {}))
    image, mark, spent = elf.read_bytes(), (0x5A5B5C5D).to_bytes(4, "little"), []
    assert image.count(mark) == 1
    for count in (1000, 3000):
        other = elf.with_suffix(f".{count}")
        other.write_bytes(image.replace(mark, count.to_bytes(4, "little")))
        stage = LoneBoard(other)
        stage.run(10e-3)
        spent.append(stage.image.paths.costs["idle"].most_cycles)
    return (spent[1] - spent[0]) / 2000


@pytest.mark.parametrize(
    ("body", "cycles"),
    [
        ("nop", 1 + 1 + 1 + 3),
        ("add r4, r1, r2", 1 + 1 + 4),
        ("ldr r4, [r3]", 2 + 1 + 4),
        ("str r4, [r3, #4]", 2 + 1 + 4),
        ("ldrd r4, r5, [r3]", 3 + 1 + 4),
        ("push {r4, r5}\\n pop {r4, r5}", 3 + 3 + 1 + 4),
        ("ldmia r3, {r1, r2, r4}", 4 + 1 + 4),
        ("mul r4, r1, r2", 1 + 1 + 4),
        ("mla r4, r1, r2, r1", 2 + 1 + 4),
        ("umull r4, r5, r1, r2", 1 + 1 + 4),
        ("udiv r4, r1, r2", 12 + 1 + 4),
        ("b 2f\\n2:", 1 + 1 + 4),
        ("cmp r1, r2\\n it ne\\n movne r4, r1", 3 + 1 + 4),
        ("vadd.f32 s0, s1, s2\\n vmul.f32 s3, s1, s2", 2 + 1 + 4),
        ("vmul.f32 s0, s1, s2\\n vadd.f32 s3, s0, s2", 3 + 1 + 4),
        ("vmla.f32 s0, s1, s2", 3 + 1 + 4),
        ("vdiv.f32 s0, s1, s2", 14 + 1 + 4),
        ("vsqrt.f32 s0, s1", 14 + 1 + 4),
        ("vldr s0, [r3]\\n vstr s0, [r3, #4]", 4 + 1 + 4),
        ("vldmia r3, {s0-s3}", 5 + 1 + 4),
    ],
)
def test_cycles_of_a_loop_in_one_line_of_flash(program, body, cycles):
    assert [cycles_of_a_turn(program, body, cached) for cached in (False, True)] == [cycles, cycles]


def test_code_in_two_lines_of_flash_waits_unless_it_is_cached(program):
    turn, body = 10 + 1 + 4, "\\n".join(["nop"] * 10)
    assert cycles_of_a_turn(program, body, cached=True) == turn
    assert cycles_of_a_turn(program, body, cached=False) == turn + 2 + 2


# What a tag without a computer needs


@pytest.mark.parametrize("milliseconds", [1, 1000, 3_600_000])
def test_the_clock_goes_on_over_long_sleeps_in_which_nothing_draws_current(start, milliseconds):
    """Within the slow clock's period of 31 us at both ends; two sleeps of an hour, which the clock's wrap allows."""
    stage = start(0.301, "LONG_SLEEP", MILLISECONDS=f"{milliseconds}u")
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


def test_a_chip_that_sleeps_when_the_processor_restarts_is_woken(start):
    stage = start(5e-3)
    for octets in ("ec0a0000", "ec0605", "ec0202"):  # no counter; SLEEP_EN and WAKE_SPI; SAVE
        stage.chip.transfer(bytes.fromhex(octets), 2_000_000)
    stage.run(0.1)
    stage.image.pull_reset_pin()
    stage.run(5e-3)
    assert stage.chip.asleep_s == pytest.approx(0.1, abs=5e-3)  # until the driver has started
    assert is_sound(stage)


def test_settings_survive_restarts_and_a_cut_at_any_write(start):
    """After a cut there are the new ones, or none; never half of them."""

    def write(stage, value, seconds=0.1):
        stage.write(bytes((value,)))
        stage.run(10e-6 + seconds)

    def after_a_power_cycle(stage):
        sent = len(stage.sent)
        stage.image.power_cycle()
        stage.run(0.1)  # an erasure that was cut off is over by then
        return stage.sent[sent:]

    def begun():
        stage = start(5e-3, "SETTINGS", baud=None)
        assert stage.sent[0] == 0
        write(stage, 0x11)
        assert stage.sent[-1] == 0x11
        return stage

    assert after_a_power_cycle(begun()) == b"\1\x11"
    seen = set()
    for cut_us in [1000.0, 60_000.0, *(85_000.0 + 20.0 + 56.0 * number for number in range(19))]:
        stage = begun()
        write(stage, 0x22, seconds=1e-6 * cut_us)
        if cut_us < 85_000.0:  # what a page holds that was not erased completely, nobody knows
            garbage = random.Random(cut_us)
            stage.image.settings.registers |= {at: garbage.getrandbits(32) for at in range(0, 4096, 4)}
        found = after_a_power_cycle(stage)
        assert found[0] == 0 or found == b"\1\x22"
        seen.add(found[0])
        write(stage, 0x33)
        assert after_a_power_cycle(stage) == b"\1\x33"
        assert is_sound(stage)
    assert seen == {0, 1}


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


def test_an_advertisement_is_sent_on_three_channels_as_a_phone_expects_it(start):
    stage = start(10e-3, "ADVERTISE", DATA=",".join(map(str, DATA)))
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
        (0x508, 3), (0x514, 0x008), (0x518, 0x00030025), (0x51C, 0), (0x524, 0x8F), (0x534, 3), (0x538, 0x65A),
        (0x53C, 0), (0x554, 36),
    ],
)  # fmt: skip
def test_a_wrong_register_is_a_packet_that_no_phone_receives(start, register, wrong):
    stage = start(None, "ADVERTISE", DATA=",".join(map(str, DATA)))
    set_up = stage.image.radio.enable

    def enable():
        stage.image.radio.registers[register] = wrong
        set_up()

    stage.image.radio.tasks[0] = enable
    stage.run(5e-3)
    assert len(stage.image.advertised) == 3
    assert all(heard(packet) is None for packet in stage.image.advertised)


@pytest.mark.parametrize("comes", [True, False])
def test_a_window_on_the_emulated_board(start, comes):
    """The interrupt of the frame, or of the window's end, wakes the processor; what each step takes is the page's."""
    stage = start(1.3, "WINDOW")
    while len(stage.sent) < 16:
        stage.run(0.01e-3)
    start_us, sleep_us, wake_us, ask_us = words(stage.sent[:16])
    assert wake_us < 6800 < start_us < 8500
    assert sleep_us < 150
    assert ask_us < 150
    assert stage.chip.asleep_s == pytest.approx(1.0, abs=5e-3)
    if comes:
        stage.run(3.2e-3 - ask_us * 1e-6)
        receive(stage)
    stage.run(4e-3)
    came_us, events, *more = words(stage.sent[16:])
    assert events == (RECEIVED if comes else NOTHING)
    assert more[1::2] in ([], [0])  # the line falls some us after the poll
    assert comes or came_us == pytest.approx(3077 + 410, abs=40)
    assert is_sound(stage)


# The firmware


def start_radio(stage):
    delays = b"".join(one.to_bytes(2, "little") for one in (DELAYS.tx_ticks, DELAYS.rx_ticks))
    stage.run(5e-3)
    stage.write(line_of(CONFIG, bytes((5, 64, 2, 9, 128, 0)) + delays + b"\0"))
    stage.run(60e-3)
    stage.write(line_of(RX_ON, b"", 1))
    stage.run(5e-3)


def records_of(stage):
    """Whole records, their checks included."""
    return [cobs.decode(line) for line in stage.sent.split(b"\0") if line]


def test_the_firmware_receives_and_sends_and_never_uses_half_of_its_stack(start):
    """A configuration, a reception, bytes that are no record, a frame that is sent, and a measurement."""
    stage = start()
    start_radio(stage)
    records = records_of(stage)
    assert [record[0] for record in records] == [1, 5, 5]
    hello = decode(records[0][:-2])
    assert (hello.device_id, hello.reset_cause, hello.can_transmit) == (IDENTITY, 0, True)
    assert records[-1][2 + 5] == 3  # configured, receiving
    rx_ticks = receive(stage)
    stage.run(3e-3)
    record = records_of(stage)[-1]
    assert (record[0], record[13:-2]) == (2, FRAME)
    assert int.from_bytes(record[2:7], "little") == rx_ticks
    dx = ask_to_send(stage, 3e-3, 2, before=b"garbage\0")
    stage.run(4e-3)
    assert stage.frames == [(FRAME, wrap(dx + DELAYS.tx_ticks))]
    end_sending(stage)
    record = records_of(stage)[-1]
    assert (record[0], record[2:7]) == (3, dx.to_bytes(5, "little"))
    stage.run(20e-3)
    assert is_sound(stage)
    paths = stage.image.paths.costs
    assert {"start", "idle", "byte", "reception", "transmission", "end of transmission"} <= set(paths)
    assert paths["start"].count == paths["reception"].count == paths["end of transmission"].count == 1
    assert paths["reception"].most_us < 400.0
    assert {"main", "board_turn"} <= set(stage.image.core.cycles_by_function())
    assert STACK_BYTES / 2 < stage.image.core.unused_stack_bytes < STACK_BYTES


def lights_of(stage, seconds):
    """Those that are on at instants of the next seconds, as sets of their names."""
    seen = []
    for _ in range(20):
        stage.run(seconds / 20)
        seen.append(set(stage.image.leds))
    return seen


def test_the_lights_say_what_the_page_of_the_firmware_states(start):
    page = (FIRMWARE / "README.md").read_text("utf-8")
    stated = re.findall(r"^\| \w+ \((D\d+), pin (\d+)\)", page, re.MULTILINE)
    assert {name: int(pin) for name, pin in stated} == LED_PINS
    stage = start()
    waiting = lights_of(stage, 2.2)
    assert set() in waiting
    assert {"D9"} in waiting
    assert all(lights <= {"D9"} for lights in waiting)
    start_radio(stage)
    assert lights_of(stage, 1.1) == [{"D9"}] * 20
    changes = {"D10": 0, "D11": 0}
    for number in range(32):
        before = set(stage.image.leds)
        receive(stage)
        if number % 4 == 0:
            ask_to_send(stage, 4e-3, number)
        stage.run(6e-3)
        if number % 4 == 0:
            end_sending(stage)
        stage.run(1e-3)
        for name in before ^ set(stage.image.leds):
            changes[name] += 1
    assert changes == {"D10": 2, "D11": 2}
    stage.chip.pull_reset()
    stage.chip.transfer = lambda out, hz: b"\xff" * len(out)  # the chip is gone
    start_radio(stage)
    assert "D12" in stage.image.leds


@pytest.mark.parametrize(("revision", "can_transmit"), [(5, True), (5, False), (6, True), (7, True), (8, True)])
def test_a_grounded_pin_makes_a_tag_and_what_the_processors_errata_ask_for_is_done(start, revision, can_transmit):
    """Anomalies 108 (RAM in sleep), 136 (causes besides the reset pin's); the debug port's lock from revision 7 on."""
    stage = start(can_transmit=can_transmit, revision=revision)
    assert not stage.image.keeps_ram
    assert stage.image.debug_is_open == (revision < 7)  # then the firmware opens it for good, and starts again
    stage.run(5e-3)
    assert stage.image.keeps_ram
    assert stage.image.debug_is_open
    stage.image.pull_reset_pin()
    stage.run(5e-3)
    hellos = [decode(record[:-2]) for record in records_of(stage)]
    causes = [SOFTWARE if revision >= 7 else 0, 1]
    assert [(one.can_transmit, one.reset_cause) for one in hellos] == [(can_transmit, cause) for cause in causes]
    assert is_sound(stage)


def test_a_new_board_has_460_800_baud_and_one_whose_flash_holds_another_rate_has_that(start):
    for baud, rate in ((None, 457_143), (1_000_000, 1_000_000), (115_200, 115_108)):
        stage = start(10e-3, baud=baud)
        (zero_us, _), (hello_us, hello) = stage.lines[0], stage.lines[-1]
        assert 1e6 * 10 * len(hello) / (hello_us - zero_us) == pytest.approx(rate, rel=0.07)
        assert is_sound(stage)


def test_a_tag_sleeps_without_flags_of_the_floating_point_unit(start):
    """Which would end each sleep at once: anomaly 87."""
    stage = start()
    stage.image.settings.hold(pack(BoardSettings(mode=1, output=3)))
    stage.run(30e-3)
    heard = tape(replace(ROOM, schedule=replace(ROOM.schedule, mode="free", rate_hz=50.0)), 0.8)
    for one in heard:
        stage.run(max((one.rx_ticks - heard[0].rx_ticks) * TICK_S + 40e-3 - stage.now_s(), 0.0))
        stage.chip.receive(one.frame, wrap(stage.timeline.now_ticks), Diagnostics())
        stage.image.notify()
    assert "compute_ph" in stage.image.core.cycles_by_function()
    assert is_sound(stage)


def test_a_crystal_that_never_starts_is_shown(start, monkeypatch):
    monkeypatch.setattr(peripherals, "HFCLK_START_CYCLES", 1 << 60)
    stage = start()
    for _ in range(5):
        stage.run(0.01)
        assert stage.image.leds == {"D12"}
    assert stage.sent == b""


def test_a_line_that_starts_again_in_the_middle_of_bytes_is_not_behind(start):
    """Bytes that come while the receiver stops are counted, but get to RAM only when they are flushed."""
    stage = start(5e-3)
    stage.write(b"\1\1\0" * 40)
    stage.run(3e-3)
    stage.write(b"\0" + line_of(ASK_STATUS, b""))
    stage.run(3e-3)
    assert [record[0] for record in records_of(stage)] == [1, 5]
    assert stage.image.misuse.total() <= 2  # the fifth byte while it stops, after twenty garbled lines and twenty more


def test_a_pin_is_high_while_the_firmware_is_awake(start):
    stage = start()
    seen = set()
    for _ in range(2000):
        stage.run(3.1e-6)
        seen.add((stage.image.is_asleep, stage.image.gpio.is_driven(AWAKE_PIN, high=True)))
    assert seen == {(False, False), (False, True), (True, False)}  # not yet an output; awake; asleep


def test_a_run_repeats_itself(start):
    runs = []
    for _ in range(2):
        stage = start()
        start_radio(stage)
        runs.append((stage.lines, stage.image.core.cycles, stage.image.paths.costs))
    assert runs[0] == runs[1]


def test_a_supply_that_fails_cuts_a_record_off_and_lets_the_chip_go(start):
    stage = start()
    while not stage.sent:
        stage.run(50e-6)
    stage.image.power_cycle()  # HELLO is on the line
    assert len(stage.sent) == 1
    stage.run(5e-3)
    records = [record for record in records_of(stage) if record]
    assert [record[0] for record in records] == [1]
    assert stage.image.resets == {"power": 1}
    assert stage.chip.misuse.total() == 0
