"""The outbox: bounded whatever happens, nothing of QoS 1 lost within its bounds, and every loss counted."""

import math
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.run.mqtt.connection import Limits, Outbox

pytestmark = pytest.mark.site

LIMITS = Limits(topics=3, topic_bytes=60, messages=8, bytes=90, window=4, payload=40)

PUTS = st.tuples(st.sampled_from("abcdef"), st.integers(0, 50), st.integers(0, 1), st.booleans())
STEPS = st.lists(st.one_of(PUTS, st.sampled_from(["take", "acknowledge", "restart"])), max_size=200)


class Broker:
    """What a faithful broker would have got."""

    def __init__(self, box):
        self.box = box
        self.flying = []
        self.got = []
        self.number = 0

    def take(self):
        message = self.box.next_message(0.0)
        if message is None:
            return None
        self.number += 1
        self.box.mark_sent(message, self.number)
        self.got.append((message.topic, message.payload, message.qos > 0, message.retain))
        if message.qos:
            self.flying.append(self.number)
        return message

    def acknowledge(self):
        if self.flying:
            self.box.acknowledge(self.flying.pop(0))

    def restart(self):
        self.box.restart()
        self.flying = []

    def take_all(self):
        """The rest, in a connection that lasts."""
        self.restart()
        while self.take() is not None or self.flying:
            self.acknowledge()


def waiting_bytes(box):
    """Payload of all messages that wait or are kept."""
    return box._newest_bytes + box._queue_bytes + box._retained_bytes


@given(STEPS)
def test_its_bounds_hold_and_all_losses_are_counted(steps):
    box = Outbox(LIMITS)
    broker = Broker(box)
    put = Counter()
    for number, step in enumerate(steps):
        if isinstance(step, str):
            getattr(broker, step)()
        else:
            topic, size, qos, retain = step
            box.add(topic, b"%04d" % number + b"." * size, qos, retain=retain)
            put[qos, retain] += 1
        assert len(box._newest) <= LIMITS.topics
        assert len(box._retained) <= LIMITS.topics
        assert len(box._flying) <= LIMITS.window
        assert len(box._queue) <= LIMITS.messages
        assert waiting_bytes(box) <= 2 * LIMITS.topic_bytes + LIMITS.bytes + LIMITS.window * LIMITS.payload
    broker.take_all()
    assert waiting_bytes(box) == sum(len(message.payload) for message in box._retained.values())
    assert box.unacknowledged == 0
    unretained = {message for message in broker.got if not message[3]}
    lost = put[0, False] + put[1, False] - len(unretained)
    assert 0 <= lost <= box.dropped <= lost + put[0, True] + put[1, True]


@given(STEPS)
def test_qos_1_comes_in_order_and_completely(steps):
    """With room for all of them, each comes, first in the order of ``put``, whatever connections do."""
    box = Outbox(Limits(window=4))
    broker = Broker(box)
    put = []
    for number, step in enumerate(steps):
        if isinstance(step, str):
            getattr(broker, step)()
        else:
            payload = b"%d" % number
            box.add(step[0], payload, 1, retain=False)
            put.append(payload)
    broker.take_all()
    assert list(dict.fromkeys(payload for _, payload, _, _ in broker.got)) == put
    assert box.dropped == 0
    assert box.sent == len(put)


def test_of_qos_0_the_newest_of_a_topic_wins():
    box = Outbox(Limits())
    for number in range(5):
        box.add("a", b"%d" % number, 0, retain=False)
    box.add("b", b"x", 0, retain=False)
    broker = Broker(box)
    while broker.take():
        pass
    assert [message[:2] for message in broker.got] == [("a", b"4"), ("b", b"x")]
    assert box.dropped == 4


def test_of_qos_1_the_oldest_that_is_not_on_its_way_goes():
    box = Outbox(LIMITS)
    broker = Broker(box)
    for number in range(4):
        box.add("a", b"%d" % number, 1, retain=False)
    while broker.take():
        pass
    for number in range(4, 20):
        box.add("a", b"%d" % number, 1, retain=False)
    while broker.take() is not None or broker.flying:
        broker.acknowledge()
    assert [int(payload) for _, payload, _, _ in broker.got] == [0, 1, 2, 3, 16, 17, 18, 19]
    assert box.dropped == 12


def test_the_newest_retained_message_is_sent_again_to_every_broker():
    box = Outbox(Limits())
    broker = Broker(box)
    for payload in (b"old", b"new"):
        box.add("a", payload, 1, retain=True)
    for _ in range(2):
        while broker.take() is not None or broker.flying:
            broker.acknowledge()
        broker.restart()
    assert broker.got == [("a", b"new", True, True)] * 2
    assert box.dropped == 0
    box.forget("a")
    assert broker.take() is None


@pytest.mark.parametrize("topic", ["", "a/+/b", "a/#", "a b", "a\tb", "a\x00b", "a" * 251])
def test_a_topic_that_a_broker_would_not_take_is_dropped(topic):
    box = Outbox(Limits())
    box.add(topic, b"", 1, retain=False)
    assert box.dropped == 1
    assert box.next_message(0.0) is None


@given(st.lists(st.tuples(st.sampled_from("ab"), st.floats(0.0, 1.0), st.floats(0.0, 1.0)), max_size=30))
def test_what_has_waited_too_long_is_dropped_and_counted_and_never_sent(steps):
    """Times pass; a message is put in that is good for some time, or one is taken."""
    box, now_s, got = Outbox(Limits()), 0.0, 0
    for topic, pass_s, good_s in steps:
        box.add(topic, b"", 0, retain=False, until_s=now_s + good_s)
        now_s += pass_s
        message = box.next_message(now_s)
        if message is not None:
            assert message.until_s >= now_s
            got += 1
    assert box.next_message(math.inf) is None  # all have become too old
    assert len(steps) == got + box.dropped
    assert box.late <= box.dropped


def test_a_message_without_an_end_waits_as_long_as_it_has_to():
    box = Outbox(Limits())
    for qos, retain in ((0, False), (1, False), (1, True)):
        box.add(f"a{qos}{retain}", b"", qos, retain=retain)
    assert [box.next_message(1e9).qos for _ in range(3)] == [1, 1, 0]
    assert box.late == 0
