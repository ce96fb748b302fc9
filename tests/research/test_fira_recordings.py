"""Logs of UCI and records of phones: what their readers make of good, odd and random lines."""

import io
import json
import os
import random
from collections import Counter
from math import degrees, dist

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.masterless_packets import Packet
from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite
from skyless.core.ticks import TICK_M, TICK_RATE_HZ
from skyless.radio.foreign import fira, phones, uci
from skyless.radio.foreign.uci import DtMeasurement, DtMessageType, GeodeticPoint, SessionInfo, encode_wgs84
from skyless.research.foreign.formats import open_recording
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

LINES = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))
"""SKYLESS_FUZZ_FRAMES=1000000 for a full run."""


def read(module_read, data):
    drops = Counter()
    return list(module_read(io.BytesIO(data), drops)), drops


def test_all_readers_agree():
    binary, text, records = (
        read(reader, b"".join(maker(90)))
        for reader, maker in (
            (fira.read_binary, synthetic.uci_binary),
            (fira.read_text, synthetic.uci_text),
            (phones.read, synthetic.phone_records),
        )
    )
    assert binary == text == records
    packets, drops = binary
    assert len(packets) == 90
    assert not drops
    assert {packet.anchor: packet.position_m for packet in packets} == {
        anchor: pytest.approx(place_m) for anchor, place_m in synthetic.ANCHORS_M.items()
    }
    assert [len(packet.relays) for packet in packets[:9]] == [0, *[1] * 7, 7]


@pytest.mark.parametrize("form", ["{}", "[TX] 20 00 00 01 00 [RX]: {}", "uci rx: {} (ok)", "0x{}"])
@pytest.mark.parametrize("between", ["", " ", ":", ", 0x", " 0x"])
def test_a_notification_is_found_however_its_bytes_are_written(form, between):
    def line(segment):
        text = between.join(f"{byte:02X}" for byte in segment)
        return form.format(text.removeprefix("0x")).encode() + b"\r\n"

    rounds = list(synthetic.dl_tdoa_rounds(18))
    log = b"".join(line(one) for n, messages in enumerate(rounds) for one in synthetic.uci_notification(messages, n))
    packets, drops = read(fira.read_text, b"start\n\n" + log)
    assert len(packets) == 18
    assert drops == {"line-without-notification": 1}


def test_measurements_that_failed_or_are_not_understood_are_counted():
    poll = DtMeasurement(1, 0, 5, 0, 100, 2**63 + 100, rx_bytes=8)
    bad = [
        DtMeasurement(2, 1, 5, 0, 1, 1, status=0x21),
        DtMeasurement(2, 9, 5, 0, 1, 1),
        DtMeasurement(2, 1, 5, 0, 1, 1, tx_bytes=4),
    ]
    drops = Counter()
    (packet,) = fira.DtTag(drops, uci.AnchorFrame()).on_info(SessionInfo(1, 1, 2, (*bad, poll)))
    assert drops == {"reception-failed": 1, "unknown-message": 1, "stamp-missing": 1}
    assert (packet.rx_ticks, packet.host_s) == (100, pytest.approx((2**63 + 100) / TICK_RATE_HZ))
    (packet,) = fira.DtTag(drops, uci.AnchorFrame()).on_info(SessionInfo(1, 1, 2, (poll,)), 5.0)
    assert packet.host_s == 5.0


def test_measurements_are_put_into_the_order_of_their_reception():
    response = DtMeasurement(2, 1, 5, 0, 2000, 30, responder_reply_ticks=500)
    poll = DtMeasurement(1, 0, 5, 0, 100, 2**40 - 7)
    first, second = fira.DtTag(Counter(), uci.AnchorFrame()).on_info(SessionInfo(1, 1, 1, (response, poll)))
    assert (first.anchor, second.anchor, len(second.relays)) == (1, 2, 1)


def test_positions_on_the_earth_are_in_the_frame_of_the_first():
    origin = GeoreferenceSite(latitude_deg=48.1, longitude_deg=11.5, height_m=500.0, heading_deg=0.0)
    latitude, longitude, height = geodetic((30.0, -40.0, 2.5), origin)
    here = GeodeticPoint(48.1, 11.5, 500.0)
    frame = uci.AnchorFrame()
    assert frame.position_m(here) == (0.0, 0.0, 0.0)
    assert dist(frame.position_m(GeodeticPoint(latitude, longitude, height)), (30.0, -40.0, 2.5)) < 1e-3
    tag = fira.DtTag(Counter(), uci.AnchorFrame())

    def heard(address, point):
        one = DtMeasurement(
            address, DtMessageType.POLL, 1, 0, 0, address, location_kind=1, location=encode_wgs84(point)
        )
        return tag.on_info(SessionInfo(1, 1, 1, (one,)))[0].position_m

    assert heard(1, here) == (0.0, 0.0, 0.0)
    east_m, north_m, up_m = heard(2, GeodeticPoint(latitude, longitude, height))
    assert (east_m, north_m) == pytest.approx((30.0, -40.0), abs=0.01)  # the line's steps are 4 and 7 mm
    assert up_m == pytest.approx(2.5, abs=0.001)


