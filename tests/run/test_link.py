"""The link against real brokers: what it promises to nodes when brokers and processes die, freeze and come back."""

import asyncio
import contextlib
import logging
import shutil
import signal
import socket
import subprocess
import sys
import threading

import msgspec
import pytest
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.run import broker as broker_module
from skyless.run.broker import BrokerLimits
from skyless.run.mqtt import connection
from skyless.run.mqtt import link as link_module
from skyless.run.mqtt.address import USERS, MqttAddress, Role
from skyless.run.mqtt.connection import Introduction, Reactions, check_broker, open_connection
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import StatusMessage, Zone, ZonesMessage
from skyless.run.mqtt.topics import fix_topic, receptions_topic, status_topic, zones_topic
from support.mqtt_brokers import Embedded, running, stopped, subscribed
from support.processes import free_port
from support.waiting import until

pytestmark = pytest.mark.site

ZONES = ZonesMessage((Zone("z1", "door", ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))),))


class Inbox:
    """What a link has been sent."""

    def __init__(self, address, *filters, qos=0, **options):
        self.link = Link(address, "inbox", site=7, kind="recorder", **options)
        self.messages = []
        for name in filters:
            self.link.subscribe(name, lambda topic, payload: self.messages.append((topic, payload)), qos)

    def of(self, topic):
        return [payload for name, payload in self.messages if name == topic]

    def online(self, kind, name):
        told = self.of(status_topic(7, kind, name))
        return msgspec.json.decode(told[-1], type=StatusMessage).online if told else None


def tag_link(address, **options):
    return Link(address, "t1", site=7, kind="tag", **options)


async def test_a_retained_message_reaches_later_subscribers_also_of_a_broker_that_lost_it(make_broker):
    first, empty = make_broker("first"), make_broker("empty")
    tag = tag_link(first.address)
    async with running(first, tag):
        tag.publish(zones_topic(7), ZONES, qos=1, retain=True)
        await until(lambda: not tag.unacknowledged)
        inbox = Inbox(first.address, zones_topic("+"))
        reader = asyncio.ensure_future(inbox.link.run())
        await until(lambda: inbox.messages)
        assert msgspec.json.decode(inbox.messages[0][1], type=ZonesMessage) == ZONES
        await stopped(reader)
        await first.kill()
        move(empty, first)
        await empty.start()
        await until(lambda: tag.connected and not tag.unacknowledged)
        later = Inbox(first.address, zones_topic("+"))
        reader = asyncio.ensure_future(later.link.run())
        await until(lambda: later.of(zones_topic(7)))
        await stopped(reader)
        await empty.stop()


def move(broker, to):
    """Let a broker listen where another one did."""
    if hasattr(broker, "settings"):
        broker.settings = replace(broker.settings, port=to.address.port)
    else:
        text = broker.file.read_text(encoding="utf-8").replace(f"listener {broker.port}", f"listener {to.port}")
        broker.file.write_text(text, encoding="utf-8")
        broker.port = to.port
    broker.address = to.address


async def test_what_the_broker_has_kept_comes_before_what_replaces_it(make_broker):
    broker = make_broker()
    one, other = Inbox(broker.address), Inbox(broker.address, zones_topic(7))
    async with running(broker, one.link):
        one.link.publish(zones_topic(7), ZONES, qos=1, retain=True)
        await until(lambda: one.link.connected and not one.link.unacknowledged)
        other.link.publish(zones_topic(7), ZonesMessage(()), qos=1, retain=True)
        task = asyncio.ensure_future(other.link.run())
        await until(lambda: len(other.messages) == 2)
        assert [len(msgspec.json.decode(payload, type=ZonesMessage).zones) for _, payload in other.messages] == [1, 0]
        await stopped(task)


NODE = """
import asyncio, sys
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
link = Link(MqttAddress("127.0.0.1", int(sys.argv[1])), "t1", site=7, kind="tag", keepalive_s=1)
asyncio.run(link.run())
"""


async def start_node(broker):
    return await asyncio.create_subprocess_exec(sys.executable, "-c", NODE, str(broker.address.port))


