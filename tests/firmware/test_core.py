"""The estimator with a board's sizes: the same bits from Python and C, in both forms of P, and on all processors."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from core_build import SITES, batch_of, disturbed, in_webassembly, input_of, needs, runner, same_rows, track
from estimator_builders import MESH, begun, episode_of, one_by_one, settings_of
from firmware_stage import needs_processor
from with_sizes import BOARD, BOARD_DOUBLE, BY_HAND

import wasm_core
from skyless.core.estimator import process
from skyless.core.estimator.process import BatchPacket, BatchRow, Place, Relay
from skyless.core.estimator.state import State, covariances
from skyless.core.native.views import records

pytestmark = pytest.mark.site

WITH_SIZES = [sys.executable, Path(__file__).parents[1] / "native" / "with_sizes.py"]
SHORT = 4
"""Superframes that Python processes."""
COUNTED = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "600"))
"""Receptions on the chip."""
EVERY = 10
"""Of how many of them one is compared in all; what differs once differs from then on."""


def case(name, superframes):
    """An estimator that has begun, its packets, of which some are lost and others late, and where the anchors stand."""
    anchors_m, height_m, errors = SITES[name]
    episode = episode_of(MESH, superframes, 3, anchors_m)
    given = settings_of(height_m=height_m, stationary_s=0.5, **errors)
    return begun(episode, given, anchors_m, std_m=0.1), disturbed(episode, 7), anchors_m


def in_use(state):
    return covariances(state)[: state.layout.end, : state.layout.end]


@needs("gcc")
def test_both_forms_of_the_covariance_give_the_same_bits_in_python_and_c(tmp_path):
    """A process of its own has the packed form."""
    subprocess.run([*WITH_SIZES, "board-double", __file__, "forms", tmp_path], check=True)
    program = runner(tmp_path, "gcc", "-O1")
    for name in SITES:
        packed = np.load(tmp_path / f"{name}.npz")
        rows, state = track(program, input_of(*case(name, SHORT)))
        for language in ("python", "c", "hand"):
            assert same_rows(packed[f"{language}_rows"], rows)
            assert np.array_equal(packed[f"{language}_P"], in_use(state))


def save_packed(folder):
    """What Python itself, C, and C with the functions by hand compute."""
    programs = {}
    for language, *options in (("c",), ("hand", BY_HAND)):
        (folder / language).mkdir()
        programs[language] = runner(folder / language, "gcc", "-O1", *BOARD_DOUBLE, *options)
    for name in SITES:
        estimator, packets, anchors_m = case(name, SHORT)
        found = {language: track(program, input_of(*case(name, SHORT))) for language, program in programs.items()}
        tables = map(records, (Place, BatchPacket, Relay), batch_of(packets, anchors_m))
        rows = np.zeros(len(packets.anchors), np.dtype(BatchRow))
        process.track(estimator.state, *tables, records(BatchRow, rows), len(rows), True)
        found["python"] = rows, estimator.state
        arrays = {f"{language}_rows": rows for language, (rows, _) in found.items()}
        np.savez(folder / name, **arrays, **{f"{language}_P": in_use(state) for language, (_, state) in found.items()})


@needs_processor
@needs("gcc", "clang", "wasm-ld", "node")
def test_the_chip_this_computer_and_webassembly_give_the_same_bits():
    done = subprocess.run([*WITH_SIZES, "board", __file__, "chip"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def compare(folder):
    from core_stage import BoardCore

    wasm_core.build(folder / "core.wasm", *BOARD)
    here = runner(folder, "gcc", "-O2", *BOARD)
    for name in SITES:
        estimator, packets, anchors_m = case(name, COUNTED // len(SITES) // len(SITES[name][0]))
        given = input_of(estimator, packets, anchors_m)
        (rows, last), (others, other) = (track(one, given) for one in (here, in_webassembly(folder / "core.wasm")))
        assert (rows.tobytes(), bytes(last)) == (others.tobytes(), bytes(other)), f"{name}: WebAssembly"
        chip = BoardCore()
        chip.put_state(estimator.state)
        for number, (row, packet) in enumerate(zip(rows, one_by_one(packets), strict=True), 1):
            outcome, _ = chip.process(*estimator.packet_of(*packet))
            assert outcome == row["outcome"], name
            if number % EVERY == 0 or number == len(rows):
                state = chip.state(State)
                found = (*state.x[: state.dim], *state.levels)
                assert found == (*row["position_m"][: state.dim], *row["levels"]), name
        assert np.array_equal(in_use(state), in_use(last)), name


if __name__ == "__main__":
    if sys.argv[1] == "forms":
        save_packed(Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as made:
            compare(Path(made))
