"""The serial link's bytes, against published check values and the package ``cobs``."""

import bisect
import itertools
import random
import struct
from binascii import crc_hqx

import msgspec
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.frame import Reception
from skyless.radio.serial import link
from skyless.radio.serial.link import Hello, Status, decode

TICKS = st.integers(0, 2**40 - 1)
SIXTEEN = st.integers(-0x8000, 0x7FFF)
FRAMES = st.binary(max_size=link.MAX_FRAME_BYTES)
NOISE = st.one_of(st.binary(max_size=300), st.binary(max_size=40).map(lambda piece: piece * 20))


def test_the_check_is_the_published_one_and_cancels_itself():
    """CRC-16/IBM-3740: 0x29B1 over the nine digits (Cook's catalogue of parametrised CRCs)."""
    assert link.crc16(b"123456789") == 0x29B1
    assert link.crc16(b"123456789\x29\xb1") == 0


LONG_RECORDS = st.integers(0, link.MAX_RECORD_BYTES).map(lambda length: b"\x7f" * length)


@given(
    st.one_of(st.binary(max_size=250), st.lists(st.sampled_from([0, 1, 255]), max_size=250).map(bytes), LONG_RECORDS)
)
def test_stuffing_is_that_of_others(record):
    assert link.stuff(record) == cobs.encode(record) + b"\0"
    assert link.unstuff(cobs.encode(record)) == record


def test_what_is_no_record_is_not_stuffed_wrongly():
    with pytest.raises(ValueError, match="range"):
        link.stuff(bytes([1]) * 255)


@given(st.binary(max_size=link.MAX_STUFFED_BYTES).map(lambda data: data.replace(b"\0", b"\1")))
def test_unstuffing_agrees_with_others_on_anything_without_zeros(line):
    try:
        wanted = cobs.decode(line)
    except cobs.DecodeError:
        wanted = None
    assert link.unstuff(line) == wanted


def makers_of(writer):
    """Every record that there is, with what stands in it."""
    ticks, frame = 0x0403020100, bytes(range(60))
    yield lambda: writer.rx(ticks, -7953, -8312, 12, frame)
    yield lambda: writer.rx(ticks, -7953, -8312, 12, frame, 0x8001)
    yield lambda: writer.tx_done(ticks, ticks)
    yield lambda: writer.tx_late(ticks, 1)
    yield lambda: writer.status(ticks, 3, [1, 2, 3, 4, 5, 6])
    yield lambda: writer.hello((0, 1, 0), bytes(8), 1)
    yield lambda: writer.record(link.REFUSED, bytes((link.CONFIG, 1)))
    yield writer.ask_hello
    yield lambda: writer.record(link.RX_ON)
    yield lambda: writer.config(16436, 16436)
    yield lambda: writer.tx_at(ticks, frame)


def stream(count, seed=1):
    """That many records of all kinds in any order: bytes of each, what it must come out as."""
    writer, draw = link.Writer(), random.Random(seed)
    makers = list(makers_of(writer))
    lines = [draw.choice(makers)() for _ in range(count)]
    return lines, [cobs.decode(line[:-1])[:-2] for line in lines]


def read(data, cuts=()):
    """Records of a stream that comes in pieces, and the reader."""
    reader, found = link.Reader(), []
    for begin, end in itertools.pairwise([0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]):
        found += reader.read(data[begin:end])
    return found, reader


@given(st.integers(0, 20), st.lists(st.integers(0, 5000), max_size=30))
def test_records_come_out_however_the_stream_is_cut(count, cuts):
    lines, records = stream(count)
    found, reader = read(b"".join(lines), cuts)
    assert found == records
    assert (reader.garbled, reader.overlong) == (0, 0)


