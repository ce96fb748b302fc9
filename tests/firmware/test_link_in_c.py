"""The firmware's end of the serial link against the host's, the package ``cobs`` and published check values."""

import ctypes
import itertools
import re
from binascii import crc_hqx

import pytest
from cobs import cobs
from emulator.board_library import library
from emulator.build import FIRMWARE, HAS_HOST_COMPILER
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.ieee802154 import fcs
from skyless.core.fix import NoFixReason
from skyless.radio.serial import link
from skyless.radio.serial.link import Done, Heard, Hello, NotDone, Status, TooLate, decode
from skyless.radio.tag_reports import AnchorPlace, BoardStatus, board_fix
from support.board_tag import OriginInC, StatusInC, fix_in_c

pytestmark = pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed")

STAMPS = st.integers(0, 2**40 - 1)
SIXTEEN = st.integers(-0x8000, 0x7FFF)
COUNTS = st.integers(0, 2**32 - 1)
FRAMES = st.binary(min_size=1, max_size=127)
NOISE = st.one_of(st.binary(max_size=300), st.binary(max_size=40).map(lambda piece: piece * 20))


class Measured(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int32) for name in ("rx_power_cdbm", "first_path_cdbm", "offset_ppb", "phase"))


class StatusFields(ctypes.Structure):
    _fields_ = (
        ("now_ticks", ctypes.c_uint64),
        *((name, ctypes.c_uint32) for name in ("state", "received", "errors", "sent", "late", "garbled", "unsent")),
        ("temperature_cc", ctypes.c_int32),
        ("millivolts", ctypes.c_uint32),
    )


class HelloFields(ctypes.Structure):
    _fields_ = (
        ("firmware", ctypes.c_uint8 * 3),
        ("identity", ctypes.c_uint8 * 8),
        ("capabilities", ctypes.c_uint32),
        ("reset_cause", ctypes.c_uint32),
    )


class Writer:
    def __init__(self):
        self._memory = ctypes.create_string_buffer(library().host_writer_bytes())

    def write(self, name, *arguments):
        """The record without its check, taken out of its line by others."""
        c = library()
        getattr(c, f"link_write_{name}")(self._memory, *arguments)
        line = ctypes.string_at(c.host_writer_line(self._memory), c.host_writer_length(self._memory))
        assert line[-1] == 0
        assert 0 not in line[:-1]
        record = cobs.decode(line[:-1])
        assert crc_hqx(record, 0xFFFF) == 0
        assert cobs.encode(record) == line[:-1]
        return record[:-2]


class Reader:
    def __init__(self):
        self._memory = ctypes.create_string_buffer(library().host_reader_bytes())

    def read(self, data, cuts=()):
        c, found = library(), []
        for begin, end in itertools.pairwise([0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]):
            at = begin
            while at < end:
                at += c.link_read(self._memory, data[at:end], end - at)
                length = c.host_reader_number(self._memory, 0)
                if length:
                    found.append(ctypes.string_at(c.host_reader_record(self._memory), length))
        return found

    @property
    def faults(self):
        return library().host_reader_number(self._memory, 1) + library().host_reader_number(self._memory, 2)


def u64(value):
    return ctypes.c_uint64(value)


def test_the_link_has_the_same_values_at_both_ends():
    known, header = {}, (FIRMWARE / "source" / "link.h").read_text("utf-8")
    for name, text in re.findall(r"^#define LINK_(\w+) (.+?)(?: */\*.*)?$", header, re.MULTILINE):
        known[name] = eval(re.sub(r"\b(0x[0-9A-Fa-f]+|\d+)u\b", r"\1", text).replace("LINK_", ""), {}, known)
    shared = known.keys() - {"IDENTITY_BYTES", "STAMP_BYTES", "MAX_LINE_BYTES"}
    assert len(shared) > 30
    assert {name: known[name] for name in shared} == {name: getattr(link, name) for name in shared}


@given(st.binary(max_size=300))
def test_the_checks_are_those_of_the_standard_library_and_of_the_beacons(data):
    assert library().link_crc16(data, len(data)) == crc_hqx(data, 0xFFFF)
    assert library().link_fcs(data, len(data)).to_bytes(2, "little") == fcs(data)


def test_the_check_is_the_published_one():
    """CRC-16/IBM-3740: 0x29B1 over the nine digits; CRC-16/KERMIT, the FCS's relative: 0x2189."""
    assert library().link_crc16(b"123456789", 9) == 0x29B1
    assert library().link_fcs(b"123456789", 9) == 0x2189


@given(STAMPS, SIXTEEN, SIXTEEN, SIXTEEN, st.integers(-1, 0xFFFF), FRAMES)
def test_a_reception_arrives_as_it_was(ticks, rx_power, first_path, offset, phase, frame):
    measured = Measured(rx_power, first_path, offset, phase)
    record = Writer().write("rx", u64(ticks), ctypes.byref(measured), frame, len(frame))
    assert record[0] == (link.RX if phase < 0 else link.RX_PHASE)
    heard = decode(record)
    assert isinstance(heard, Heard)
    assert (heard.rx_ticks, heard.frame) == (ticks, frame)
    assert heard.carrier_phase_cycles == (None if phase < 0 else phase / 2**16)
    values = [
        heard.diagnostics.rx_power_dbm,
        heard.diagnostics.first_path_power_dbm,
        heard.diagnostics.carrier_offset_ppm,
    ]
    for value, steps, unit in zip(values, (rx_power, first_path, offset), (100, 100, 1000), strict=True):
        assert value == (None if steps == -32768 else steps / unit)


