"""The serial link's bytes, against published check values, the package ``cobs`` and, where it runs, MicroPython."""

import ast
import bisect
import itertools
import random
import shutil
import struct
import subprocess
import sys
from binascii import crc_hqx
from pathlib import Path

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from skyless.firmware import link

VECTORS = Path(__file__).with_name("link_vectors.py")
FOLDER = Path(link.__file__).parent
MICROPYTHON = shutil.which("micropython", path=Path(sys.executable).parent) or shutil.which("micropython")

STAMPS = st.binary(min_size=5, max_size=5).map(bytearray)
SIXTEEN = st.integers(-0x8000, 0x7FFF)
FRAMES = st.binary(max_size=link.MAX_FRAME_BYTES)
NOISE = st.one_of(st.binary(max_size=300), st.binary(max_size=40).map(lambda piece: piece * 20))


def test_the_check_is_the_published_one():
    """CRC-16/IBM-3740: 0x29B1 over the nine digits (Cook's catalogue of parametrised CRCs)."""
    assert link.crc16(b"123456789", 9) == 0x29B1


@given(st.binary(max_size=300))
def test_the_check_is_that_of_the_standard_library_and_cancels_itself(data):
    crc = link.crc16(data, len(data))
    assert crc == crc_hqx(data, 0xFFFF)
    assert link.crc16(data + crc.to_bytes(2, "big"), len(data) + 2) == 0


