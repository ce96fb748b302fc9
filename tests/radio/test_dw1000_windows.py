"""A receiver that is on for a while only, that has two buffers, and that sleeps: the driver on the register model."""

import random

import pytest
from chip_stage import HandClock

from skyless.core.air.frame import Diagnostics, after_rmarker_s, air_time_s, fcs, preamble_s
from skyless.core.ticks import TICK_S, from_seconds, wrap
from skyless.radio.dw1000 import radio as dw1000
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.chip import ASLEEP_A, IDLE_A, RECEIVING_A, Chip, ModelBus

pytestmark = pytest.mark.site

FRAMES = [bytes((number,)) * 98 + fcs(bytes((number,)) * 98) for number in range(8)]
PREAMBLE_S, REST_S, FRAME_S = preamble_s(), after_rmarker_s(100), air_time_s(100)
WINDOW = 400
ACTIONS = ["listen", "window", "window", "idle", "measure", "sleep", *["frame"] * 3, *["poll"] * 3]
WINDOW_S = WINDOW * 65536 * TICK_S


class Stage:
    """A chip that has been started, in an air whose time the test moves."""

    def __init__(self, ticks=0, *, uses_both_buffers=False):
        self.air = HandClock(ticks)
        self.chip = Chip(self.air, 16_436, 16_436, self.air.now_s)
        self.driver = dw1000.DW1000(ModelBus(self.chip, self.air.pass_s))
        self.driver.uses_both_buffers = uses_both_buffers
        self.driver.start(16_436, 16_436)

    def pass_to(self, seconds):
        assert seconds >= self.air.now_s()
        self.air.ticks = from_seconds(seconds)

    def arrive(self, number, marker_s, ppm=0.0):
        """A frame whose RMARKER is at the antenna at that time; what becomes of it at its end."""
        self.pass_to(marker_s + REST_S)
        return self.chip.receive(FRAMES[number], wrap(from_seconds(marker_s)), Diagnostics(-80.0, -83.0, ppm))


@pytest.mark.parametrize("begin_ticks", [0, 2**40 - from_seconds(3e-3)])
@pytest.mark.parametrize(
    ("marker_s", "outcome"),
    [
        (PREAMBLE_S + 20e-6, "heard"),
        (WINDOW_S - REST_S - 1e-6, "heard"),
        (WINDOW_S - REST_S + 1e-6, "receiver-off"),  # it has not ended in the window
        (PREAMBLE_S / 2 - 20e-6, "preamble-missed"),
    ],
)
def test_a_window_hits_a_frame_at_its_time_and_no_other(begin_ticks, marker_s, outcome):
    stage = Stage(begin_ticks)
    begin_s = stage.air.now_s() + 2e-3
    before_s = stage.chip.receiving_s
    assert stage.driver.receive_at(wrap(from_seconds(begin_s)), WINDOW) == dw1000.QUEUED
    assert stage.driver.state == dw1000.AWAITING
    assert stage.driver.transmit_at(0, FRAMES[0]) == dw1000.BUSY
    assert stage.driver.poll() == 0
    assert stage.arrive(1, begin_s + marker_s) == outcome
    expected_s = marker_s + REST_S if outcome == "heard" else WINDOW_S
    stage.pass_to(begin_s + max(WINDOW_S, marker_s + REST_S) + 1e-6)
    assert stage.chip.irq
    assert stage.driver.poll() == (dw1000.RECEIVED if outcome == "heard" else dw1000.NOTHING)
    assert outcome != "heard" or stage.driver.frame == FRAMES[1]
    assert stage.driver.state == dw1000.IDLE
    assert stage.chip.receiving_s - before_s == pytest.approx(expected_s, abs=10e-9)  # DX_TIME has steps of 8 ns
    assert not stage.chip.irq
    assert stage.chip.misuse.total() == 0


def test_a_time_that_has_passed_is_reported_and_the_receiver_stays_off():
    stage = Stage()
    assert stage.driver.receive_at(stage.driver.now() - from_seconds(1e-3), WINDOW) == dw1000.LATE
    assert stage.driver.state == dw1000.IDLE
    assert stage.arrive(0, stage.air.now_s() + 1e-3) == "receiver-off"
    assert stage.chip.receiving_s == 0.0
    stage.driver.sleep()
    assert stage.driver.receive_at(0, WINDOW) == dw1000.NOT_READY


