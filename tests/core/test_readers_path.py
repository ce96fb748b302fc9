"""What a tag does with a beacon is read in the files that ``docs/architecture.md`` lists, and in no other room."""

import re
import sys
from pathlib import Path

import pytest

import skyless
from skyless import Request, fleet_of, lab_site
from skyless.core.air.beacon import decode_cached

pytestmark = pytest.mark.site

SOURCE = str(Path(skyless.__file__).parent) + "/"
DOCUMENT = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
LISTED = [
    name for row in re.findall(r"^\| \d \|.*", DOCUMENT, re.MULTILINE) for name in re.findall(r"`(core/[\w/.]+)`", row)
]
SMALL = {"core/air/frame.py", "core/air/site_choice.py", "core/ticks.py"}
"""Checksum, kind of frame, weak first path and phase, which of several sites, wrapping counters: a line of each."""
WARM_S = 3.0


def files_of(receiver, reception):
    """Files of Skyless whose functions run, and whether there is a fix."""
    files = set()

    def note(frame, event, _):
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(SOURCE):
            files.add(name.removeprefix(SOURCE))

    decode_cached.cache_clear()
    before = sys.gettrace()
    sys.settrace(note)
    try:
        fix = receiver.hear(reception)
    finally:
        sys.settrace(before)
    return files, fix is not None


def test_a_beacon_becomes_a_fix_within_the_files_that_are_listed():
    fleet = fleet_of(Request(site=lab_site(), seed=1, positions_m=((3.0, 4.0),)))
    receiver, passed, fixes = fleet.receivers[0], set(), 0
    for sent in fleet.world.run(WARM_S + 0.5):
        for _, reception, _ in sent.receptions():
            if sent.end_s < WARM_S:
                receiver.hear(reception)
                continue
            files, made_fix = files_of(receiver, reception)
            passed |= files
            fixes += made_fix
    assert fixes > 50
    assert {name for name in passed - SMALL if not name.startswith(tuple(LISTED))} == set()
