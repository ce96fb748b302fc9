"""``ros2://`` as other programs of DDS meet it, and what it costs the program that it runs in: nothing."""

import asyncio
import os
import random
import sys
import threading
import time

import pytest

from skyless.bridges.ros2 import MARKERS, POSE, DdsTypes, Ros2Target, RosSettings, make_target
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.core.errors import SkylessError
from support.bridged_values import BARE_SITE, SITE, a_fix
from support.waiting import running

pytest.importorskip("cyclonedds", reason="Cyclone DDS has no wheel here")

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

DDS_TYPES = DdsTypes()

WAIT_S = 30.0
"""As long as a busy machine may take; it is usually some milliseconds."""


@pytest.fixture(scope="module")
def domain():
    """One that no other worker has. Its UDP ports (7400 + 250 times the domain) lie below those that Linux gives to
    clients, from 32768 on."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return random.Random().choice(range(1 + worker % 8, 99, 8))


def target_of(text, said=None):
    return make_target(TargetUrl(text), BridgeContext((said if said is not None else []).append))


def reader_of(participant, topic, kind, durability=Policy.Durability.Volatile):
    """As a subscriber of ROS asks for it by default."""
    quality = Qos(Policy.Reliability.Reliable(max_blocking_time=0), Policy.History.KeepLast(100), durability)
    return DataReader(participant, Topic(participant, topic, DDS_TYPES.type(kind)), qos=quality)


async def until(condition):
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, "in vain"
        await asyncio.sleep(0.01)


async def test_fixes_arrive_in_order_also_where_the_reader_comes_later(domain):
    target = target_of(f"ros2://?domain={domain}")
    participant = DomainParticipant(domain)
    found = []
    async with running(target.run()):
        target.on_site(SITE)
        serial = 0
        for _ in range(2):
            reader = reader_of(participant, "rt/skyless/tag1/pose", POSE)
            stamps = []

            def more(reader=reader, stamps=stamps):
                nonlocal serial
                serial += 1
                target.on_fix(a_fix(unix_s=1000.0 + serial, position_m=(serial, 2.0, 3.0)))
                for one in reader.take(100):
                    assert one.pose.pose.position.x == one.header.stamp.sec - 1000.0
                    stamps.append(one.header.stamp.sec)
                return len(stamps) >= 10

            await until(more)
            assert stamps == sorted(set(stamps))  # a starved reader may miss some: writers keep the last ten
            found += stamps
    dropped = target.dropped
    assert len(found) >= 20
    assert not dropped


async def test_anchors_last_and_writers_name_their_types_hash(domain):
    target = target_of(f"ros2://?domain={domain}&namespace=hall&frame=map&tf=yes")
    participant = DomainParticipant(domain)
    async with running(target.run()):
        target.on_site(SITE)
        target.on_fix(a_fix())
        publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        known = {}

        def all_known():
            known.update({one.topic_name: one for one in publications.take(100) if one.sample_info.valid_data})
            return {"rt/hall/anchors", "rt/hall/tag1/fix", "rt/tf"} <= known.keys()

        await until(all_known)
        pose = known["rt/hall/tag1/pose"]
        assert pose.type_name == "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
        assert pose.qos[Policy.Userdata].data == f"typehash={DDS_TYPES.hash(POSE)};".encode()
        assert pose.qos[Policy.Durability] == Policy.Durability.Volatile
        late = reader_of(participant, "rt/hall/anchors", MARKERS, Policy.Durability.TransientLocal)
        read = []
        await until(lambda: read.extend(late.take(10)) or read)
        assert len(read[0].markers) == 2 * len(SITE.anchors_m)


async def test_the_writers_are_gone_once_the_target_has_ended(domain):
    target = target_of(f"ros2://?domain={domain}&namespace=for_a_while")
    participant = DomainParticipant(domain)
    publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    ours = {}

    def seen():
        for one in publications.take(100):
            if one.topic_name == "rt/for_a_while/anchors" if one.sample_info.valid_data else one.key in ours:
                ours[one.key] = one.sample_info.valid_data
        return list(ours.values())

    async with running(target.run()):
        target.on_site(SITE)
        await until(lambda: seen() == [True])
    await until(lambda: seen() == [False])


class StuckPublisher:
    """DDS that waits for something."""

    def __init__(self):
        self.go_on, self.written = threading.Event(), []

    def close(self):
        pass

    def write(self, message):
        self.go_on.wait()
        self.written.append(message)


async def test_dds_that_waits_holds_nobody_up_and_loses_the_oldest():
    publisher = StuckPublisher()
    target = Ros2Target("ros2://", publisher, RosSettings(), BridgeContext(print))
    async with running(target.run()):
        target.on_site(BARE_SITE)
        await until(target._waiting.empty)  # the thread waits in the first write
        for serial in range(2000):
            target.on_fix(a_fix(velocity_mps=None, unix_s=float(serial)))
        publisher.go_on.set()
        await until(target._waiting.empty)
    written, dropped = publisher.written, target.dropped
    assert dropped == {"slow-dds": 1500}
    assert len(written) == 501  # the anchors and the newest fixes
    assert [one.data[4:8] for one in written[1:]] == [serial.to_bytes(4, "little") for serial in range(1500, 2000)]


async def test_a_fault_of_dds_is_counted_and_logged_once_for_each_topic():
    class Broken:
        def write(self, message):
            raise OSError("no memory")

        def close(self):
            pass

    said = []
    target = Ros2Target("ros2://", Broken(), RosSettings(), BridgeContext(said.append))
    async with running(target.run()):
        target.on_site(SITE)
        for _ in range(10):
            target.on_fix(a_fix())
        await until(lambda: target.dropped["not-sent"] == 31)
    assert [line.split(" ")[1] for line in said] == [
        "/skyless/anchors",
        "/skyless/tag1/pose",
        "/skyless/tag1/velocity",
        "/skyless/tag1/fix",
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ros2://?domain=233", "domain=233"),
        ("ros2://?domain=x", "domain=x"),
        ("ros2://?tf=perhaps", "no or yes"),
        ("ros2://?frame=a%20b", "frame="),
        ("ros2://?frame=/map", "frame="),
        ("ros2://?domain=", "domain="),
        ("ros2://?namespace=1st", "namespace="),
        ("ros2://?colour=red", "'colour'"),
    ],
)
def test_wrong_settings_are_named(text, words):
    with pytest.raises(SkylessError, match=words.replace("?", ".")):
        target_of(text)


async def test_the_domain_is_that_of_ros(monkeypatch, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    target = target_of("ros2://?namespace=of_ros")
    participant = DomainParticipant(domain)
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    async with running(target.run()):
        target.on_site(SITE)
        names = set()
        await until(lambda: names.update(one.topic_name for one in reader.take(50)) or "rt/of_ros/anchors" in names)


@pytest.mark.parametrize("number", ["233", "seven", "-1"])
def test_a_domain_that_ros_would_refuse_is_named(monkeypatch, domain, number):
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    with pytest.raises(SkylessError, match=f"ROS_DOMAIN_ID, which is '{number}'; it should be .* 0 to 232"):
        target_of("ros2://")
    target_of(f"ros2://?domain={domain}")  # then it does not matter


@pytest.mark.parametrize("settings", ["<CycloneDDS><Wrong/></CycloneDDS>", "<CycloneDDS><ö/></CycloneDDS>"])
def test_settings_that_cyclone_refuses_are_named(monkeypatch, settings):
    monkeypatch.setenv("CYCLONEDDS_URI", settings)
    with pytest.raises(SkylessError, match=f"domain 99: .*CYCLONEDDS_URI is '{settings}'"):
        target_of("ros2://?domain=99")


def test_without_a_georeference_a_line_says_what_is_missing(domain):
    said = []
    target_of(f"ros2://?domain={domain}", said).on_site(BARE_SITE)
    assert "[georeference]" in said[0]


def test_without_the_package_the_message_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds.topic", None)
    with pytest.raises(SkylessError, match=r"needs cyclonedds, which is not installed"):
        target_of("ros2://")
