"""The firmware's loop against lines and chips that hold anything; what is checked stands in firmware/host/fuzz.c.

python tests/firmware/test_fuzz.py 10000000 1        # number of bytes, seed
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / "firmware")]

from emulator.build import HAS_HOST_COMPILER, build
from msgspec.structs import replace

from skyless.core.site import GeoreferenceSite
from skyless.core.ticks import wrap
from support.bench import ROOM, tape

HEARD = np.dtype([("length", "<i4"), ("bytes", "u1", 140), ("rx_ticks", "<i8")], align=True)
PAUSE_TICKS = 10**9
FIX, TAG_STATUS = 7, 8
"""Places of their counts, from that of HELLO on."""
pytestmark = [pytest.mark.site, pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed")]


def write_frames(path, seconds=3.0):
    """What tags hear of two sites that differ in their pages: with a given height, and with one to be estimated."""
    rows, after = [], 0
    for height_m in (0.0, None):
        schedule = replace(ROOM.schedule, mode="free", rate_hz=50.0)
        tags = replace(ROOM.tags, height_m=height_m)
        site = replace(ROOM, schedule=schedule, tags=tags, georeference=GeoreferenceSite(52.5, 13.4, 30.0, 12.0))
        heard = tape(site, seconds)
        for one in heard:
            padded = np.frombuffer(one.frame.ljust(140, b"\0"), np.uint8)
            rows.append((len(one.frame), padded, after + wrap(one.rx_ticks - heard[0].rx_ticks)))
        after = rows[-1][2] + PAUSE_TICKS
    path.write_bytes(np.array(rows, HEARD).tobytes())
    return path


def fuzzed(*words):
    """Bytes in and out, frames sent, and counts of records of each kind and of lines of text."""
    done = subprocess.run([build("fuzz"), *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return list(map(int, re.findall(r"\d+", done.stdout)))


def judge(found, count):
    received, _, frames, *kinds, lines = found
    assert received >= count
    assert frames > count // 100_000
    assert kinds[FIX] > count // 20_000
    assert lines > 0  # as long as the settings that are drawn ask for them


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("frames") / "heard")


def test_random_bytes_any_chip_and_damaged_beacons_stop_nothing(heard):
    """With the address and undefined-behaviour sanitizers."""
    judge(fuzzed(2_000_000, 1, heard), 2_000_000)


def test_there_is_no_fix_from_noise():
    """Without a file; a fix in its own is a finding."""
    assert fuzzed(1_000_000, 1)[3 + TAG_STATUS] > 10


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.statistical
def test_ten_million_of_them_stop_nothing(heard, seed):
    judge(fuzzed(10_000_000, seed, heard), 10_000_000)


def test_the_fuzzer_says_what_it_needs():
    done = subprocess.run([str(build("fuzz"))], capture_output=True, text=True, check=False)
    assert (done.returncode, "10000000" in done.stderr) == (2, True)


if __name__ == "__main__":
    print(*fuzzed(*sys.argv[1:], write_frames(Path(build("fuzz")).with_name("heard"))))
