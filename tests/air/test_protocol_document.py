"""docs/protocol.md says what the code does."""

import json
import re
from pathlib import Path

import msgspec
import pytest

from skyless.core.air.almanac import AnchorPage
from skyless.core.air.frame import Malformed
from skyless.core.protocol1.almanac import page_for, pages_of
from skyless.core.protocol1.beacon import Beacon
from skyless.core.protocol1.codec import decode, encode
from skyless.core.site import AnchorSite, Site

DOCUMENT = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")


def block(language):
    return re.search(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)[1]


FRAME = bytes.fromhex(block("hex"))
STATED = json.loads(block("json"))
ROWS = re.findall(r"^\| (\d+) \| `([0-9a-f ]+)` \| (.+?) \| (\w+) \|$", DOCUMENT, re.MULTILINE)


def test_example_decodes_to_the_stated_beacon():
    stated = msgspec.convert(STATED, Beacon)
    assert decode(FRAME) == stated
    assert encode(stated) == FRAME


def test_rows_of_the_example_are_the_frame():
    at = 0
    for offset, row_bytes, field, value in ROWS:
        data = bytes.fromhex(row_bytes)
        assert int(offset) == at, field
        assert int.from_bytes(data, "little") == int(value, 0), field
        at += len(data)
    assert b"".join(bytes.fromhex(row[1]) for row in ROWS) == FRAME


def test_rows_give_the_same_values_as_the_beacon():
    steps = {"std_ticks": 64, "x_m": 1000, "y_m": 1000, "z_m": 1000}
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
            assert stated * steps.get(path[-1], 1) == int(value, 0), field
            compared += 1
    assert compared == 24


def test_example_carries_the_page_of_its_turn():
    anchors = tuple(AnchorSite(number, 6.0, 4.125, 2.5) for number in range(1, 8))
    pages = pages_of(Site("lab", 42, 1, anchors))
    assert len(pages) == 10
    assert page_for(pages, STATED["superframe"], STATED["slot"]) == AnchorPage(4, 6.0, 4.125, 2.5, 3) == pages[6]


@pytest.mark.parametrize("reason", sorted({*Malformed} - {Malformed.BAD_PERIOD}))
def test_every_reason_is_listed(reason):
    assert f"| `{reason}` |" in DOCUMENT


def test_rotation_formula_of_the_document():
    for count in range(1, 80):
        pages = tuple(range(count))
        positions = next(p for p in range(max(count, 2), 200) if all(p % d for d in range(2, p)))
        stride = round(positions * 0.618034)
        for superframe, slot in ((0, 0), (12345, 2), (999_999, 254)):
            assert page_for(pages, superframe, slot) == (superframe + stride * slot) % positions % count