def ios(number, **changes):
    """A poll of anchor 1, a response of anchor 2 in the initiator's time, as iOS 27 gives them."""
    kind = ("poll", "response")[number]
    record = {
        "address": 1 + number,
        "measurementType": kind,
        "rawTransmitTime": 10**12 + 10**8 * number,
        "rawReceiveTime": 5 * 10**15 + 10**8 * number,
        "coordinates": [6.0 * number, 0.0, 2.0],
        "coordinatesType": "relative",
        "signalStrength": -80.5,
        "carrierFrequencyOffset": 1e-6,
    }
    return json.dumps({name: value for name, value in (record | changes).items() if value is not None}).encode() + b"\n"


def test_records_of_ios():
    packets, drops = read(phones.read, ios(0) + ios(1, clusterInitiatorAddress="0001"))
    assert not drops
    poll, response = packets
    flight = 6.0 / TICK_M
    assert (poll.anchor, poll.tx_ticks, poll.rx_ticks) == (1, 10**12 % 2**40, 5 * 10**15 % 2**40)
    assert poll.host_s == pytest.approx(5e15 / TICK_RATE_HZ)
    ((anchor, sequence, rx_ticks, tof),) = [(r.anchor, r.sequence, r.rx_ticks, r.tof_ticks) for r in response.relays]
    assert (anchor, sequence, rx_ticks) == (1, poll.sequence, 10**12 + round(flight))
    assert tof == pytest.approx(flight)
    seconds = {"rawTransmitTime": None, "rawReceiveTime": None, "transmitTime": 2.5, "receiveTime": 7.25}
    (old,), _ = read(phones.read, ios(0, measurementType=0, coordinatesType=1, **seconds))
    assert (old.tx_ticks, old.rx_ticks) == (int(2.5 * TICK_RATE_HZ) % 2**40, int(7.25 * TICK_RATE_HZ) % 2**40)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"{}\n", "malformed-record"),
        (b"[1]\n", "malformed-record"),
        (b'{"address": 1}\n', "unknown-message"),
        (b'{"address": 1, "x": ' + b"[" * 8000 + b"]" * 8000 + b"}\n", "malformed-record"),
        (b'{"address": 1' + b"0" * 6000 + b"}\n", "malformed-record"),
        (ios(0, rawReceiveTime=2**64), "stamp-missing"),
        (ios(0, rawReceiveTime=True), "malformed-record"),
        (ios(0, rawReceiveTime=float("nan")), "malformed-record"),
        (ios(0, measurementType="ping"), "unknown-message"),
        (ios(0, address="xy"), "impossible-address"),
        (ios(0, address=-1), "impossible-address"),
        (ios(0, rawReceiveTime=-1), "stamp-missing"),
        (ios(0, rawReceiveTime=None), "stamp-missing"),
        (ios(1), "message-without-poll"),
        (ios(0) + ios(1, coordinates=None), "flight-unknown"),
        (b'{"address": 1, "messageType": 0, "txTimestamp": "0102030405", "rxTimestamp": [1]}\n', "stamp-missing"),
        (
            b'{"address": 1, "messageType": 0, "blockIndex": -1, "txTimestamp": 1, "rxTimestamp": 1}\n',
            "impossible-number",
        ),
    ],
)
def test_records_of_no_use_are_counted(line, reason):
    assert read(phones.read, line)[1] == {reason: 1}


values = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.lists(st.integers(), max_size=9)
)
names = st.sampled_from([field for kind in (phones._Record,) for field in kind.__struct_encode_fields__])


@given(st.lists(st.dictionaries(names, values, max_size=12), max_size=6))
def test_any_record_is_a_packet_or_counted(records):
    lines = b"".join(json.dumps({"address": 1, "messageType": 0} | record).encode() + b"\n" for record in records)
    packets, drops = read(phones.read, lines)
    assert len(packets) + sum(drops.values()) == len(records)