@pytest.mark.parametrize(
    "end",
    [
        pytest.param(signal.SIGKILL, id="killed"),
        pytest.param(signal.SIGSTOP, id="frozen", marks=pytest.mark.statistical),
    ],
)
async def test_a_process_that_was_killed_or_frozen_is_offline_by_its_last_will_and_comes_back(make_broker, end):
    broker = make_broker()
    inbox = Inbox(broker.address, status_topic(7, "tag", "+"))
    async with running(broker, inbox.link):
        node = await start_node(broker)
        await until(lambda: inbox.online("tag", "t1"))
        node.send_signal(end)
        await until(lambda: inbox.online("tag", "t1") is False)
        if end == signal.SIGSTOP:
            node.send_signal(signal.SIGCONT)
        else:
            await node.wait()
            node = await start_node(broker)
        await until(lambda: inbox.online("tag", "t1"))
        node.kill()
        await node.wait()


async def test_a_stopped_link_logs_it_and_sends_what_waits_and_can_run_again(make_broker):
    broker = make_broker()
    inbox = Inbox(broker.address, "skyless/v1/7/#", qos=1)
    tag = tag_link(broker.address)
    async with running(broker, inbox.link, tag) as (_, task):
        await until(lambda: inbox.online("tag", "t1"))
        for number in range(500):
            tag.publish(receptions_topic(7, "t1"), b"%d" % number, qos=1)
        await stopped(task)
        assert not tag.connected
        await until(lambda: inbox.online("tag", "t1") is False)
        # The embedded broker keeps the order of one topic only: the status may overtake receptions.
        await until(lambda: len(inbox.of(receptions_topic(7, "t1"))) == 500)
        assert inbox.of(receptions_topic(7, "t1")) == [b"%d" % number for number in range(500)]
        again = asyncio.ensure_future(tag.run())
        await until(lambda: inbox.online("tag", "t1"))
        await stopped(again)
        await until(lambda: inbox.online("tag", "t1") is False)


async def test_a_link_stopped_without_a_broker_ends_at_once_and_logs_what_is_lost(caplog):
    link = tag_link(MqttAddress("127.0.0.1", free_port()))
    task = asyncio.ensure_future(link.run())
    link.publish(receptions_topic(7, "t1"), b"1", qos=1)
    link.publish("not a topic", b"")
    await until(lambda: "cannot be reached" in caplog.text)
    await stopped(task)
    assert task.cancelled()
    assert "has not accepted 1 messages" in caplog.text
    assert "'not a topic' is not one that every broker accepts" in caplog.text
    assert link.counters.dropped == 1


async def test_a_will_that_comes_late_does_not_show_a_running_node_as_offline(make_broker):
    broker = make_broker()
    inbox = Inbox(broker.address, status_topic(7, "tag", "+"))
    tag = tag_link(broker.address)
    async with running(broker, inbox.link, tag):
        await until(lambda: inbox.online("tag", "t1"))
        offline = StatusMessage(online=False, kind="tag", name="t1")
        inbox.link.publish(status_topic(7, "tag", "t1"), offline, qos=1, retain=True)
        inbox.link.forget(status_topic(7, "tag", "t1"))
        await until(lambda: b'"online":false' in b"".join(inbox.of(status_topic(7, "tag", "t1"))))
        await until(lambda: inbox.online("tag", "t1"))


async def test_after_a_broker_s_death_it_reconnects_and_logs_what_was_dropped(make_broker, caplog):
    caplog.set_level(logging.WARNING, "skyless.run.mqtt")
    broker = make_broker()
    states = []
    tag = tag_link(broker.address)
    tag.on_state.append(states.append)
    async with running(broker, tag):
        await until(lambda: tag.counters.published == 1)  # its status, acknowledged
        await broker.kill()
        await until(lambda: not tag.connected)
        for number in range(100):
            tag.publish(fix_topic(7, "t1"), b"%d" % number)
        await broker.start()
        await until(lambda: tag.connected)
        await until(lambda: tag.counters.published == 3)  # two statuses, the newest fix
        assert tag.counters.dropped == 99
        assert tag.counters.reconnects == 1
        assert states == [True, False, True]
        assert "99 messages were dropped" in caplog.text


