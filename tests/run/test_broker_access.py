"""Roles at the embedded broker: each may do exactly what the table says."""

import asyncio
import re

import pytest
from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion

from skyless.cli.main import main
from skyless.core.errors import SkylessError
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import ACCESS, USERS, MqttAddress, Role, create_access, read_access
from skyless.run.mqtt.connection import check_broker
from skyless.run.mqtt.link import Link
from support.mqtt_brokers import Embedded, stopped
from support.waiting import until

pytestmark = pytest.mark.site

KINDS = ("tag", "anchor", "ether", "dashboard", "recorder", "history", "survey", "bridge", "homeassistant", "watch")
NODES = {topics.status_topic: (*KINDS, "doctor"), topics.health_topic: ("tag", "anchor", "ether")}


def every_topic():
    """All topics of Skyless, of two sites and one node of each kind, and some that are none of them."""
    found = []
    for topic in (one for one in vars(topics).values() if isinstance(one, topics.Topic)):
        nodes = [(kind, "n1") for kind in NODES.get(topic, ())] or [("n1", "n2")[: topic.levels.count("+")]]
        found += [topic(site, *words) for site in (7, 8) for words in nodes]
    assert len(set(found)) == len(found) > 25
    others = ["homeassistant/status", "homeassistant/device/skyless-7-t/config", "homeassistant/switch/x/set"]
    return found + others + ["skyless/v2/7/site", "skyless/v1/7/tag/n1/fix/more", "skyless", "other"]


TOPICS = every_topic()
INTERNAL = ("$MQTT/msgs/skyless/v1/7/site", "$JS/API/STREAM/DELETE/$MQTT_msgs", "$SYS/REQ/SERVER/PING")
BROAD = ("#", "+/#", "skyless/#", "skyless/v1/#", "skyless/v1/+/#", "skyless/v1/7/tag/#", "$MQTT/#", "$JS/#", "$SYS/#")


def matches(filters, topic):
    return any(paho.topic_matches_sub(name, topic) for name in filters)


class Client:
    """A client of paho that a test drives step by step."""

    def __init__(self, port, user=None, password=None, session=""):
        self.got, self.acknowledged, self.codes, self.code, self.ended = [], set(), {}, None, False
        self.paho = paho.Client(CallbackAPIVersion.VERSION2, session, clean_session=not session)
        self.paho.max_inflight_messages_set(0)
        self.paho.username_pw_set(user, password)
        self.paho.on_connect = lambda client, data, flags, code, more: setattr(self, "code", str(code))
        self.paho.on_disconnect = lambda *_: setattr(self, "ended", True)
        self.paho.on_message = lambda client, data, message: self.got.append((message.topic, message.payload.decode()))
        self.paho.on_publish = lambda client, data, number, code, more: self.acknowledged.add(number)
        self.paho.on_subscribe = lambda client, data, number, codes, more: self.codes.__setitem__(number, codes)
        self.paho.connect("127.0.0.1", port)
        self.until(lambda: self.code)

    def until(self, condition):
        for _ in range(400):
            if condition():
                return
            self.paho.loop(0.05)
        raise AssertionError("nothing came for 20 s")

    def publish(self, payload, names, *, retain=False):
        """Publish to all topics; returns when the broker has acknowledged all."""
        numbers = {self.paho.publish(name, payload, 1, retain).mid for name in names}
        self.until(lambda: numbers <= self.acknowledged)

    def subscribe(self, filters, qos=1):
        """Those that the broker grants; all that was published before has come when it answers."""
        _, number = self.paho.subscribe([(name, qos) for name in filters])
        self.until(lambda: number in self.codes)
        return {name for name, code in zip(filters, self.codes[number], strict=True) if not code.is_failure}


class Access:
    """A broker with roles, and clients of each."""

    def __init__(self, folder, **settings):
        create_access(folder / "passwords", MqttAddress("127.0.0.1", 1883))
        self.passwords = read_access(folder / "passwords")
        self.broker = Embedded(folder, roles=self.passwords, **settings)
        self.port = self.broker.address.port
        self.clients = []

    def client(self, role, session=""):
        named = role is not Role.STRANGER
        client = Client(self.port, str(role) if named else None, self.passwords.get(role), session)
        self.clients.append(client)
        return client

    def address(self, role):
        return MqttAddress("127.0.0.1", self.port, user=str(role), password=self.passwords[role])

    @property
    def log(self):
        return (self.broker.broker.data / "nats-server.log").read_text(encoding="utf-8")


