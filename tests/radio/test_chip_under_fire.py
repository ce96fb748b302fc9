"""The driver against the register model, whatever comes in which order: a state machine of hypothesis."""

import pytest
from chip_stage import HandClock, TimedNode
from hypothesis import event, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from skyless.core.air.frame import Diagnostics, Reception, Transmission, after_rmarker_s, fcs
from skyless.core.ticks import from_seconds, wrap
from skyless.radio.dw1000 import radio as dw1000
from skyless.radio.interface import AntennaDelays, Late, Sent
from skyless.sim.dw1000 import registers as r

pytestmark = pytest.mark.site

DELAYS = AntennaDelays(16_500, 16_300)
FAULTS = st.sampled_from([None, None, None, "header", "parity", "delimiter", "first-path", "fcs"])
MICROSECONDS = st.integers(0, 4000)


class Fire(RuleBasedStateMachine):
    @initialize(ticks=st.integers(0, 2**40 - 1))
    def begin(self, ticks):
        self.air = HandClock(ticks)
        self.node = TimedNode(self.air, DELAYS, DELAYS)
        self.driver = self.node.session.driver
        self.node.start()
        self.serial = 0
        self.flown = {}
        """Frames that came in unspoilt, with stamp and powers."""
        self.asked = {}
        """Stamps of frames that are to be sent, with them."""
        self.heard = self.lost = self.spoilt = self.missed_errors = self.taken_back = self.requests = 0
        self.waits = None
        """Outcome of a reception that the host has not fetched."""
        self.told_frames = 0

    # The air

    @rule(us=MICROSECONDS)
    def pass_time(self, us):
        self.air.pass_s(1e-6 * us)

    @rule(
        us=st.sampled_from([500, 500, 500, 200, 0]),
        fault=FAULTS,
        size=st.integers(1, 110),
        power=st.integers(-95, -60),
        offset=st.integers(-20, 20),
        phase=st.one_of(st.none(), st.floats(0.0, 1.0, exclude_max=True)),
        served=st.booleans(),
    )
    def arrive(self, us, fault, size, power, offset, phase, served):
        """A frame that ends after so much time; the host may fetch it at once."""
        self.air.pass_s(1e-6 * us)
        self.serial += 1
        body = self.serial.to_bytes(4, "little") + bytes(size)
        frame = body + (fcs(body) if fault != "fcs" else bytes(x ^ 1 for x in fcs(body)))
        stamp = wrap(self.air.ticks - from_seconds(after_rmarker_s(len(frame))))
        told = Diagnostics(float(power), power - 3.0, float(offset))
        fault = None if fault == "fcs" else fault
        outcome = self.node.chip.receive(frame, stamp, told, fault, carrier_phase_cycles=phase)
        if outcome in ("heard", "spoilt", "suspect"):
            assert self.waits is None, "a frame came over one that had not been fetched"
            self.waits = outcome
            self.heard += outcome != "spoilt"
            self.spoilt += outcome == "spoilt"
            self.flown[frame] = (stamp, told, phase)
        assert outcome not in ("suspect", "other-settings", "without-microcode")
        if served:
            self.serve()

    @rule()
    def lose_supply(self):
        """The chip forgets everything; the host does not know."""
        self.node.chip.pull_reset()
        self.air.pass_s(1e-4)
        self.forget()
        self.forget_sending()
        assert not self.node.session.serve()
        assert self.driver.state == dw1000.OFF
        self.node.start()

    # The host

    @rule()
    def serve(self):
        assert self.node.session.serve()
        self.fetched()

    @rule(
        us=st.one_of(st.integers(-3000, 20_000), st.integers(0, 1000)),
        size=st.integers(1, 120),
        refuses=st.integers(0, 9),
    )
    def transmit(self, us, size, refuses):
        self.serial += 1
        body = self.serial.to_bytes(4, "big") + bytes(size)
        frame = body + fcs(body)
        dx = wrap(self.air.ticks + from_seconds(1e-6 * us)) & ~0x1FF
        tx_ticks = wrap(dx + DELAYS.tx_ticks)
        taken = tx_ticks in self.asked
        self.asked.setdefault(tx_ticks, frame)
        self.air.in_time = refuses != 0
        flew = len(self.air.sent)
        self.requests += 1
        self.node.session.transmit(Transmission(frame, tx_ticks))
        self.air.in_time = True
        self.fetched()
        if not taken and self.air.sent[flew:]:
            assert us > 100

    @rule()
    def give_up(self):
        waits = self.node.session.overdue_ticks is not None
        self.node.session.cancel_overdue()
        if waits:
            self.fetched()

    @rule()
    def restart(self):
        """The host starts the chip again."""
        self.forget()
        self.forget_sending()
        self.node.start()

    @rule()
    def measure(self):
        """Nothing is received meanwhile."""
        if self.driver.state == dw1000.LISTENING:
            self.serve()
        if self.driver.measure():
            assert abs(self.driver.temperature_cc - 3100) < 115

    @rule()
    def read_counter(self):
        assert self.node.session.read_ticks() == wrap(self.air.ticks) & ~0x1FF

    # What must hold

    def of(self, kind):
        return [one for one in self.node.events if isinstance(one, kind)]

    def fetched(self):
        self.waits = None

    def forget(self):
        if self.waits is not None:
            self.lost += self.waits != "spoilt"
            self.missed_errors += self.waits == "spoilt"
        self.waits = None

    def forget_sending(self):
        self.taken_back += self.node.session.overdue_ticks is not None

    @invariant()
    def no_frame_leaves_with_another_stamp_than_was_announced(self):
        for sent in self.air.sent:
            assert self.asked[sent.tx_ticks] == sent.frame
        flown = {sent.tx_ticks for sent in self.air.sent}
        assert all(one.tx_ticks in flown for one in self.of(Sent))
        assert self.node.counters["sent-at-another-time"] == 0

    @invariant()
    def no_stamp_is_torn(self):
        for one in self.of(Reception)[self.told_frames :]:
            stamp, told, phase = self.flown.pop(one.frame)
            assert one.rx_ticks == stamp
            assert abs(one.diagnostics.rx_power_dbm - told.rx_power_dbm) < 0.06
            assert abs(one.diagnostics.first_path_power_dbm - told.first_path_power_dbm) < 0.06
            assert abs(one.diagnostics.carrier_offset_ppm - told.carrier_offset_ppm) < 0.002
            assert (one.carrier_phase_cycles is None) == (phase is None)
            if phase is not None:
                assert abs((one.carrier_phase_cycles - phase + 0.5) % 1.0 - 0.5) < 2e-4
        self.told_frames = len(self.of(Reception))

    @invariant()
    def counters_account_for_all_frames(self):
        waits = self.waits is not None and self.waits != "spoilt"
        assert len(self.of(Reception)) == self.driver.received == self.heard - self.lost - waits
        assert self.driver.errors == self.spoilt - self.missed_errors - (self.waits == "spoilt")
        assert len(self.of(Sent)) == self.driver.sent
        counts = self.node.chip.transceiver.counts
        assert counts["sent"] >= self.driver.sent
        assert counts["started"] == len(self.air.sent)
        waits = self.node.session.overdue_ticks is not None
        assert self.requests == len(self.of(Sent)) + len(self.of(Late)) + self.taken_back + waits

    @invariant()
    def the_driver_does_nothing_that_the_manual_forbids(self):
        assert not +self.node.chip.misuse

    @invariant()
    def tally(self):
        """What the examples reach, for ``--hypothesis-show-statistics``."""
        for kind in (Reception, Sent, Late):
            event(f"{kind.__name__}: {min(len(self.of(kind)), 3)}")

    def teardown(self):
        """After a reset everything works again."""
        if not hasattr(self, "node"):
            return
        self.restart()
        for _ in range(2):
            self.air.pass_s(1e-3)
            before = len(self.of(Reception)), len(self.of(Sent))
            self.arrive(500, None, 20, -80, 1, 0.5, served=False)
            assert self.node.chip.irq
            self.serve()
            self.air.pass_s(1e-3)
            self.transmit(2000, 30, 1)
            self.air.pass_s(4e-3)
            assert self.node.chip.irq
            self.serve()
            assert (len(self.of(Reception)), len(self.of(Sent))) == (before[0] + 1, before[1] + 1)
            assert self.node.chip.memory.get(r.SYS_MASK)
        self.counters_account_for_all_frames()
        self.no_stamp_is_torn()


Fire.TestCase.settings = settings(max_examples=60, stateful_step_count=60, deadline=None)
TestUnderFire = Fire.TestCase
