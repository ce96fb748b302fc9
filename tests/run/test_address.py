"""Addresses of brokers: what is read, what is refused and how, and that the password stays hidden."""

import contextlib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress, hide_password, mqtt_address


@pytest.fixture(autouse=True)
def no_password(monkeypatch):
    monkeypatch.delenv("SKYLESS_MQTT_PASSWORD", raising=False)


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("mqtt://127.0.0.1", MqttAddress("127.0.0.1", 1883)),
        ("mqtt://localhost:2000/", MqttAddress("localhost", 2000)),
        ("MQTT://[::1]:2000", MqttAddress("::1", 2000)),
        ("mqtts://hall.example", MqttAddress("hall.example", 8883, True)),
        ("mqtts://ann@hall.example:1", MqttAddress("hall.example", 1, True, "ann")),
        ("mqtts://a%40b:p%2Fw%3A@h:1", MqttAddress("h", 1, True, "a@b", "p/w:")),
        ("mqtt://a,b:2,[::1]:3/", MqttAddress("a", 1883, others=(("b", 2), ("::1", 3)))),
        ("mqtts://ann:p,w@a:1,b", MqttAddress("a", 1, True, "ann", "p,w", others=(("b", 8883),))),
    ],
)
def test_urls(url, expected):
    assert mqtt_address(url) == expected


def test_the_password_may_stand_in_the_environment(monkeypatch):
    monkeypatch.setenv("SKYLESS_MQTT_PASSWORD", "from outside")
    assert mqtt_address("mqtts://ann@h").password == "from outside"
    assert mqtt_address("mqtts://ann:own@h").password == "own"
    assert mqtt_address("mqtt://h").password is None


@pytest.mark.parametrize(
    ("url", "right"),
    [
        ("127.0.0.1:1883", "mqtt://HOST"),
        ("http://h", "mqtt://HOST"),
        ("", "mqtt://HOST"),
        ("mqtt://", "a host name"),
        ("mqtt://a b", "a host name"),
        ("mqtt://a..b", "a host name"),
        ("mqtt://" + "a" * 64, "a host name"),
        ("mqtt://[::1", "mqtt|host|port"),
        ("mqtt://h:0", "a port between 1 and 65535"),
        ("mqtt://h:65536", "a port between 1 and 65535"),
        ("mqtt://h:x", "a port between 1 and 65535"),
        ("mqtt://h/skyless", "nothing after the port"),
        ("mqtt://:word@h", "a user's name"),
        ("mqtt://a,,b", "a host name"),
        ("mqtt://a,b:x", "a port between 1 and 65535"),
        ("mqtt://a,mqtt://b", "mqtt|host|port"),
    ],
)
def test_a_wrong_url_is_reported_with_what_would_be_right(url, right):
    with pytest.raises(SkylessError, match=right):
        mqtt_address(url)


def test_several_brokers_are_one_address_and_its_text():
    address = mqtt_address("mqtts://ann:word@a,b:2,[::1]", Path("x.pem"))
    assert str(address) == "mqtts://ann@a:8883,b:2,[::1]:8883"
    assert [(one.host, one.port, one.others) for one in address.brokers] == [
        ("a", 8883, ()),
        ("b", 2, ()),
        ("::1", 8883, ()),
    ]
    assert {(one.user, one.password, one.ca, one.tls) for one in address.brokers} == {
        ("ann", "word", Path("x.pem"), True)
    }
    assert msgspec.structs.replace(mqtt_address(str(address)), password="word", ca=Path("x.pem")) == address


SECRET = "S3cretWord"


@pytest.mark.parametrize("rest", ["h:99999", "a,b:x", "h/x", "a b", "", "h:x", "[::1"])
@pytest.mark.parametrize("scheme", ["mqtt://", "mqtts://", "http://", "mqtt:/", ""])
@pytest.mark.parametrize("user", ["ann", "", "a%40b"])
def test_no_error_shows_the_password(scheme, user, rest):
    with pytest.raises(SkylessError) as error:
        mqtt_address(f"{scheme}{user}:{SECRET}@{rest}")
    assert SECRET not in str(error.value)


@pytest.mark.parametrize(
    "url", ["smtp://h:25/?to=a@b", "smtp://[::1]:25?starttls&to=a@b", "smtps://h?to=a@b", "smtp://ann@h:25/?to=a@b"]
)
def test_an_address_without_a_password_is_shown_as_it_is(url):
    assert hide_password(url) == url


def test_neither_text_of_an_address_shows_it():
    address = mqtt_address(f"mqtts://ann:{SECRET}@h")
    assert str(address) == "mqtts://ann@h:8883"
    assert SECRET not in f"{address} {address!r} {[address]}"


@given(st.text())
def test_any_text_is_an_address_or_an_error_of_ours(text):
    for url in (text, "mqtt://" + text):
        with contextlib.suppress(SkylessError):
            assert mqtt_address(url).host
        hide_password(url)


def test_trusted_certificates(tmp_path):
    with pytest.raises(SkylessError, match="mqtts://"):
        mqtt_address("mqtt://h", Path("x.pem"))
    missing = mqtt_address("mqtts://h", tmp_path / "missing.pem")
    with pytest.raises(SkylessError, match=r"missing.pem cannot be used as --mqtt-ca: No such file"):
        missing.tls_context()
    (tmp_path / "no.pem").write_text("no certificate", encoding="utf-8")
    with pytest.raises(SkylessError, match="PEM"):
        mqtt_address("mqtts://h", tmp_path / "no.pem").tls_context()
    assert mqtt_address("mqtts://h").tls_context().check_hostname
    assert mqtt_address("mqtt://h").tls_context() is None


@pytest.mark.parametrize(
    ("host", "here"), [("127.0.0.1", True), ("localhost", True), ("::1", True), ("10.0.0.1", False)]
)
def test_which_brokers_are_on_this_machine(host, here):
    assert MqttAddress(host, 1).loopback is here
    assert not MqttAddress(host, 1, others=(("10.0.0.1", 1),)).loopback
