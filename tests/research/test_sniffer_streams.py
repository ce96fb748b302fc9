import gzip
import io
import random
import tracemalloc
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.air.masterless_packets import Packet
from skyless.files import CHUNK_BYTES, open_source
from skyless.radio.foreign import bitcraze
from skyless.research.foreign import crazyflie as bitcraze_captures
from support.capture_makers import binary_record, tdoa2, tdoa3, text_line, yaml_document

READERS = {
    "binary": (bitcraze.read_binary, binary_record),
    "text": (bitcraze.read_text, text_line),
    "yaml": (bitcraze_captures.read_yaml, yaml_document),
}
both = pytest.mark.parametrize("kind", READERS)


def heard(number):
    """Sender, RX ticks and payload of a made-up packet; both kinds of payload occur."""
    if number % 5 == 0:
        return number % 8, number * 1_000_003 % 2**40, tdoa2([number % 256] * 8, [number + 1] * 8, [33000] * 8)
    relays = [(anchor, number % 128, number * 7919 % 2**32, 33000 + anchor) for anchor in range(number % 4)]
    return number % 8, number * 1_000_003 % 2**40, tdoa3(number % 128, number * 31 % 2**32, relays)


def read(kind, data):
    drops = Counter()
    return list(READERS[kind][0](io.BytesIO(data), drops)), drops


def capture(kind, count):
    return b"".join(READERS[kind][1](*heard(number)) for number in range(count))


@both
def test_every_packet_comes_back(kind):
    packets, drops = read(kind, capture(kind, 3000))
    assert not drops
    assert len(packets) == 3000
    assert [(p.anchor, p.rx_ticks) for p in packets] == [heard(n)[:2] for n in range(3000)]
    assert all(p.tx_ticks == n * 31 for n, p in enumerate(packets) if n % 5)


@both
def test_the_readers_agree(kind):
    packets, _ = read(kind, capture(kind, 50))
    reference, _ = read("text", capture("text", 50))
    assert [(p.anchor, p.sequence, p.tx_ticks, p.rx_ticks, p.relays) for p in packets] == [
        (p.anchor, p.sequence, p.tx_ticks, p.rx_ticks, p.relays) for p in reference
    ]


@both
@given(data=st.data())
@settings(max_examples=60)
def test_a_capture_cut_off_anywhere_gives_the_whole_packets_before_the_cut(kind, data):
    whole = capture(kind, 12)
    cut = data.draw(st.integers(0, len(whole)))
    reference, _ = read(kind, whole)
    packets, drops = read(kind, whole[:cut])
    assert packets == reference[: len(packets)]
    complete = sum(len(capture(kind, n)) <= cut for n in range(1, 13))
    assert complete <= len(packets) <= complete + 1  # the lines at the end of a YAML document are not needed
    assert sum(drops.values()) <= 1


def feigned_end(stream, begin, end):
    """Where the last of the binary records ends that seem to begin in a stretch; without any, the stretch's own end.

    The mark and a length that is told twice are all that a record is known by, so noise may look like one.
    """
    ends = [end]
    for at in range(begin, end):
        last = at + 10 + int.from_bytes(stream[at + 8 : at + 10], "little")
        if stream[at] == 0xBC and len(stream) >= last + 2 and stream[last : last + 2] == stream[at + 8 : at + 10]:
            ends.append(last + 2)
    return max(ends)


@both
@given(noise=st.binary(max_size=300))
@settings(max_examples=60)
def test_garbage_between_packets_costs_at_most_the_packets_beside_it(kind, noise):
    around = capture(kind, 20)
    separator = b"\n---\n" if kind == "yaml" else b"\n"
    stream = around + separator + noise + separator + around
    packets, drops = read(kind, stream)
    if kind == "binary":
        assert around.count(b"\xbc") == 20
        behind = len(stream) - len(around)
        over = feigned_end(stream, len(around), behind) - behind
        assert len(packets) >= 40 - sum(len(capture(kind, number)) < over for number in range(20))
        assert sum(drops.values()) >= 1
    else:
        assert len(packets) >= 38


@pytest.mark.parametrize("reach", [1, 2, 7])
def test_noise_that_looks_like_a_binary_record_costs_what_it_covers(reach):
    """Its length stands again where it says, within the records behind it."""
    around = capture("binary", 20)
    length = len(capture("binary", reach)) - 3
    false_start = b"\xbc" + bytes(7) + length.to_bytes(2, "little")
    marked = around[:length] + length.to_bytes(2, "little") + around[length + 2 :]
    packets, _ = read("binary", around + false_start + marked)
    assert feigned_end(around + false_start + marked, len(around), len(around) + 10) == len(around) + 12 + length
    assert [packet.rx_ticks for packet in packets][-20 + reach :] == [heard(number)[1] for number in range(reach, 20)]


