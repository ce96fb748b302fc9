"""Damaged packets lead the compiled estimator neither out of its arrays nor to numbers that are none.

python tests/native/test_damaged_packets.py 10000000 1        # number of packets, seed
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from core_build import damaged_program, has, input_of

sys.path.insert(0, str(Path(__file__).parents[1] / "positioning"))

from estimator_builders import MESH, ROOM_M, begun, episode_of, settings_of

pytestmark = pytest.mark.skipif(not has("gcc"), reason="there is no gcc")

ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
WITHOUT_LEAKS = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}  # the program keeps its memory to its end


def damaged(program, count, seed, height_m):
    """How many packets were damaged, accepted, and left a fix that is no number."""
    episode = episode_of(MESH, 120, 3, ROOM_M)
    estimator = begun(episode, settings_of(height_m=height_m, stationary_s=0.5, **ERRORS), ROOM_M, std_m=0.1)
    given = input_of(estimator, episode.packets, ROOM_M)
    done = subprocess.run(
        [program, str(count), str(seed)], input=given, capture_output=True, env=WITHOUT_LEAKS, check=False
    )
    assert done.returncode == 0, done.stderr.decode()[:2000]
    return [int(number) for number in done.stdout.split()]


@pytest.mark.parametrize("height_m", [0.0, None])
def test_sanitizers_find_nothing_and_every_fix_is_a_number(tmp_path, height_m):
    found = damaged(damaged_program(tmp_path), 20_000, 1, height_m)
    assert found[0] > 5_000
    assert found[1] > 300  # a filter that lost its state takes none until its next start
    assert found[2] == 0


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for fixed_m in (0.0, None):
            print(*damaged(damaged_program(Path(folder)), int(sys.argv[1]), int(sys.argv[2]), fixed_m))
