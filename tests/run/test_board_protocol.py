"""What emulated boards say and do, word by word, without ports and air."""

import random
from collections import Counter

import pytest
from msgspec.structs import replace
from serial_stage import PlayedRadio

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.frame import Heard, Reception, Transmission
from skyless.core.air.masterless_packets import Packet, Relay
from skyless.core.alert import Alert
from skyless.core.anchor import Anchor as FreeAnchor
from skyless.core.integrity import IntegrityRequirement
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import Beacon, encode
from skyless.core.site import GeoreferenceSite
from skyless.core.tag.receiver import Receiver
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.radio.foreign.foreign_radios import SnifferStream
from skyless.radio.interface import Late, Restarted, Sent
from skyless.radio.serial import link
from skyless.radio.serial.link import BoardSettings, Done, Hello, NotDone, Status, TagConfig, TooLate, decode
from skyless.radio.tag_reports import BoardReceiver
from skyless.run.board import LinkProtocol, SnifferProtocol
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from support.frames import with_fcs

DELAY = 16_450


class Host:
    """Talks with a board."""

    def __init__(self, can_transmit=True):
        self.radio, self.said, self.full, self.now_s = PlayedRadio("a board with a long name", 77), [], False, 0.0
        self._reader, self.writer = link.Reader(), link.Writer()
        self.board = LinkProtocol(self.radio, self._take, can_transmit=can_transmit, clock_s=lambda: self.now_s)

    def _take(self, data):
        if not self.full:
            self.said += map(decode, self._reader.read(data))
        return not self.full

    def say(self, line):
        """What the board answers."""
        self.said.clear()
        self.board.on_host_data(line)
        return list(self.said)

    def ready(self):
        self.say(self.writer.config(DELAY, DELAY))
        self.say(self.writer.record(link.RX_ON))
        return self


def test_it_greets_and_is_configured_step_by_step():
    host = Host(can_transmit=False)
    (hello,) = host.say(host.writer.ask_hello())
    assert hello == Hello(1, 4, (0, 0, 0), b"a board ", 63_897_600, 40, False, 0, True, True)
    (status,) = host.say(host.writer.record(link.ASK_STATUS))
    assert (status.ticks, status.configured, status.receiving) == (77, False, False)
    assert host.say(host.writer.record(link.RX_ON)) == [NotDone(link.RX_ON, link.REFUSED_MALFORMED)]
    (status,) = host.say(host.writer.config(DELAY, DELAY))
    assert (status.configured, status.receiving) == (True, False)
    host.board.on_radio_event(Reception(b"not wanted yet", 5))
    (status,) = host.say(host.writer.record(link.RX_ON))
    assert (status.configured, status.receiving, status.received) == (True, True, 0)
    host.said.clear()
    host.board.on_radio_event(Restarted())
    (hello,) = host.said
    assert isinstance(hello, Hello)
    (status,) = host.say(host.writer.record(link.ASK_STATUS))
    assert not status.configured


@pytest.mark.parametrize("flags", [0, link.WANTS_PHASES])
def test_phases_are_reported_where_the_host_wants_them(flags):
    host = Host()
    host.say(host.writer.config(DELAY, DELAY, flags))
    host.say(host.writer.record(link.RX_ON))
    host.said.clear()
    for phase_cycles in (0.75, None, 0.999_999_9):
        host.board.on_radio_event(Reception(b"frame", 5, carrier_phase_cycles=phase_cycles))
    wanted = [0.75, None, 0.0] if flags else [None] * 3
    assert [heard.carrier_phase_cycles for heard in host.said] == wanted


@pytest.mark.parametrize("at", range(6))
def test_another_channel_or_preamble_is_refused(at):
    host = Host()
    wanted = bytearray([5, 64, 2, 9, 128, 0, 1, 0, 1, 0, 0])
    wanted[at] += 1
    assert host.say(host.writer.record(link.CONFIG, wanted)) == [NotDone(link.CONFIG, link.REFUSED_SETTING)]
    assert host.say(host.writer.record(link.CONFIG, wanted[:10])) == [NotDone(link.CONFIG, link.REFUSED_MALFORMED)]


def test_a_frame_leaves_at_dx_without_its_low_bits_and_the_antenna_delay_later():
    host = Host().ready()
    frame = with_fcs(b"a frame")
    assert host.say(host.writer.tx_at(2**40 - 1, frame)) == []
    tx_ticks = (2**40 - 512 + DELAY) % 2**40
    assert host.radio.transmissions == [Transmission(frame, tx_ticks)]
    assert host.say(host.writer.tx_at(512, frame)) == [TooLate(512, link.LATE_BUSY)]
    host.said.clear()
    host.board.on_radio_event(Sent(tx_ticks))
    assert host.said == [Done(2**40 - 1, tx_ticks)]
    host.say(host.writer.tx_at(512, frame))
    host.board.on_radio_event(Late(512 + DELAY))
    assert host.said == [TooLate(512, link.LATE_FOR_RADIO)]
    host.board.on_radio_event(Sent(5))  # none of its own
    (status,) = host.say(host.writer.record(link.ASK_STATUS))
    assert (status.sent, status.late) == (1, 2)
    for wrong in (b"", b"\0\0", frame[:-1] + b"\1", with_fcs(bytes(126))):
        assert host.say(host.writer.tx_at(512, wrong)) == [NotDone(link.TX_AT, link.REFUSED_MALFORMED)]
    silent = Host(can_transmit=False).ready()
    assert silent.say(silent.writer.tx_at(512, frame)) == [TooLate(512, link.LATE_NOT_READY)]


