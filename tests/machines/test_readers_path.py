"""The way of a beacon from ``Receiver.hear`` to a fix of ``weighted`` is as short as ``docs/architecture.md`` says."""

import re
import sys
from pathlib import Path

import skyless
from skyless import Request, fleet_of, lab_site
from skyless.core.protocol1.codec import decode_cached

SOURCE = str(Path(skyless.__file__).parent) + "/"
DOCUMENT = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
PATH = re.findall(r"^\| \d \| `([\w/]+\.py)`", DOCUMENT, re.MULTILINE)
APART = {"core/air/ieee802154.py", "air/frames.py", "core/air/site_choice.py"}
"""The checksum, the version of the frame, and which of several sites it is: a line of each."""
WARM_S = 4.0


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
    fleet = fleet_of(Request(site=lab_site(), method="weighted", seed=1, positions_m=((3.0, 4.0),)))
    receiver, passed, fixes = fleet.receivers[0], set(), 0
    for sent in fleet.world.run(WARM_S + 1.0):
        for _, reception, _ in sent.receptions():
            if sent.end_s < WARM_S:
                receiver.hear(reception)
                continue
            files, made_fix = files_of(receiver, reception)
            passed |= files
            fixes += made_fix
    assert fixes > 50
    assert len(PATH) == 8
    assert passed - APART == set(PATH)