@given(STAMPS, STAMPS, st.integers(0, 255), st.integers(0, 255))
def test_ends_of_frames_and_refusals_arrive_as_they_were(dx_ticks, tx_ticks, kind, reason):
    writer = Writer()
    assert decode(writer.write("tx_done", u64(dx_ticks), u64(tx_ticks))) == Done(dx_ticks, tx_ticks)
    assert decode(writer.write("tx_late", u64(dx_ticks), reason)) == TooLate(dx_ticks, reason)
    assert decode(writer.write("refused", kind, reason)) == NotDone(kind, reason)


@given(STAMPS, st.integers(0, 15), st.lists(COUNTS, min_size=6, max_size=6), SIXTEEN, st.integers(0, 0xFFFF))
def test_the_status_arrives_as_it_was(ticks, state, counts, temperature, millivolts):
    record = Writer().write("status", ctypes.byref(StatusFields(ticks, state, *counts, temperature, millivolts)))
    status = decode(record)
    assert isinstance(status, Status)
    assert status.ticks == ticks
    assert status.configured | status.receiving << 1 | status.polled << 3 == state & 11
    got = (status.received, status.errors, status.sent, status.late, status.garbled, status.unsent_records)
    assert got == tuple(count % 2**30 for count in counts)
    assert status.temperature_c == (None if temperature == -32768 else temperature / 100)
    assert status.supply_v == (None if millivolts == 0xFFFF else millivolts / 1000)


@given(st.binary(min_size=3, max_size=3), st.binary(min_size=8, max_size=8), st.integers(0, 7), st.integers(0, 255))
def test_the_identity_arrives_as_it_was(firmware, identity, abilities, cause):
    fields = HelloFields((ctypes.c_uint8 * 3)(*firmware), (ctypes.c_uint8 * 8)(*identity), abilities, cause)
    hello = decode(Writer().write("hello", ctypes.byref(fields)))
    assert isinstance(hello, Hello)
    assert (hello.major, hello.minor) == (link.MAJOR, link.MINOR)
    assert (hello.firmware, hello.device_id) == (tuple(firmware), identity)
    known = (hello.can_transmit, hello.has_phases, hello.can_compute)
    assert (known, hello.reset_cause) == (tuple(bool(abilities & bit) for bit in (1, 2, 4)), cause)
    assert (hello.rate_khz * 1000, hello.counter_bits) == (499_200_000 * 128, 40)


COUNTED = ("heard", "fixes", "overload", "overload-superframe", "dropped-on-board")


def test_what_a_tag_says_arrives_as_it_was():
    writer, fix = Writer(), fix_in_c()
    record = writer.write("fix", ctypes.byref(fix))
    assert record[2:] == fix.sent()
    assert repr(decode(record)) == repr(board_fix(record))
    for kind, body, value in (
        (link.TAG_STATUS, StatusInC(3, 8, 1, 4, 5, 6, 7, 8, 9000, 1500),
         BoardStatus(3, NoFixReason.ACQUIRING, dict(zip(COUNTED, (4, 5, 6, 7, 8), strict=True)))),
        (link.TAG_STATUS, StatusInC(0xFFFF), BoardStatus(None, None, dict.fromkeys(COUNTED, 0))),
        (link.ANCHOR_PLACE, fix.anchors[1], AnchorPlace(2, (12.0, 0.0, 2.5))),
        (link.GEOREFERENCE, OriginInC(-525_130_000, 134_000_000, -40_000, 3_599_999_999),
         GeoreferencePage(-52.513, 13.4, -40.0, 359.9999999)),
    ):  # fmt: skip
        assert decode(writer.write("words", kind, ctypes.byref(body), ctypes.sizeof(body))) == value


WRONG_FIXES = [
    {"reason": 1}, {"levels": 4}, {"risk": 0.2}, {"risk": float("nan")}, {"alert_limit_m": -1.0},
    {"covariance_m2": (float("nan"),) * 6}, {"mean_square_m2": -1.0},
]  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG_FIXES)
def test_a_fix_that_cannot_be_is_malformed(wrong):
    assert decode(bytes((link.FIX, 0)) + fix_in_c(**wrong).sent()) == "malformed-record"
    assert decode(bytes((link.FIX, 0)) + fix_in_c().sent()[:-1]) == "malformed-record"


def test_numbers_wrap_at_256():
    writer = Writer()
    numbers = [writer.write("refused", 1, 1)[1] for _ in range(300)]
    assert numbers == [number % 256 for number in range(300)]


def lines(bodies):
    records = [bytes((kind, number & 0xFF)) + body for number, (kind, body) in enumerate(bodies)]
    return records, [cobs.encode(one + crc_hqx(one, 0xFFFF).to_bytes(2, "big")) + b"\0" for one in records]


RECORDS = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=246)), max_size=12)
CUTS = st.lists(st.integers(0, 5000), max_size=20)


@given(NOISE, RECORDS, CUTS)
def test_both_ends_find_the_same_in_anything(noise, bodies, cuts):
    """And all records before the noise."""
    records, sent = lines(bodies)
    data = b"".join(sent) + noise + b"".join(sent)
    reader, host = Reader(), link.Reader()
    found = reader.read(data, cuts)
    assert found == list(host.read(data))
    assert found[: len(records)] == records
    assert reader.faults == host.garbled + host.overlong