def test_a_board_whose_radio_is_dead_logs_nothing_and_one_that_is_not_fetched_counts():
    host = Host()
    host.radio.ticks = None
    assert host.say(host.writer.ask_hello()) == []
    host.radio.ticks = 5
    host.ready()
    host.full = True
    host.board.on_radio_event(Reception(b"lost", 5))
    host.full = False
    (status,) = host.say(host.writer.record(link.ASK_STATUS))
    assert isinstance(status, Status)
    assert (status.received, status.unsent_records) == (1, 1)


def test_garbage_from_the_host_is_counted_and_hurts_nothing():
    host, rng = Host().ready(), random.Random(2)
    for _ in range(500):
        record = bytearray(host.writer.tx_at(512, with_fcs(b"frame")))
        record[rng.randrange(len(record))] ^= 1 << rng.randrange(8)
        host.board.on_host_data(rng.randbytes(rng.randrange(200)) + b"\0" + bytes(record))
    host.board.on_host_data(b"\0")
    host.say(host.writer.record(0x7F))
    (status,) = host.say(host.writer.record(link.ASK_STATUS))
    assert status.receiving
    assert status.garbled > 900
    assert host.radio.transmissions == []


LAB = paper_lab_site()


def frames():
    """Beacons of two seconds of the simulated lab, which tell the whole almanac."""
    world = World(LAB, lambda anchor: Anchor(LAB, anchor), [TagSpec(Static(1.0, 1.0))], lab_impairments(100.0), 1)
    return [reception.frame for broadcast in world.run(2.0) for _, reception, _ in broadcast.receptions()]


@pytest.mark.parametrize("knows_binary", [True, False])
def test_a_beacon_becomes_a_packet_of_a_tdoa3_system(knows_binary):
    out = bytearray()
    speech = SnifferProtocol(lambda data: out.extend(data) is None, knows_binary=knows_binary)
    speech.on_host_data(b"b")
    for frame in frames():
        speech.on_radio_event(Reception(frame, 1))
    out.clear()
    heard = (Heard(3, 250, 2**39 + 7), Heard(300, 1, 5))
    beacon = Beacon(LAB.id, 2, 200, 9, 1, 2**40 - 5, 1, 1, 0, Heard(1, 130, 9), None, heard, None)
    speech.on_radio_event(Reception(encode(beacon), 2**40 - 1))
    speech.on_radio_event(Reception(b"no beacon", 4))
    assert out.startswith(b"\xbc" if knows_binary else b"From 02 to ff @ffffffffff: 30")
    drops = Counter()
    (packet,) = SnifferStream(drops).feed(bytes(out))
    places = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in LAB.anchors}

    def flight(other):
        squared = sum((a - b) ** 2 for a, b in zip(places[2], places[other], strict=True))
        return round(squared**0.5 / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ)

    relays = (Relay(3, 250 % 128, 7, flight(3)), Relay(1, 130 % 128, 9, flight(1)))
    assert packet == Packet(None, 2, 200 % 128, 2**32 - 5, 2**40 - 1, relays)
    assert speech.drops == {"not-translated": 1}
    assert not drops


def test_a_tag_on_a_board_makes_the_receiver_s_fixes_and_says_where_its_anchors_are():
    site = replace(lab_site(), georeference=GeoreferenceSite(52.5, -13.4, 40.0, 120.0))
    world = World(site, lambda anchor: FreeAnchor(site, anchor), [TagSpec(Static(1.0, 1.0))], lab_impairments(100.0), 1)
    heard = [reception for broadcast in world.run(2.0) for _, reception, _ in broadcast.receptions()]
    settings = BoardSettings(mode=1, rate_hz=0, tag=9, qa_m2ps3=0.5, alert_limit_m=0.2)
    host, integrity = Host(can_transmit=False), IntegrityRequirement(alert_limit_m=0.2)
    board, receiver = BoardReceiver(), Receiver(qa=0.5, integrity=integrity)
    assert host.say(host.writer.set_tag_config(settings, keep=False)) == [TagConfig(settings, in_flash=False)]
    assert host.say(host.writer.record(link.SET_TIME, bytes(8))) == []
    made = []
    for reception in heard:
        host.said.clear()
        host.now_s += 0.01
        host.board.on_radio_event(replace(reception, host_s=None))
        expected = receiver.hear(reception)
        fixes = [fix for fix in map(board.take, host.said) if fix is not None]
        assert len(fixes) == (expected is not None)
        made += zip(fixes, [expected], strict=False)
    assert len(made) > 300
    for fix, expected in made:
        assert (fix.anchors, fix.height_known, fix.alert) == (expected.anchors, expected.height_known, expected.alert)
        assert fix.time_s == pytest.approx(expected.time_s, abs=1e-10)
        assert fix.position_m == pytest.approx(expected.position_m, abs=5.1e-4)
        assert fix.anchors_m == pytest.approx(expected.anchors_m, abs=5.1e-4)
        for name in ("covariance_m2", "velocity_covariance", "chi2", "residual_rms_m"):
            assert getattr(fix, name) == pytest.approx(getattr(expected, name), rel=1e-6, abs=1e-12)
        assert (fix.hpl_m or 0.0) == pytest.approx(expected.hpl_m or 0.0, rel=1e-6)
    assert Alert.LIMIT in {fix.alert for fix, _ in made}
    assert board.heard_site.georeference == GeoreferencePage(52.5, -13.4, 40.0, 120.0)

    host.said.clear()
    host.board.tag.each_second()
    (status,) = host.said
    assert (status.site, status.reason) == (site.id, None)
    assert status.counters["heard"] == len(heard)
    assert status.counters["fixes"] == receiver.counters["fixes"]
    host.ready()
    host.said.clear()
    host.board.tag.each_second()
    host.board.on_radio_event(heard[0])
    assert [type(said) for said in host.said] == [Reception]