@given(TICKS, st.tuples(SIXTEEN, SIXTEEN, SIXTEEN), st.integers(0, 0xFFFF), FRAMES)
def test_a_reception_comes_back_with_a_phase_or_without(ticks, levels, phase, frame):
    (record,), _ = read(link.Writer().rx(ticks, *levels, frame, phase))
    (without,), _ = read(link.Writer().rx(ticks, *levels, frame))
    assert (record[0], without[0]) == (link.RX_PHASE, link.RX)
    assert record[2:7] == without[2:7] == ticks.to_bytes(5, "little")
    assert struct.unpack_from("<3hH", record, 7) == (*levels, phase)
    assert struct.unpack_from("<3h", without, 7) == levels
    assert without[link.RX_FRAME_AT :] == frame
    heard = decode(record)
    if not frame:
        assert heard == "malformed-record"
        return
    assert heard == Reception(frame, ticks, None, link.from_steps(*levels), phase / 2**16)
    assert link.to_turn(heard.carrier_phase_cycles) == phase
    assert decode(without) == msgspec.structs.replace(heard, carrier_phase_cycles=None)


@given(st.floats(0.0, 1.0))
def test_a_phase_is_rounded_to_the_next_step_on_the_circle(phase_cycles):
    steps = link.to_turn(phase_cycles)
    assert 0 <= steps < 2**16
    assert abs((link.cycles(steps) - phase_cycles + 0.5) % 1.0 - 0.5) <= 2**-17


@given(TICKS, FRAMES, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.integers(0, 1))
def test_commands_come_back(dx_ticks, frame, tx_delay, rx_delay, flags):
    writer = link.Writer()
    (record,), _ = read(writer.tx_at(dx_ticks, frame))
    assert (record[0], record[link.TX_FRAME_AT :]) == (link.TX_AT, frame)
    assert int.from_bytes(record[2:7], "little") == dx_ticks
    (record,), _ = read(writer.config(tx_delay, rx_delay, flags))
    assert len(record) == link.CONFIG_BYTES
    assert struct.unpack_from("<2HB", record, 8) == (tx_delay, rx_delay, flags)


@given(st.binary(min_size=8, max_size=8), st.integers(0, 3), st.integers(0, 255))
def test_an_identity_comes_back_and_one_of_version_1_0_has_no_cause(device_id, capabilities, cause):
    writer = link.Writer()
    (record,), _ = read(writer.hello((1, 2, 3), device_id, capabilities, cause))
    hello = Hello(1, link.MINOR, (1, 2, 3), device_id, 63_897_600, 40, bool(capabilities & 1), cause, capabilities > 1)
    assert decode(record) == hello
    assert decode(record[: link.HELLO_BYTES]).reset_cause is None
    assert decode(record + b"more") == hello
    assert decode(record[: link.HELLO_BYTES - 1]) == "malformed-record"


@given(TICKS, st.integers(0, 15), st.lists(st.integers(0, 2**30 - 1), min_size=6, max_size=6), st.integers(0, 5000))
def test_a_state_comes_back(ticks, state, counts, millivolts):
    (record,), _ = read(link.Writer().status(ticks, state, counts, -512, millivolts))
    bits = [bool(state & bit) for bit in (link.IS_CONFIGURED, link.IS_RECEIVING, link.IS_POLLED)]
    assert decode(record) == Status(ticks, *bits, *counts, -5.12, millivolts / 1000)


def test_lengths_are_the_documented_ones_and_numbers_run_round():
    writer = link.Writer()
    (record,), _ = read(writer.hello((1, 2, 3), bytes(8), 1))
    assert len(record) == link.HELLO_BYTES + 1
    assert int.from_bytes(record[15:19], "little") * 1000 == 499_200_000 * 128
    (record,), _ = read(writer.status(0, 1, [2**30] * 6))
    assert len(record) == link.STATUS_BYTES
    assert record[8:12] == bytes(4)
    numbers = [read(writer.record(link.RX_ON))[0][0][1] for _ in range(300)]
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
    line = link.stuff(body + link.crc16(body).to_bytes(2, "big"))
    for cut in range(len(line)):
        found, reader = read(line + line, (cut,))
        assert found == [body, body]
        assert reader.overlong == 0
    found, reader = read(b"\1" * 5000 + b"\0" + line)
    assert (found, reader.overlong, reader.garbled) == ([body], 1, 0)
