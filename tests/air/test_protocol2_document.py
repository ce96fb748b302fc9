"""docs/protocol2.md says what the code does."""

import json
import re
from pathlib import Path

import msgspec
import pytest

from skyless.air.beacon2 import Beacon2
from skyless.air.codec2 import decode_2, encode_2, heard_capacity_2
from skyless.air.ieee802154 import air_time_s
from skyless.positioning.methods.selection import MOST_ANCHORS_IN_USE
from skyless.site.local_almanac import LEAST_ANCHORS, MOST_ISSUES, MOST_PAGES, MOST_POSITIONS

DOCUMENT = (Path(__file__).parents[2] / "docs" / "protocol2.md").read_text(encoding="utf-8")
SIGNED = {"rate", "x_m", "y_m", "z_m", "floor", "residual_ticks", "tag_height_m"}
STEPS = {"rate": 2**36, "x_m": 1e3, "y_m": 1e3, "z_m": 1e3, "std_m": 1e3, "residual_ticks": 256, "std_ticks": 64}
STEPS |= {"tag_height_m": 1e3}


def block(language):
    return re.search(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)[1]


FRAME = bytes.fromhex(block("hex"))
STATED = json.loads(block("json"))
ROWS = re.findall(r"^\| (\d+) \| `([0-9a-f ]+)` \| (.+?) \| (-?\w+) \|$", DOCUMENT, re.MULTILINE)


def test_example_decodes_to_the_stated_beacon():
    stated = msgspec.convert(STATED, Beacon2)
    assert decode_2(FRAME) == stated
    assert encode_2(stated) == FRAME


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
    assert compared == 30


@pytest.mark.parametrize(
    ("slot_time", "site_time", "bare", "entries"), [(False, False, 52, 8), (True, False, 68, 6), (True, True, 73, 5)]
)
def test_lengths_and_air_times_of_the_table(slot_time, site_time, bare, entries):
    assert heard_capacity_2(slot_time=slot_time, position=True, site_time=site_time) == entries
    longest = bare + 8 * entries
    assert f"| {bare} | {entries} | {longest} | {1e6 * air_time_s(longest):.0f} µs |" in DOCUMENT


def test_bounds_of_the_document():
    assert (MOST_ANCHORS_IN_USE, MOST_POSITIONS, MOST_ISSUES, MOST_PAGES, LEAST_ANCHORS) == (24, 64, 4, 4, 3)
