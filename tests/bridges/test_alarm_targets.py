"""Alarms that leave by webhook and mail: real servers on loopback that accept, refuse, hang, fail and are slow."""

import asyncio
import contextlib
import hmac
import json
import socket
import threading
import time
from email import message_from_bytes, policy

import pytest
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import AuthResult
from msgspec.structs import replace

from skyless.bridges import _deliveries
from skyless.bridges.target import BridgeContext, Hub
from skyless.bridges.targets import open_route
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import AlarmMessage
from skyless.run.web import BridgeLimits
from support.alarm_receiver import Receiver
from support.bridged_values import SITE
from support.waiting import running, until

ALARM = AlarmMessage(
    "cold/t1/1795000000000", "cold", "Too long in the cold store", "inside", "critical", "t1",
    1_795_000_000.0, 4e9, "Ada (t1) has been in Cold store for 10 min", ("t1",), "cold", "Cold store", (1.0, 2.0, 1.0),
)  # fmt: skip
"""Raised after the start of any bridge."""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(_deliveries, "FIRST_PAUSE_S", 0.02)
    monkeypatch.setattr(_deliveries, "LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(_deliveries, "LAST_S", 0.5)


def open_target(text, log=lambda _line: None):
    route = open_route(text, BridgeContext(log))
    route.target.on_site(SITE)
    return route.target


def deliver(target, alarms, condition):
    """Give alarms to a target that runs, until something is so."""

    async def main():
        async with running(target.run()):
            for alarm in alarms:
                target.on_alarm(alarm)
            await until(condition)

    asyncio.run(main())


def verified(secret, headers, body):
    """As docs/howto/alarms.md shows it."""
    stamp = headers["Skyless-Timestamp"]
    right = hmac.new(secret, stamp.encode() + b"." + body, "sha256").hexdigest()
    return hmac.compare_digest(right, headers["Skyless-Signature"]) and abs(time.time() - int(stamp)) < 300


def secret_file(tmp_path, text="a secret\n", mode=0o600):
    path = tmp_path / "secret"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.site
def test_what_becomes_of_an_alarm_is_posted_in_order_and_signed(tmp_path):
    with Receiver() as receiver:
        path = secret_file(tmp_path)
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/alarms/1?secret_file={path}")
        seen = replace(ALARM, acknowledged_unix_s=4e9, acknowledged_by="Ada")
        deliver(target, [ALARM, ALARM, seen, replace(seen, ended_unix_s=4e9)], lambda: target.delivered == 3)
        assert receiver.types == ["raised", "acknowledged", "ended"]
        where, headers, body = receiver.requests[0]
        assert where == "/alarms/1"
        assert json.loads(body)["alarm"]["sentence"] == ALARM.sentence
        assert json.loads(body)["site"] == {"id": SITE.id, "name": SITE.name, "simulated": True}
        assert headers["Idempotency-Key"] == "cold/t1/1795000000000/raised"
        assert verified(b"a secret", headers, body)
        assert not verified(b"a secret", headers, body + b" ")
        assert not verified(b"another", headers, body)


@pytest.mark.site
def test_a_receiver_that_fails_is_asked_again_and_each_time_with_the_same_key():
    with Receiver([500, 503, 429, 408, 200]) as receiver:
        lines = []
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/", lines.append)
        deliver(target, [ALARM], lambda: target.delivered == 1)
        assert receiver.types == ["raised"] * 5
        assert len({headers["Idempotency-Key"] for _, headers, _ in receiver.requests}) == 1
        assert not target.dropped
        assert any("500" in line for line in lines)
        assert "delivered again" in lines[-1]


@pytest.mark.site
@pytest.mark.parametrize("answer", [400, 404, 410, 301])
def test_what_a_receiver_refuses_is_not_posted_again(answer):
    with Receiver([answer]) as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/")
        ended = replace(ALARM, ended_unix_s=4e9)
        deliver(target, [ALARM, ended], lambda: target.delivered == 1)
        assert receiver.types == ["raised", "ended"]
        assert target.dropped == {"refused": 1}


@pytest.mark.site
def test_a_receiver_that_is_not_there_is_tried_until_it_is():
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    lines = []
    target = open_target(f"webhook+http://127.0.0.1:{port}/", lines.append)
    deliver(target, [ALARM], lambda: any("cannot be reached" in line for line in lines))
    assert (len(lines), lines[-1]) == (2, f"{target.text}: stopped; messages that were not delivered: 1")
    assert (target.delivered, target.dropped) == (0, {"stopped": 1})


@pytest.mark.site
def test_what_waits_when_the_bridge_stops_is_tried_once_more(monkeypatch):
    monkeypatch.setattr(_deliveries, "FIRST_PAUSE_S", 1000.0)
    lines = []
    with Receiver([500, 503, 204, 500]) as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/", lines.append)
        other = replace(ALARM, id="b")
        deliver(target, [ALARM, other, replace(other, ended_unix_s=4e9)], lambda: len(lines) == 2)
        assert (len(receiver.requests), target.delivered, target.dropped) == (4, 1, {"stopped": 2})


@pytest.mark.site
async def test_receivers_that_hang_or_drip_cost_only_their_own_messages(monkeypatch):
    monkeypatch.setattr(_deliveries, "TIMEOUT_S", 0.3)
    ended = threading.Event()

    def drip(server):
        with contextlib.suppress(OSError):
            while not ended.is_set():
                connection, _ = server.accept()
                threading.Thread(target=_drip, args=(connection, ended), daemon=True).start()

    with (
        Receiver() as good,
        socket.create_server(("127.0.0.1", 0)) as hanging,
        socket.create_server(("127.0.0.1", 0)) as dripping,
    ):
        threading.Thread(target=drip, args=(dripping,), daemon=True).start()
        lines = []
        texts = [
            f"webhook+http://127.0.0.1:{port}/"
            for port in (hanging.getsockname()[1], dripping.getsockname()[1], good.port)
        ]
        routes = [open_route(text, BridgeContext(lines.append)) for text in texts]
        hub = Hub(routes, lines.append)
        hub.on_site(SITE)
        async with running(*(route.target.run() for route in routes)):
            for k in range(100):
                hub.on_alarm(replace(ALARM, id=f"cold/t{k}/1"))
            await until(lambda: routes[2].target.delivered == 100)
            await until(lambda: sum("no answer" in line for line in lines) >= 2)
        ended.set()
        assert [route.target.delivered for route in routes] == [0, 0, 100]


def _drip(connection, ended):
    with connection, contextlib.suppress(OSError):
        connection.sendall(b"HTTP/1.1 200 OK\r\n")
        while not ended.wait(0.02):
            connection.sendall(b"X: y\r\n")


@pytest.mark.site
def test_the_oldest_of_too_many_is_dropped_and_counted(monkeypatch):
    monkeypatch.setattr(_deliveries, "LIMITS", BridgeLimits(deliveries=5))
    with Receiver() as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/")
        deliver(target, [replace(ALARM, id=f"cold/t/{k}") for k in range(8)], lambda: target.delivered == 5)
        ids = [json.loads(body)["alarm"]["id"] for _, _, body in receiver.requests]
        assert ids == [f"cold/t/{k}" for k in range(3, 8)]
        assert target.dropped == {"too-many": 3}


@pytest.mark.site
def test_after_a_day_a_message_is_dropped(monkeypatch):
    monkeypatch.setattr(_deliveries, "KEPT_S", 0.1)
    with Receiver([500] * 1000) as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/")
        deliver(target, [ALARM], lambda: target.dropped["too-old"] == 1)


@pytest.mark.site
def test_of_what_the_broker_has_kept_only_active_alarms_that_nobody_has_seen_are_posted():
    old = replace(ALARM, unix_s=1.0)
    with Receiver() as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/")
        seen = replace(old, id="seen", acknowledged_unix_s=2.0)
        kept = [old, seen, replace(old, id="ended", ended_unix_s=2.0)]
        deliver(target, [*kept, replace(seen, ended_unix_s=3.0)], lambda: target.delivered == 2)
        assert [(json.loads(b)["alarm"]["id"], json.loads(b)["type"]) for *_, b in receiver.requests] == [
            (old.id, "raised"),
            ("seen", "ended"),
        ]


@pytest.mark.site
def test_one_failing_alarm_does_not_hold_up_another():
    with Receiver([500] + [200] * 10) as receiver:
        target = open_target(f"webhook+http://127.0.0.1:{receiver.port}/")
        other = replace(ALARM, id="b")
        deliver(target, [ALARM, replace(ALARM, ended_unix_s=4e9), other], lambda: target.delivered == 3)
        order = [(json.loads(b)["alarm"]["id"], json.loads(b)["type"]) for *_, b in receiver.requests]
        assert order.index(("b", "raised")) < order.index((ALARM.id, "ended"))
        assert [one for one in order if one[0] == ALARM.id] == [
            (ALARM.id, "raised"),
            (ALARM.id, "raised"),
            (ALARM.id, "ended"),
        ]


@pytest.mark.parametrize(("content", "mode", "words"), [("x", 0o644, "chmod 600"), ("\n", 0o600, "a line of text")])
def test_a_secret_is_for_its_owner_alone(tmp_path, content, mode, words):
    path = secret_file(tmp_path, content, mode)
    with pytest.raises(SkylessError, match=words):
        open_target(f"webhook+https://h/?secret_file={path}")


def test_unencrypted_posts_to_other_machines_are_warned_of():
    lines = []
    open_target("webhook+http://192.0.2.1/", lines.append)
    open_target("webhook+http://localhost/", lines.append)
    assert len(lines) == 1
    assert "unencrypted" in lines[0]


class Mailbox:
    """A mail server's handler: keeps what came, and refuses when told so."""

    def __init__(self, answers=(), to_bob=()):
        self.mails, self.answers, self.to_bob = [], list(answers), list(to_bob)

    async def handle_RCPT(self, _server, _session, envelope, address, _options):  # noqa: N802 - aiosmtpd calls it so
        answer = self.to_bob.pop(0) if self.to_bob and address.startswith("bob@") else "250 OK"
        if answer.startswith("250"):
            envelope.rcpt_tos.append(address)
        return answer

    async def handle_DATA(self, _server, _session, envelope):  # noqa: N802 - aiosmtpd calls it so
        answer = self.answers.pop(0) if self.answers else "250 OK"
        if answer.startswith("250"):
            self.mails.append((envelope.rcpt_tos, message_from_bytes(envelope.content, policy=policy.default)))
        return answer


@contextlib.contextmanager
def mail_server(handler, **settings):
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    controller = Controller(handler, hostname="127.0.0.1", port=port, **settings)
    controller.start()
    try:
        yield port
    finally:
        controller.stop()


@pytest.mark.site
def test_a_mail_when_an_alarm_is_raised_and_when_it_has_ended():
    box = Mailbox(["451 later", "250 OK"])
    with mail_server(box) as port:
        target = open_target(f"smtp://127.0.0.1:{port}?to=ada@example.org,bob@example.org&from=site@example.org")
        seen = replace(ALARM, acknowledged_unix_s=4e9)
        deliver(target, [ALARM, seen, replace(seen, ended_unix_s=4e9)], lambda: target.delivered == 2)
    (people, raised), (_, ended) = box.mails
    assert people == ["ada@example.org", "bob@example.org"]
    assert raised["Subject"] == "Too long in the cold store [critical] hall"
    assert ended["Subject"] == "ended: Too long in the cold store [critical] hall"
    assert raised["From"] == "site@example.org"
    assert raised["Message-ID"] != ended["Message-ID"]
    text = raised.get_content()
    assert ALARM.sentence in text
    assert "Place: Cold store" in text
    assert "This site is simulated." in text


@pytest.mark.site
@pytest.mark.parametrize(
    "name", ["x\r\nBcc: eve@example.org\r\n\r\nbody", "=?utf-8?q?=0D=0ABcc:_eve@example.org?=", "\x1b]0;x\x07\x85"]
)
def test_a_name_cannot_add_headers(name):
    box = Mailbox()
    with mail_server(box) as port:
        target = open_target(f"smtp://127.0.0.1:{port}?to=ada@example.org")
        deliver(target, [replace(ALARM, name=name)], lambda: target.delivered == 1)
    ((people, mail),) = box.mails
    assert people == ["ada@example.org"]
    assert mail["Bcc"] is None
    assert mail["Subject"].isprintable()


@pytest.mark.site
@pytest.mark.parametrize("unix_s", [1e17, -1e17, 1e300])
def test_a_time_that_is_none_does_not_stop_a_mail(unix_s):
    box = Mailbox()
    with mail_server(box) as port:
        target = open_target(f"smtp://127.0.0.1:{port}?to=ada@example.org")
        deliver(target, [replace(ALARM, since_unix_s=unix_s)], lambda: target.delivered == 1)
    assert "which is no time" in box.mails[0][1].get_content()


@pytest.mark.site
def test_a_mail_that_is_refused_for_good_is_counted():
    box = Mailbox(["554 no"])
    with mail_server(box) as port:
        target = open_target(f"smtp://127.0.0.1:{port}?to=ada@example.org")
        deliver(target, [ALARM], lambda: target.dropped["refused"] == 1)
    assert box.mails == []


@pytest.mark.site
def test_who_is_refused_for_now_gets_a_mail_later_and_the_others_get_it_once():
    box = Mailbox(to_bob=["450 later", "250 OK", "550 nobody"])
    with mail_server(box) as port:
        address = f"smtp://127.0.0.1:{port}?to=ada@example.org,bob@example.org"
        target, another = open_target(address), open_target(address)
        deliver(target, [ALARM], lambda: target.delivered == 1)
        assert [people for people, _ in box.mails] == [["ada@example.org"], ["bob@example.org"]]
        deliver(another, [replace(ALARM, id="another")], lambda: another.dropped["refused"] == 1)
    assert [people for people, _ in box.mails[2:]] == [["ada@example.org"]]


@pytest.mark.site
def test_user_and_password(tmp_path):
    asked = []

    def authenticator(_server, _session, _envelope, _mechanism, login):
        asked.append((login.login, login.password))
        return AuthResult(success=True)

    path = secret_file(tmp_path, "the password\n")
    with mail_server(Mailbox(), authenticator=authenticator, auth_require_tls=False, auth_required=True) as port:
        target = open_target(f"smtp://ada@127.0.0.1:{port}?to=ada@example.org&password_file={path}")
        deliver(target, [ALARM], lambda: target.delivered == 1)
    assert asked == [(b"ada", b"the password")]
