"""Damaged captures of every format through the whole replay; SKYLESS_FUZZ_FRAMES sets how many mutations."""

import os
import random
from math import isfinite

import pytest

from skyless.core.errors import ConfigurationError
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

MUTATIONS = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))
PER_FILE = 100
TRUTH = tuple((k / 20, 1.0, 1.0, 1.0) for k in range(1200))
NUMBERS = [b"nan", b"inf", b"-1", b"1e999", b"0x10", b"9" * 30, b"1_0", b"", b"\xff\xfe", b"\x00", b"---\n", b"\n"]
REAL = {
    "bitcraze-yaml": "kuipman_tdoa3_sniffer/raw_yaml/b34daf0_output20240415.yaml",
    "avalue": "nozomi_rtls/avalue_first90s/ccp.csv",
    "miluv": "miluv_passive/cirObstacles_1_random3_0/ifo001/passive_ticks_u32.csv",
    "tdoa-table": "bitcraze_log05/log05_tdoa.csv",
}


def mutate(data, rng, count):
    """So many bytes changed, cut out, put in, repeated or replaced by numbers that readers stumble over."""
    for _ in range(count):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(8):
            case 0:
                del data[at : at + rng.randrange(1, 200)]
            case 1:
                data[at:at] = rng.randbytes(rng.randrange(1, 40))
            case 2:
                data[at:at] = data[at : at + rng.randrange(1, 400)]
            case 3 | 4:
                data[at : at + rng.randrange(1, 9)] = rng.choice(NUMBERS)
            case 5:
                data[at : at + 1] = bytes([data[at] ^ 1 << rng.randrange(8)]) if at < len(data) else b""
            case _:
                data[at : at + 1] = rng.randbytes(1)
    return data


def replay(path, name, rng):
    """The report, None for a refusal; the format is named or found by content, the height free or given."""
    asked = ReplayOptions(
        path,
        anchors=synthetic.ANCHORS_M,
        truth=TRUTH,
        format=rng.choice([name, name, None]),
        tag_height_m=rng.choice(["free", 1.2]),
    )
    try:
        return CaptureReplay(asked).run(check, lambda read: None)
    except ConfigurationError:
        return None


def check(_tag, _time_s, fix):
    assert all(map(isfinite, fix.position_m))
    assert all(map(isfinite, fix.covariance_m2.flat))


def fuzz(whole, name, path, mutations, seed):
    """Replays of damaged slices of a recording; how many were not refused."""
    rng, accepted = random.Random(seed), 0
    header = b"" if name.startswith(("bitcraze", "uci", "dl-tdoa")) else whole[: whole.index(b"\n") + 1]
    for _ in range(max(mutations // PER_FILE, 1)):
        size = rng.choice([3_000, 30_000])
        start = rng.randrange(max(len(whole) - size, 1))
        damaged = mutate(bytearray(whole[start : start + size]), rng, PER_FILE if size > 5_000 else PER_FILE // 5)
        path.write_bytes(header + damaged if rng.random() < 0.9 else damaged)
        report = replay(path, name, rng)
        if report is not None:
            accepted += 1
            assert report.dropped == sum(report.drops.values())
            assert (report.reason is None) == (report.fixes > 0)
    return accepted


@pytest.mark.parametrize("name", synthetic.MAKERS)
@pytest.mark.statistical
def test_made_up_captures(tmp_path, name):
    whole = b"".join(synthetic.MAKERS[name](1500))
    assert fuzz(whole, name, tmp_path / "damaged", MUTATIONS // 10, seed=name) > 0


@pytest.mark.parametrize("name", REAL)
def test_real_captures(tmp_path, recordings, name):
    whole = (recordings / REAL[name]).read_bytes()
    assert fuzz(whole, name, tmp_path / "damaged", MUTATIONS // 10, seed=name) > 0
