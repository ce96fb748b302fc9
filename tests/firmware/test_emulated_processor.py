"""The emulated nRF52832: small programs whose behaviour is known by the processor's specification, counted by hand."""

import re

import pytest
from board_stage import line_of
from cobs import cobs
from emulator.build import FIRMWARE, build
from processor_stage import STACK_BYTES, build_program, needs_processor

from skyless.core.air.frame import Diagnostics, after_rmarker_s, fcs
from skyless.core.ticks import from_seconds, wrap
from skyless.radio.serial.link import decode
from skyless.sim.dw1000 import registers as r

pytest.importorskip("unicorn")

from emulator.processor import peripherals
from emulator.processor.cortex_m4 import EmulationError
from emulator.processor.lone_board import DELAYS, IDENTITY, LoneBoard
from emulator.processor.nrf52832 import LED_PINS

pytestmark = [pytest.mark.site, needs_processor]

AWAKE_PIN = 15
WATCHDOG, SOFTWARE, LOCKUP = 2, 4, 8
"""Bits of RESETREAS."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def firmware():
    return build("all")


# The line


def test_bytes_take_their_time_both_ways(folder):
    stage = LoneBoard(build_program(folder, "START"))
    stage.run(1e-3)
    assert stage.sent == b"\0"
    for value in (10, 20, 255):
        arrived_us = stage.write(bytes((value,)))
        stage.run(1e-3)
        came_us, data = stage.lines[-1]
        assert data == bytes(((value + 1) & 0xFF,))
        assert 13.0 < came_us - arrived_us < 16.0  # 3 µs to wake up, some instructions, 10 µs on the line
    assert stage.image.misuse.total() == 0


def test_a_long_transfer_arrives_record_by_record(folder, firmware):
    stage = LoneBoard(firmware)
    stage.run(5e-3)
    (zero_us, zero), (hello_us, hello) = stage.lines
    assert zero == b"\0"
    assert hello[-1] == 0
    assert 0 not in hello[:-1]
    assert hello_us - zero_us >= 10.0 * len(hello) - 0.1


def test_the_ring_goes_round_without_the_processor(folder):
    stage = LoneBoard(build_program(folder, "RING"))
    stage.run(1e-3)
    total = 0
    for length in (3, 254, 255, 256, 700):
        data = bytes(1 + at % 250 for at in range(length - 1)) + b"\0"
        stage.write(data)
        stage.run(length * 10e-6 + 1e-3)
        total += length
        assert stage.sent[-7:] == total.to_bytes(4, "little") + data[-3:]
        assert len(stage.lines[-1][1]) >= 1
    assert stage.image.misuse.total() == 0


def test_what_comes_to_a_receiver_that_is_off_is_lost_and_counted(folder):
    stage = LoneBoard(build_program(folder, "SLEEP"))
    stage.run(1e-3)
    stage.write(b"abc")
    stage.run(1e-3)
    assert stage.image.misuse == {"uarte-byte-lost": 3}


# The chip


def test_the_chip_answers_over_spi_and_its_line_wakes_the_processor(folder):
    stage = LoneBoard(build_program(folder, "CHIP"))
    stage.run(2e-3)
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
def test_the_timer_ends_sleeps(folder, clock_ppm):
    stage = LoneBoard(build_program(folder, "SLEEP"), clock_ppm=clock_ppm)
    stage.run(10e-3)
    slept = [int.from_bytes(stage.sent[at : at + 4], "little") for at in (0, 4)]
    assert 1003 <= slept[0] <= 1006  # 3 µs to wake up
    assert 53 <= slept[1] <= 56 + 51  # and the first word on the line
    (first_us, _), *_ = stage.lines
    assert first_us > (1000 + 50) * (1 + 1e-6 * clock_ppm)
    busy = stage.image.busy_share
    assert 0.0 < busy < 0.03


@pytest.mark.parametrize("macros", [{}, {"AWAKE": 1}])
def test_a_watchdog_that_is_not_fed_resets(folder, macros):
    stage = LoneBoard(build_program(folder, "WATCHDOG", **macros))
    stage.run(36e-3)
    assert stage.sent == b"\0"
    stage.run(36e-3)
    assert stage.sent == bytes((0, WATCHDOG))
    (start_us, _), (again_us, _) = stage.lines
    assert again_us - start_us == pytest.approx(27e3 + 328 / 32768 * 1e6, abs=60.0)
    assert stage.image.resets == {"watchdog": 1}


def test_a_power_cycle_leaves_no_cause(folder):
    stage = LoneBoard(build_program(folder, "WATCHDOG"))
    stage.run(40e-3)
    stage.image.power_cycle()
    stage.run(5e-3)
    assert stage.sent == bytes((0, WATCHDOG, 0))


# Faults

READ_NOWHERE = "(void)REGISTER(0x90000000u)"
UNDEFINED = '__asm volatile("udf #0")'
INTO_FLASH = "REGISTER(0x00000100u)=1u"
REAL = '__asm volatile("vmov.f32 s0, #1.0")'
"""With the floating-point unit still off."""
JUMP_NOWHERE = "((void(*)(void))0x60000001u)()"


@pytest.mark.parametrize(
    ("forbidden", "address"),
    [
        (READ_NOWHERE, "0x90000000"),
        (UNDEFINED, None),
        (INTO_FLASH, "0x00000100"),
        (JUMP_NOWHERE, "0x60000000"),
        (REAL, None),
    ],
)
def test_a_fault_ends_in_its_handler(folder, forbidden, address):
    stage = LoneBoard(build_program(folder, "FAULT", FORBIDDEN=forbidden))
    stage.run(5e-3)
    assert stage.sent[0] == 0
    assert stage.sent[2:] == bytes((SOFTWARE, 0x77))
    (fault,) = stage.image.core.faults
    assert "PC 0x" in fault
    assert address is None or address in fault


def test_a_fault_in_the_handler_is_a_lockup(folder):
    stage = LoneBoard(build_program(folder, "FAULT", FORBIDDEN=UNDEFINED, FAULT_IN_HANDLER=1))
    stage.run(5e-3)
    assert stage.sent[2:] == bytes((LOCKUP, 0x77))
    assert len(stage.image.core.faults) == 2


def test_a_stack_that_is_too_long_changes_no_variable(folder):
    """Below it is nothing: the processor can neither go on nor enter its handler."""
    beyond = f'__asm volatile("ldr r0, =stack_top-{STACK_BYTES - 8}\\n mov sp, r0\\n push {{r0-r3}}")'
    stage = LoneBoard(build_program(folder, "FAULT", FORBIDDEN=beyond))
    stage.run(100e-6)
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
def test_what_is_not_modelled_is_an_error_that_names_it(folder, forbidden, message):
    stage = LoneBoard(build_program(folder, "SILENT", FORBIDDEN=forbidden))
    with pytest.raises(EmulationError, match=message):
        stage.run(1e-3)


# Instructions


def test_conditional_instructions_around_peripherals(folder):
    stage = LoneBoard(build_program(folder, "CONDITIONAL"))
    for _ in range(400):
        stage.run(7.3e-6)  # many stops within the program
    stage.run(5e-3)
    values = [int.from_bytes(stage.sent[at : at + 4], "little") for at in (0, 4, 8)]
    assert values == [250, 750, 999]


@pytest.mark.parametrize("cached", [False, True])
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
def test_cycles_of_a_loop(folder, body, cycles, cached):
    spent = []
    for count in (1000, 3000):
        macros = {"COUNT": f'"{count}"', "BODY": f'"{body}"', "FPU": 1} | ({"CACHED": 1} if cached else {})
        stage = LoneBoard(build_program(folder, "LOOP", **macros))
        stage.run(10e-3)
        spent.append(stage.image.paths.costs["idle"].most_cycles)
    assert spent[1] - spent[0] == 2000 * cycles


def test_code_in_two_lines_of_flash_waits_unless_it_is_cached(folder):
    body = "\\n".join(["nop"] * 10)
    spent = {}
    for cached in (False, True):
        for count in (1000, 3000):
            macros = {"COUNT": f'"{count}"', "BODY": f'"{body}"'} | ({"CACHED": 1} if cached else {})
            stage = LoneBoard(build_program(folder, "LOOP", **macros))
            stage.run(10e-3)
            spent[cached, count] = stage.image.paths.costs["idle"].most_cycles
    turn = 10 + 1 + 4
    assert spent[True, 3000] - spent[True, 1000] == 2000 * turn
    assert spent[False, 3000] - spent[False, 1000] == 2000 * (turn + 2 + 2)


# The firmware


def start_radio(stage):
    stage.run(5e-3)
    stage.write(line_of(0x42, bytes((5, 64, 2, 9, 128, 0)) + DELAYS.tx_ticks.to_bytes(2, "little")
                        + DELAYS.rx_ticks.to_bytes(2, "little") + b"\0"))  # fmt: skip
    stage.run(60e-3)
    stage.write(line_of(0x44, b"", 1))
    stage.run(5e-3)


def records_of(stage):
    """Whole records, their checks included."""
    return [cobs.decode(line) for line in stage.sent.split(b"\0") if line]


def test_the_firmware_receives_and_sends(firmware):
    stage = LoneBoard(firmware)
    start_radio(stage)
    records = records_of(stage)
    assert [record[0] for record in records] == [1, 5, 5]
    hello = decode(records[0][:-2])
    assert (hello.device_id, hello.reset_cause, hello.can_transmit) == (IDENTITY, 0, True)
    assert records[-1][2 + 5] == 3  # configured, receiving
    frame = bytes(range(100)) + fcs(bytes(range(100)))
    rx_ticks = wrap(stage.timeline.now_ticks - from_seconds(after_rmarker_s(len(frame))))
    stage.chip.receive(frame, rx_ticks, Diagnostics())
    stage.image.notify()
    stage.run(3e-3)
    record = records_of(stage)[-1]
    assert (record[0], record[13:-2]) == (2, frame)
    assert int.from_bytes(record[2:7], "little") == rx_ticks
    dx = wrap(stage.timeline.now_ticks + from_seconds(3e-3)) & ~0x1FF
    stage.write(line_of(0x43, dx.to_bytes(5, "little") + frame, 2))
    stage.run(4e-3)
    assert stage.frames == [(frame, wrap(dx + DELAYS.tx_ticks))]
    stage.chip.transceiver.finish()
    stage.image.notify()
    stage.run(1e-3)
    record = records_of(stage)[-1]
    assert (record[0], record[2:7]) == (3, dx.to_bytes(5, "little"))
    assert stage.image.core.faults == []
    assert stage.image.misuse.total() == stage.chip.misuse.total() == 0
    paths = stage.image.paths.costs
    assert {"start", "idle", "byte", "reception", "transmission", "end of transmission"} <= set(paths)
    assert paths["start"].count == paths["reception"].count == paths["end of transmission"].count == 1
    assert paths["reception"].most_us < 400.0
    functions = stage.image.core.cycles_by_function()
    assert {"main", "board_turn"} <= set(functions)


def lights_of(stage, seconds):
    """Those that are on at instants of the next seconds, as sets of their names."""
    seen = []
    for _ in range(20):
        stage.run(seconds / 20)
        seen.append(set(stage.image.leds))
    return seen


def test_the_lights_say_what_the_page_of_the_firmware_states(firmware):
    page = (FIRMWARE / "README.md").read_text("utf-8")
    assert dict(re.findall(r"^\| \w+ \((D\d+), pin (\d+)\)", page, re.MULTILINE)) == {
        name: str(pin) for name, pin in LED_PINS.items()
    }
    stage = LoneBoard(firmware)
    waiting = lights_of(stage, 2.2)
    assert set() in waiting
    assert {"D9"} in waiting
    assert all(lights <= {"D9"} for lights in waiting)
    start_radio(stage)
    assert lights_of(stage, 1.1) == [{"D9"}] * 20
    frame = bytes(range(100)) + fcs(bytes(range(100)))
    changes = {"D10": 0, "D11": 0}
    for number in range(32):
        before = set(stage.image.leds)
        stage.chip.receive(frame, wrap(stage.timeline.now_ticks - from_seconds(after_rmarker_s(102))), Diagnostics())
        stage.image.notify()
        if number % 4 == 0:
            dx = wrap(stage.timeline.now_ticks + from_seconds(4e-3)) & ~0x1FF
            stage.write(line_of(0x43, dx.to_bytes(5, "little") + frame, number & 0xFF))
        stage.run(6e-3)
        if number % 4 == 0:
            stage.chip.transceiver.finish()
            stage.image.notify()
        stage.run(1e-3)
        for name in before ^ set(stage.image.leds):
            changes[name] += 1
    assert changes == {"D10": 2, "D11": 2}
    stage.chip.pull_reset()
    stage.chip.transfer = lambda out, hz: b"\xff" * len(out)  # the chip is gone
    start_radio(stage)
    assert "D12" in stage.image.leds


def test_half_of_the_stack_is_never_used(firmware):
    """A configuration, a reception, a frame that is sent, a measurement, and bytes that are no record."""
    stage = LoneBoard(firmware)
    start_radio(stage)
    frame = bytes(98) + fcs(bytes(98))
    stage.chip.receive(frame, wrap(stage.timeline.now_ticks - from_seconds(after_rmarker_s(100))), Diagnostics())
    stage.image.notify()
    stage.run(3e-3)
    dx = wrap(stage.timeline.now_ticks + from_seconds(4e-3)) & ~0x1FF
    stage.write(b"garbage\0" + line_of(0x43, dx.to_bytes(5, "little") + frame, 2))
    stage.run(20e-3)
    assert len(stage.frames) == 1
    assert STACK_BYTES / 2 < stage.image.core.unused_stack_bytes < STACK_BYTES


def test_a_grounded_pin_makes_a_tag(firmware):
    capabilities = []
    for can_transmit in (True, False):
        stage = LoneBoard(firmware, can_transmit=can_transmit)
        stage.run(5e-3)
        capabilities.append(decode(records_of(stage)[0][:-2]).can_transmit)
    assert capabilities == [True, False]


def test_what_the_processors_errata_ask_for_is_done(firmware):
    """Anomalies 108 (RAM in sleep) and 136 (causes that are set besides the reset pin's)."""
    stage = LoneBoard(firmware)
    assert not stage.image.keeps_ram
    stage.run(5e-3)
    assert stage.image.keeps_ram
    stage.image.pull_reset_pin()
    stage.run(5e-3)
    assert [decode(record[:-2]).reset_cause for record in records_of(stage)] == [0, 1]


def test_a_crystal_that_never_starts_is_shown(firmware, monkeypatch):
    monkeypatch.setattr(peripherals, "HFCLK_START_CYCLES", 1 << 60)
    stage = LoneBoard(firmware)
    for _ in range(5):
        stage.run(0.01)
        assert stage.image.leds == {"D12"}
    assert stage.sent == b""


def test_a_line_that_starts_again_in_the_middle_of_bytes_is_not_behind(firmware):
    """Bytes that come while the receiver stops are counted, but get to RAM only when they are flushed."""
    stage = LoneBoard(firmware)
    stage.run(5e-3)
    stage.write(b"\1\1\0" * 40)
    stage.run(3e-3)
    stage.write(b"\0" + line_of(0x45, b""))
    stage.run(3e-3)
    assert [record[0] for record in records_of(stage)] == [1, 5]
    assert stage.image.misuse.total() <= 2  # the fifth byte while it stops, after twenty garbled lines and twenty more


def test_a_pin_is_high_while_the_firmware_is_awake(firmware):
    stage = LoneBoard(firmware)
    seen = set()
    for _ in range(2000):
        stage.run(3.1e-6)
        seen.add((stage.image.is_asleep, stage.image.gpio.is_driven(AWAKE_PIN, high=True)))
    assert seen == {(False, False), (False, True), (True, False)}  # not yet an output; awake; asleep


def test_a_run_repeats_itself(firmware):
    runs = []
    for _ in range(2):
        stage = LoneBoard(firmware)
        start_radio(stage)
        runs.append((stage.lines, stage.image.core.cycles, stage.image.paths.costs))
    assert runs[0] == runs[1]


def test_a_supply_that_fails_cuts_a_record_off_and_lets_the_chip_go(firmware):
    stage = LoneBoard(firmware)
    while not stage.sent:
        stage.run(50e-6)
    stage.image.power_cycle()  # HELLO is on the line
    assert len(stage.sent) == 1
    stage.run(5e-3)
    records = [record for record in records_of(stage) if record]
    assert [record[0] for record in records] == [1]
    assert stage.image.resets == {"power": 1}
    assert stage.chip.misuse.total() == 0
