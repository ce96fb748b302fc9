"""The board's loop: what it answers, when it sends and collects garbage, what a frame costs; in MicroPython too."""

import ast
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from board_bench import FOLDER, VECTORS, bytecodes_of_lines, on_nrf52, values, vectors
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.firmware import board, dw1000, link
from skyless.radios.serial.link_records import Done, Heard, Hello, NotDone, Status, TooLate

MICROPYTHON = shutil.which("micropython", path=Path(sys.executable).parent) or shutil.which("micropython")
FRAME = bytearray(range(127))
TICKS_PER_US = vectors.TICKS_PER_US


def bench(**kind):
    made = vectors.Bench(**kind).ready()
    made.turn(200)
    made.wire.take()
    return made


def said(made, turns=1):
    made.turn(turns)
    return values(made.wire.take())


def run(interpreter):
    done = subprocess.run(
        [interpreter, str(VECTORS), str(FOLDER)], capture_output=True, text=True, timeout=100, check=True
    )
    return done.stdout.splitlines(), done.stderr


@pytest.mark.skipif(MICROPYTHON is None, reason="MicroPython's unix port is only on PyPI for x86-64")
def test_micropython_says_the_same_and_allocates_nothing_per_frame():
    """With the heap locked: receptions, frames sent and late, errors, noise, greetings, status."""
    lines, told = run(MICROPYTHON)
    assert lines == run(sys.executable)[0]
    assert "allocated 0" in told
    assert "passed 72 24 24 0 0" in lines  # received, sent, errors, late at the radio, unsent: all of it was run


# What it answers


def test_a_board_greets_and_is_configured_by_its_host():
    made = vectors.Bench()
    made.board.begin()
    assert made.wire.take()[0] == 0
    made.say(made.host.ask(link.ASK_HELLO))
    assert said(made) == [Hello(1, 0, (0, 1, 0), b"identity", 63_897_600, 40, can_transmit=True)]
    made.say(made.host.ask(link.RX_ON))
    assert said(made) == [NotDone(link.RX_ON, link.REFUSED_MALFORMED)]
    made.say(made.host.config(vectors.TX_DELAY, vectors.RX_DELAY))
    (status,) = said(made)
    assert (status.configured, status.receiving) == (True, False)
    assert not made.bus.listening
    made.say(made.host.ask(link.RX_ON))
    (status,) = said(made)
    assert (status.configured, status.receiving) == (True, True)
    assert made.bus.listening
    assert 0 <= made.clock.us * TICKS_PER_US - status.ticks < 100 * TICKS_PER_US


def command(kind, body):
    writer = link.Writer()
    writer.begin(kind)
    writer.append_bytes(bytearray(body), 0, len(body))
    return bytes(writer.line[: writer.end()])


CONFIG = bytes((5, 64, 2, 9, 128, 0, 52, 64, 52, 64, 0))


@pytest.mark.parametrize(
    ("kind", "body", "reason"),
    [
        (link.CONFIG, CONFIG[:-1], link.REFUSED_MALFORMED),
        (link.CONFIG, b"", link.REFUSED_MALFORMED),
        *[(link.CONFIG, CONFIG[:at] + b"\7" + CONFIG[at + 1 :], link.REFUSED_SETTING) for at in range(6)],
        (link.TX_AT, bytes(5), link.REFUSED_MALFORMED),
        (link.TX_AT, bytes(7), link.REFUSED_MALFORMED),
        (link.TX_AT, bytes(133), link.REFUSED_MALFORMED),
    ],
)
def test_what_it_cannot_do_is_refused(kind, body, reason):
    made = bench()
    line = command(kind, body)
    made.wire.put(line, len(line))
    assert said(made, 4) == [NotDone(kind, reason)]
    assert made.bus.listening