def test_frames_only_costs_what_its_windows_cost():
    """Six slots of 1.07 ms with a window each: the receiver's time and the charge are those of the windows."""
    stage = Stage()
    begin_s, receiving_s = stage.air.now_s() + 1e-3, 0.0
    before_c, before_s = stage.chip.charge_c, stage.air.now_s()
    for slot in range(6):
        on_s = begin_s + slot * 1.07e-3
        assert stage.driver.receive_at(wrap(from_seconds(on_s)), WINDOW) == dw1000.QUEUED
        stage.arrive(slot, on_s + 0.1e-3 + PREAMBLE_S)
        receiving_s += 0.1e-3 + FRAME_S
        assert stage.driver.poll() == dw1000.RECEIVED
    assert stage.chip.receiving_s == pytest.approx(receiving_s, abs=6 * 10e-9)
    charge_c = RECEIVING_A * receiving_s + IDLE_A * (stage.air.now_s() - before_s - receiving_s)
    assert stage.chip.charge_c - before_c == pytest.approx(charge_c, rel=1e-4)


def test_listening_goes_on_without_a_window_afterwards():
    stage = Stage()
    stage.driver.receive_at(wrap(from_seconds(stage.air.now_s() + 1e-3)), WINDOW)
    stage.driver.receive()
    stage.pass_to(stage.air.now_s() + 1.0)
    assert stage.driver.poll() == 0
    assert stage.chip.receiving_s == pytest.approx(1.0, rel=1e-4)
    assert stage.arrive(3, stage.air.now_s() + 1e-3) == "heard"
    stage.driver.idle()
    assert (stage.driver.state, stage.driver.poll()) == (dw1000.IDLE, 0)


# Two buffers


def test_a_frame_that_comes_while_another_is_read_waits_in_the_second_buffer():
    """The carrier offset has one place for both, and belongs to the right frame all the same."""
    stage = Stage(uses_both_buffers=True)
    stage.driver.receive()
    read = []
    transfer = stage.chip.transfer

    def slow(out, hz):
        """While the first frame's octets are read, the next one comes in and ends."""
        if out[0] == r.RX_BUFFER.file and len(read) < 7:
            read.append(len(read) + 1)
            assert stage.arrive(read[-1], stage.air.now_s() + PREAMBLE_S, float(read[-1])) == "heard"
        return transfer(out, hz)

    stage.chip.transfer = slow
    assert stage.arrive(0, stage.air.now_s() + PREAMBLE_S, 0.0) == "heard"
    for number in range(8):
        assert stage.driver.poll() == dw1000.RECEIVED
        assert stage.driver.frame == FRAMES[number]
        assert stage.driver.offset_ppb == pytest.approx(1e3 * number, abs=1.0)
    assert stage.driver.poll() == 0
    assert stage.chip.arrivals == {"heard": 8}
    assert stage.chip.misuse.total() == 0


@pytest.mark.parametrize("uses_both_buffers", [False, True])
def test_the_receiver_is_off_for_less_time_with_two_buffers(uses_both_buffers):
    stage = Stage(uses_both_buffers=uses_both_buffers)
    stage.driver.receive()
    off_s = []
    command = stage.chip.transceiver.command

    def noted(control):
        command(control)
        if control & r.RXENAB:
            off_s.append(stage.air.now_s())

    stage.chip.transceiver.command = noted
    stage.arrive(0, stage.air.now_s() + 1e-3)
    ended_s = stage.air.now_s()
    stage.driver.poll()
    (on_s,) = off_s
    assert (on_s - ended_s < 12e-6) is uses_both_buffers  # SPI at 16 MHz alone


@pytest.mark.parametrize("fault", ["header", "parity", "delimiter", "first-path"])
def test_buffers_are_aligned_after_an_error(fault):
    stage = Stage(uses_both_buffers=True)
    stage.driver.receive()
    for number in range(6):
        marker_s = stage.air.now_s() + 1e-3
        if number % 2:
            stage.pass_to(marker_s + REST_S)
            stage.chip.receive(FRAMES[number], wrap(from_seconds(marker_s)), Diagnostics(), fault)
            assert stage.driver.poll() == dw1000.FAILED
        else:
            assert stage.arrive(number, marker_s) == "heard"
            assert stage.driver.poll() == dw1000.RECEIVED
            assert stage.driver.frame == FRAMES[number]
    stage.arrive(0, stage.air.now_s() + 1e-3)
    stage.driver.measure()  # forgets it
    assert stage.driver.poll() == 0
    assert stage.arrive(7, stage.air.now_s() + 1e-3) == "heard"
    assert stage.driver.poll() == dw1000.RECEIVED
    assert stage.driver.frame == FRAMES[7]


