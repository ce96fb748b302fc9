"""The estimator with a board's sizes: the same bits from Python and C, in both forms of P, and on all processors.

python tests/firmware/test_core_on_the_chip.py 100000    # this number of receptions on the emulated chip and elsewhere
"""

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from core_stage import BoardCore
from processor_stage import needs_processor
from with_board_sizes import BY_HAND, DOUBLE, FLOAT

sys.path.append(str(Path(__file__).parents[2] / "tools"))
sys.path.append(str(Path(__file__).parents[1] / "native"))
sys.path.append(str(Path(__file__).parents[1] / "core"))

from core_build import disturbed, has, input_of, rows_and_state, runner
from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, one_by_one, settings_of

import wasm_core
from skyless.core.estimator import process
from skyless.core.estimator.process import BatchPacket, BatchRow, Place, Relay
from skyless.core.estimator.state import State, covariances
from skyless.core.native.views import records

pytestmark = pytest.mark.site

ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
CASES = {"lab": (LAB_M, 0.0, {}), "room": (ROOM_M, 0.0, ERRORS), "3-D": (ROOM_M, None, ERRORS)}
"""All with packets that are lost and others that are late."""
WITH_BOARD_SIZES = Path(__file__).with_name("with_board_sizes.py")
SHORT = 4
"""Superframes that Python processes."""
COUNTED = 2000
"""Receptions on the chip."""
EVERY = 10
"""Of how many of them one is compared in all; what differs once differs from then on."""


def case(name, superframes):
    """An estimator that has begun, its packets, and where the anchors stand."""
    anchors_m, height_m, errors = CASES[name]
    episode = episode_of(MESH, superframes, 3, anchors_m)
    given = settings_of(height_m=height_m, stationary_s=0.5, **errors)
    return begun(episode, given, anchors_m, std_m=0.1), disturbed(episode, 7), anchors_m


def by_python(name):
    """What Python itself computes: rows and covariances."""
    estimator, packets, anchors_m = case(name, SHORT)
    data, state = np.frombuffer(input_of(estimator, packets, anchors_m)[16:], np.uint8), estimator.state
    made, begin = [], ctypes.sizeof(State)
    for kind, count in ((Place, len(anchors_m)), (BatchPacket, len(packets.anchors)), (Relay, len(packets.relays))):
        made.append(records(kind, data[begin : begin + count * ctypes.sizeof(kind)].view(kind).copy()))
        begin += count * ctypes.sizeof(kind)
    rows = np.zeros(len(packets.anchors), np.dtype(BatchRow))
    process.track(state, *made, records(BatchRow, rows), len(rows), True)
    end = state.layout.end
    return rows, covariances(state)[:end, :end]


def by_c(program, name):
    estimator, packets, anchors_m = case(name, SHORT)
    given = input_of(estimator, packets, anchors_m)
    done = subprocess.run(program, input=given, capture_output=True, check=True)
    rows, state = rows_and_state(done.stdout, len(packets.anchors))
    end = state.layout.end
    return rows, covariances(state)[:end, :end]


def same(one, other):
    """Both signs of zero are the same."""
    return all(np.array_equal(one[field], other[field]) for field in one.dtype.names)


@pytest.mark.skipif(not has("gcc"), reason="there is no gcc")
def test_both_forms_of_the_covariance_give_the_same_bits_in_python_and_c(tmp_path):
    """A process of its own has the packed form."""
    subprocess.run([sys.executable, WITH_BOARD_SIZES, "double", __file__, "forms", tmp_path], check=True)
    program = runner(tmp_path, "gcc", "-O1")
    for name in CASES:
        packed = np.load(tmp_path / f"{name}.npz")
        full_rows, full_P = by_c(program, name)
        for language in ("python", "c", "hand"):
            assert same(packed[f"{language}_r"], full_rows)
            assert np.array_equal(packed[f"{language}_P"], full_P)


def save_packed(folder):
    found = {name: {"python": by_python(name)} for name in CASES}
    for language, *options in (("c",), ("hand", BY_HAND)):
        program = runner(folder, "gcc", "-O1", *DOUBLE, *options)
        for name in CASES:
            found[name][language] = by_c(program, name)
    for name, given in found.items():
        arrays = {f"{language}_r": rows for language, (rows, _) in given.items()}
        arrays |= {f"{language}_P": P for language, (_, P) in given.items()}
        np.savez(folder / f"{name}.npz", **arrays)


# The chip, this computer, and WebAssembly


@needs_processor
@pytest.mark.skipif(not has("gcc", "clang", "wasm-ld", "node"), reason="gcc, clang, lld or node is not here")
def test_the_chip_this_computer_and_webassembly_give_the_same_bits():
    command = [sys.executable, WITH_BOARD_SIZES, "float", __file__, "chip", str(COUNTED)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def compare(folder, receptions):
    wasm_core.build(folder / "core.wasm", *FLOAT)
    sizes = [str(ctypes.sizeof(one)) for one in (State, Place, BatchPacket, Relay, BatchRow)]
    here = runner(folder, "gcc", "-O2", *FLOAT)
    for name in CASES:
        estimator, packets, anchors_m = case(name, receptions // len(CASES) // len(CASES[name][0]))
        given = input_of(estimator, packets, anchors_m)
        ours = subprocess.run(here, input=given, capture_output=True, check=True).stdout
        script = Path(__file__).parents[1] / "native" / "run_core.mjs"
        theirs = subprocess.run(
            ["node", script, folder / "core.wasm", *sizes], input=given, capture_output=True, check=True
        )
        assert ours == theirs.stdout, f"{name}: WebAssembly"
        rows, _ = rows_and_state(ours, len(packets.anchors))
        chip = BoardCore()
        chip.put_state(estimator.state)
        for number, (row, packet) in enumerate(zip(rows, one_by_one(packets), strict=True), 1):
            outcome, _ = chip.process(*estimator.packet_of(*packet))
            assert outcome == row["outcome"], name
            if number % EVERY == 0 or number == len(rows):
                state = chip.state(State)
                found = (*state.x[: state.dim], *state.levels)
                assert found == (*row["position_m"][: state.dim], *row["levels"]), name
        last = rows_and_state(ours, len(rows))[1]
        end = last.layout.end
        assert np.array_equal(covariances(state)[:end, :end], covariances(last)[:end, :end]), name


if __name__ == "__main__":
    if sys.argv[1] == "forms":
        save_packed(Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as made:
            compare(Path(made), int(sys.argv[2]))