@pytest.mark.parametrize("reader", [fira.read_text, phones.read])
@pytest.mark.statistical
def test_random_lines_never_raise(reader):
    rng, found = random.Random(5), 0
    whole = b"".join(synthetic.uci_text(90) if reader is fira.read_text else synthetic.phone_records(90))
    lines = whole.splitlines(keepends=True) + ([ios(0), ios(1)] * 20 if reader is phones.read else [])
    for _ in range(LINES // 100):
        data = bytearray(b"".join(rng.choices(lines, k=100)))
        for _ in range(60):
            at = rng.randrange(len(data))
            data[at : at + rng.randrange(3)] = rng.randbytes(rng.randrange(3))
        packets, _ = read(reader, bytes(data))
        found += len(packets)
        assert all(isinstance(packet, Packet) for packet in packets)
    assert found > 0


@pytest.mark.parametrize("stated", ["messages", "common time"])
def test_two_sessions_that_take_turns_are_kept_apart(stated):
    """Their blocks and rounds have the same numbers."""
    tag, relays = fira.DtTag(Counter(), uci.AnchorFrame()), []
    polls = [DtMeasurement(anchor, 0, 5, 0, 100, 1000 + anchor) for anchor in (1, 11)]
    responses = [
        DtMeasurement(anchor, 1, 5, 0, 2000, 2000 + anchor, responder_reply_ticks=500, flight_ticks=64)
        for anchor in (2, 12)
    ]
    if stated == "common time":
        responses = [msgspec.structs.replace(one, common_time=True) for one in responses]
    for messages in (polls, responses):
        for session, one in enumerate(messages):
            (packet,) = tag.on_info(SessionInfo(1, session, 1, (one,)))
            relays += [relay.anchor for relay in packet.relays]
    assert relays == [1, 11]


def test_one_frame_has_one_kind_of_positions_and_several_tags_share_it():
    here, there = GeodeticPoint(48.1, 11.5, 500.0), GeodeticPoint(48.1, 11.6, 500.0)
    frame = uci.AnchorFrame()
    assert frame.position_m(None) is None
    assert frame.position_m(here) == (0.0, 0.0, 0.0)
    assert frame.position_m((1.0, 2.0, 3.0)) is None
    first, second = fira.DtTag(Counter(), frame), fira.DtTag(Counter(), frame)
    one = DtMeasurement(1, 0, 1, 0, 0, 0, location_kind=1, location=encode_wgs84(there))
    first_m, second_m = (tag.on_info(SessionInfo(1, 1, 1, (one,)))[0].position_m for tag in (first, second))
    assert first_m == second_m
    assert first_m[0] > 7000.0
    relative = uci.AnchorFrame()
    assert relative.position_m((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert relative.position_m(here) is None
    assert relative.origin is None


def test_records_without_positions_are_used_with_a_table_of_anchors(tmp_path):
    path = tmp_path / "phone.jsonl"
    path.write_bytes(ios(0, coordinates=None) + ios(1, coordinates=None))
    for anchors_m, relays in (({}, 0), ({1: (0.0, 0.0, 2.0), 2: (6.0, 0.0, 2.0)}, 1)):
        with open_recording(path, anchors_m=anchors_m) as recording:
            assert sum(len(packet.relays) for packet in recording) == relays


@pytest.mark.parametrize(
    ("reader", "maker"), [(fira.read_binary, synthetic.uci_binary), (phones.read, synthetic.phone_records)]
)
def test_a_table_of_anchors_replaces_what_messages_state(reader, maker):
    packets = reader(io.BytesIO(b"".join(maker(9))), Counter(), {1: (0.0, 0.0, 9.0)})
    assert {packet.position_m for packet in packets} == {None}


def test_anchors_that_state_other_positions_later_are_where_they_state(tmp_path):
    """As of a tag on a board: the second half of the recording is made 100 m farther east."""
    path = tmp_path / "moved.jsonl"
    whole = list(synthetic.phone_records(900))
    moved = [json.loads(line) for line in whole[450:]]
    for record in moved:
        record["anchorLocation"]["relativeLocation"]["x"] += 100_000
    path.write_bytes(b"".join(whole[:450]) + b"".join(json.dumps(record).encode() + b"\n" for record in moved))
    found = []
    CaptureReplay(ReplayOptions(path)).run(lambda _, time_s, fix: found.append(fix), lambda _: None)
    assert found[300].position_m[0] < 20.0
    assert found[-1].position_m[0] > 80.0


def test_degrees_of_a_metre():
    """The frame's scale, from the Earth's radius."""
    metre_deg = degrees(1.0 / 6_371_000.0)
    frame = uci.AnchorFrame()
    frame.position_m(GeodeticPoint(0.0, 0.0, 0.0))
    east_m, north_m, _ = frame.position_m(GeodeticPoint(metre_deg, metre_deg, 0.0))
    assert (east_m, north_m) == pytest.approx((1.0, 1.0), abs=0.007)