@pytest.mark.statistical
async def test_no_message_of_qos_1_is_lost_when_the_broker_dies_and_comes_back(make_broker):
    """The publisher goes on at 200 a second, the subscriber has a persistent session."""
    broker = make_broker()
    topic = receptions_topic(7, "t1")
    inbox = Inbox(broker.address, topic, qos=1, persistent=True)
    tag = tag_link(broker.address)
    async with running(broker, inbox.link, tag):
        await broker.saved()
        for number in range(300):
            tag.publish(topic, b"%d" % number, qos=1)
            await asyncio.sleep(0.005)
            if number == 100:
                restart = asyncio.ensure_future(again(broker))
        await restart
        await until(lambda: not tag.unacknowledged)
        await until(lambda: {int(payload) for payload in inbox.of(topic)} == set(range(300)))
        assert tag.counters.dropped == 0


async def again(broker):
    await broker.kill()
    await asyncio.sleep(0.2)
    await broker.start()


async def test_a_persistent_subscriber_gets_what_came_while_it_was_away_and_the_broker_died(make_broker):
    broker = make_broker()
    topic = receptions_topic(7, "t1")
    inbox = Inbox(broker.address, topic, qos=1, persistent=True)
    tag = tag_link(broker.address)
    async with running(broker, tag):
        crashed = asyncio.ensure_future(inbox.link.run())
        await subscribed(inbox.link)
        tag.publish(topic, b"0", qos=1)
        await until(lambda: inbox.messages)
        inbox.link._connection.abort("crash")
        crashed.cancel()
        await asyncio.wait([crashed])
        for number in range(1, 1200):
            tag.publish(topic, b"%d" % number, qos=1)
        await until(lambda: not tag.unacknowledged)
        await broker.saved()
        await broker.kill()
        await broker.start()
        back = Inbox(broker.address, topic, qos=1, persistent=True)
        reader = asyncio.ensure_future(back.link.run())
        await until(lambda: {int(payload) for payload in back.of(topic)} >= set(range(1, 1200)))
        await stopped(reader)


@pytest.mark.statistical
async def test_a_frozen_broker_delays_nothing_and_gets_the_newest_afterwards(make_broker):
    """The same event loop freezes and thaws the broker: were anything to block, it would never be thawed."""
    broker = make_broker()
    inbox = Inbox(broker.address, "skyless/v1/7/tag/#", qos=1)
    tag = tag_link(broker.address)
    topics = [fix_topic(7, "t1"), fix_topic(7, "t2")]
    count, size = 12_000, 1000
    async with running(broker, inbox.link, tag):
        await asyncio.sleep(0.2)
        broker.signal(signal.SIGSTOP)
        turns = 0
        for number in range(count):
            for topic in topics:
                tag.publish(topic, b"%d" % number + b" " * size)
            if number % 100 == 0:
                tag.publish(receptions_topic(7, "t1"), b"%d" % number, qos=1)
                await asyncio.sleep(0)
                turns += 1
        assert turns == count / 100
        assert tag.connected
        assert tag.counters.dropped > count  # far more than any buffer holds
        assert len(tag._outbox._newest) == 2
        await asyncio.sleep(2.0)
        broker.signal(signal.SIGCONT)
        for topic in topics:
            await until(lambda topic=topic: inbox.of(topic)[-1:] == [b"%d" % (count - 1) + b" " * size])
        await until(lambda: len(inbox.of(receptions_topic(7, "t1"))) == count / 100)
        numbers = [int(payload) for payload in inbox.of(receptions_topic(7, "t1"))]
        assert numbers == list(range(0, count, 100))
        assert tag.counters.reconnects == 0


async def test_a_broker_frozen_for_longer_than_the_keepalive_is_left_and_found_again(make_broker):
    broker = make_broker()
    tag = tag_link(broker.address, keepalive_s=1)
    async with running(broker, tag):
        broker.signal(signal.SIGSTOP)
        await until(lambda: not tag.connected)
        assert "silent" in tag.trouble
        broker.signal(signal.SIGCONT)
        await until(lambda: tag.connected)


