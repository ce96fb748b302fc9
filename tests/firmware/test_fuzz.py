"""The firmware's loop against lines and chips that hold anything; what is checked stands in firmware/host/fuzz.c.

``SKYLESS_FUZZ_BYTES=10000000`` gives it as many.
"""

import os
import re
import subprocess

import numpy as np
import pytest
from emulator.build import build
from firmware_stage import needs_compiler
from msgspec.structs import replace

from skyless.core.site import GeoreferenceSite
from skyless.core.ticks import wrap
from support.bench import ROOM, tape

HEARD = np.dtype([("length", "<i4"), ("bytes", "u1", 140), ("rx_ticks", "<i8")], align=True)
PAUSE_TICKS = 10**9
FIX, TAG_STATUS = 7, 8
"""Places of their counts, from that of HELLO on."""
COUNT = int(os.environ.get("SKYLESS_FUZZ_BYTES", "500000"))
pytestmark = [pytest.mark.site, needs_compiler]


def fuzzed(*words):
    """Bytes in and out, frames sent, and counts of records of each kind and of lines of text."""
    done = subprocess.run([build("fuzz"), *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return list(map(int, re.findall(r"\d+", done.stdout)))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.statistical)])
def test_random_bytes_any_chip_and_damaged_beacons_stop_nothing(tmp_path, seed):
    """With sanitizers. Tags hear two sites that differ in their pages: the height is given, or to be estimated."""
    rows, after, count = [], 0, COUNT if seed == 1 else 10 * COUNT
    for height_m in (0.0, None):
        schedule = replace(ROOM.schedule, mode="free", rate_hz=50.0)
        tags = replace(ROOM.tags, height_m=height_m)
        site = replace(ROOM, schedule=schedule, tags=tags, georeference=GeoreferenceSite(52.5, 13.4, 30.0, 12.0))
        heard = tape(site, 3.0)
        for one in heard:
            padded = np.frombuffer(one.frame.ljust(140, b"\0"), np.uint8)
            rows.append((len(one.frame), padded, after + wrap(one.rx_ticks - heard[0].rx_ticks)))
        after = rows[-1][2] + PAUSE_TICKS
    (tmp_path / "heard").write_bytes(np.array(rows, HEARD).tobytes())
    received, _, frames, *kinds, lines = fuzzed(count, seed, tmp_path / "heard")
    assert received >= count
    assert frames > count // 100_000
    assert kinds[FIX] > count // 20_000
    assert lines > 0  # as long as the settings that are drawn ask for them


def test_there_is_no_fix_from_noise():
    """Without a file; a fix in its own is a finding."""
    assert fuzzed(COUNT // 2, 1)[3 + TAG_STATUS] > 5


def test_the_fuzzer_says_what_it_needs():
    done = subprocess.run([str(build("fuzz"))], capture_output=True, text=True, check=False)
    assert (done.returncode, "10000000" in done.stderr) == (2, True)
