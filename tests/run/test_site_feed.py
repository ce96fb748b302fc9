"""The feed: each message is decoded and checked once for all readers, and what cannot be used is counted by kind."""

from collections import Counter

import pytest
from dashboard_builders import SITE_ID, Wire, fix, status

from skyless.run.mqtt.messages import AlarmMessage, WrongMessageError, ZoneEvent
from skyless.run.mqtt.topics import ROOT
from skyless.run.site_feed import KINDS, SiteFeed
from support.site_messages import anchor_health, tag_health

DECODED = [(kind, kind.levels.replace("+", "x")) for kind in KINDS if kind.payload]
ALARM = AlarmMessage("r/t1/1", "r", "r", "inside", "warning", "t1", 1.0, 1.0, "")


class Heard:
    """A feed with a reader of every kind, and what that has got."""

    def __init__(self):
        self.feed, self.wire, self.got = SiteFeed(), Wire(), []
        for kind, _ in DECODED:
            self.feed.on(kind.payload, lambda message, channel: self.got.append((channel.kind, message)))
        self.feed.attach(self.wire, SITE_ID)

    def say(self, topic, message):
        self.wire.deliver(f"{ROOT}/{SITE_ID}/{topic}", message)


@pytest.mark.parametrize("payload", [b"null", b"[]", b"{", b"\xff\xfe\x00", b"[" * 10_000, b'{"unix_s":"now"}'])
def test_what_cannot_be_read_reaches_nobody_and_is_counted_by_kind(payload):
    heard = Heard()
    for _, topic in DECODED:
        heard.say(topic, payload)
    assert heard.got == []
    assert heard.feed.drops == Counter(kind.kind for kind, _ in DECODED)


def test_a_retained_message_that_is_withdrawn_is_none_and_any_other_is_wrong():
    heard = Heard()
    for _, topic in DECODED:
        heard.say(topic, b"")
    assert heard.got == [(kind.kind, None) for kind, _ in DECODED if kind.retained]
    assert heard.feed.drops == Counter(kind.kind for kind, _ in DECODED if not kind.retained)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("tag/t2/fix", fix("t1")),
        ("tag/t2/health", tag_health("t1")),
        ("anchor/2/health", anchor_health(1)),
        ("anchor/2/status", status("anchor", "1")),
        ("zone/kitchen/event", ZoneEvent("desk", "Desk", "t1", "enter", 1.0, (0.0, 0.0, 0.0))),
        ("alarm/r/t2/state", ALARM),
        ("zones", b'{"zones":[{"id":"a","name":"A","polygon_m":[[0,0],[1,1]]}]}'),
    ],
)
def test_a_message_of_another_subject_than_its_topics_or_with_values_that_cannot_be_is_wrong(topic, message):
    heard = Heard()
    heard.say(topic, message)
    assert (heard.got, heard.feed.drops.total()) == ([], 1)


def test_other_topics_are_no_fault_and_what_a_reader_of_bytes_refuses_is_counted(caplog):
    feed, wire = SiteFeed(), Wire()

    def refuse(payload, _channel):
        raise WrongMessageError(f"no image in {payload!r}")

    feed.attach(wire, SITE_ID)
    feed.on_bytes("floor_plan", refuse)
    for topic in ("elsewhere", f"{ROOT}/{SITE_ID}/toaster/1/health", f"{ROOT}/{SITE_ID}/tag/t1/fix"):
        feed.receive(topic, b"{}")
    assert not feed.drops
    for floor in ("floor_plan", "floor_plan/2"):
        wire.deliver(f"{ROOT}/{SITE_ID}/{floor}", b"x")
    assert feed.drops == {"floor_plan": 2}
    assert len(caplog.records) == 1, "it is said once"
