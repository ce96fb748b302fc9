"""The firmware's loop against the chip's model, whatever comes in which order: a state machine of hypothesis."""

from collections import Counter

import pytest
from board_stage import (
    ASK_HELLO,
    ASK_STATUS,
    DELAYS,
    DEVICE_ID,
    RX_ON,
    TICKS_PER_US,
    BoardStage,
    frame_of,
    line_of,
    needs_compiler,
)
from emulator.board_library import CBoard
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from skyless.core.ticks import wrap
from skyless.radio.serial.link import Done, Heard, Status, TooLate

pytestmark = pytest.mark.statistical

FAULTS = st.sampled_from([None, None, None, "header", "parity", "delimiter", "first-path"])


class Fire(RuleBasedStateMachine):
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
            if isinstance(one, Heard):
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
TestBoardUnderFire = needs_compiler(Fire.TestCase)
