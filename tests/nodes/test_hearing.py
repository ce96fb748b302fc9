"""A node that hears nothing of use says where to look, once, and again when it is something else."""

from collections import Counter

import pytest
from msgspec.structs import replace
from node_stage import LAB, FakeRadio, receptions

import masterless_world as hall
from skyless.air.masterless_packets import Packet
from skyless.nodes.anchor import AnchorNode
from skyless.nodes.hearing import AGAIN_S, LOOK_S, Hearing
from skyless.nodes.packet_tags import PacketTagNode, PacketTagSettings
from skyless.nodes.tag import TagNode, TagSettings
from skyless.radios.interface import Gone, Restarted
from skyless.radios.serial.listener_radio import ListenerRadio
from skyless.radios.serial.sniffer_radio import SnifferRadio

HEARD = receptions(1.0)


class Watched:
    """Counts that the test moves, looked at every second."""

    def __init__(self):
        self.said, self.now_s = [], 100.0
        self.came = self.used = 0
        self.reasons = Counter()
        self.advice = "the line is silent"
        self.hearing = Hearing("tag t1", self.said.append, lambda: self.advice)

    def pass_s(self, seconds, came=0, used=0, **reasons):
        for _ in range(round(seconds)):
            self.now_s += 1.0
            self.came += came
            self.used += used
            self.reasons.update({reason.replace("_", "-"): count for reason, count in reasons.items()})
            self.hearing.look(self.now_s, self.came, self.used, self.reasons)


def test_what_is_the_matter_is_said_once_and_again_when_it_changes():
    watched = Watched()
    watched.pass_s(60)
    assert watched.said == []  # there is no radio yet, as was said
    watched.hearing.begin()
    watched.pass_s(LOOK_S)
    assert watched.said == []
    watched.pass_s(301)
    assert watched.said == ["tag t1: nothing of use for 5 s; the line is silent"]
    watched.advice = "the line is noisy"
    watched.pass_s(300, malformed_line=2)
    watched.pass_s(300, came=10, foreign_site=8, bad_fcs=2)
    assert watched.said[1:] == [
        "tag t1: nothing of use for 5 s; the line is noisy; most counted: malformed-line (10), "
        "lines of another format, or another rate",
        "tag t1: nothing of use for 5 s; 50 frames have come; most counted: foreign-site (40), "
        "those are of another site than asked for",
    ]


def test_who_hears_says_nothing_whatever_is_dropped_beside():
    watched = Watched()
    watched.hearing.begin()
    watched.pass_s(300, came=100, used=1, foreign_site=99)
    assert watched.said == []


def test_hearing_that_comes_and_goes_does_not_fill_the_screen():
    watched = Watched()
    watched.hearing.begin()
    for _ in range(30):
        watched.pass_s(20)
        watched.pass_s(10, came=1, used=1)
    assert 2 <= len(watched.said) <= 30 * 30 / AGAIN_S + 1


def test_a_radio_that_has_gone_is_not_complained_of_twice():
    watched = Watched()
    watched.hearing.begin()
    watched.hearing.end()
    watched.pass_s(60)
    assert watched.said == []
    watched.hearing.begin()
    watched.pass_s(LOOK_S)
    assert watched.said == []  # it is given time anew


def looks(node, seconds=12):
    """The node is looked at every second; the words behind the last semicolons."""
    for second in range(seconds):
        node.look(1000.0 + second)


def tag(radio=None, **settings):
    said = []
    node = TagNode(TagSettings(**settings), radio or FakeRadio("t1"), lambda fix: None, said.append)
    node.hear(Restarted())
    node.look(999.0)
    return node, said


def test_a_tag_that_hears_nothing_asks_its_radio_where_to_look():
    node, said = tag()
    looks(node)
    assert said == ["tag t1: listening", "tag t1: nothing of use for 5 s; the radio says where to look"]
    node.hear(Gone("pulled out"))
    looks(node)
    assert len(said) == 3


@pytest.mark.parametrize(
    ("settings", "spoil", "reason"),
    [
        ({"site": LAB.id + 1}, lambda frame: frame, "foreign-site"),
        ({}, lambda frame: frame[:-1] + bytes([frame[-1] ^ 1]), "bad-fcs"),
        ({}, lambda frame: b"\x02\x00\x07", "too-short"),
    ],
)
def test_a_tag_whose_frames_are_all_dropped_says_why(settings, spoil, reason):
    node, said = tag(**settings)
    for one in HEARD:
        node.hear(replace(one, frame=spoil(one.frame)))
    looks(node)
    assert said[1].startswith(
        f"tag t1: nothing of use for 5 s; {len(HEARD)} frames have come; most counted: {reason} ({len(HEARD)})"
    )


def test_a_tag_that_hears_says_nothing():
    node, said = tag()
    for second in range(6):
        for one in HEARD[second::6]:
            node.hear(one)
        node.look(1000.0 + second)
    assert said == ["tag t1: listening"]


def test_an_anchor_that_hears_nobody_says_so_and_what_is_dropped():
    said = []
    node = AnchorNode(replace(LAB, id=LAB.id + 1), 3, FakeRadio("3"), said.append)
    node._wait = lambda seconds, then: None  # it has no loop
    node.radio.ready = False
    node.hear(Restarted())
    node.look(999.0)
    looks(node, 6)
    node.look(1005.5)
    for one in HEARD:
        node.hear(one)
    for second in range(6, 20):
        node.look(1000.0 + second)
    assert said[1] == "anchor 3: nothing of use for 5 s; the radio says where to look"
    assert "most counted: foreign-site" in said[2]


def test_a_sniffer_whose_anchors_are_not_in_the_table_says_so():
    said = []
    radio = SnifferRadio("/dev/sniffer", 115_200, "drone")
    node = PacketTagNode(PacketTagSettings(hall.ANCHORS_M), radio, lambda fix: None, said.append)
    node.hear(Restarted())
    node.look(999.0)
    for number in range(20):
        node.hear(Packet(1000.0 + 0.01 * number, 77, number * 10**9, number, 5, ()))
    looks(node)
    assert "20 frames have come; most counted: unknown-anchor (20)" in said[1]


@pytest.mark.parametrize(
    ("kind", "speaker", "garbage"),
    [
        (ListenerRadio, "the listener of uwb-apps", b"Hello from PANS\r\n" * 20),
        (SnifferRadio, "a Bitcraze sniffer", bytes(20_000)),
    ],
)
def test_a_line_that_is_silent_and_one_of_another_speaker_are_told_apart(kind, speaker, garbage):
    radio = kind("/dev/ttyACM7", 115_200, "t1")
    node, said = tag(radio)
    radio.begin(lambda data: None)
    looks(node)
    assert said[1] == (
        "tag t1: nothing of use for 5 s; nothing at all comes from /dev/ttyACM7 at 115200 baud: nothing on the air, "
        f"another port, or not {speaker}?"
    )
    radio.hear(garbage)
    for second in range(12, 24):
        node.look(1000.0 + second)
    assert f"what comes from /dev/ttyACM7 at 115200 baud is not from {speaker}" in said[2]
    assert "most counted: malformed-line" in said[2] or "most counted: bytes-of-no-record" in said[2]
