"""The firmware's loop on the chip's model: what it answers, when it sends, what it does when something fails."""

import ctypes
import math
import random
from collections import Counter

import pytest
from emulator.board_library import CBoard, places
from firmware_stage import (
    ASK_HELLO,
    ASK_STATUS,
    CONFIG,
    DELAYS,
    DEVICE_ID,
    RX_ON,
    TICKS_PER_US,
    TX_AT,
    BoardStage,
    frame_of,
    line_of,
    needs_compiler,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from skyless.core.air.frame import Reception
from skyless.core.ticks import difference, wrap
from skyless.radio.dw1000 import radio as dw1000
from skyless.radio.serial import link
from skyless.radio.serial.link import (
    BoardSettings,
    Done,
    Hello,
    NotDone,
    Status,
    TagConfig,
    TooLate,
    Value,
    pack,
)

pytestmark = [pytest.mark.site, needs_compiler]

FRAME = frame_of(range(98))
SHORT = frame_of(range(40))
LEAD_US, CLOSE_US, POLL_US, CHECK_US = 600, 30, 50_000, 200_000
FOR_RADIO, BUSY, NOT_READY = 1, 2, 3
SETTING, MALFORMED, RADIO = 1, 2, 3


def kinds(reports):
    return [type(one) for one in reports]


def test_python_knows_all_fields_of_the_chip_in_c():
    assert places()["chip_bytes"] == ctypes.sizeof(dw1000.DW1000)


@pytest.fixture
def stage():
    """A board that a host has set up."""
    return BoardStage().ready()


# What it answers


def test_a_board_reports_itself_and_is_configured_by_its_host():
    stage = BoardStage(reset_cause=0x82)
    stage.board.begin()
    assert stage.bus.from_board[0] == 0
    for hello in stage.ask(ASK_HELLO, turns=2):
        assert (hello.major, hello.minor, hello.device_id, hello.can_transmit) == (1, 4, b"identity", True)
        assert hello.has_phases
        assert (hello.rate_khz, hello.counter_bits, hello.reset_cause) == (63_897_600, 40, 0x82)
    assert stage.ask(RX_ON, turns=2) == [NotDone(RX_ON, MALFORMED)]
    stage.config()
    stage.turn(2)
    (status,) = stage.reports()
    assert (status.configured, status.receiving, status.temperature_c, status.supply_v) == (True, False, None, None)
    (status,) = stage.ask(RX_ON, turns=1)
    assert (status.configured, status.receiving) == (True, True)
    assert 0 <= difference(wrap(stage.air.ticks), status.ticks) < 200 * 63_898
    assert not +stage.chip.misuse


RIGHT = bytes((5, 64, 2, 9, 128, 0, 52, 64, 52, 64, 0))


@pytest.mark.parametrize(
    ("kind", "body", "reason"),
    [
        (CONFIG, RIGHT[:-1], MALFORMED),
        (CONFIG, b"", MALFORMED),
        *[(CONFIG, RIGHT[:at] + b"\7" + RIGHT[at + 1 :], SETTING) for at in range(6)],
        (TX_AT, bytes(3), MALFORMED),
        (TX_AT, bytes(5), MALFORMED),
        (TX_AT, bytes(7), MALFORMED),
        (TX_AT, bytes(5) + frame_of(bytes(126)), MALFORMED),
        (TX_AT, bytes(5) + FRAME[:-1] + bytes((FRAME[-1] ^ 1,)), MALFORMED),
    ],
)
def test_what_it_cannot_do_is_refused(stage, kind, body, reason):
    stage.bus.to_board += line_of(kind, body)
    stage.turn(5)
    assert stage.reports() == [NotDone(kind, reason)]
    assert stage.board.chip.state == dw1000.LISTENING


def test_a_later_version_may_append_fields_and_add_kinds(stage):
    for line in (line_of(CONFIG, RIGHT + b"more"), line_of(0x7E, b"new")):
        stage.bus.to_board += line
    stage.turn(2)
    (status,) = stage.reports()
    assert (status.configured, status.garbled) == (True, 0)
    assert stage.ask(ASK_STATUS, turns=1)[0].garbled == 1


@pytest.mark.parametrize("size", [1, 98, 125])
def test_receptions_are_reported_with_the_chips_own_stamp(stage, size):
    stage.air.pass_s(1e-3)
    stamp = stage.arrive(frame_of(range(size)))
    stage.turn()
    (heard,) = stage.reports()
    assert (heard.frame, heard.rx_ticks) == (frame_of(range(size)), stamp)
    assert heard.diagnostics.rx_power_dbm == pytest.approx(-80.0, abs=0.03)
    assert heard.diagnostics.carrier_offset_ppm == pytest.approx(1.0, abs=0.002)
    assert stage.board.chip.state == dw1000.LISTENING


@given(st.lists(st.tuples(st.integers(0, 255), st.none() | st.floats(0.0, 1.0)), min_size=1, max_size=4))
def test_phases_are_reported_as_long_as_the_host_wants_them(receptions):
    stage = BoardStage().ready()
    for flags, phase_cycles in receptions:
        stage.config(flags)
        stage.send(RX_ON)
        stage.turn(8)
        stage.air.pass_s(1e-3)
        stage.reports()
        stamp = stage.arrive(FRAME, phase_cycles=phase_cycles)
        stage.turn()
        (heard,) = stage.reports()
        assert (heard.frame, heard.rx_ticks) == (FRAME, stamp)
        assert (heard.carrier_phase_cycles is not None) == (flags & 1 == 1 and phase_cycles is not None)
        if heard.carrier_phase_cycles is not None:
            assert abs((heard.carrier_phase_cycles - phase_cycles + 0.5) % 1.0 - 0.5) < 2e-4
    assert not +stage.chip.misuse


def test_errors_are_counted_and_it_listens_on(stage):
    for fault in ("header", "parity", "delimiter", "first-path"):
        stage.air.pass_s(1e-3)
        stage.arrive(FRAME, fault=fault)
        stage.turn(3)
        assert stage.reports() == []
    assert stage.ask(ASK_STATUS, turns=1)[0].errors == 4
    stage.air.pass_s(1e-3)
    stage.arrive(FRAME)
    stage.turn()
    assert kinds(stage.reports()) == [Reception]


# When it sends


@pytest.mark.parametrize(
    ("ahead_us", "step_us"),
    [(450, 1), (1000, 100), (1200, 37), (3000, 37), (14_700, 1), (14_700, 100), (2_000_000, 37)],
)
@pytest.mark.statistical
def test_frames_leave_at_their_tick_and_the_receiver_is_off_no_longer_than_needed(stage, ahead_us, step_us):
    tx_ticks = stage.tx_at(ahead_us, SHORT)
    off_us, reports = 0, []
    if ahead_us > 10_000:
        stage.pass_us(ahead_us - 5000)
    for _ in range(round((min(ahead_us, 5000) + 1000) / step_us)):
        stage.turn(1, step_us)
        off_us += step_us * (stage.board.chip.state != dw1000.LISTENING)
        reports += stage.reports()
    dx_ticks = wrap(tx_ticks - DELAYS.tx_ticks)
    (done,) = reports
    assert isinstance(done, Done)
    assert (done.dx_ticks & ~0x1FF, done.tx_ticks) == (dx_ticks, tx_ticks)
    assert [(one.frame, one.tx_ticks) for one in stage.air.sent] == [(SHORT, tx_ticks)]
    assert off_us <= LEAD_US + CLOSE_US + 200 + 3 * step_us
    assert stage.board.chip.state == dw1000.LISTENING
    assert not +stage.chip.misuse


@pytest.mark.parametrize(("flags", "lead_us"), [(0, LEAD_US), (1, LEAD_US + 40)])
def test_a_frame_is_handed_over_earlier_where_receptions_have_phases(stage, flags, lead_us):
    stage.config(flags)
    stage.send(RX_ON)
    stage.turn(8)
    stage.reports()
    stage.tx_at(4000, SHORT)
    due_ticks = stage.air.ticks + 4000 * TICKS_PER_US
    while stage.board.chip.state == dw1000.LISTENING and stage.air.ticks < due_ticks:
        before_ticks = stage.air.ticks
        stage.turn(1, 5)
    assert 0 <= (due_ticks - before_ticks) / TICKS_PER_US - lead_us <= CLOSE_US + 10, "and its turn"


@pytest.mark.parametrize("ahead_us", [120, 0, -1, -5000, -8_000_000])
def test_what_comes_too_late_is_reported_and_never_sent(stage, ahead_us):
    stage.tx_at(ahead_us - 20, SHORT)
    stage.turn(500)
    (late,) = stage.reports()
    assert (type(late), late.reason) == (TooLate, FOR_RADIO)
    assert stage.air.sent == []
    assert stage.board.chip.state == dw1000.LISTENING


def test_every_frame_is_answered_once_and_one_is_held_at_a_time(stage):
    first = stage.tx_at(5000, SHORT)
    stage.turn(2)
    second = stage.tx_at(9000, SHORT)
    stage.pass_us(12_000)
    late, done = stage.reports()
    assert (type(late), late.reason, wrap((late.dx_ticks & ~0x1FF) + DELAYS.tx_ticks)) == (TooLate, BUSY, second)
    assert (type(done), done.tx_ticks) == (Done, first)


def test_a_tag_or_an_unconfigured_board_sends_nothing():
    for stage in (BoardStage(), BoardStage(can_transmit=False).ready()):
        stage.tx_at(5000, SHORT)
        stage.pass_us(8000)
        (late,) = stage.reports()
        assert (type(late), late.reason) == (TooLate, NOT_READY)
        assert stage.air.sent == []


def test_a_frame_that_comes_shortly_before_ones_own_is_not_lost(stage):
    stage.tx_at(4000, SHORT)
    stage.pass_us(4000 - LEAD_US - 100)
    stage.arrive(FRAME)
    stage.pass_us(2000)
    assert kinds(stage.reports()) == [Reception, Done]


def test_a_frame_whose_end_the_chip_never_reports_is_cancelled(stage):
    stage.air.in_time = False  # the air refuses it, and the chip shows nothing
    stage.tx_at(3000, SHORT)
    stage.pass_us(9000)
    (late,) = stage.reports()
    assert (type(late), late.reason) == (TooLate, FOR_RADIO)
    assert stage.board.chip.state == dw1000.LISTENING
    assert stage.air.sent == []


# When something fails


def test_a_chip_that_was_reset_is_reported_and_can_be_configured_again(stage):
    stage.tx_at(900_000, SHORT)
    stage.turn(4)
    stage.chip.pull_reset()
    stage.pass_us(POLL_US + 1000)
    late, hello = stage.reports()
    assert (type(late), late.reason, type(hello)) == (TooLate, NOT_READY, Hello)
    (status,) = stage.ask(ASK_STATUS, turns=1)
    assert (status.configured, status.receiving, status.ticks) == (False, False, 0)
    stage.pass_us(1_000_000)
    assert stage.air.sent == []
    stage.ready()
    stage.pass_us(5000)
    stage.arrive(FRAME)
    stage.turn()
    assert kinds(stage.reports()) == [Reception]


@pytest.mark.parametrize("after_us", [1, 10_000, 14_350, 14_420, 14_600, 14_900])
def test_a_chip_that_loses_its_supply_before_a_frame_is_due_sends_nothing_wrong(stage, after_us):
    stage.pass_us(20_000)
    stage.tx_at(15_000, SHORT)
    stage.pass_us(after_us)
    stage.chip.pull_reset()
    stage.pass_us(300_000)
    assert stage.chip.transceiver.counts["sent-with-other-settings"] == 0
    assert stage.chip.transceiver.counts["sent"] == 0
    assert TooLate in kinds(stage.reports())


def test_a_chip_that_looks_right_and_has_lost_its_settings_is_found_soon(stage):
    stage.chip.memory.write(0x1F, 0, b"\0")
    stage.pass_us(CHECK_US + 1000)
    assert kinds(stage.reports()) == [Hello]
    assert not stage.ask(ASK_STATUS, turns=1)[0].configured


def test_a_board_without_a_chip_says_so_and_goes_on():
    stage = BoardStage()
    stage.bus.present = False
    stage.board.begin()
    stage.config()
    stage.send(RX_ON)
    stage.turn(4)
    assert stage.reports()[1:] == [NotDone(CONFIG, RADIO, start_step=1), NotDone(RX_ON, MALFORMED)]
    assert stage.bus.lights & 8
    stage.bus.present = True
    stage.ready()
    assert stage.board.chip.state == dw1000.LISTENING
    assert not stage.bus.lights & 8


@pytest.mark.parametrize("stuck", [True, False])
def test_a_stuck_interrupt_line_is_reported_and_the_chip_is_polled(stage, stuck):
    stage.bus.stuck = stuck
    for _ in range(8):  # what the slow polls find shows that the line is dead
        stage.arrive(FRAME)
        stage.pass_us(60_000)
    for _ in range(200):
        stage.arrive(FRAME)
        stage.pass_us(1050)
    assert stage.chip.arrivals["heard"] >= 206  # a measurement may cost two
    assert kinds(stage.reports()) == [Reception] * stage.chip.arrivals["heard"]
    stage.tx_at(3000, SHORT)
    stage.pass_us(5000)
    assert kinds(stage.reports()) == [Done]
    assert stage.ask(ASK_STATUS, turns=1)[0].polled
    assert stage.bus.lights & 8
    stage.bus.stuck = None  # and back
    for _ in range(4):
        stage.pass_us(3000)
        stage.arrive(FRAME)
    stage.pass_us(3000)
    assert not stage.ask(ASK_STATUS, turns=1)[-1].polled


def test_a_sound_interrupt_line_is_never_called_stuck():
    stage, draw = BoardStage().ready(), random.Random(2)
    for _ in range(400):
        stage.pass_us(draw.randrange(1, 2000))
        stage.arrive(FRAME)
        stage.turn(draw.randrange(1, 4), step_us=1)
        stage.send(ASK_STATUS)
        stage.turn(2)
        assert not [one for one in stage.reports() if isinstance(one, Status) and one.polled]


# When it measures


def superframe(stage, slot_us=2100, slots=7, mine=3):
    """All slots of a superframe but the own one are heard; the own frame is asked for early."""
    begin = stage.air.now_s()
    stage.tx_at(mine * slot_us, FRAME)
    for slot in range(slots):
        stage.pass_us(1e6 * (begin - stage.air.now_s()) + slot * slot_us + 200)
        if slot != mine:
            stage.arrive(FRAME)
            assert stage.outcome == "heard"
    stage.pass_us(1e6 * (begin - stage.air.now_s()) + slots * slot_us)


def test_temperature_and_supply_are_measured_in_the_own_slot_where_all_others_send(stage):
    superframe(stage)
    assert kinds(stage.reports()) == [Reception, Reception, Reception, Done, Reception, Reception, Reception]
    (status,) = stage.ask(ASK_STATUS, turns=1)
    assert status.temperature_c == pytest.approx(31.0, abs=1.2)
    assert status.supply_v == pytest.approx(3.3, abs=0.02)
    for _ in range(10):
        superframe(stage)
    assert stage.board.chip.received == 11 * 6
    assert stage.board.chip.sent == 11


@given(st.integers(0, 9000), st.integers(20, 200))
@settings(max_examples=40, deadline=None)
def test_nothing_long_is_begun_shortly_before_a_frame_is_due(ahead_us, quiet_us):
    stage = BoardStage().ready()
    stage.pass_us(quiet_us)
    stage.tx_at(ahead_us, SHORT)
    stage.pass_us(ahead_us + 5000)
    assert stage.air.sent or ahead_us <= 450
    assert (stage.board.chip.sent, len(stage.reports())) == (len(stage.air.sent) - stage.air.withdrawn, 1)


def test_where_no_slot_is_free_the_measurement_costs_one_reception_a_minute():
    stage = BoardStage(can_transmit=False).ready()
    lost = 0
    for _ in range(60):
        stage.air.pass_s(0.998)  # as if it were one slot of many
        stage.turn()
        stage.pass_us(1900)
        stage.arrive(FRAME)
        lost += stage.outcome != "heard"
        stage.turn()
    assert lost <= 1
    assert stage.ask(ASK_STATUS, turns=1)[-1].temperature_c is not None


# What comes from the host may be anything


@given(
    st.lists(st.one_of(st.binary(max_size=70), st.sampled_from(["hello", "status", "rx", "tx", "cut"])), max_size=30)
)
@settings(max_examples=60, deadline=None)
def test_nothing_that_a_host_says_stops_a_board(pieces):
    stage = BoardStage().ready()
    commands = {
        "hello": lambda: stage.send(ASK_HELLO),
        "status": lambda: stage.send(ASK_STATUS),
        "rx": lambda: stage.send(RX_ON),
        "tx": lambda: stage.tx_at(2000, SHORT),
        "cut": lambda: stage.bus.to_board.extend(line_of(TX_AT, bytes(60))[:30]),
    }
    for piece in pieces:
        if isinstance(piece, str):
            commands[piece]()
        else:
            stage.bus.to_board += piece
        stage.turn(3)
        assert not [one for one in stage.reports() if isinstance(one, str)]
    stage.bus.to_board += b"\0"
    assert kinds(stage.ask(ASK_STATUS, turns=40))[-1] is Status
    assert not +stage.chip.misuse
    assert {one.frame for one in stage.air.sent} <= {SHORT}


def test_a_flood_of_noise_costs_no_reception_and_restarts_the_line():
    stage, noise = BoardStage().ready(), random.Random(5)
    for _ in range(300):
        stage.air.pass_s(1e-3)
        stage.bus.to_board += noise.randbytes(noise.randrange(1, 200))
        stage.arrive(FRAME)
        stage.turn(5)
    assert stage.board.chip.received == 300
    assert stage.bus.restarts >= 1
    assert kinds(stage.reports()) == [Reception] * 300
    stage.bus.to_board[:] = b"\0"
    assert stage.ask(ASK_STATUS, turns=2)[-1].garbled > 100


def test_a_host_that_does_not_read_costs_records_and_they_are_counted(stage):
    stage.bus.room = 1024
    for _ in range(100):
        stage.air.pass_s(1e-3)
        stage.arrive(FRAME)
        stage.turn(2)
    assert stage.board.chip.received == 100
    kept = len(stage.reports())
    assert 0 < kept < 12
    assert stage.ask(ASK_STATUS, turns=1)[0].unsent_records == 100 - kept


def test_the_clock_may_wrap():
    stage = BoardStage(ticks=round((2**32 - 20_000) * 63_897.6)).ready()
    for _ in range(20):
        stage.tx_at(3000, SHORT)
        stage.pass_us(6000)
        stage.arrive(FRAME)
        stage.turn(2)
    assert kinds(stage.reports()) == [Done, Reception] * 20


# All of it in any order

FAULTS = st.sampled_from([None, None, None, "header", "parity", "delimiter", "first-path"])


class Fire(RuleBasedStateMachine):
    """Whatever comes in which order."""

    @initialize(ticks=st.integers(0, 2**40 - 1), can_transmit=st.booleans())
    def begin(self, ticks, can_transmit):
        self.can_transmit = can_transmit
        self.stage = BoardStage(ticks=ticks, can_transmit=can_transmit).ready()
        self.serial = 0
        self.asked = {}
        """Frames that the host has asked for, by their stamps."""
        self.arrived = {}
        """Stamps of frames that came to the antenna."""
        self.answers = Counter()
        self.seen = 0

    def new_frame(self, size):
        self.serial += 1
        return frame_of(self.serial.to_bytes(4, "little") + bytes(size))

    # The air

    @rule(us=st.integers(0, 4000))
    def pass_time(self, us):
        self.stage.pass_us(us)

    @rule(us=st.integers(0, 60_000), step_us=st.integers(1, 400))
    def turn_late(self, us, step_us):
        """A processor that is slow: time passes between its turns."""
        self.stage.turn(us // (10 * step_us) + 1, step_us)

    @rule(fault=FAULTS, size=st.integers(1, 110))
    def arrive(self, fault, size):
        frame = self.new_frame(size)
        self.arrived[frame] = self.stage.arrive(frame, fault=fault)
        assert self.stage.outcome not in ("suspect", "without-microcode")

    @rule(in_time=st.booleans())
    def let_the_air_refuse(self, in_time):
        self.stage.air.in_time = in_time

    # What fails

    @rule()
    def lose_the_chips_supply(self):
        self.stage.chip.pull_reset()

    @rule(stuck=st.sampled_from([None, None, True, False]))
    def stick_the_interrupt_line(self, stuck):
        self.stage.bus.stuck = stuck

    @rule(present=st.sampled_from([True, True, False]))
    def unsolder_the_chip(self, present):
        self.stage.bus.present = present

    @rule()
    def reset_the_processor(self):
        stage = self.stage
        stage.chip.pull_reset()  # main.c does so first of all
        stage.board = CBoard(stage.bus, can_transmit=self.can_transmit, device_id=DEVICE_ID, reset_cause=2)
        stage.board.begin()

    @rule(room=st.sampled_from([0, 50, 1 << 30]))
    def fill_the_line(self, room):
        self.stage.bus.room = room

    # The host

    @rule(ahead_us=st.one_of(st.integers(-3000, 20_000), st.integers(0, 1000)), size=st.integers(1, 119))
    def ask_for_a_frame(self, ahead_us, size):
        frame = self.new_frame(size)
        tx_ticks = wrap((wrap(self.stage.air.ticks + round(ahead_us * TICKS_PER_US)) & ~0x1FF) + DELAYS.tx_ticks)
        if tx_ticks not in self.asked:
            self.asked[tx_ticks] = frame
            self.stage.tx_at(ahead_us, frame)

    @rule(kind=st.sampled_from([ASK_HELLO, ASK_STATUS, RX_ON, 0x7F]))
    def command(self, kind):
        self.stage.send(kind)

    @rule()
    def configure(self):
        self.stage.config()
        self.stage.send(RX_ON)

    @rule(noise=st.binary(max_size=60))
    def make_noise(self, noise):
        self.stage.bus.to_board += noise

    # What must hold

    @invariant()
    def reports_are_true(self):
        stage = self.stage
        for one in stage.reports():
            assert not isinstance(one, str), one
            if isinstance(one, Reception):
                assert self.arrived.pop(one.frame) == one.rx_ticks
            elif isinstance(one, Done):
                assert (one.dx_ticks & ~0x1FF) + DELAYS.tx_ticks in (one.tx_ticks, one.tx_ticks + 2**40)
                assert one.tx_ticks in {sent.tx_ticks for sent in stage.air.sent}
            if isinstance(one, Done | TooLate):
                self.answers[one.dx_ticks] += 1
                assert self.answers[one.dx_ticks] == 1, "a frame is answered once"

    @invariant()
    def nothing_wrong_is_sent(self):
        for sent in self.stage.air.sent:
            assert self.asked[sent.tx_ticks] == sent.frame
        assert self.stage.chip.transceiver.counts["sent-with-other-settings"] == 0
        assert self.can_transmit or not self.stage.air.sent

    def teardown(self):
        """When all is sound again, a host that asks for the state finds the board working."""
        if not hasattr(self, "stage"):
            return
        stage = self.stage
        stage.bus.stuck, stage.bus.present, stage.bus.room, stage.air.in_time = None, True, 1 << 30, True
        stage.bus.to_board += b"\0"
        while stage.bus.to_board:  # each configuration takes 8 ms
            stage.pass_us(10_000)
        stage.pass_us(250_000)  # a chip that has lost its settings is found
        self.reports_are_true()
        stage.bus.to_board += b"\0" + line_of(ASK_HELLO, b"\1\1")
        stage.config()
        stage.send(RX_ON)
        stage.pass_us(20_000)
        self.reports_are_true()
        for _ in range(2):
            stage.pass_us(5000)
            self.arrive(None, 50)
            assert stage.outcome == "heard"
            stage.pass_us(1000)
            received = stage.board.chip.received
            assert received >= 1
            self.reports_are_true()
            sent = stage.board.chip.sent
            self.ask_for_a_frame(4000, 60)
            stage.pass_us(8000)
            assert stage.board.chip.sent == sent + self.can_transmit
            self.reports_are_true()
        stage.send(ASK_STATUS)
        stage.pass_us(100)
        status = stage.reports()[-1]
        assert isinstance(status, Status)
        assert (status.configured, status.receiving, status.polled) == (True, True, False)
        self.nothing_wrong_is_sent()
        assert not stage.chip.misuse.keys() - {"spi-too-fast", "radio-without-pll"}  # of a chip that was just reset


Fire.TestCase.settings = settings(max_examples=40, stateful_step_count=50, deadline=None)
TestBoardUnderFire = pytest.mark.statistical(Fire.TestCase)


# What a self-test asks


def reading(file, sub=0, octets=4, times=1, flags=0, data=b""):
    body = bytes((file,)) + sub.to_bytes(2, "little") + bytes((octets,)) + times.to_bytes(2, "little")
    return body + bytes((flags,)) + data


def test_registers_of_the_chip_are_read_as_often_as_asked_and_one_is_written(stage):
    value = Value(0, 0, 0, (0xDECA0130).to_bytes(4, "little"))
    for flags in (0, link.READ_SLOWLY):
        assert stage.ask(link.READ, reading(0x00, times=1000, flags=flags)) == [value]
        pattern = bytes.fromhex("a55a00ff")
        assert stage.ask(link.READ, reading(0x03, times=7, flags=flags, data=pattern)) == [Value(3, 0, 0, pattern)]
    part = stage.chip.clocking.sensors.part
    assert stage.ask(link.READ, reading(link.OTP, 0x06)) == [Value(link.OTP, 6, 0, part.to_bytes(4, "little"))]
    (clocks,) = stage.ask(link.READ, reading(link.CLOCKS))
    assert difference(stage.air.now_ticks(), int.from_bytes(clocks.data[8:], "little")) * 1e6 < TICKS_PER_US * 1e9
    assert stage.chip.misuse == {}
    stage.arrive(FRAME)
    stage.turn(2)
    assert kinds(stage.reports()) == [Reception]


@pytest.mark.parametrize(
    "body",
    [
        reading(0x00)[:6], reading(0x00, octets=0), reading(0x00, octets=17), reading(0x00, times=1001),
        reading(0x04, data=bytes(4)), reading(0x03, sub=1, data=bytes(4)), reading(0x03, data=bytes(3)),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused(stage, body):
    assert stage.ask(link.READ, body) == [NotDone(link.READ, MALFORMED)]
    assert stage.chip.misuse == {}


def test_records_that_test_the_line_have_their_length_and_keep_to_its_rate(stage):
    begun_us = stage.bus.now_us()
    stage.send(link.TEST_LINE, bytes((30, 0, 117)))
    lines, ended_us = [], begun_us
    while len(lines) < 30:
        stage.turn()
        if stage.bus.from_board:
            lines.append(len(stage.bus.from_board))
            ended_us = stage.bus.now_us()
            assert kinds(stage.reports()) == [link.Test]
    assert set(lines) == {117}
    assert ended_us - begun_us == pytest.approx(29 * 117 * 10 / 0.4608, rel=0.03)
    for length in (5, 251):
        assert stage.ask(link.TEST_LINE, bytes((1, 0, length))) == [NotDone(link.TEST_LINE, MALFORMED)]


def test_a_rate_that_flash_does_not_hold_is_given_up_after_silence_and_flash_holds_for_both_modes(stage):
    rates = []
    stage.bus.set_rate = rates.append
    stage.board = CBoard(stage.bus, can_transmit=True)
    stage.board.begin()
    for baud, keep in ((115_200, False), (1_000_000, True)):
        stage.send(link.SET_TAG_CONFIG, bytes((keep,)) + pack(BoardSettings(baud=baud)))
        stage.pass_us(2_900_000)
        stage.send(ASK_STATUS)  # which is understood
        stage.pass_us(2_900_000)
        stage.pass_us(200_000)
    assert rates == [460_800, 115_200, 460_800, 1_000_000]
    assert kinds(stage.reports()).count(TagConfig) == 2
    stage.board = CBoard(stage.bus, can_transmit=True)
    stage.board.begin()
    assert rates[-1] == 1_000_000


def test_a_chip_that_does_not_start_says_where_it_ended():
    stage = BoardStage()
    stage.board.begin()
    stage.chip.clocking.restart = lambda: setattr(stage.chip.clocking, "_lock_s", math.inf)
    stage.config()
    stage.turn(4)
    (refused,) = stage.reports()[1:]
    assert (refused.reason, refused.start_step, refused.identifier) == (RADIO, 2, 0xDECA0130)
    assert "does not lock" in link.start_failure(refused.start_step, refused.identifier)
