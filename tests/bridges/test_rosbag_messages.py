"""Messages of ROS 2, read by rosbags."""

import re
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from rosbags.typesys import Stores, get_typestore

from skyless.bridges import rosbag
from skyless.bridges.rosbag import RosEncoder, ros_name, stamp_of
from skyless.bridges.target import floored
from skyless.core.earth import geodetic, rotated
from skyless.run.mqtt.messages import AnchorHealth, Counters, TagHealth
from support.bridged_values import BARE_SITE, SITE, a_fix, fixes, georeferences

pytestmark = pytest.mark.site

TYPES = [value for value in vars(rosbag).values() if isinstance(value, str) and "/msg/" in value]
RELEASES = [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED]
KILTED = get_typestore(Stores.ROS2_KILTED)

tag_health = st.builds(
    TagHealth,
    tag=st.sampled_from(("tag1", "b")),
    unix_s=st.floats(0.0, 2e9),
    reason=st.none() | st.text(max_size=20).filter(lambda text: "\0" not in text),
    counters=st.dictionaries(st.sampled_from(("bad-crc", "foreign")), st.integers(0, 2**40)),
    mqtt=st.just(Counters(0, 0, 0)),
    latency_p50_s=st.none() | st.floats(0.0, 1.0),
    phases=st.just(()),
)


def encoder(site=SITE, *, transforms=True):
    made = RosEncoder("map", transforms=transforms)
    (anchors,) = made.on_site(site)
    return made, anchors


def by_topic(found):
    """Each message as rosbags reads it; what rosbags would write of it is the same bytes."""
    read = {}
    for one in found:
        read[one.topic] = KILTED.deserialize_cdr(one.data, one.type)
        assert bytes(KILTED.serialize_cdr(read[one.topic], one.type)) == one.data
    return read


def seconds(stamp):
    return stamp.sec + Fraction(stamp.nanosec, 10**9)


def xyz(vector):
    return vector.x, vector.y, vector.z


@pytest.mark.parametrize("release", RELEASES, ids=lambda release: release.value)
def test_types_are_the_same_in_each_release(release):
    store = get_typestore(release)
    assert len(TYPES) == 7
    for name in TYPES:
        assert store.hash_rihs01(name) == KILTED.hash_rihs01(name)


@given(fix=fixes(), origin=georeferences)
def test_every_fix_is_read_as_it_was(fix, origin):
    made, _ = encoder(structs.replace(SITE, georeference=origin))
    name = ros_name(fix.tag)
    read = by_topic(made.on_fix(fix))
    pose = read.pop(f"/skyless/{name}/pose")
    assert pose.header.frame_id == "map"
    if fix.unix_s < 2**31 - 1:
        assert abs(seconds(pose.header.stamp) - Fraction(fix.unix_s)) <= Fraction(1, 2 * 10**9)
    assert xyz(pose.pose.pose.position) == fix.position_m
    turn = pose.pose.pose.orientation
    assert (*xyz(turn), turn.w) == (0.0, 0.0, 0.0, 1.0)
    covariance = pose.pose.covariance.reshape(6, 6)
    assert tuple(covariance[:3, :3].ravel()) == floored(fix.covariance_m2)
    assert (covariance[3:, 3:] == 1e6 * (covariance[3:, 3:] != 0.0)).all()
    assert covariance.trace() == pytest.approx(3e6 + sum(floored(fix.covariance_m2)[::4]))
    assert not covariance[:3, 3:].any()
    assert not covariance[3:, :3].any()
    velocity = read.pop(f"/skyless/{name}/velocity", None)
    assert (velocity is None) == (fix.velocity_mps is None)
    if velocity is not None:
        assert velocity.header == pose.header
        assert xyz(velocity.twist.twist.linear) == fix.velocity_mps
        assert xyz(velocity.twist.twist.angular) == (0.0, 0.0, 0.0)
        assert tuple(velocity.twist.covariance.reshape(6, 6)[:3, :3].ravel()) == fix.velocity_covariance
    earth = read.pop(f"/skyless/{name}/fix")
    assert (earth.header.stamp, earth.header.frame_id) == (pose.header.stamp, name)
    assert (earth.status.status, earth.status.service, earth.position_covariance_type) == (0, 0, 3)
    assert (earth.latitude, earth.longitude, earth.altitude) == geodetic(fix.position_m, origin)
    expected = rotated(floored(fix.covariance_m2), origin.heading_deg)
    assert tuple(earth.position_covariance) == expected
    (transform,) = read.pop("/tf").transforms
    assert (transform.header, transform.child_frame_id) == (pose.header, name)
    assert xyz(transform.transform.translation) == fix.position_m
    assert read == {}


def test_without_a_georeference_there_is_no_position_on_the_earth():
    made, _ = encoder(BARE_SITE, transforms=False)
    topics = [one.topic for one in made.on_fix(a_fix())]
    assert topics == ["/skyless/tag1/pose", "/skyless/tag1/velocity"]


@given(tag_health)
def test_health_of_a_tag_is_a_diagnostic(health):
    (found,) = by_topic(encoder()[0].on_health(health)).values()
    (status,) = found.status
    assert status.name == f"skyless: tag {health.tag}"
    assert status.level == (0 if health.reason is None else 2)
    assert health.reason is None or status.message == f"no fix: {health.reason}"
    values = {one.key: one.value for one in status.values}
    assert values["latency_p50_s"] == ("" if health.latency_p50_s is None else str(health.latency_p50_s))
    assert all(values[f"dropped {reason}"] == str(count) for reason, count in health.counters.items())


@given(st.builds(AnchorHealth, heard_age_s=st.just({}), counters=st.just({}), mqtt=st.just(Counters(0, 0, 0))))
def test_an_anchor_that_is_not_synchronised_warns(health):
    (found,) = by_topic(encoder()[0].on_health(health)).values()
    assert found.status[0].level == (0 if health.synchronised else 1)


def test_anchors_are_markers_that_last():
    _, anchors = encoder()
    assert anchors.lasting
    found = by_topic([anchors])["/skyless/anchors"].markers
    cubes = {one.id: xyz(one.pose.position) for one in found if one.type == 1}
    assert cubes == SITE.anchors_m
    assert {one.text for one in found if one.type == 9} == {"1", "2"}
    assert {one.header.frame_id for one in found} == {"map"}


def test_a_site_that_is_known_already_gives_nothing():
    made, _ = encoder()
    assert made.on_site(SITE) == []


@given(st.lists(st.from_regex(r"[A-Za-z0-9_-]{1,32}", fullmatch=True), unique=True, max_size=8))
def test_each_tag_has_topics_of_its_own_that_ros_allows(tags):
    made, _ = encoder()
    topics = [made.on_fix(a_fix(tag=tag))[0].topic for tag in tags]
    assert len(set(topics)) == len(tags)
    assert all(re.fullmatch(r"(/[A-Za-z][A-Za-z0-9_]*)+", topic) and "__" not in topic for topic in topics)
    assert topics == [made.on_fix(a_fix(tag=tag))[0].topic for tag in tags]


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_stamp_is_always_one(unix_s):
    whole, nanoseconds = stamp_of(unix_s)
    assert 0 <= whole < 2**31
    assert 0 <= nanoseconds < 10**9