@pytest.mark.parametrize("uses_both_buffers", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_whatever_is_asked_and_comes_each_frame_has_its_own_stamp(seed, uses_both_buffers):
    """Random windows, listening, sleep, frames good and spoilt: no stamp of a receiver that was not reset."""
    chance, stage = random.Random(seed), Stage(uses_both_buffers=uses_both_buffers)
    heard, stamps = 0, {}
    for number in range(400):
        begin_s = stage.air.now_s() + 0.2e-3
        action = chance.choice(ACTIONS)
        if action == "listen":
            stage.driver.receive()
        elif action == "window":
            assert stage.driver.receive_at(wrap(from_seconds(begin_s)), chance.randrange(200, 3000)) == dw1000.QUEUED
        elif action == "idle" and chance.random() < 0.3:
            stage.driver.idle()
        elif action == "measure":
            stage.driver.measure()
        elif action == "sleep" and chance.random() < 0.1:
            stage.driver.sleep()
            assert stage.driver.wake(16_436, 16_436)
        elif action == "frame":
            marker_s = begin_s + chance.uniform(PREAMBLE_S, 1e-3)
            frame = number.to_bytes(2, "little") + bytes(96)
            stamps[number] = wrap(from_seconds(marker_s))
            stage.pass_to(marker_s + REST_S)
            fault = chance.choice([None, None, None, "header", "parity", "delimiter", "first-path"])
            stage.chip.receive(frame + fcs(frame), stamps[number], Diagnostics(), fault)
        elif stage.driver.poll() & dw1000.RECEIVED:
            heard += 1
            assert stage.driver.rx_ticks == stamps[int.from_bytes(stage.driver.frame[:2], "little")]
    assert heard > 3
    assert stage.chip.misuse.total() == 0


# Sleep


def test_a_chip_sleeps_and_wakes_configured():
    stage = Stage()
    woken = []
    stage.chip.on_wake = lambda: woken.append(stage.air.now_s())
    stage.driver.receive()
    stage.driver.sleep()
    assert stage.driver.state == dw1000.OFF
    before_c, before_s = stage.chip.charge_c, stage.chip.asleep_s
    stage.pass_to(stage.air.now_s() + 3600.0)
    assert stage.chip.receive(FRAMES[0], 0, Diagnostics()) == "receiver-off"
    assert stage.chip.asleep_s - before_s == pytest.approx(3600.0)
    assert stage.chip.charge_c - before_c == pytest.approx(3600.0 * ASLEEP_A)
    begin_s = stage.air.now_s()
    assert stage.driver.wake(16_436, 16_436)
    assert len(woken) == 1
    assert stage.air.now_s() - begin_s < 6.5e-3
    assert (stage.driver.state, stage.chip.misuse.total()) == (dw1000.IDLE, 0)
    stage.driver.receive()
    assert stage.arrive(5, stage.air.now_s() + 1e-3) == "heard"
    assert stage.driver.poll() == dw1000.RECEIVED


def test_what_a_sleeping_chip_does_not_bear_is_counted():
    stage = Stage()
    stage.driver.sleep()
    assert stage.driver.now() == 0
    stage.chip.pull_reset()
    assert stage.chip.misuse == {"spi-while-asleep": 1, "reset-while-asleep": 1}
    stage.chip.select(499e-6)
    assert stage.driver.now() == 0
    stage.chip.select(501e-6)
    stage.pass_to(stage.air.now_s() + 5e-3)
    assert stage.driver.now() != 0


def test_a_chip_that_does_not_wake_is_off():
    stage = Stage()
    stage.driver.sleep()
    stage.chip.transfer = lambda out, _: bytes(len(out))
    assert not stage.driver.wake(0, 0)
    assert stage.driver.state == dw1000.OFF
