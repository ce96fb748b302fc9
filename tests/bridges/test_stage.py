"""OSC and PosiStageNet: python-osc and pypsn read the values that were given, with y up where it is asked for."""

import math
import struct

import pypsn
import pytest
from bridged_values import SITE, a_fix
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from pythonosc.osc_message import OscMessage

from skyless.bridges.osc import OscEncoder, make_encoder
from skyless.bridges.psn import MAX_PACKET_BYTES, PsnFrames
from skyless.bridges.target import BridgeContext, TargetUrl, turned
from skyless.core.errors import SkylessError

pytestmark = pytest.mark.site

START_UNIX_S = 1_795_000_000.0
CONTEXT = BridgeContext(print)
names = st.from_regex(r"[A-Za-z0-9_-]{1,32}", fullmatch=True)
vectors = st.tuples(*[st.floats(-1e30, 1e30)] * 3)


def float32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def rounded(vector):
    return tuple(map(float32, vector))


def test_y_up_keeps_the_hand():
    """A person faces north (y of the site): x stays right, up becomes y, and away from the audience is -z."""
    assert turned((1.0, 2.0, 3.0), "y") == (1.0, 3.0, -2.0)
    assert turned((1.0, 2.0, 3.0), "z") == (1.0, 2.0, 3.0)
    x, y, z = (turned(axis, "y") for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    cross = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    assert cross == z


# OSC


@given(names, vectors, st.sampled_from("yz"))
def test_python_osc_reads_a_fix(tag, position_m, up):
    encoder = OscEncoder(up)
    state, xyz = map(OscMessage, encoder.on_fix(a_fix(tag=tag, position_m=position_m)))
    assert (state.address, state.params) == (f"/skyless/{tag}/fix", [1])
    assert xyz.address == f"/skyless/{tag}/xyz"
    assert tuple(xyz.params) == rounded(turned(position_m, up))
    assert len(encoder.on_fix(a_fix(tag=tag, position_m=position_m))) == 1


def test_osc_states_that_there_is_no_fix_and_that_there_is_one_again():
    encoder = OscEncoder()
    encoder.on_fix(a_fix())
    for _ in range(2):
        (lost,) = map(OscMessage, encoder.on_no_fix("tag1", 0.0, "lost"))
        assert (lost.address, lost.params) == ("/skyless/tag1/fix", [0])
    assert [OscMessage(data).address for data in encoder.on_fix(a_fix())] == ["/skyless/tag1/fix", "/skyless/tag1/xyz"]


def test_osc_repeats_each_second_which_tags_have_a_fix():
    """For programs that began later, or lost the datagram that said so."""
    encoder = OscEncoder()
    assert encoder.on_second(0.0) == []
    for tag in ("tag2", "tag1"):
        encoder.on_fix(a_fix(tag=tag))
    states = [OscMessage(data) for data in encoder.on_second(0.0)]
    assert [(one.address, one.params) for one in states] == [("/skyless/tag1/fix", [1]), ("/skyless/tag2/fix", [1])]
    encoder.on_no_fix("tag1", 0.0, "lost")
    assert [OscMessage(data).address for data in encoder.on_second(0.0)] == ["/skyless/tag2/fix"]


def test_osc_drops_what_no_float_holds():
    encoder = OscEncoder()
    assert encoder.on_fix(a_fix(position_m=(1e39, 0.0, 0.0))) == []
    assert encoder.dropped == {"osc-value": 1}


def test_the_axis_that_is_up_is_checked():
    assert OscMessage(make_encoder(TargetUrl("osc+udp://?up=y"), CONTEXT).on_fix(a_fix())[1]).params == [1.0, 1.5, -2.0]
    with pytest.raises(SkylessError, match="y or z"):
        make_encoder(TargetUrl("osc+udp://?up=x"), CONTEXT)


# PosiStageNet


def frames(fixes=(), up="y"):
    made = PsnFrames(START_UNIX_S, up)
    made.on_site(SITE)
    for fix in fixes:
        made.on_fix(fix)
    return made


@given(vectors, st.none() | vectors, st.floats(0.0, 1e6))
def test_pypsn_reads_a_fix(position_m, velocity_mps, age_s):
    made = frames([a_fix(position_m=position_m, velocity_mps=velocity_mps, unix_s=START_UNIX_S + age_s)])
    (data,) = made.data_packets(START_UNIX_S + 2.5)
    found = pypsn.parse_psn_packet(data)
    assert (found.info.version_high, found.info.version_low, found.info.packet_count) == (2, 3, 1)
    assert found.info.timestamp == 2_500_000
    (tracker,) = found.trackers
    assert tracker.id == 1
    assert tuple(tracker.pos) == rounded(turned(position_m, "y"))
    assert tracker.status == 1.0
    assert abs(tracker.timestamp - (round(age_s * 1e6) & 0xFFFFFFFF)) <= 1  # it reads 32 of the 64 bits
    if velocity_mps is None:
        assert tracker.speed is None
    else:
        assert tuple(tracker.speed) == rounded(turned(velocity_mps, "y"))


@given(st.lists(names, unique=True, min_size=1, max_size=120))
def test_pypsn_reads_the_names_of_all_trackers_and_no_packet_is_too_long(tags):
    made = frames([a_fix(tag=tag) for tag in tags])
    info, data = made.info_packets(START_UNIX_S), made.data_packets(START_UNIX_S)
    assert max(map(len, info + data)) <= MAX_PACKET_BYTES
    named, placed = {}, []
    for packet in map(pypsn.parse_psn_packet, info):
        assert packet.name == b"hall"
        assert packet.info.packet_count == len(info)
        named |= {tracker.tracker_id: tracker.tracker_name.decode() for tracker in packet.trackers}
    for packet in map(pypsn.parse_psn_packet, data):
        assert packet.info.packet_count == len(data)
        placed += [tracker.id for tracker in packet.trackers]
    assert sorted(named.values()) == sorted(tags)
    assert placed == sorted(named)


def test_a_tag_has_the_number_of_its_name_where_it_is_free():
    made = frames([a_fix(tag=tag) for tag in ("tag3", "singer", "old3", "tag99999", "tag0", "tag2")])
    (info,) = made.info_packets(START_UNIX_S)
    found = {tracker.tracker_id: tracker.tracker_name for tracker in pypsn.parse_psn_packet(info).trackers}
    assert found == {3: b"tag3", 1: b"singer", 2: b"old3", 4: b"tag99999", 5: b"tag0", 6: b"tag2"}


def test_a_long_name_of_a_site_is_cut_between_characters():
    made = frames([a_fix()])
    made.on_site(structs.replace(SITE, name=200 * "ä"))
    (info,) = made.info_packets(START_UNIX_S)
    assert pypsn.parse_psn_packet(info).name.decode() == 127 * "ä"


def test_nothing_is_sent_while_there_is_no_tag():
    assert frames().info_packets(START_UNIX_S) == frames().data_packets(START_UNIX_S) == []


def test_a_tag_without_a_fix_has_no_position():
    made = frames([a_fix(), a_fix(tag="tag2")])
    made.on_no_fix("tag1")
    (data,) = made.data_packets(START_UNIX_S)
    lost, found = pypsn.parse_psn_packet(data).trackers
    assert (lost.id, lost.pos, lost.status) == (1, None, 0.0)
    assert (found.id, found.status) == (2, 1.0)
    made.on_fix(a_fix(position_m=(4.0, 5.0, 6.0)))
    again, _ = pypsn.parse_psn_packet(made.data_packets(START_UNIX_S)[0]).trackers
    assert tuple(again.pos) == (4.0, 6.0, -5.0)


def test_frames_are_numbered_and_z_up_is_the_sites_own():
    made = frames([a_fix(position_m=(1.0, 2.0, 3.0))], up="z")
    found = [pypsn.parse_psn_packet(made.data_packets(START_UNIX_S)[0]) for _ in range(300)]
    assert [packet.info.frame_id for packet in found] == [(number + 1) % 256 for number in range(300)]
    assert tuple(found[0].trackers[0].pos) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("value", [1e39, math.nan, math.inf])
def test_psn_drops_what_no_float_holds(value):
    made = frames([a_fix(), a_fix(velocity_mps=(0.0, value, 0.0), position_m=(9.0, 9.0, 9.0))])
    (tracker,) = pypsn.parse_psn_packet(made.data_packets(START_UNIX_S)[0]).trackers
    assert tuple(tracker.pos) == (1.0, 1.5, -2.0)
    assert made.dropped == {"psn-value": 1}


def test_a_host_that_had_no_time_at_its_start_sends_stamps_that_fit():
    made = PsnFrames(0.0)
    made.on_fix(a_fix(unix_s=-5.0))
    (data,) = made.data_packets(1.8e9)
    assert pypsn.parse_psn_packet(data).info.timestamp == 1_800_000_000_000_000


def test_at_most_255_packets_make_a_frame():
    made = frames([a_fix(tag=f"t{number}") for number in range(1, 7000)])
    packets = made.data_packets(START_UNIX_S)
    assert len(packets) == 255
    assert made.dropped["psn-packets"] > 0