@pytest.fixture
def make_access(tmp_path):
    """A function that starts a broker with roles."""
    with asyncio.Runner() as runner:
        made = []

        def make(**settings):
            made.append(Access(tmp_path, **settings))
            runner.run(made[0].broker.start())
            return made[0]

        yield make
        for access in made:
            for client in access.clients:
                client.paho.disconnect()
            runner.run(access.broker.stop())


def test_each_role_publishes_exactly_what_the_table_says(make_access):
    access = make_access(strangers_read=True)
    reader = access.client(Role.OPERATOR)
    assert reader.subscribe(["#"], 0) == {"#"}
    for role in Role:
        reader.got.clear()
        client = access.client(role)
        client.publish(str(role), TOPICS)
        if role is not Role.OPERATOR:
            client.publish(str(role), INTERNAL)
        reader.publish("the end", ["the/end"])
        reader.until(lambda: ("the/end", "the end") in reader.got)
        passed = {name for name, payload in reader.got if payload == str(role)}
        assert passed == {name for name in TOPICS if matches(ACCESS[role].publish, name)}, role
        assert not client.ended


def test_each_role_receives_exactly_what_the_table_says(make_access):
    access = make_access(strangers_read=True)
    operator = access.client(Role.OPERATOR)
    for role, names in [(role, TOPICS[k::2]) for role in Role for k in (0, 1)]:  # a session takes 63 of QoS 1
        client = access.client(role)
        may = {name for name in names if matches(ACCESS[role].subscribe, name)}
        assert client.subscribe(names) == may, role
        operator.publish(str(role), TOPICS)
        client.until(lambda client=client, may=may: {name for name, _ in client.got} >= may)
        client.subscribe(["other"])
        assert {name for name, _ in client.got} == may, role


def test_no_role_but_the_operator_subscribes_to_more_than_it_may(make_access):
    access = make_access(strangers_read=True)
    page = {"skyless/#", "skyless/v1/#", "skyless/v1/+/#", "skyless/v1/7/tag/#"}
    granted = {Role.PAGE: page, Role.SURVEY: page, Role.OPERATOR: page | {"#", "+/#"}}
    for role in Role:
        assert access.client(role).subscribe(BROAD) - {"$JS/#", "$SYS/#"} == granted.get(role, set()), role
        if role is not Role.OPERATOR:
            assert not access.client(role).subscribe(["$JS/#", "$SYS/#", "$MQTT/#"]), role


def test_the_dangerous_pairs_by_hand():
    """What the table is for, whatever else changes in it."""
    writers = {name: {role for role in Role if matches(ACCESS[role].publish, name)} for name in TOPICS}
    operator = Role.OPERATOR
    assert writers["skyless/v1/7/site"] == {operator, Role.ANCHORS}
    assert writers["skyless/v1/7/tag/n1/fix"] == {operator, Role.TAGS}
    assert writers["skyless/v1/7/request"] == {operator, Role.PAGE, Role.SURVEY}
    for what in ("placement", "save", "facts", "state"):
        assert writers[f"skyless/v1/7/survey/{what}"] == {operator, Role.SURVEY}
    assert not any(Role.STRANGER in roles for roles in writers.values())
    assert all(operator in roles for roles in writers.values())
    assert {name for name in TOPICS if matches(ACCESS[Role.STRANGER].subscribe, name)} == {
        f"skyless/v1/{site}/{what}" for site in (7, 8) for what in ("site", "tag/n1/fix")
    }


def test_what_is_retained_and_what_a_session_keeps_stays_within_the_role(make_access):
    access = make_access(strangers_read=True)
    access.client(Role.ANCHORS).publish("kept", ["skyless/v1/7/site"], retain=True)
    access.client(Role.TAGS).publish("false", ["skyless/v1/7/site"], retain=True)
    stranger = access.client(Role.STRANGER)
    assert stranger.subscribe(["skyless/v1/+/site"])
    stranger.until(lambda: stranger.got)
    assert stranger.got == [("skyless/v1/7/site", "kept")]

    recorder = access.client(Role.PAGE, "recorder")
    assert recorder.subscribe(["skyless/v1/7/#"])
    recorder.until(lambda: recorder.got)
    recorder.paho.disconnect()
    access.client(Role.TAGS).publish("1", ["skyless/v1/7/tag/n1/receptions", "skyless/v1/7/zones"])
    again = access.client(Role.PAGE, "recorder")
    again.until(lambda: again.got)
    assert again.got == [("skyless/v1/7/tag/n1/receptions", "1")]


