"""Packets against the standard's examples, paho's encoder, and streams cut anywhere."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt import client as paho

from skyless.outputs import packets
from skyless.outputs.filters import matches
from skyless.outputs.packets import Message, PacketError, Splitter, Will, read_message

TOPICS = st.text(st.characters(codec="utf-8", exclude_characters="\0+#"), min_size=1, max_size=30)


def paho_bytes(use):
    """What paho would send."""
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id="me")
    sent = []
    client._packet_queue = lambda command, packet, *_: sent.append(bytes(packet)) or paho.MQTT_ERR_SUCCESS
    use(client)
    return b"".join(sent)


@given(TOPICS, st.binary(max_size=300), st.integers(0, 65535), st.booleans(), st.booleans())
def test_publish_is_what_paho_sends(topic, payload, number, retain, again):
    again = again and number > 0

    def use(client):
        client._sock = object()
        client._send_publish(number, topic.encode(), payload, int(number > 0), retain, again)
        client._sock = None

    assert packets.publish(topic, payload, packet=number, retain=retain, again=again) == paho_bytes(use)


@pytest.mark.parametrize("user", [None, "ann"])
@pytest.mark.parametrize("password", [None, "wörd"])
@pytest.mark.parametrize("will", [None, Will("a/status", b"{}")])
def test_connect_is_what_paho_sends(user, password, will):
    def use(client):
        if will is not None:
            client.will_set(will.topic, will.payload, 1, retain=True)
        client.username_pw_set(user, password if user else None)
        client._send_connect(10)

    ours = packets.connect("me", clean=True, keepalive_s=10, user=user, password=password, will=will)
    assert ours == paho_bytes(use)


def test_subscribe_is_the_standard_s_example():
    """MQTT 3.1.1, figure 3.23, with the packet number 10 and its second QoS as 0."""
    assert packets.subscribe(10, {"a/b": 1, "c/d": 0}) == b"\x82\x0e\x00\x0a\x00\x03a/b\x01\x00\x03c/d\x00"
    assert packets.unsubscribe(10, ["a/b", "c/d"]) == b"\xa2\x0c\x00\x0a\x00\x03a/b\x00\x03c/d"  # figure 3.30
    assert packets.puback(0x0102) == b"\x40\x02\x01\x02"


@pytest.mark.parametrize(
    ("size", "coded"),
    [
        (0, "00"),
        (127, "7f"),
        (128, "8001"),
        (16_383, "ff7f"),
        (16_384, "808001"),
        (2_097_151, "ffff7f"),
        (2_097_152, "80808001"),
        (268_435_455, "ffffff7f"),
    ],
)
def test_lengths_are_those_of_the_standard(size, coded):
    """Table 2.4."""
    assert packets._length(size).hex() == coded


@given(st.lists(st.tuples(TOPICS, st.binary(max_size=400), st.integers(0, 65535))), st.randoms(use_true_random=False))
def test_a_stream_may_be_cut_anywhere(messages, random):
    stream = b"".join(packets.publish(topic, payload, packet=number) for topic, payload, number in messages)
    splitter, found = Splitter(), []
    while stream:
        cut = random.randint(1, 500)
        found += [read_message(head, body) for head, body in splitter.feed(stream[:cut])]
        stream = stream[cut:]
    assert found == [Message(*message) for message in messages]


@given(st.binary(max_size=200))
def test_garbage_is_a_packet_error_and_nothing_else(data):
    try:
        for head, body in Splitter().feed(data):
            read_message(head, body)
            packets.refusal(body)
    except PacketError:
        pass


LEVELS = st.lists(st.sampled_from(["a", "b", "", "$x"]), min_size=1, max_size=4)
FILTERS = st.lists(st.sampled_from(["a", "b", "", "+", "$x"]), min_size=1, max_size=4)


@given(FILTERS, st.booleans(), LEVELS)
def test_filters_mean_what_paho_says(levels, rest, topic):
    name = "/".join(levels + ["#"] * rest)
    if topic[0].startswith("$") == name.startswith("$"):
        assert matches(name, "/".join(topic)) == paho.topic_matches_sub(name, "/".join(topic))
    else:
        assert not matches(name, "/".join(topic))


def test_refusals_are_told():
    assert packets.refusal(b"\x00\x00") is None
    assert re.search("password", packets.refusal(b"\x00\x04"))
    assert packets.refusal(b"\x00\x63") == "code 99"