def test_a_later_version_may_append_fields_and_add_kinds():
    made = bench()
    for line in (command(link.CONFIG, CONFIG + b"more"), command(0x7E, b"new")):
        made.wire.put(line, len(line))
    (status,) = said(made, 2)
    assert (status.configured, status.garbled) == (True, 0)
    made.say(made.host.ask(link.ASK_STATUS))
    assert said(made)[0].garbled == 1


def test_receptions_are_told_with_the_chips_own_stamp():
    made = bench()
    for size in (3, 100, 127):
        ticks = 0xFE_DCBA_9876 + size
        assert made.bus.hear(FRAME, size, ticks)
        (heard,) = said(made)
        assert (heard.frame, heard.rx_ticks) == (bytes(FRAME[:size]), ticks)
        assert heard.diagnostics.rx_power_dbm == pytest.approx(made.chip.rx_power_cdbm / 100)
    assert made.bus.listening


def test_errors_are_counted_and_it_listens_on():
    made = bench()
    made.bus.status[1] |= 0x80
    assert said(made, 2) == []
    made.say(made.host.ask(link.ASK_STATUS))
    assert said(made)[0].errors == 1
    assert made.bus.hear(FRAME, 10, 1)
    assert isinstance(said(made)[0], Heard)


# When it sends


@pytest.mark.parametrize("ahead_us", [400, 1000, 1200, 3000, 14_700, 2_000_000])
@pytest.mark.parametrize("step_us", [5, 37, 300])
def test_frames_leave_at_their_tick_and_the_receiver_is_off_no_longer_than_needed(ahead_us, step_us):
    made = bench()
    at_us = made.clock.us + ahead_us
    made.tx_at(at_us, FRAME, 40)
    dx = int.from_bytes(made.dx, "little")
    deaf_us, told = 0, []
    while made.clock.us < at_us + 1000:
        made.turn(1, step_us)
        deaf_us += step_us * (not made.bus.listening)
        told += values(made.wire.take())
    stamp = (dx & ~0x1FF) + vectors.TX_DELAY
    assert told == [Done(dx % 2**40, stamp % 2**40)]
    assert made.bus.sent[:38] == FRAME[:38]
    assert deaf_us <= board.LEAD_US + board.CLOSE_US + 3 * step_us
    assert made.bus.listening


@pytest.mark.parametrize("ahead_us", [137, 0, -1, -5000, -8_000_000])
def test_what_comes_too_late_is_told_and_never_sent(ahead_us):
    made = bench()
    made.tx_at(made.clock.us + ahead_us - 20, FRAME, 40)
    told = said(made, 500)
    assert told == [TooLate(int.from_bytes(made.dx, "little") % 2**40, link.LATE_FOR_RADIO)]
    assert made.chip.sent == 0
    assert made.bus.listening


def test_every_frame_is_answered_once_and_one_is_held_at_a_time():
    made = bench()
    made.tx_at(made.clock.us + 5000, FRAME, 40)
    first = int.from_bytes(made.dx, "little")
    made.turn(2)
    made.tx_at(made.clock.us + 9000, FRAME, 40)
    second = int.from_bytes(made.dx, "little")
    told = said(made, 1000)
    assert [(type(one), one.dx_ticks) for one in told] == [(TooLate, second), (Done, first)]
    assert told[0].reason == link.LATE_BUSY


def test_a_tag_or_an_unconfigured_board_sends_nothing():
    for made in (vectors.Bench(), bench(can_transmit=False)):
        made.tx_at(made.clock.us + 5000, FRAME, 40)
        told = said(made, 500)
        assert [(type(one), one.reason) for one in told] == [(TooLate, link.LATE_NOT_READY)]
        assert made.bus.sent_bytes == 0


def test_a_frame_that_comes_shortly_before_ones_own_is_not_lost():
    made = bench()
    at_us = made.clock.us + 4000
    made.tx_at(at_us, FRAME, 40)
    made.turn(4)
    made.clock.us = at_us - board.LEAD_US - 10
    made.bus.hear(FRAME, 50, 777)
    made.board._interrupt = None  # and nobody has told so far
    kinds = [type(one) for one in said(made, 200)]
    assert kinds == [Heard, Done]


