"""docs/protocol.md and docs/protocol2.md say what the code does."""

import json
import re
from pathlib import Path

import msgspec
import pytest

from skyless.core.air import beacon
from skyless.core.air.almanac import LONGEST_PERIOD_CODE, OFFERED_HZ, SHORTEST_PERIOD_S, AnchorPage, period_ticks
from skyless.core.air.frame import Heard, Malformed, PackedHeard, air_time_s
from skyless.core.air.site_pages import MIN_ANCHORS
from skyless.core.native.records import MAX_ANCHORS_IN_USE, MAX_NEIGHBOURS, MAX_PAGES, MAX_SENDERS
from skyless.core.protocol1 import beacon as protocol1
from skyless.core.protocol1.almanac import page_for, pages_of
from skyless.core.site import AnchorSite, Site
from skyless.core.ticks import to_seconds

SIGNED = {"x_m", "y_m", "z_m", "floor", "tag_height_m"}
STEPS = {"x_m": 1e3, "y_m": 1e3, "z_m": 1e3, "std_m": 1e3, "tag_height_m": 1e3, "std_ticks": 64}


class Document:
    """A document with an example: the frame, the beacon in it, and its bytes row by row."""

    def __init__(self, name, kind, codec, compared):
        self.text = (Path(__file__).parents[2] / "docs" / name).read_text(encoding="utf-8")
        self.kind, (self.decode, self.encode), self.compared = kind, codec, compared
        self.frame, self.stated = bytes.fromhex(self.block("hex")), json.loads(self.block("json"))
        self.rows = re.findall(r"^\| (\d+) \| `([0-9a-f ]+)` \| (.+?) \| (-?\w+) \|$", self.text, re.MULTILINE)

    def block(self, language):
        return re.search(rf"```{language}\n(.*?)```", self.text, re.DOTALL)[1]


FIRST = Document("protocol.md", protocol1.Beacon, (protocol1.decode, protocol1.encode), 24)
SECOND = Document("protocol2.md", beacon.Beacon, (beacon.decode, beacon.encode), 20)
each_document = pytest.mark.parametrize("document", [FIRST, SECOND], ids=["protocol 1", "protocol 2"])


@each_document
def test_example_decodes_to_the_stated_beacon(document):
    stated = msgspec.convert(document.stated, document.kind)
    assert document.decode(document.frame) == stated
    assert document.encode(stated) == document.frame


@each_document
def test_rows_of_the_example_are_the_frame(document):
    at = 0
    for offset, row_bytes, field, value in document.rows:
        data = bytes.fromhex(row_bytes)
        name = field.partition(" in ")[0].rpartition(".")[2]
        assert int(offset) == at, field
        assert int.from_bytes(data, "little", signed=name in SIGNED) == int(value, 0), field
        at += len(data)
    assert b"".join(bytes.fromhex(row[1]) for row in document.rows) == document.frame


@each_document
def test_rows_give_the_same_values_as_the_beacon(document):
    compared = 0
    for _, _, field, value in document.rows:
        path = re.findall(r"\w+", field.partition(" in ")[0])
        stated = document.stated
        try:
            for key in path:
                stated = stated[int(key) if key.isdigit() else key]
        except (KeyError, TypeError):
            continue
        if isinstance(stated, int | float):
            assert stated * STEPS.get(path[-1], 1) == pytest.approx(int(value, 0), abs=1e-6), field
            compared += 1
    assert compared == document.compared


def test_example_carries_the_page_of_its_turn():
    anchors = tuple(AnchorSite(number, 6.0, 4.125, 2.5) for number in range(1, 8))
    pages = pages_of(Site("lab", 42, 1, anchors))
    assert len(pages) == 10
    carried = page_for(pages, FIRST.stated["superframe"], FIRST.stated["slot"])
    assert carried == pages[6] == AnchorPage(4, 6.0, 4.125, 2.5, 3)


@pytest.mark.parametrize("reason", sorted({*Malformed} - {Malformed.BAD_PERIOD}))
def test_every_reason_is_listed(reason):
    assert f"| `{reason}` |" in FIRST.text


def test_rotation_formula_of_the_document():
    for count in range(1, 80):
        pages = tuple(range(count))
        positions = next(p for p in range(max(count, 2), 200) if all(p % d for d in range(2, p)))
        stride = round(positions * 0.618034)
        for superframe, slot in ((0, 0), (12345, 2), (999_999, 254)):
            assert page_for(pages, superframe, slot) == (superframe + stride * slot) % positions % count


def test_length_and_air_time_of_the_table():
    entries = beacon.heard_capacity(position=True)
    longest = 53 + 8 * entries
    assert f"| 53 | {entries} | {longest} | {1e6 * air_time_s(longest):.0f} µs |" in SECOND.text


def test_flags_of_the_document():
    stated = {int(flag, 16) for flag in re.findall(r"\*flag (0x[0-9A-F]+)\*", SECOND.text)}
    flags = {beacon.HAS_POSITION, beacon.HAS_PAGE, beacon.HAS_AUTHENTICATION, beacon.HAS_CERTIFICATE, beacon.HAS_PHASES}
    assert stated == flags
    assert sum(flags) == 0xFF & ~beacon.RESERVED_FLAGS


def test_the_entry_with_a_phase_of_the_document():
    (entry,) = re.findall(r"`([0-9a-f ]{23})` is the entry", SECOND.text)
    heard = PackedHeard(bytes.fromhex(entry), has_phases=True)
    (first,) = heard
    example = SECOND.decode(SECOND.frame).relayed[0]
    assert first == Heard(example.anchor, example.sequence, example.rx_ticks & 0xFFFFFFFF, 0.25, is_short=True)
    assert first.rx_ticks_near(example.rx_ticks - 10**9) == example.rx_ticks


def test_periods_of_the_document():
    assert round(OFFERED_HZ) == 476
    assert "476 beacons a second" in SECOND.text
    assert to_seconds(period_ticks(SECOND.stated["period_code"])) == pytest.approx(SHORTEST_PERIOD_S) == 0.015
    assert [round(1e3 * to_seconds(period_ticks(code))) for code in (0, LONGEST_PERIOD_CODE)] == [4, 3968]
    assert "0x9F" in SECOND.text


def test_bounds_of_the_document():
    assert (MAX_ANCHORS_IN_USE, MAX_NEIGHBOURS, MAX_PAGES, MAX_SENDERS, MIN_ANCHORS) == (24, 256, 64, 16, 3)