def test_a_last_will_is_bound_to_the_role_too(make_access):
    access = make_access()
    reader = access.client(Role.OPERATOR)
    reader.subscribe(["#"], 0)

    def die(*, will):
        client = paho.Client(CallbackAPIVersion.VERSION2)
        client.username_pw_set("tags", access.passwords[Role.TAGS])
        client.will_set(will, b"gone", 1, True)
        client.connect("127.0.0.1", access.port)
        while not client.is_connected():
            client.loop(0.05)
        client.socket().close()

    die(will="skyless/v1/7/anchor/n1/status")
    while "Publish Violation" not in access.log:  # it was published, and refused
        reader.paho.loop(0.05)
    die(will="skyless/v1/7/tag/n1/status")
    reader.until(lambda: reader.got)
    assert reader.got == [("skyless/v1/7/tag/n1/status", "gone")]


def test_strangers_and_wrong_passwords_are_refused(make_access):
    access = make_access()
    refused = "Not authorized"
    assert Client(access.port).code == refused
    for role in USERS:
        assert Client(access.port, str(role), "wrong-password").code == refused
        assert Client(access.port, str(role)).code == refused
        assert Client(access.port, str(role), access.passwords[role]).code == "Success"
    assert Client(access.port, "tags", access.passwords[Role.ANCHORS]).code == refused
    assert Client(access.port, "stranger", "").code == refused
    assert str(access.broker.broker.address) == f"mqtt://127.0.0.1:{access.port}"
    assert (access.broker.broker.data / "nats-server.conf").stat().st_mode & 0o777 == 0o600
    assert not any(password in access.log for password in access.passwords.values())


@pytest.mark.parametrize("role", [Role.ANCHORS, Role.PAGE])
def test_a_program_of_the_wrong_role_is_warned(role, make_access, caplog, monkeypatch):
    """Anchors may not read a tag's status; the page may, but what it publishes there never comes back."""
    monkeypatch.setattr("skyless.run.mqtt.link._ECHO_S", 0.5)
    access = make_access()
    access.client(Role.TAGS).publish('{"online":true}', ["skyless/v1/7/tag/n1/status"], retain=True)

    async def check():
        link = Link(access.address(role), "n1", site=7, kind="tag")
        task = asyncio.ensure_future(link.run())
        await until(lambda: "has not returned skyless/v1/7/tag/n1/status" in caplog.text)
        await stopped(task)

    asyncio.run(check())
    assert ("a subscription to skyless/v1/7/tag/n1/status" in caplog.text) == (role is Role.ANCHORS)
    assert access.passwords[role] not in caplog.text


def test_a_program_of_the_right_role_is_not_warned(make_access, caplog):
    """Here the check does not wait for its time: it comes as soon as the status has been returned."""
    access = make_access()

    async def check():
        link = Link(access.address(Role.TAGS), "n1", site=7, kind="tag")
        returned = []
        link.subscribe("skyless/v1/7/tag/+/status", lambda _, payload: returned.append(payload))
        task = asyncio.ensure_future(link.run())
        await until(lambda: returned and not link.unacknowledged)
        link._check_echo(link._connection)
        await stopped(task)

    asyncio.run(check())
    assert caplog.text == ""


# The files


def test_the_files_are_private_complete_and_never_replaced(tmp_path, capsys, complaint):
    folder = tmp_path / "new" / "passwords"
    assert main(["broker", "access", str(folder), "--mqtt", "mqtts://hall.local"]) == 0
    assert capsys.readouterr().out.split() == [str(folder / f"{role}.env") for role in USERS]
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {file.stat().st_mode & 0o777 for file in folder.iterdir()} == {0o600}
    passwords = read_access(folder)
    assert len(set(passwords.values())) == len(USERS) == len(list(folder.iterdir()))
    text = (folder / "tags.env").read_text(encoding="utf-8")
    assert f"\nSKYLESS_MQTT=mqtts://tags@hall.local:8883\nSKYLESS_MQTT_PASSWORD={passwords[Role.TAGS]}\n" in text
    assert "has the files of all roles" in complaint("broker", "access", folder)
    (folder / "tags.env").unlink()
    assert main(["broker", "access", str(folder)]) == 0
    again = read_access(folder)
    assert {role for role in USERS if again[role] != passwords[role]} == {Role.TAGS}