def test_a_frame_whose_end_the_chip_never_tells_is_taken_back():
    made = bench()
    made.bus.never_tells = True
    made.tx_at(made.clock.us + 3000, FRAME, 40)
    told = said(made, 1000)
    assert [(type(one), one.reason) for one in told] == [(TooLate, link.LATE_FOR_RADIO)]
    assert made.bus.listening


def test_reasons_of_driver_and_link_are_the_same_numbers():
    assert (dw1000.LATE, dw1000.BUSY, dw1000.NOT_READY) == (
        link.LATE_FOR_RADIO,
        link.LATE_BUSY,
        link.LATE_NOT_READY,
    )


def test_a_chip_that_was_reset_is_told_of_and_can_be_configured_again():
    made = bench()
    made.tx_at(made.clock.us + 900_000, FRAME, 40)
    made.turn(4)
    made.bus.reset()
    made.clock.us += board.POLL_US
    told = said(made, 2)
    assert [type(one) for one in told] == [TooLate, Hello]
    made.say(made.host.ask(link.ASK_STATUS))
    (status,) = said(made)
    assert (status.configured, status.receiving, status.ticks) == (False, False, 0)
    made.ready()
    assert made.bus.hear(FRAME, 10, 1)
    assert isinstance(said(made)[-1], Heard)


def test_a_chip_that_looks_well_and_has_lost_its_settings_is_found_out():
    made = bench()
    made.bus.channel[0] = 0
    made.clock.us += board.MEASURE_US
    told = said(made, 400)
    assert [type(one) for one in told] == [Hello]
    made.say(made.host.ask(link.ASK_STATUS))
    assert not said(made)[0].configured


def test_a_board_without_a_chip_says_so_and_goes_on():
    made = vectors.Bench()
    made.bus.present = False
    made.ready()
    assert [one for one in values(made.wire.take()) if isinstance(one, NotDone)] == [
        NotDone(link.CONFIG, link.REFUSED_RADIO),
        NotDone(link.RX_ON, link.REFUSED_MALFORMED),
    ]
    made.bus.present = True
    made.ready()
    assert made.bus.listening


# When it collects garbage, and measures


def superframe(made, slot_us=2100, slots=7, mine=3):
    """All slots of a superframe but the own one are heard; the own frame is asked for early."""
    begin_us = made.clock.us
    made.tx_at(begin_us + mine * slot_us, FRAME, 100)
    for slot in range(slots):
        while made.clock.us < begin_us + slot * slot_us + 200:
            made.turn(1)
        if slot != mine:
            made.bus.hear(FRAME, 100, slot)
    while made.clock.us < begin_us + slots * slot_us:
        made.turn(1)


def test_garbage_is_collected_in_the_own_slot_where_all_others_speak():
    made = vectors.Bench().ready()
    superframe(made)
    (at_us,) = made.collector.at_us
    sent_us = int.from_bytes(made.bus.tx_stamp, "little") / TICKS_PER_US
    assert -1 <= at_us - sent_us < 300
    assert made.chip.received == 6
    for _ in range(20):
        superframe(made)
    assert len(made.collector.at_us) <= 2  # once for the start, once for the measurement
    assert made.chip.received == 21 * 6
    assert made.chip.sent == 21


def test_temperature_and_supply_are_measured_now_and_then():
    made = bench()
    assert made.board.chores == 3  # the start's garbage, a measurement and its garbage
    made.say(made.host.ask(link.ASK_STATUS))
    (status,) = said(made)
    assert (status.temperature_c, status.supply_v) == (-113.0, 2.3)  # the stand-in's zeros by the typical formulas
    made.clock.us += board.MEASURE_US
    made.turn(400)
    assert made.board.chores == 5


