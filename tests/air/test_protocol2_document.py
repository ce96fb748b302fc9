"""docs/protocol2.md says what the code does."""

import json
import re
from pathlib import Path

import msgspec
import pytest

from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import decode, encode, heard_capacity
from skyless.core.air.ieee802154 import air_time_s
from skyless.core.air.instants import LONGEST_PERIOD_CODE, OFFERED_HZ, SHORTEST_PERIOD_S, period_ticks
from skyless.core.air.local_almanac import MAX_ISSUE_PAGES, MAX_ISSUES, MAX_POSITIONS, MIN_ANCHORS
from skyless.core.tag.selection import MAX_ANCHORS_IN_USE
from skyless.core.ticks import to_seconds

DOCUMENT = (Path(__file__).parents[2] / "docs" / "protocol2.md").read_text(encoding="utf-8")
SIGNED = {"x_m", "y_m", "z_m", "floor", "tag_height_m"}
STEPS = {"x_m": 1e3, "y_m": 1e3, "z_m": 1e3, "std_m": 1e3, "tag_height_m": 1e3}


def block(language):
    return re.search(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)[1]


FRAME = bytes.fromhex(block("hex"))
STATED = json.loads(block("json"))
ROWS = re.findall(r"^\| (\d+) \| `([0-9a-f ]+)` \| (.+?) \| (-?\w+) \|$", DOCUMENT, re.MULTILINE)


def test_example_decodes_to_the_stated_beacon():
    stated = msgspec.convert(STATED, Beacon)
    assert decode(FRAME) == stated
    assert encode(stated) == FRAME


def test_rows_of_the_example_are_the_frame():
    at = 0
    for offset, row_bytes, field, value in ROWS:
        data = bytes.fromhex(row_bytes)
        name = field.partition(" in ")[0].rpartition(".")[2]
        assert int(offset) == at, field
        assert int.from_bytes(data, "little", signed=name in SIGNED) == int(value, 0), field
        at += len(data)
    assert b"".join(bytes.fromhex(row[1]) for row in ROWS) == FRAME


def test_rows_give_the_same_values_as_the_beacon():
    compared = 0
    for _, _, field, value in ROWS:
        path = re.findall(r"\w+", field.partition(" in ")[0])
        stated = STATED
        try:
            for key in path:
                stated = stated[int(key) if key.isdigit() else key]
        except (KeyError, TypeError):
            continue
        if isinstance(stated, int | float):
            assert stated * STEPS.get(path[-1], 1) == pytest.approx(int(value, 0), abs=1e-6), field
            compared += 1
    assert compared == 20


def test_length_and_air_time_of_the_table():
    entries = heard_capacity(position=True)
    longest = 53 + 8 * entries
    assert f"| 53 | {entries} | {longest} | {1e6 * air_time_s(longest):.0f} µs |" in DOCUMENT


def test_periods_of_the_document():
    assert round(OFFERED_HZ) == 476
    assert "476 beacons a second" in DOCUMENT
    assert to_seconds(period_ticks(STATED["period_code"])) == pytest.approx(SHORTEST_PERIOD_S) == 0.015
    assert [round(1e3 * to_seconds(period_ticks(code))) for code in (0, LONGEST_PERIOD_CODE)] == [4, 3968]
    assert "0x9F" in DOCUMENT


def test_bounds_of_the_document():
    assert (MAX_ANCHORS_IN_USE, MAX_POSITIONS, MAX_ISSUES, MAX_ISSUE_PAGES, MIN_ANCHORS) == (24, 64, 4, 4, 3)