async def test_what_a_broker_has_kept_is_found_also_while_it_is_too_busy_to_answer(make_broker, monkeypatch):
    broker, topic = make_broker(), status_topic(7, "tag", "t1")
    connect = connection.open_connection

    async def open_and_freeze(*given):
        opened = await connect(*given)
        broker.signal(signal.SIGSTOP)
        asyncio.get_running_loop().call_later(1.2, broker.signal, signal.SIGCONT)
        return opened

    async with running(broker):
        before = await connect(broker.address, None, Introduction("", 10))
        before.publish(topic, b"kept", 1, retain=True)
        await before.leave()
        monkeypatch.setattr(connection, "open_connection", open_and_freeze)
        assert await connection.kept_messages(broker.address, iter(["skyless/#", "other"])) == {topic: b"kept"}


async def test_tls_trusts_only_the_given_certificate(make_broker, certificate):
    broker = make_broker(certificate=certificate[0], key=certificate[1])
    trusting = replace(broker.address, ca=certificate[0])
    tag = tag_link(trusting)
    async with running(broker, tag):
        await check_broker(trusting)
        with pytest.raises(SkylessError, match=r"certificate of the broker mqtts://.* --mqtt-ca"):
            await check_broker(broker.address)
        plain = MqttAddress("127.0.0.1", broker.address.port)
        with pytest.raises(SkylessError, match=r"broker mqtt://127\.0\.0\.1"):
            await check_broker(plain)


async def test_a_wrong_password_is_reported_without_showing_it(make_broker, caplog):
    broker = make_broker(user="ann", password="right-word")
    wrong = replace(broker.address, password="wrong-word")
    async with running(broker, tag_link(broker.address)):
        with pytest.raises(
            SkylessError, match=r"wrong user name or password.*; the password goes in SKYLESS_MQTT"
        ) as error:
            await check_broker(wrong)
        link = tag_link(wrong)
        task = asyncio.ensure_future(link.run())
        await until(lambda: "wrong user name or password" in caplog.text)
        assert "wrong user name" in link.trouble
        assert "wrong-word" not in caplog.text + str(error.value) + repr(wrong)
        await stopped(task)