@given(st.integers(0, 9000), st.integers(20, 200))
@settings(max_examples=60, deadline=None)
def test_nothing_long_is_begun_shortly_before_a_frame_is_due(ahead_us, step_us):
    made = bench()
    made.collector.at_us.clear()
    made.clock.us += 100_000
    made.board._litter = True
    at_us = made.clock.us + ahead_us
    made.tx_at(at_us, FRAME, 40)
    made.board._busy_us = made.clock.ticks_add(made.clock.ticks_us(), -50_000)  # as after a long silence
    while made.clock.us < at_us + 20_000:
        made.turn(1, step_us)
    (collected_us,) = made.collector.at_us
    assert collected_us >= at_us - 1 or collected_us <= at_us - board.CLEARANCE_US
    if ahead_us > 500:
        assert made.chip.sent == 1


def test_a_silent_host_and_a_silent_air_leave_time_and_a_busy_air_none():
    made = vectors.Bench(can_transmit=False).ready()
    for number in range(50):
        made.bus.hear(FRAME, 100, number)
        made.turn(100, 20)  # a reception every 2 ms
    assert made.collector.at_us == []
    made.turn(200)
    assert len(made.collector.at_us) >= 1


# What comes from the host may be anything


@given(
    st.lists(st.one_of(st.binary(max_size=70), st.sampled_from(["hello", "status", "rx", "tx", "cut"])), max_size=30)
)
@settings(max_examples=80, deadline=None)
def test_nothing_that_a_host_says_stops_a_board(pieces):
    made = bench()
    lines = {
        "hello": lambda: made.host.ask(link.ASK_HELLO),
        "status": lambda: made.host.ask(link.ASK_STATUS),
        "rx": lambda: made.host.ask(link.RX_ON),
        "tx": lambda: made.host.tx_at(bytearray(5), FRAME, 40),
        "cut": lambda: made.host.tx_at(bytearray(5), FRAME, 40) // 2,
    }
    for piece in pieces:
        if isinstance(piece, str):
            made.say(lines[piece]())
        else:
            made.wire.put(piece, len(piece))
        made.turn(3)
        values(made.wire.take())  # whole records, whatever came
    made.wire.put(b"\0", 1)
    made.say(made.host.ask(link.ASK_STATUS))
    assert isinstance(said(made, 30)[-1], Status)


def test_a_flood_of_noise_costs_no_reception_and_starts_the_uart_anew():
    made, noise = bench(), random.Random(5)
    heard = 0
    for number in range(300):
        mess = noise.randbytes(noise.randrange(1, 200))
        made.wire.put(mess, len(mess))
        heard += made.bus.hear(FRAME, 100, number)
        made.turn(5)
        values(made.wire.take())
    assert made.chip.received == heard == 300
    assert made.wire.restarts >= 1
    made.wire.put(b"\0", 1)
    made.say(made.host.ask(link.ASK_STATUS))
    assert said(made, 2)[-1].garbled > 100


def test_a_host_that_does_not_read_costs_records_and_they_are_counted():
    made = bench()
    for number in range(100):
        made.bus.hear(FRAME, 100, number)
        made.turn(2)
    assert made.chip.received == 100
    kept = len(values(made.wire.take()))
    assert made.board.unsent == 100 - kept > 0
    made.say(made.host.ask(link.ASK_STATUS))
    assert said(made)[0].unsent_records == 100 - kept


# What a frame costs

COMPILED_ON_BOARDS = {"copy", "copy_masked", "log10", "crc16", "stuff", "unstuff", "copy_to_zero", "write_number"}
FILES = {module.__file__ for module in (board, dw1000, link)}


def operations(act, lines):
    """How many bytecodes are run for it: CPython's, and MicroPython's of the same lines; ``lines`` by file.

    Without what boards run as machine code. MicroPython does not count what it runs, but tells what a line becomes.
    """
    here = there = 0

    def trace(frame, event, argument):
        nonlocal here, there
        code = frame.f_code
        if code.co_filename not in lines or code.co_name in COMPILED_ON_BOARDS:
            return None
        frame.f_trace_opcodes = True
        here += event == "opcode"
        if event == "line":
            there += lines[code.co_filename].get(frame.f_lineno, 0)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        act()
    finally:
        sys.settrace(before)
    return here, there