def stuffed(data):
    out = bytearray(len(data) + len(data) // 254 + 3)
    return bytes(out[: link.stuff(data, len(data), out)])


@given(st.one_of(st.binary(max_size=700), st.lists(st.sampled_from([0, 1, 255]), max_size=700).map(bytes)))
def test_stuffing_is_that_of_others(data):
    assert stuffed(data) == cobs.encode(data) + b"\0"


@pytest.mark.parametrize("length", [0, 1, 253, 254, 255, 507, 508, 509])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0\0", b"\1"])
def test_stuffing_is_that_of_others_where_blocks_are_full(length, tail):
    data = b"\x7f" * length + tail
    assert stuffed(data) == cobs.encode(data) + b"\0"
    out = bytearray(len(data) + 3)
    line = cobs.encode(data)
    assert bytes(out[: link.unstuff(line, len(line), out)]) == data


@given(st.binary(max_size=300).map(lambda data: data.replace(b"\0", b"\1")))
def test_unstuffing_agrees_with_others_on_anything_without_zeros(line):
    out = bytearray(len(line) + 1)
    size = link.unstuff(line, len(line), out)
    if not line:
        assert size == 0
        return
    try:
        assert bytes(out[:size]) == cobs.decode(line)
    except cobs.DecodeError:
        assert size == -1


def lines_of(writer):
    """Every record that there is, with what stands in it."""
    ticks, frame = bytearray(b"\0\1\2\3\4"), bytearray(range(60))
    yield lambda: writer.rx(ticks, -7953, -8312, 12, frame, 60)
    yield lambda: writer.tx_done(ticks, ticks)
    yield lambda: writer.tx_late(ticks, 1)
    yield lambda: writer.status(ticks, 3, [1, 2, 3, 4, 5, 6])
    yield lambda: writer.hello((0, 1, 0), bytearray(8), 1)
    yield lambda: writer.refused(link.CONFIG, 1)
    yield lambda: writer.ask(link.ASK_HELLO)
    yield lambda: writer.ask(link.RX_ON)
    yield lambda: writer.config(16436, 16436)
    yield lambda: writer.tx_at(ticks, frame, 60)


def stream(count, seed=1):
    """So many records of all kinds in any order: bytes of each, what it must come out as."""
    writer, draw = link.Writer(), random.Random(seed)
    makers = list(lines_of(writer))
    lines, records = [], []
    for _ in range(count):
        line = bytes(writer.line[: draw.choice(makers)()])
        lines.append(line)
        records.append(cobs.decode(line[:-1])[:-2])
    return lines, records


def read(data, cuts=()):
    """Records of a stream that comes in pieces, and the reader."""
    reader, found = link.Reader(), []
    for begin, end in itertools.pairwise([0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]):
        at = begin
        while at < end:
            at = reader.read(data, at, end)
            if reader.length:
                found.append(bytes(reader.record[: reader.length]))
    return found, reader


@given(st.integers(0, 20), st.lists(st.integers(0, 5000), max_size=30))
def test_records_come_out_however_the_stream_is_cut(count, cuts):
    lines, records = stream(count)
    found, reader = read(b"".join(lines), cuts)
    assert found == records
    assert (reader.garbled, reader.overlong) == (0, 0)


@given(STAMPS, SIXTEEN, SIXTEEN, SIXTEEN, FRAMES)
def test_a_reception_comes_back(ticks, rx_power, first_path, offset, frame):
    writer = link.Writer()
    end = writer.rx(ticks, rx_power, first_path, offset, bytearray(frame), len(frame))
    (record,), _ = read(bytes(writer.line[:end]))
    assert record[0] == link.RX
    assert record[2:7] == bytes(ticks)
    assert struct.unpack_from("<hhh", record, 7) == (rx_power, first_path, offset)
    assert record[link.RX_FRAME_AT :] == frame


@given(STAMPS, FRAMES, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_commands_come_back(dx, frame, tx_delay, rx_delay):
    writer = link.Writer()
    (record,), _ = read(bytes(writer.line[: writer.tx_at(dx, bytearray(frame), len(frame))]))
    assert (record[0], record[2:7], record[link.TX_FRAME_AT :]) == (link.TX_AT, bytes(dx), frame)
    (record,), _ = read(bytes(writer.line[: writer.config(tx_delay, rx_delay)]))
    assert len(record) == link.CONFIG_BYTES
    assert [link.unsigned(record, at, 2) for at in (8, 10)] == [tx_delay, rx_delay]


def test_lengths_are_as_told_and_numbers_run_round():
    writer = link.Writer()
    (record,), _ = read(bytes(writer.line[: writer.hello((1, 2, 3), bytearray(8), 1)]))
    assert len(record) == link.HELLO_BYTES
    assert link.unsigned(record, 15, 4) * 1000 == 499_200_000 * 128
    (record,), _ = read(bytes(writer.line[: writer.status(bytearray(5), 1, [2**30] * 6)]))
    assert len(record) == link.STATUS_BYTES
    assert link.unsigned(record, 8, 4) == 0
    numbers = [read(bytes(writer.line[: writer.ask(link.RX_ON)]))[0][0][1] for _ in range(300)]
    assert numbers == [(2 + number) % 256 for number in range(300)]


def is_counted(noise, reader):
    """Whether bytes that ended with a zero were counted, unless they were all idle."""
    return reader.garbled + reader.overlong > 0 or not noise.strip(b"\0")


@given(NOISE, st.lists(st.integers(0, 5000), max_size=10))
def test_after_any_garbage_the_next_zero_is_enough(noise, cuts):
    lines, records = stream(5)
    found, reader = read(noise + b"\0" + b"".join(lines), cuts)
    assert found[-5:] == records
    assert is_counted(noise, reader) or len(found) > 5  # chance makes a record of noise once in 65536 tries


def is_record(line):
    """Whether others find a record in a line, as they do in noise once in 65536 times that it is stuffed at all."""
    try:
        record = cobs.decode(line)
    except cobs.DecodeError:
        return False
    return len(record) >= 4 and crc_hqx(record, 0xFFFF) == 0


@given(NOISE, st.lists(st.integers(0, 5000), max_size=10))
def test_garbage_before_a_record_costs_that_record_at_most(noise, cuts):
    lines, records = stream(5)
    found, reader = read(noise + b"".join(lines), cuts)
    first = (noise + lines[0][:-1]).rpartition(b"\0")[2]
    assert found[-4:] == records[1:]
    if first == lines[0][:-1]:
        assert found[-5:] == records
    else:
        assert reader.garbled + reader.overlong > 0 or is_record(first)


def test_cut_out_bytes_cost_the_records_they_touch():
    """Every cut that there is in a stream of all lengths of records.

    A zero ends a line and stands nowhere else. So what is left between two zeros either is a line as it was written,
    which counts even where its own zero is gone and that of a later one ends it, or it is damaged.
    """
    lines, records = stream(8, seed=3)
    data = b"".join(lines)
    ends = list(itertools.accumulate(map(len, lines)))
    written = {line[:-1]: record for line, record in zip(lines, records, strict=True)}
    for begin, end in itertools.combinations(range(len(data) + 1), 2):
        left = data[:begin] + data[end:]
        found, reader = read(left)
        *ended, _unended = left.split(b"\0")
        damaged = [line for line in ended if line and line not in written]
        assert found == [written[line] for line in ended if line in written], (begin, end)
        assert (reader.garbled, reader.overlong) == (len(damaged), 0), (begin, end)
        assert len(damaged) <= 1, (begin, end)
        before = records[: bisect.bisect_right(ends, begin)]
        after = records[bisect.bisect_left([0, *ends], end) + 1 :]  # the first one may hang on damaged bytes
        assert found[: len(before)] == before, (begin, end)
        assert found[len(found) - len(after) :] == after, (begin, end)


def test_a_record_of_the_greatest_length_is_none_too_long_however_it_is_cut():
    body = bytes([1]) * (link.MAX_RECORD_BYTES - 2)
    whole = body + link.crc16(body, len(body)).to_bytes(2, "big")
    line = stuffed(whole)
    for cut in range(len(line)):
        found, reader = read(line + line, (cut,))
        assert found == [body, body]
        assert reader.overlong == 0
    found, reader = read(b"\1" * 5000 + b"\0" + line)
    assert (found, reader.overlong, reader.garbled) == ([body], 1, 0)


def test_the_file_imports_nothing_but_micropython_or_its_stand_in():
    tree = ast.walk(ast.parse(Path(link.__file__).read_text(encoding="utf-8")))
    assert [ast.unparse(node) for node in tree if isinstance(node, ast.Import | ast.ImportFrom)] == [
        "from skyless.firmware import micropython, ptr8", "import micropython"
    ]  # fmt: skip


@pytest.mark.skipif(MICROPYTHON is None, reason="no MicroPython here: PyPI has it for x86-64 only")
def test_micropython_writes_and_reads_the_same_bytes_and_allocates_nothing():
    here, there = (
        subprocess.run([program, str(VECTORS), str(FOLDER)], capture_output=True, text=True, timeout=60, check=True)
        for program in (sys.executable, MICROPYTHON)
    )
    assert there.stdout == here.stdout
    assert here.stdout.count("\n") > 20
    assert "found [68, 69, 65]" in here.stdout
    assert there.stderr.strip() == "allocated 0"
