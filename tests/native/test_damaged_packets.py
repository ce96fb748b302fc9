"""Damaged packets and frames lead compiled code neither out of its arrays nor to numbers that are none.

python tests/native/test_damaged_packets.py 10000000 1        # number of packets, and of frames; seed
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from core_build import damaged_programs, has, input_of

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "core"))

from estimator_builders import MESH, ROOM_M, begun, episode_of, settings_of
from msgspec.structs import replace

from skyless.core.tag.receiver import Receiver
from skyless.sim.impairments import CarrierModel
from support.bench import ROOM, tape

HEARD = np.dtype([("length", "<i4"), ("bytes", "u1", 140), ("rx_ticks", "<i8")], align=True)
pytestmark = [pytest.mark.site, pytest.mark.skipif(not has("gcc"), reason="there is no gcc")]

ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
WITHOUT_LEAKS = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}  # the program keeps its memory to its end


def damaged(program, count, seed, height_m):
    """How many packets were damaged, accepted, and left a fix that is no number."""
    episode = episode_of(MESH, 120, 3, ROOM_M)
    estimator = begun(episode, settings_of(height_m=height_m, stationary_s=0.5, **ERRORS), ROOM_M, std_m=0.1)
    given = input_of(estimator, episode.packets, ROOM_M)
    return numbers(program, count, seed, given)


def numbers(program, count, seed, given):
    """What a program prints."""
    command = [program, str(count), str(seed)]
    done = subprocess.run(command, input=given, capture_output=True, env=WITHOUT_LEAKS, check=False)
    assert done.returncode == 0, done.stderr.decode()[:2000]
    return [int(number) for number in done.stdout.split()]


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    return damaged_programs(tmp_path_factory.mktemp("damaged"))


@pytest.mark.parametrize("height_m", [0.0, None])
def test_sanitizers_find_nothing_and_every_fix_is_a_number(programs, height_m):
    found = damaged(programs["damaged"], 20_000, 1, height_m)
    assert found[0] > 5_000
    assert found[1] > 300  # a filter that lost its state takes none until its next start
    assert found[2] == 0


def damaged_frames(program, count, seed, height_m, carrier_phase=False):
    """How many frames were damaged, made a fix, made a start, and how many of these should not have."""
    schedule = replace(ROOM.schedule, mode="free", carrier_phase=carrier_phase)
    site = replace(ROOM, schedule=schedule, tags=replace(ROOM.tags, height_m=height_m))
    heard = [one.reception for one in tape(site, 3.0, carrier=CarrierModel())]
    warm = len(heard) // 2
    tag = Receiver()
    for reception in heard[:warm]:
        tag.hear(reception)
    rows = np.zeros(len(heard) - warm, HEARD)
    for row, reception in zip(rows, heard[warm:], strict=True):
        row["length"], row["rx_ticks"] = len(reception.frame), reception.rx_ticks
        row["bytes"][: len(reception.frame)] = np.frombuffer(reception.frame, np.uint8)
    parts = [np.array([len(rows)], np.int32), tag.tag, tag.method.estimator.state, rows]
    return numbers(program, count, seed, b"".join(bytes(one) for one in parts))


@pytest.mark.parametrize("carrier_phase", [False, True])
@pytest.mark.parametrize("height_m", [0.0, None])
def test_damaged_frames_do_no_harm(programs, height_m, carrier_phase):
    found = damaged_frames(programs["damaged_frames"], 20_000, 1, height_m, carrier_phase)
    assert found[0] > 5_000
    assert found[1] > 1_000
    assert found[2] > 50
    assert found[3] == 0


if __name__ == "__main__":
    given = int(sys.argv[1]), int(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        made = damaged_programs(Path(folder))
        for fixed_m in (0.0, None):
            print(*damaged(made["damaged"], *given, fixed_m))
            for has_phases in (False, True):
                print(*damaged_frames(made["damaged_frames"], *given, fixed_m, has_phases))