def test_the_binary_reader_finds_a_record_again_that_a_false_start_swallows_at_the_end():
    false_start = b"\xbc" + bytes(7) + (900).to_bytes(2, "little")
    packets, drops = read("binary", false_start + binary_record(*heard(3)))
    assert len(packets) == 1
    assert drops == {"bytes-of-no-record": 1}


@both
@pytest.mark.parametrize("seed", range(3))
def test_random_and_mutated_bytes_never_raise(kind, seed):
    random_bytes = random.Random(seed)
    mutated = bytearray(capture(kind, 400))
    for _ in range(400):
        mutated[random_bytes.randrange(len(mutated))] = random_bytes.randrange(256)
    packets, drops = read(kind, bytes(mutated))
    assert all(isinstance(packet, Packet) and 0 <= packet.rx_ticks < 2**40 for packet in packets)
    assert drops
    assert read(kind, random_bytes.randbytes(200_000))[1]


class Endless:
    """A stream of the same bytes over and over, for 60 chunks."""

    def __init__(self, piece):
        self._chunk = piece * (CHUNK_BYTES // len(piece))
        self._left = 60

    def read1(self, size):
        self._left -= 1
        return self._chunk if self._left >= 0 else b""


@both
@pytest.mark.statistical
def test_memory_stays_flat_with_packets_and_without_any_separator(kind):
    for piece in (capture(kind, 100), b"\xbc\x01a: " + b"x" * 95):
        drops = Counter()
        tracemalloc.start()
        count = sum(1 for _ in READERS[kind][0](Endless(piece), drops))
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert count > 10_000 or drops
        assert peak_bytes < 16 * CHUNK_BYTES
        assert sum(drops.values()) <= 3  # stretches of bytes and overlong lines are counted once


def test_yaml_documents_of_other_shapes_are_read_as_well():
    packet = tdoa3(5, 6, [(2, 3, 4, None)])
    usual = yaml_document(4, 99, packet)
    keys = usual.decode().splitlines()[1:-1]
    data, rest = keys[:2], keys[2:]
    reordered = ("---\n" + "\n".join(rest[::-1] + data) + "\n").encode()
    flow = b'---\n{ts: 99, from: 4, "data": !!binary "' + data[1].strip().encode() + b'", rxSys: 1700000000.25}\n'
    nested = usual.replace(b"seq: 1", b"remoteAnchorData:\n- distance: 1\n  ts: 5\nseq: 1")
    windows = usual.replace(b"\n", b"\r\n")
    for shape in (reordered, flow, nested, windows):
        packets, drops = read("yaml", shape + usual)
        assert not drops
        assert packets[0] == packets[1], shape


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        (b"---\n" + b"[" * 5000 + b"\n", "malformed-document"),
        (b"---\n" + b"- " * 3000 + b"\n", "malformed-document"),
        (b"---\nfrom: 1\nts: 4\n", "incomplete-document"),
        (b"---\njust text\n", "incomplete-document"),
        (b"---\ndata: MAA=\nfrom: x\nts: 4\n", "malformed-document"),
        (b"---\ndata: a\nfrom: 1\nts: 4\n", "malformed-document"),
        (b"---\ndata: MAA=\nfrom: 1\nts: 1099511627776\n", "impossible-stamp"),
        (b"---\ndata: MAA=\nfrom: 1\nts: 1\nrxSys: .nan\n", "malformed-document"),
        (b"---\ndata: MAA=\nfrom: 1\nts: 1\nrxSys: nan\n", "impossible-host-time"),
        (b"---\ndata: MAA=\nfrom: 1\nts: 1\n", "short-payload"),
        (b"---\ndata: " + b"A" * 20_000 + b"\nfrom: 1\nts: 1\n", "overlong-document"),
    ],
)
def test_bad_documents_are_counted_by_reason(document, reason):
    packets, drops = read("yaml", yaml_document(*heard(1)) + document + yaml_document(*heard(2)))
    assert len(packets) == 2
    assert drops == {reason: 1}


def test_a_compressed_capture_cut_off_gives_what_was_readable(tmp_path):
    compressed = gzip.compress(capture("text", 4000))
    file = tmp_path / "capture.gz"
    file.write_bytes(compressed[: len(compressed) * 3 // 4])
    drops = Counter()
    with open_source(file) as stream:
        packets = list(bitcraze.read_text(stream, drops))
    assert 2000 < len(packets) < 4000
    assert drops["compressed-stream-cut-off"] == 1
    file.write_bytes(compressed[:5000] + bytes(500) + compressed[5500:])
    with open_source(file) as stream:
        assert len(list(bitcraze.read_text(stream, drops))) < 4000
    assert drops["unreadable-bytes"] == 1