BOUNDS = (130, 1300, 850, 900, 950, 950)
"""For nothing, a reception, a frame from the line, to the chip, its end, a status."""


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="bytecodes are counted as CPython 3.11 has and traces them")
def test_bytecodes_and_octets_per_frame_keep_a_slot():
    """All that a board runs; docs/hardware.md has what it takes."""
    made = vectors.Bench()
    spi, files = on_nrf52(made)
    made.ready().turn(200)
    lines = {file: bytecodes_of_lines(MICROPYTHON, file) if MICROPYTHON else {} for file in files}
    cost = []

    def measure(turns=1):
        made.bus.transactions = spi.octets = 0
        here, there = operations(lambda: made.turn(turns), lines)
        cost.append((here, there, made.bus.transactions, spi.octets))

    measure()  # nothing to do
    made.bus.hear(FRAME, 100, 5)
    measure()  # a reception
    made.tx_at(made.clock.us + 9000, FRAME, 100)
    measure(2)  # a frame is taken from the line, 64 bytes in a turn
    made.clock.us += 7900
    measure()  # and handed to the chip
    made.clock.us += 1200
    measure()  # and has left
    made.say(made.host.ask(link.ASK_STATUS))
    measure()
    assert (made.chip.received, made.chip.sent, made.chip.state) == (1, 1, dw1000.LISTENING)
    assert [transfers for _, _, transfers, _ in cost] == [0, 8, 1, 8, 6, 1]
    assert all(octets <= bound for (*_, octets), bound in zip(cost, (0, 152, 6, 138, 27, 6), strict=True))
    for (here, there, _, _), bound in zip(cost, BOUNDS, strict=True):
        assert bound / 2 < here <= bound
        if MICROPYTHON:
            assert 0.8 * here < there < 1.2 * here
            assert there <= bound


def test_no_number_needs_memory_on_a_board_of_32_bits():
    """MicroPython there holds 31 bits in a word, which the unix port cannot show: locals and results are looked at."""
    made, seen = bench(), 0

    def look(frame, event, argument):
        nonlocal seen
        if frame.f_code.co_filename not in FILES:
            return None
        numbers = [value for value in (argument, *frame.f_locals.values()) if isinstance(value, int)]
        assert all(-(2**30) <= number < 2**30 for number in numbers), (frame.f_code.co_name, frame.f_locals)
        seen += len(numbers)
        return look

    made.clock.us = 2**30 - 5_000  # the clock comes round
    before = sys.gettrace()
    sys.settrace(look)
    try:
        vectors.slots(made, FRAME, 12)
    finally:
        sys.settrace(before)
    assert (made.chip.received, made.chip.sent) == (12, 4)
    assert made.clock.us > 2**30
    assert seen > 10_000


def test_what_boards_compile_is_marked_so():
    """The names above are those that are marked for machine code."""
    marked = set()
    for file in FILES:
        for node in ast.walk(ast.parse(Path(file).read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and any("viper" in ast.unparse(mark) for mark in node.decorator_list):
                marked.add(node.name)
    assert marked == COMPILED_ON_BOARDS


def test_the_file_needs_nothing_that_boards_lack():
    tree = list(ast.walk(ast.parse(Path(board.__file__).read_text(encoding="utf-8"))))
    imports = {alias.name for node in tree if isinstance(node, ast.Import | ast.ImportFrom) for alias in node.names}
    assert imports == {"dw1000", "link"}
    assert not [node for node in tree if isinstance(node, ast.Constant) and isinstance(node.value, float)]
    assert not [node for node in tree if isinstance(node, ast.Div | ast.Pow)]
