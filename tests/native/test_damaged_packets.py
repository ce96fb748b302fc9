"""Damaged packets and frames lead compiled code neither out of its arrays nor to numbers that are none.

``SKYLESS_FUZZ_FRAMES=10000000`` gives it as many. ``test_float.py`` runs the same with the library for ``float``.
"""

import ctypes
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from core_build import ERRORS, EXACT, NATIVE, input_of, needs
from estimator_builders import MESH, ROOM_M, begun, episode_of, settings_of
from msgspec.structs import replace

from skyless.core.native.records import c_type
from skyless.core.tag.receiver import Receiver
from skyless.sim.impairments import CarrierModel
from support.bench import ROOM, tape

pytestmark = [pytest.mark.site, needs("gcc")]

HEARD = np.dtype([("length", "<i4"), ("bytes", "u1", 140), ("rx_ticks", "<i8")], align=True)
COUNT = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))


@pytest.fixture(scope="module")
def numbers(tmp_path_factory):
    """A function that gives an input to one of the programs beside this file, and has the numbers that it prints.

    The programs end at an access out of bounds, an overflow and the like.
    """
    folder = tmp_path_factory.mktemp("damaged")
    real = ["-DSKYLESS_FLOAT"] if c_type(float) is ctypes.c_float else []
    checks = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    command, core = ["gcc", *EXACT, *real, *checks], folder / "core.o"
    subprocess.run([*command, "-c", NATIVE / "skyless_core.c", "-o", core], check=True)
    for name in ("damaged", "damaged_frames"):
        subprocess.run([*command, core, Path(__file__).with_name(f"{name}.c"), "-o", folder / name], check=True)

    def run(name, given):
        environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}  # the program keeps its memory to its end
        words = [folder / name, str(COUNT), "1"]
        done = subprocess.run(words, input=given, capture_output=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr.decode()[:2000]
        return [int(number) for number in done.stdout.split()]

    return run


@pytest.mark.parametrize("height_m", [0.0, None])
def test_sanitizers_find_nothing_and_every_fix_is_a_number(numbers, height_m):
    episode = episode_of(MESH, 120, 3, ROOM_M)
    estimator = begun(episode, settings_of(height_m=height_m, stationary_s=0.5, **ERRORS), ROOM_M, std_m=0.1)
    damaged, accepted, wrong = numbers("damaged", input_of(estimator, episode.packets, ROOM_M))
    assert damaged > COUNT / 4
    assert accepted > 300  # a filter that lost its state takes none until its next start
    assert wrong == 0


@pytest.mark.parametrize("carrier_phase", [False, True])
@pytest.mark.parametrize("height_m", [0.0, None])
def test_damaged_frames_do_no_harm(numbers, height_m, carrier_phase):
    schedule = replace(ROOM.schedule, mode="free", carrier_phase=carrier_phase)
    site = replace(ROOM, schedule=schedule, tags=replace(ROOM.tags, height_m=height_m))
    heard = [one.reception for one in tape(site, 3.0, carrier=CarrierModel())]
    tag, warm = Receiver(), len(heard) // 2
    for reception in heard[:warm]:
        tag.hear(reception)
    rows = np.zeros(len(heard) - warm, HEARD)
    for row, reception in zip(rows, heard[warm:], strict=True):
        row["length"], row["rx_ticks"] = len(reception.frame), reception.rx_ticks
        row["bytes"][: len(reception.frame)] = np.frombuffer(reception.frame, np.uint8)
    parts = [np.array([len(rows)], np.int32), tag.tag, tag.method.estimator.state, rows]
    damaged, fixes, starts, wrong = numbers("damaged_frames", b"".join(bytes(one) for one in parts))
    assert damaged > COUNT / 4
    assert fixes > COUNT / 20
    assert starts > 50
    assert wrong == 0
