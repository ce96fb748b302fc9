"""Garbage, cut, doubled and spoilt records through the parsers of every serial stream.

After each damage come some whole records; the first of them may be lost with it, all others must come out, in order.
The sniffer's binary form has no checksum: damage that promises a length, and finds it again so far behind, is a record,
of up to 1026 bytes, and what it covers is lost. That must be rare, and behind it all must be well. UCI has nothing but
a plausible header: damage that looks like one costs what it promises, and that is not rare.
SKYLESS_FUZZ_BYTES sets how many bytes of damage each parser gets.
"""

import json
import os
import random
from collections import Counter

import pytest

from skyless.radio.foreign.foreign_radios import ListenerRadio, SnifferStream, UciRadio
from skyless.radio.foreign.uci import AnchorFrame, DtMeasurement, SessionInfo, encode_packet, encode_session_info
from skyless.radio.interface import AntennaDelays
from skyless.radio.serial import link
from skyless.radio.serial.serial_radio import LinkSession
from support.capture_makers import binary_record, tdoa3, text_line

pytestmark = pytest.mark.site

BYTES = int(os.environ.get("SKYLESS_FUZZ_BYTES", "300000"))
ALPHABETS = (
    bytes(range(256)),
    b"\0\x01\x02\xff",
    b"\xbc\x1e\0\0\x01",
    b'{"ts":,}0d\\',
    b"From to ff @0123: \r\n",
    b"\r\n",
)
SPOILT = 0xA5 << 32
"""Numbers of records that are spoilt begin here, far from the others by more than one bit."""

BEHIND = 0xA6 << 32

WITHOUT_CHECKSUM = ("sniffer", "uci")
FLUSH = 100
"""Records after which such a line is well in any case."""


class LinkLine:
    """Receptions of a board that is ready."""

    def __init__(self):
        self.found, self.counters = [], Counter()
        self.session = LinkSession("board", AntennaDelays(), lambda data: None, self._take, self.counters)
        self.session.begin(0.0)
        self._writer = link.Writer()
        self.feed(self._writer.hello((1, 0, 0), bytes(8), 1))
        self.feed(self._writer.status(0, 3, [0] * 6))
        self.found.clear()

    def _take(self, event):
        self.found.append(getattr(event, "rx_ticks", None))

    def feed(self, data):
        self.session.on_data(data, 0.0)

    def record(self, number, rng):
        phase = rng.choice((None, rng.randrange(1 << 16)))
        return self._writer.rx(number, 1, 2, 3, rng.randbytes(rng.randrange(1, 128)), phase)


class ListenerLine:
    def __init__(self):
        self.found = []
        self.radio = ListenerRadio("listener", 115_200, "tag")
        self.radio._listener = lambda event: self.found.append(getattr(event, "rx_ticks", None))
        self.radio.on_open(lambda data: None)
        self.counters = self.radio.counters
        self.found.clear()

    def feed(self, data):
        self.radio.on_data(data)

    def record(self, number, rng):
        frame = rng.randbytes(rng.randrange(1, 128))
        line = {"utime": number, "ts": number, "rssi": -80.5, "dlen": len(frame), "d": frame.hex()}
        return json.dumps(line).encode() + b"\n"


class SnifferLine:
    def __init__(self, make):
        self.found, self.counters, self._make = [], Counter(), make
        self._stream = SnifferStream(self.counters)

    def feed(self, data):
        self.found += [packet.rx_ticks for packet in self._stream.feed(data)]

    def record(self, number, rng):
        relays = [(anchor, 5, rng.randrange(2**32), 33_000) for anchor in range(rng.randrange(5))]
        return self._make(3, number, tdoa3(number % 128, rng.randrange(2**32), relays))


class UciLine:
    """Notifications of a FiRa board, a poll each."""

    def __init__(self):
        self.found = []
        self.radio = UciRadio("uci", 115_200, "tag", AnchorFrame())
        self.radio._listener = lambda event: self.found.append(getattr(event, "rx_ticks", None))
        self.radio.on_open(lambda data: None)
        self.counters = self.radio.counters
        self.found.clear()

    def feed(self, data):
        self.radio.on_data(data)

    def record(self, number, rng):
        poll = DtMeasurement(3, 0, number & 0xFFFF, 0, rng.randrange(2**40), number)
        return encode_packet(encode_session_info(SessionInfo(number % 2**32, 1, 1, (poll,))))


LINES = {
    "link": LinkLine,
    "listener": ListenerLine,
    "sniffer": lambda: SnifferLine(binary_record),
    "sniffer-text": lambda: SnifferLine(text_line),
    "uci": UciLine,
}


def damage(record, rng):
    """Bytes that are no whole record, or the same one twice."""
    match rng.randrange(6):
        case 0:
            return bytes(rng.choices(rng.choice(ALPHABETS), k=rng.randrange(1, 600)))
        case 1:
            return record[: rng.randrange(len(record))]
        case 2:
            return record[rng.randrange(1, len(record)) :]
        case 3:
            at, size = rng.randrange(len(record)), rng.randrange(1, 20)
            return record[:at] + record[at + size :]
        case 4:
            at = rng.randrange(len(record))
            return record[:at] + bytes([record[at] ^ 1 << rng.randrange(8)]) + record[at + 1 :]
        case _:
            return record + record if rng.random() < 0.9 else rng.randbytes(20_000)


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.statistical
def test_whatever_is_on_the_line_costs_one_record_behind_it_at_most_and_is_counted(kind):
    rng, line = random.Random(11), LINES[kind]()
    number, spoilt, missed, covered, passed = 1, 0, 0, 0, 0
    for _ in range(3):
        line.feed(line.record(number, rng))
        number += 1
    while spoilt < BYTES:
        bad = damage(line.record(SPOILT + number, rng), rng)
        whole = range(number, number + rng.randrange(2, 5))
        stream = bad + b"".join(line.record(one, rng) for one in whole) + flush(kind, line, rng)
        line.found.clear()
        while stream:
            size = rng.choice((1, 7, 64, 700, 5000))
            line.feed(stream[:size])
            stream = stream[size:]
        found = [one for one in line.found if one in whole]
        if kind in WITHOUT_CHECKSUM and len(found) < len(whole) - 1:
            covered += 1
            assert [one for one in line.found if one >= BEHIND][-20:] == list(
                range(BEHIND + FLUSH - 20, BEHIND + FLUSH)
            )
        else:
            assert found in (list(whole), list(whole)[1:]), f"after {bad[:200]!r}: {found} of {whole}"
        missed += len(found) < len(whole)
        spoilt += len(bad)
        passed += 1
        number += len(whole)
    assert passed > BYTES / 3000
    assert missed < passed
    assert covered <= 3 + passed / (500 if kind == "sniffer" else 2)
    assert sum(line.counters.values()) > passed / 4  # what is counted as copies or drops; some damage is none


def flush(kind, line, rng):
    """A false start waits for as many bytes as it promised: the sniffer's at most 1026, UCI's 4100."""
    return b"".join(line.record(BEHIND + k, rng) for k in range(FLUSH)) if kind in WITHOUT_CHECKSUM else b""
