"""A node that hears nothing usable says where to look, once, and again when it is something else."""

from collections import Counter

import pytest
from msgspec.structs import replace
from node_stage import LAB, FakeRadio, receptions, undated

from skyless.core.air.masterless_packets import Packet
from skyless.radio.foreign.foreign_radios import ListenerRadio, SnifferRadio
from skyless.radio.interface import Gone, Restarted
from skyless.run.anchor import AnchorNode
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from skyless.run.open_radio import REPEAT_S, UNUSABLE_S, RadioMonitor
from skyless.run.tag import TagNode, TagSettings
from support import masterless_world as hall

HEARD = undated(receptions(1.0))


class Watched:
    """Counts that the test moves, looked at every second."""

    def __init__(self):
        self.logged, self.now_s = [], 100.0
        self.received = self.used = 0
        self.drops = Counter()
        self.advice = "the line is silent"
        self.monitor = RadioMonitor("tag t1", "listening", self.logged.append, lambda: self.advice)

    def restart(self):
        self.monitor.on_event(Restarted())
        assert self.logged.pop().startswith("tag t1: listening")

    def lose(self):
        self.monitor.on_event(Gone("unplugged"))
        assert self.logged.pop() == "tag t1: unplugged; still looking for it"

    def pass_s(self, seconds, received=0, used=0, **reasons):
        for _ in range(round(seconds)):
            self.now_s += 1.0
            self.received += received
            self.used += used
            self.drops.update({reason.replace("_", "-"): count for reason, count in reasons.items()})
            self.monitor.check(self.now_s, self.received, self.used, self.drops)


def test_what_is_the_matter_is_logged_once_and_again_when_it_changes():
    watched = Watched()
    watched.pass_s(60)
    assert watched.logged == []  # there is no radio yet, as was logged
    watched.restart()
    watched.pass_s(UNUSABLE_S)
    assert watched.logged == []
    watched.pass_s(301)
    assert watched.logged == ["tag t1: nothing usable for 5 s; the line is silent"]
    watched.advice = "the line is noisy"
    watched.pass_s(300, malformed_line=2)
    watched.pass_s(300, received=10, foreign_site=8, bad_fcs=2)
    assert watched.logged[1:] == [
        "tag t1: nothing usable for 5 s; the line is noisy; most counted: malformed-line (10), "
        "lines of another format, or another rate",
        "tag t1: nothing usable for 5 s; 50 frames have come; most counted: foreign-site (40), "
        "those are of another site than asked for",
    ]


def test_a_node_that_receives_logs_nothing_whatever_else_is_dropped():
    watched = Watched()
    watched.restart()
    watched.pass_s(300, received=100, used=1, foreign_site=99)
    assert watched.logged == []


def test_reception_that_comes_and_goes_does_not_fill_the_screen():
    watched = Watched()
    watched.restart()
    for _ in range(30):
        watched.pass_s(20)
        watched.pass_s(10, received=1, used=1)
    assert 2 <= len(watched.logged) <= 30 * 30 / REPEAT_S + 1


def test_a_radio_that_has_gone_is_not_complained_of_twice():
    watched = Watched()
    watched.restart()
    watched.lose()
    watched.pass_s(60)
    assert watched.logged == []
    watched.restart()
    watched.pass_s(UNUSABLE_S)
    assert watched.logged == []  # it is given time again


def looks(node, seconds=12):
    """The node is looked at every second; the words behind the last semicolons."""
    for second in range(seconds):
        node.check_reception(1000.0 + second)


def tag(radio=None, **settings):
    logged = []
    node = TagNode(TagSettings(**settings), radio or FakeRadio("t1"), lambda fix: None, logged.append)
    node.on_event(Restarted())
    node.check_reception(999.0)
    return node, logged


def test_a_tag_that_receives_nothing_asks_its_radio_where_to_look():
    node, logged = tag()
    looks(node)
    assert logged == ["tag t1: listening", "tag t1: nothing usable for 5 s; the radio says where to look"]
    node.on_event(Gone("pulled out"))
    looks(node)
    assert len(logged) == 3


@pytest.mark.parametrize(
    ("settings", "spoil", "reason"),
    [
        ({"site": LAB.id + 1}, lambda frame: frame, "foreign-site"),
        ({}, lambda frame: frame[:-1] + bytes([frame[-1] ^ 1]), "bad-fcs"),
        ({}, lambda frame: b"\x02\x00", "too-short"),
    ],
)
def test_a_tag_whose_frames_are_all_dropped_logs_why(settings, spoil, reason):
    node, logged = tag(**settings)
    for one in HEARD:
        node.on_event(replace(one, frame=spoil(one.frame)))
    looks(node)
    assert logged[1].startswith(
        f"tag t1: nothing usable for 5 s; {len(HEARD)} frames have come; most counted: {reason} ({len(HEARD)})"
    )


def test_a_tag_that_receives_logs_nothing():
    node, logged = tag()
    for second in range(6):
        for one in HEARD[second::6]:
            node.on_event(one)
        node.check_reception(1000.0 + second)
    assert logged == ["tag t1: listening"]


def test_an_anchor_that_receives_nobody_logs_it_and_what_is_dropped():
    logged = []
    node = AnchorNode(replace(LAB, id=LAB.id + 1), 3, FakeRadio("3"), logged.append)
    node._wait = lambda seconds, then: None  # it has no loop
    node.radio.ready = False
    node.on_event(Restarted())
    node.check_reception(999.0)
    looks(node, 6)
    node.check_reception(1005.5)
    for one in HEARD:
        node.on_event(one)
    for second in range(6, 20):
        node.check_reception(1000.0 + second)
    assert logged[1] == "anchor 3: nothing usable for 5 s; the radio says where to look"
    assert "most counted: foreign-site" in logged[2]


def test_a_sniffer_whose_anchors_are_not_in_the_table_logs_it():
    logged = []
    radio = SnifferRadio("/dev/sniffer", 115_200, "drone")
    node = PacketTagNode(PacketTagSettings(hall.ANCHORS_M), radio, lambda fix: None, logged.append)
    node.on_event(Restarted())
    node.check_reception(999.0)
    for number in range(20):
        node.on_event(Packet(None, 77, number * 10**9, number, 5, ()))
    looks(node)
    assert "20 frames have come; most counted: unknown-anchor (20)" in logged[1]


@pytest.mark.parametrize(
    ("kind", "sender", "garbage"),
    [
        (ListenerRadio, "the listener of uwb-apps", b"Hello from PANS\r\n" * 20),
        (SnifferRadio, "a Bitcraze sniffer", bytes(20_000)),
    ],
)
def test_a_line_that_is_silent_and_one_of_another_sender_are_reported_apart(kind, sender, garbage):
    radio = kind("/dev/ttyACM7", 115_200, "t1")
    node, logged = tag(radio)
    radio.on_open(lambda data: None)
    looks(node)
    assert logged[1] == (
        "tag t1: nothing usable for 5 s; nothing at all comes from /dev/ttyACM7 at 115200 baud: nothing on the air, "
        f"another port, or not {sender}?"
    )
    radio.on_data(garbage)
    for second in range(12, 24):
        node.check_reception(1000.0 + second)
    assert f"what comes from /dev/ttyACM7 at 115200 baud is not from {sender}" in logged[2]
    assert "most counted: malformed-line" in logged[2] or "most counted: bytes-of-no-record" in logged[2]
