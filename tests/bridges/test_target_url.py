"""Addresses of targets: their parts, and what is said about wrong ones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.bridges.targets import TARGET_KINDS, open_route
from skyless.core.errors import SkylessError

CONTEXT = BridgeContext(log=lambda _line: None)


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
    "mavlink+udpout://:14550": "has no profile=; it should be ardupilot",
}


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
    with pytest.raises(SkylessError, match="it should be jsonl") as raised:
        open_route("jsonl+tcp://me:secret@:7010", CONTEXT)
    assert "secret" not in str(raised.value)