@pytest.mark.parametrize(
    ("spoil", "right"),
    [
        (lambda file: file.unlink(), r"page\.env is missing; skyless broker access \S+ makes it"),
        (lambda file: file.chmod(0o640), r"page\.env has mode 640; only its owner .*: chmod 600 \S+page\.env"),
        (lambda file: file.chmod(0o604), r"page\.env has mode 604"),
        (lambda file: file.write_bytes(b""), r"one line SKYLESS_MQTT_PASSWORD=.* with 12 to 200 letters"),
        (lambda file: file.write_bytes(b"SKYLESS_MQTT_PASSWORD=short"), "12 to 200 letters"),
        (lambda file: file.write_bytes(b"SKYLESS_MQTT_PASSWORD='quoted-password'"), "12 to 200 letters"),
        (lambda file: file.write_bytes(b"SKYLESS_MQTT_PASSWORD=$2a$10$abcdefghijkl"), "12 to 200 letters"),
        (lambda file: file.write_bytes(2 * b"SKYLESS_MQTT_PASSWORD=abcdefghijkl\n"), "one line"),
        (lambda file: file.write_bytes(b"\xff" * 99), "12 to 200 letters"),
        (lambda file: (file.unlink(), file.mkdir()), r"page\.env cannot be read: Is a directory"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line(spoil, right, tmp_path, capsys):
    create_access(tmp_path, MqttAddress("127.0.0.1", 1883))
    spoil(tmp_path / "page.env")
    assert main(["broker", "--access", str(tmp_path), "--data", str(tmp_path / "store")]) == 2
    said = capsys.readouterr().err
    assert re.search(right, said)
    assert said.count("\n") == 1
    assert "abcdefghijkl" not in said


def test_a_file_may_be_edited(tmp_path):
    create_access(tmp_path, MqttAddress("127.0.0.1", 1883))
    (tmp_path / "page.env").write_bytes(b"# mine\r\nPAGE=0.0.0.0:80\r\n  SKYLESS_MQTT_PASSWORD=abcdefgh_-12 \r\n")
    assert read_access(tmp_path)[Role.PAGE] == "abcdefgh_-12"


@pytest.mark.parametrize(
    ("arguments", "right"),
    [
        (["access", "{}", "--mqtt", "mqtt://ann@h"], "--mqtt is 'mqtt://ann@h:1883'; it should be .* without a user"),
        (["access", "{}", "--mqtt", "mqtt://$(x)"], "--mqtt is .*; it should be"),
        (["access", "{}", "--mqtt", "h"], "mqtt://HOST"),
        (["access", "/proc/nothing"], "/proc/nothing cannot be written: "),
        (["--strangers-read"], "--strangers-read needs --access"),
        (["--access", "{}"], "anchors.env is missing; skyless broker access"),
    ],
)
def test_wrong_options_leave_nothing_behind(arguments, right, tmp_path, capsys):
    folder = tmp_path / "passwords"
    assert main(["broker", *(word.format(folder) for word in arguments)]) == 2
    assert re.search(right, capsys.readouterr().err)
    assert not folder.exists()


def test_a_user_and_roles_exclude_each_other(tmp_path, monkeypatch, complaint):
    create_access(tmp_path, MqttAddress("127.0.0.1", 1883))
    monkeypatch.setenv("SKYLESS_MQTT_PASSWORD", "word")
    assert "--user and --access exclude each other" in complaint("broker", "--user", "ann", "--access", tmp_path)


async def test_roles_open_the_broker_to_other_machines(tmp_path):
    create_access(tmp_path / "passwords", MqttAddress("127.0.0.1", 1883))
    broker = Embedded(tmp_path, roles=read_access(tmp_path / "passwords"), listen="0.0.0.0")
    await broker.start()
    with pytest.raises(SkylessError, match=r"wrong user name or password.*has no user: it should be USER@HOST"):
        await check_broker(broker.address)
    await broker.stop()
