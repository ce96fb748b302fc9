"""The firmware's end of the serial link against the host's, the package ``cobs`` and published check values."""

import ctypes
import itertools
import re
from binascii import crc_hqx

import pytest
from cobs import cobs
from emulator.board_library import library
from emulator.build import FIRMWARE
from firmware_stage import line_of, needs_compiler
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.frame import fcs
from skyless.core.fix import NoFixReason
from skyless.radio.serial import link
from skyless.radio.serial.link import decode
from skyless.radio.tag_reports import AnchorPlace, BoardStatus, board_fix
from support.board_tag import OriginInC, StatusInC, fix_in_c

pytestmark = [pytest.mark.site, needs_compiler]

LINE = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_uint32)


class WriterInC(ctypes.Structure):
    _fields_ = (("write_line", LINE), ("is_among_text", ctypes.c_bool), ("more", ctypes.c_uint8 * 512))


class ReaderInC(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_uint32) for name in ("length", "garbled", "left", "fill")),
        ("record", ctypes.c_uint8 * 256),
    )


class Writer:
    def __init__(self):
        self._lines = []
        self._writer = WriterInC(write_line=LINE(self._take))

    def _take(self, at, size):
        self._lines.append(ctypes.string_at(at, size))
        return True

    def write(self, kind, *parts):
        """The record of bytes and of numbers with their sizes, without its check; taken out of its line by others."""
        c, writer = library(), ctypes.byref(self._writer)
        c.link_begin(writer, kind)
        for part in parts:
            if isinstance(part, bytes):
                c.link_append_bytes(writer, part, len(part))
            else:
                c.link_append(writer, ctypes.c_uint64(part[0]), part[1])
        c.link_send(writer)
        line = self._lines.pop()
        assert line[-1] == 0
        assert 0 not in line[:-1]
        record = cobs.decode(line[:-1])
        assert crc_hqx(record, 0xFFFF) == 0
        assert cobs.encode(record) == line[:-1]
        return record[:-2]


def test_the_link_has_the_same_values_at_both_ends():
    known, header = {}, (FIRMWARE / "source" / "link.h").read_text("utf-8")
    for name, text in re.findall(r"^#define LINK_(\w+) (.+?)(?: */\*.*)?$", header, re.MULTILINE):
        known[name] = eval(re.sub(r"\b(0x[0-9A-Fa-f]+|\d+)u\b", r"\1", text).replace("LINK_", ""), {}, known)
    shared = known.keys() - {"IDENTITY_BYTES", "STAMP_BYTES", "MAX_LINE_BYTES"}
    assert len(shared) > 30
    assert {name: known[name] for name in shared} == {name: getattr(link, name) for name in shared}


@given(st.binary(max_size=300))
def test_the_checks_are_those_of_the_standard_library_and_of_the_beacons(data):
    """Published for the nine digits: 0x29B1 of CRC-16/IBM-3740; 0x2189 of CRC-16/KERMIT, the FCS's relative."""
    assert library().link_crc16(data, len(data)) == crc_hqx(data, 0xFFFF)
    assert library().link_fcs(data, len(data)).to_bytes(2, "little") == fcs(data)
    assert library().link_crc16(b"123456789", 9) == 0x29B1
    assert library().link_fcs(b"123456789", 9) == 0x2189


NUMBERS = st.integers(0, 8).flatmap(lambda size: st.tuples(st.integers(-(2**63), 2**63 - 1), st.just(size)))


@given(st.integers(1, 255), st.lists(st.one_of(NUMBERS, st.binary(max_size=24)), max_size=10))
def test_records_hold_what_was_appended(kind, parts):
    body = b"".join(
        part if isinstance(part, bytes) else (part[0] % 256 ** part[1]).to_bytes(part[1], "little") for part in parts
    )
    assert Writer().write(kind, *parts) == bytes((kind, 0)) + body


COUNTED = ("heard", "fixes", "overload", "overload-superframe", "dropped-on-board")


def test_what_a_tag_says_arrives_as_it_was():
    writer, fix = Writer(), fix_in_c()
    record = writer.write(link.FIX, fix.sent())
    assert repr(decode(record)) == repr(board_fix(record))
    for kind, body, value in (
        (link.TAG_STATUS, StatusInC(3, 8, 1, 4, 5, 6, 7, 8, 9000, 1500),
         BoardStatus(3, NoFixReason.ACQUIRING, dict(zip(COUNTED, (4, 5, 6, 7, 8), strict=True)))),
        (link.TAG_STATUS, StatusInC(0xFFFF), BoardStatus(None, None, dict.fromkeys(COUNTED, 0))),
        (link.ANCHOR_PLACE, fix.anchors[1], AnchorPlace(2, (12.0, 0.0, 2.5))),
        (link.GEOREFERENCE, OriginInC(-525_130_000, 134_000_000, -40_000, 3_599_999_999),
         GeoreferencePage(-52.513, 13.4, -40.0, 359.9999999)),
    ):  # fmt: skip
        assert decode(writer.write(kind, bytes(body))) == value


@pytest.mark.parametrize(
    "wrong",
    [
        {"reason": 1}, {"levels": 4}, {"risk": 0.2}, {"risk": float("nan")}, {"alert_limit_m": -1.0},
        {"covariance_m2": (float("nan"),) * 6}, {"mean_square_m2": -1.0},
    ],
)  # fmt: skip
def test_a_fix_that_cannot_be_is_malformed(wrong):
    assert decode(bytes((link.FIX, 0)) + fix_in_c(**wrong).sent()) == "malformed-record"
    assert decode(bytes((link.FIX, 0)) + fix_in_c().sent()[:-1]) == "malformed-record"


def test_numbers_wrap_at_256():
    writer = Writer()
    numbers = [writer.write(link.REFUSED, b"\1\1")[1] for _ in range(300)]
    assert numbers == [number % 256 for number in range(300)]


NOISE = st.one_of(st.binary(max_size=300), st.binary(max_size=40).map(lambda piece: piece * 20))
RECORDS = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=246)), max_size=12)
CUTS = st.lists(st.integers(0, 5000), max_size=20)


@given(NOISE, RECORDS, CUTS)
def test_both_ends_find_the_same_in_anything(noise, bodies, cuts):
    """And all records before the noise."""
    records = [bytes((kind, number & 0xFF)) + body for number, (kind, body) in enumerate(bodies)]
    sent = b"".join(line_of(kind, body, number & 0xFF) for number, (kind, body) in enumerate(bodies))
    data = sent + noise + b"\0" + sent + b"\0"
    reader, host, found = ReaderInC(), link.Reader(), []
    for begin, end in itertools.pairwise([0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]):
        at = begin
        while at < end:
            at += library().link_read(ctypes.byref(reader), data[at:end], end - at)
            if reader.length:
                found.append(bytes(reader.record[: reader.length]))
    assert found == list(host.read(data))
    assert found[: len(records)] == records
    assert reader.garbled == host.garbled + host.overlong
