"""Addresses of targets: their parts, and what is said about wrong ones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.bridges.targets import TARGET_KINDS, open_route
from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress

CONTEXT = BridgeContext(lambda _line: None, MqttAddress("hall.example", 1883))


def test_the_parts_of_an_address():
    url = TargetUrl("NMEA+tcp://[::1]:10110?tag=tag1&hz=5")
    assert (url.scheme, url.host(), url.port(1), url.tag(), url.number("hz", 10, 1, 50)) == (
        "nmea+tcp",
        "::1",
        10110,
        "tag1",
        5.0,
    )
    url.check_all_read()
    bare = TargetUrl("jsonl+tcp://")
    assert (bare.host(), bare.port(7010), bare.tag()) == ("127.0.0.1", 7010, None)
    assert TargetUrl("nmea+pty:/run/skyless/tag%201").path() == "/run/skyless/tag 1"


WRONG = {
    "nmea": "SCHEME://HOST:PORT",
    "nmea+tcp://:99999": "a port between 1 and 65535",
    "nmea+tcp://:0": "a port between 1 and 65535",
    "jsonl+tcp://:7010#x": "without #",
    "jsonl+tcp://:7010?hz=1&hz=2": "each key once",
    "jsonl+tcp://:7010?hz=fast": "hz=fast; it should be a number from 0.1 to 1000",
    "jsonl+tcp://:7010?hz=nan": "a number from 0.1 to 1000",
    "jsonl+tcp://:7010?tag=a b": "a tag's name",
    "jsonl+tcp://:7010?tag=": "a tag's name",
    "jsonl+tcp://:7010?rate=5": "has 'rate'; its keys are hz, tag",
    "jsonl+udp://no.such.host.invalid:1": "a host that cannot be found",
    "gopher://:70": "one of ",
    "mavlink://:14550": "it should be mavlink+udpout: or mavlink+serial:, if that was meant, or one of ",
    "fox://:1": "it should be one of ",
    "jsonl+pty:/dev": "one of ",
    "nmea+tcp:10110": "it should be nmea+tcp://HOST:PORT",
    "nmea+tcp://:10110/gps": "it should be nmea+tcp://HOST:PORT",
    "nmea+serial://dev/ttyUSB0": "it should be nmea+serial:PATH",
    "nmea+pty://run/gps": "it should be nmea+pty:PATH",
    "foxglove:8765": "it should be foxglove://HOST:PORT",
    "mavlink+udpout://:14550": "has no profile=; it should be ardupilot, px4 or gps",
    "mavlink+udpout://?profile=betaflight": "ardupilot, px4 or gps",
    "mavlink+udpout://?profile=px4&system=0": "system=0; it should be a number from 1 to 255",
    "mavlink+udpout://?profile=px4&system=1.5": "system=1.5; it should be a whole number from 1 to 255",
    "mavlink+udpout://?profile=gps&satellites=many": "satellites=many",
    "mavlink+udpout://?profile=gps&satellites=6.5": "satellites=6.5; it should be a whole number",
    "mavlink+udpout://?profile=gps&satellites=": "satellites=; it should be a number",
    "mavlink+udpout://?profile=px4&heading=": "heading=; it should be a number",
    "mavlink+udpout://?profile=px4&heading=north": "heading=north",
    "mavlink+udpout://?profile=px4&yaw=3": "yaw",
    "mavlink+serial:?profile=px4": "PATH@BAUD",
    "omlox+ws://hub": "it should be omlox+ws://HOST/v2/ws/socket",
    "omlox+wss:/v2/ws/socket": "it should be omlox+wss://HOST/v2/ws/socket",
    "omlox+ws://hub/v2/ws/socket?zone=7": "with a UUID as zone=",
    "omlox+ws://hub/v2/ws/socket?token=7": "has 'token'; its keys are hz, tag, token_file, zone",
    "omlox+ws://hub/v2/ws/socket?hz=20": "a number from 0.1 to 10",
    "omlox+ws://hub/v2/ws/socket?token_file=/nowhere/t": "cannot be read",
    "homeassistant:///x": "should be",
    "homeassistant:?prefix=a+b": "prefix=a b; it should be",
    "homeassistant:?move_m=-1": "move_m=-1; it should be a number from 0",
    "homeassistant:?tls=maybe": "tls=maybe; it should be no or yes",
    "webhook+https:": "webhook+https://HOST/PATH",
    "webhook+https://h/?secret_file=/nowhere/s": "cannot be read",
    "webhook+https://h/?key=1": "its keys are",
    "webhook+https://user@h/": "webhook+https:",
    "smtp://h": "to=",
    "smtp://h?to=nobody": "NAME@HOST",
    "smtps://h?to=a@b.c&password_file=/nowhere/s": "USER@HOST",
    "smtp://u@example.org?to=a@b.c&password_file=/nowhere/s": "starttls",
    "smtp://?to=a@b.c": "HOST",
}


@pytest.mark.site
@pytest.mark.parametrize(("text", "words"), WRONG.items())
def test_a_wrong_address_is_named_with_what_would_be_right(text, words):
    with pytest.raises(SkylessError) as raised:
        open_route(text, CONTEXT)
    assert words in str(raised.value)
    assert text in str(raised.value)
    assert "\n" not in str(raised.value)


@given(
    st.text(max_size=60) | st.sampled_from(list(TARGET_KINDS)).flatmap(lambda s: st.text(max_size=30).map(s.__add__))
)
def test_no_text_costs_a_traceback(text):
    try:
        url = TargetUrl(text)
        url.host(), url.port(1), url.tag(), url.check_all_read()
    except SkylessError:
        pass


def test_a_password_is_not_shown():
    with pytest.raises(SkylessError) as raised:
        TargetUrl("homeassistant://me:secret@house:99999")
    assert "secret" not in str(raised.value)
    for text, words in (
        ("jsonl+tcp://me:secret@:7010", "it should be jsonl"),
        ("smtp://u:secret@h?to=a@b.c", "password_file"),
        ("homeassistant://:secret@host", "should be"),
    ):
        with pytest.raises(SkylessError, match=words) as raised:
            open_route(text, CONTEXT)
        assert "secret" not in str(raised.value)
