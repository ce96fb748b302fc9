"""What an emulated FiRa board reports of beacons, without ports and air."""

from collections import Counter

import pytest

from skyless.core.air.frame import Diagnostics, Heard, Reception
from skyless.core.air.masterless_packets import Packet
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import Beacon, encode
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ
from skyless.radio.foreign.foreign_radios import UciRadio
from skyless.radio.foreign.uci import AnchorFrame, UciReader, decode_session_info, location_of
from skyless.radio.interface import Restarted
from skyless.run.board import UciProtocol
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from skyless.run.open_radio import open_sniffers
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

LAB = paper_lab_site()


class Board:
    def __init__(self, version):
        self.out, self.drops = bytearray(), Counter()
        self.speech = UciProtocol(lambda data: self.out.extend(data) is None, version)

    def hear(self, beacon, rx_ticks=5):
        self.speech.on_radio_event(Reception(encode(beacon), rx_ticks, None, Diagnostics(-80.2, None, 3.0)))

    def said(self):
        infos = [decode_session_info(packet) for packet in UciReader(self.drops).feed(bytes(self.out))]
        self.out.clear()
        return infos


def beacon(anchor, superframe, tx_ticks, master_heard=None, heard=(), sequence=7):
    return Beacon(LAB.id, anchor, sequence, superframe, 1, tx_ticks, 1, 1, 0, master_heard, None, heard, None)


@pytest.mark.parametrize("version", [1, 2])
def test_a_superframe_is_a_round(version):
    board = Board(version)
    world = World(LAB, lambda anchor: Anchor(LAB, anchor), [TagSpec(Static(1.0, 1.0))], lab_impairments(100.0), 1)
    for broadcast in world.run(2.0):
        for _, reception, _ in broadcast.receptions():
            board.speech.on_radio_event(reception)
    *_, info = board.said()
    assert (info.version, [one.message for one in info.measurements]) == (version, [0, 1, 1, 1, 1, 1])
    assert [one.address for one in info.measurements] == [1, 2, 3, 4, 5, 6]
    places_m = [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in LAB.anchors]
    assert [location_of(one) for one in info.measurements] == places_m
    assert info.measurements[1].flight_ticks == round(6.0 / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ)
    assert not board.drops


def test_rounds_are_sent_when_they_are_whole_or_with_the_next_poll():
    board, one = Board(1), Heard(1, 7, 2**40 - 100)
    board.hear(beacon(1, 9, 1000))
    assert len(board.said()) == 1  # nothing is known of usual rounds
    board.hear(beacon(2, 9, 400, one), rx_ticks=2**40 - 1)
    (late,) = board.said()
    (response,) = late.measurements
    assert (response.responder_reply_ticks, response.rx_ticks_tag, response.flight_ticks) == (500, 2**40 - 1, 0)
    assert response.block == 9
    board.hear(beacon(1, 10, 5000, sequence=8))
    assert not board.said()
    board.hear(beacon(2, 10, 9000, Heard(1, 8, 8000)))
    (whole,) = board.said()
    assert [measurement.address for measurement in whole.measurements] == [1, 2]
    board.hear(beacon(1, 11, 15_000, sequence=9))
    board.hear(beacon(1, 12, 25_000, sequence=10))
    lonely, _ = board.said()
    assert [measurement.address for measurement in lonely.measurements] == [1]


def test_the_master_s_second_frame_ends_the_round_and_tells_when_it_heard_the_responses():
    board = Board(1)
    for superframe in (1, 2):
        board.said()
        board.hear(beacon(1, superframe, 1000))
        board.hear(beacon(2, superframe, 9000, Heard(1, 7, 8000), sequence=20))
        board.hear(beacon(3, superframe, 9500, Heard(1, 7, 8000), sequence=21))
        board.hear(beacon(1, superframe, 2000, None, (Heard(2, 20, 1400), Heard(3, 20, 1500)), sequence=8))
        board.hear(beacon(2, superframe, 19_000, Heard(1, 8, 18_000), sequence=22))
    (info,) = board.said()
    assert [one.message for one in info.measurements] == [0, 1, 1, 2]
    assert [one.initiator_reply_ticks for one in info.measurements] == [0, 600, 0, 0]  # 3's frame was another one
    assert board.speech.drops == {"not-of-a-round": 2}


@pytest.mark.parametrize(("x_m", "ticks"), [(300.0, round(300.0 / TICK_M)), (310.0, 0)])
def test_a_flight_that_the_line_has_no_bits_for_is_unknown(x_m, ticks):
    board = Board(1)
    board.speech._almanac.anchors_m = {1: (0.0, 0.0, 2.0), 2: (x_m, 0.0, 2.0)}
    board.hear(beacon(1, 9, 1000))
    board.hear(beacon(2, 9, 9000, Heard(1, 7, 8000)))
    *_, info = board.said()
    assert info.measurements[-1].flight_ticks == ticks


def test_a_board_that_restarts_may_receive_anchors_at_another_height():
    radio = UciRadio("/dev/ttyACM0", 115_200, "tag1", AnchorFrame())
    node = PacketTagNode(PacketTagSettings({}, auto_height=True), radio, print, print, lambda: 0.0)
    corners_m = [(0.0, 0.0), (6.0, 0.0), (6.0, 8.0), (0.0, 8.0)]
    for height_m in (2.0, 5.0):
        node.on_event(Restarted())
        for number, corner_m in enumerate(2 * corners_m):
            ticks = 1000 * number
            node.on_event(Packet(None, number % 4, number, ticks, ticks, (), (*corner_m, height_m)))
        assert node._height_m == pytest.approx(height_m)


def test_boards_of_one_process_have_one_frame():
    one, other = open_sniffers("uci:/dev/null,/dev/zero", ("tag1", "tag2"))
    assert one.frame is other.frame


def test_what_belongs_to_no_round_is_counted():
    board = Board(1)
    board.speech.on_radio_event(Restarted())
    board.hear(beacon(2, 9, 400, Heard(1, 7, 300)))
    board.hear(beacon(1, 9, 1000))
    for heard in (None, Heard(1, 6, 300), Heard(1, 7, 500)):
        board.hear(beacon(2, 9, 400, heard))
    board.speech.on_radio_event(Reception(b"no beacon", 4))
    board.speech.on_host_data(b"\x20\x00\x00\x01\x00")
    assert board.speech.drops == {"not-of-a-round": 4, "not-translated": 1}