@pytest.fixture
def certificate(tmp_path):
    """A self-made certificate and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    files = tmp_path / "certificate.pem", tmp_path / "key.pem"
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    make = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    subprocess.run([*make, "-out", files[0], "-keyout", files[1], *names], check=True, capture_output=True)
    for file in files:
        file.chmod(0o644)
    return files


@pytest.mark.parametrize(
    ("answer", "trouble"),
    [
        (b"", "no answer within 0.2 s"),
        (b"\x00\x00", "answer is not MQTT"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9, "answer is not MQTT"),
        (b"\x20\x02\x00\x00\x30\x01\xff", "answer is not MQTT"),
        (b"\x20\x02\x00\x00\x30\x05\x00", "closed the connection"),
    ],
)
async def test_what_is_no_broker_is_reported_and_tried_again(answer, trouble, monkeypatch):
    """Silence, garbage, another protocol, a wrong packet, half a packet."""
    monkeypatch.setattr(connection, "BROKER_ANSWER_S", 0.2)
    visits = []

    async def serve(_, writer):
        visits.append(writer)
        writer.write(answer)
        await asyncio.sleep(0.3)
        writer.close()

    port = free_port()
    link = tag_link(MqttAddress("127.0.0.1", port))
    task = asyncio.ensure_future(link.run())
    await until(lambda: "cannot be reached" in str(link.trouble))
    async with await asyncio.start_server(serve, "127.0.0.1", port):
        await until(lambda: trouble in str(link.trouble))
        seen = len(visits)
        await until(lambda: len(visits) > seen)
        assert not task.done()
    await stopped(task)


async def test_a_stopped_link_waits_for_no_connection_that_is_on_its_way():
    """A full backlog leaves later connections without an answer; whoever has given up closes his when it comes."""
    loop = asyncio.get_running_loop()
    with socket.socket() as server, socket.socket() as first:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        server.setblocking(False)
        first.connect(server.getsockname())
        task = asyncio.ensure_future(tag_link(MqttAddress(*server.getsockname())).run())
        await until(connecting)
        await stopped(task)
        assert connecting()
        (await loop.sock_accept(server))[0].close()
        peer, _ = await loop.sock_accept(server)
        with peer:
            async with asyncio.timeout(20):
                while await loop.sock_recv(peer, 1000):
                    pass


def connecting():
    return any(thread.name == "MQTT connect" for thread in threading.enumerate())


@pytest.mark.parametrize("qos", [0, 1])
async def test_a_flood_through_tls_arrives_completely(make_broker, certificate, qos):
    """TLS hands over more at once than the socket announces."""
    broker = make_broker(certificate=certificate[0], key=certificate[1])
    address = replace(broker.address, ca=certificate[0])
    inbox = Inbox(address, "skyless/v1/7/tag/#", qos=qos, keepalive_s=600)
    tag = tag_link(address)
    async with running(broker, inbox.link, tag):
        await asyncio.sleep(0.2)
        sizes = [30_000] * 3 + [10] * 2000
        for size in sizes:
            tag.publish(fix_topic(7, "t1"), b"." * size, qos=qos)
        await until(lambda: [len(payload) for payload in inbox.of(fix_topic(7, "t1"))] == sizes)


def test_a_handler_that_fails_costs_the_others_nothing(caplog):
    def fail(topic, payload):
        raise ValueError("a bad handler")

    inbox = Inbox(MqttAddress("127.0.0.1", 1), "skyless/v1/7/tag/#")
    for name in ("skyless/v1/7/tag/+/fix", "skyless/v1/7/#"):
        inbox.link.subscribe(name, fail)
    inbox.link._subscriptions.receive(fix_topic(7, "t1"), b"1")
    assert (inbox.of(fix_topic(7, "t1")), "a bad handler" in caplog.text) == ([b"1"], True)


def test_a_message_costs_no_more_with_many_filters_and_more_topics_than_are_kept():
    """Counted in calls of functions: 11,000 topics in turn, 100 filters."""
    link, seen = tag_link(MqttAddress("127.0.0.1", 1)), []
    for number in range(100):
        link.subscribe(f"skyless/v1/{number}/tag/+/fix", lambda topic, _payload: seen.append(topic))
    link.subscribe("skyless/#", lambda topic, _payload: seen.append(topic))
    receive, calls = link._subscriptions.receive, 0

    def count(_frame, event, _argument):
        nonlocal calls
        calls += event == "call"

    topics = [f"skyless/v1/7/tag/t{number}/fix" for number in range(11_000)]
    sys.setprofile(count)
    try:
        for topic in topics:
            receive(topic, b"")
    finally:
        sys.setprofile(None)
    assert seen == [topic for topic in topics for _ in range(2)]
    assert calls < 60 * len(topics)


@pytest.mark.parametrize("first", ["gone", "mute"])
@pytest.mark.statistical
async def test_a_link_goes_on_to_the_next_broker(make_broker, first, monkeypatch, caplog):
    """After a refusal, or without an answer; and when the one in use has died."""
    monkeypatch.setattr(connection, "BROKER_ANSWER_S", 1.0)
    one, other = make_broker("one"), make_broker("other")
    mute = await asyncio.start_server(lambda *_: asyncio.sleep(30), "127.0.0.1", 0)
    port = mute.sockets[0].getsockname()[1] if first == "mute" else free_port()
    others = ((one.address.host, one.address.port), (other.address.host, other.address.port))
    address = MqttAddress("127.0.0.1", port, others=others)
    tag, inbox = tag_link(address), Inbox(other.address, zones_topic(7), status_topic(7, "tag", "+"))
    tag.publish(zones_topic(7), ZONES, qos=1, retain=True)
    async with running(one, tag):
        await until(lambda: tag.connected and not tag.unacknowledged)
        assert f"127.0.0.1:{port}" in caplog.text
        await check_broker(address)
        await other.start()
        reader = asyncio.ensure_future(inbox.link.run())
        await until(lambda: inbox.link.connected)
        await one.kill()
        await until(lambda: inbox.of(zones_topic(7)) and inbox.online("tag", "t1"))
        await stopped(reader)
        await other.stop()
    mute.close()


async def test_a_status_is_published_again_and_again(make_broker, monkeypatch):
    """A broker that was reached over another one may have missed it, while the own connection stayed."""
    monkeypatch.setattr(link_module, "RESEND_S", 0.2)
    broker = make_broker()
    tag, inbox = tag_link(broker.address), Inbox(broker.address, status_topic(7, "tag", "+"))
    async with running(broker, inbox.link), asyncio.TaskGroup() as tasks:
        task = tasks.create_task(tag.run())
        await until(lambda: len(inbox.messages) > 3)
        assert len(set(inbox.messages)) == 1
        await stopped(task)
        await until(lambda: inbox.online("tag", "t1") is False)


async def subscribers(address, count, filters=60):
    """Connections with subscriptions of QoS 1, and whether each was granted. A session of nats-server may have 63."""
    granted, opened = [], []
    for number in range(count):
        react = Reactions(subscribed=lambda _filter, yes: granted.append(yes))
        opened.append(await open_connection(address, None, Introduction("", 10), react))
        opened[-1].subscribe({f"t/{number}/{one}": 1 for one in range(filters)})
    await until(lambda: len(granted) == count * filters)
    return opened, granted


async def test_the_embedded_broker_has_room_for_more_subscriptions_than_its_server_by_default(tmp_path):
    async with running(broker := Embedded(tmp_path)):
        opened, granted = await subscribers(broker.address, 17)
        assert granted.count(True) == 1020
        await asyncio.gather(*(one.leave() for one in opened))


@pytest.mark.parametrize("role", [None, Role.PAGE])
async def test_a_full_broker_is_named_as_the_reason_and_asked_again(tmp_path, role, monkeypatch, caplog):
    monkeypatch.setattr(broker_module, "LIMITS", BrokerLimits(subscriptions=60))
    monkeypatch.setattr(link_module, "RESEND_S", 0.2)
    roles = None if role is None else dict.fromkeys(USERS, "a-password-of-all")
    broker = Embedded(tmp_path, roles=roles)
    address = broker.address if role is None else replace(broker.address, user=str(role), password="a-password-of-all")
    everything = replace(broker.address, user=role and str(Role.OPERATOR), password=role and "a-password-of-all")
    inbox = Inbox(address, "skyless/v1/7/zones", qos=1)
    inbox.link.subscribe("elsewhere", lambda _topic, _payload: None, qos=1)
    async with running(broker):
        opened, _ = await subscribers(everything, 1)
        task = asyncio.ensure_future(inbox.link.run())
        refused = {"skyless/v1/7/zones", "elsewhere"}
        await until(lambda: inbox.link.refused == refused)
        sure = "this user may read it, so the broker has no room for more subscriptions (its log says why)"
        assert (sure in caplog.text) == (role is not None)
        assert ("the role page may not read it" in caplog.text) == (role is not None)
        assert ("or there is no room for more subscriptions" in caplog.text) == (role is None)
        await opened[0].leave()
        await until(lambda: inbox.link.refused == ({"elsewhere"} if role else set()))
        assert caplog.text.count("has refused a subscription") == 2, "each is said once"
        await stopped(task)


# To what only plays the broker


@contextlib.asynccontextmanager
async def player(answer):
    """Where something gives every client one answer, and then listens without a word."""

    async def serve(reader, writer):
        writer.write(answer)
        while await reader.read(65_536):
            pass
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield MqttAddress("127.0.0.1", server.sockets[0].getsockname()[1])


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (1, "answer is not MQTT"),
        (2, "refuses: Client identifier not valid"),
        (3, "refuses: Server unavailable"),
        (4, "refuses: wrong user name or password; the address has no user: it should be USER@HOST"),
        (5, "refuses: wrong user name or password, or no permission; the address has no user"),
        (99, "refuses: "),
    ],
)
async def test_each_refusal_of_the_standard_is_reported(code, reason):
    """MQTT 3.1.1, table 3.1."""
    async with player(bytes((0x20, 2, 0, code))) as address:
        with pytest.raises(SkylessError, match=reason):
            await check_broker(address)


async def test_a_number_that_still_flies_is_not_given_again():
    async with player(b"\x20\x02\x00\x00") as address:
        connection = await open_connection(address, None, Introduction("me", 60))
        first = connection.publish("a", b"", 1, retain=False)
        connection._client._last_mid = 0xFFFF - 5  # as if that many had been sent since
        numbers = [connection.publish("a", b"", 1, retain=False) for _ in range(10)]
        assert first not in numbers
        assert len(set(numbers)) == len(numbers)
        connection.abort("enough")
