"""What tests of the generated C share: episodes and states as a program in C takes them, and that program."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from estimator_builders import LAB_M, ROOM_M, kept, late

from skyless.core.estimator.process import BatchPacket, BatchRow, Place, Relay
from skyless.core.estimator.state import State
from skyless.core.native.library import SOURCE

NATIVE = SOURCE.parent
EXACT = ("-std=c99", "-ffp-contract=off", "-fno-math-errno", f"-I{NATIVE}")
ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
SITES = {"lab": (LAB_M, 0.0, {}), "room": (ROOM_M, 0.0, ERRORS), "3-D": (ROOM_M, None, ERRORS)}
"""Anchors, the tag's height if it is known, and the errors that the settings expect."""

RUNNER = """
#include <stdio.h>
#include <stdlib.h>
#include "skyless_core.h"

static void *read(size_t size) {
    char *bytes = calloc(1, size ? size : 1);
    if (fread(bytes, 1, size, stdin) != size) exit(1);
    return bytes;
}

int main(void) {
    int32_t *counts = read(4 * sizeof(int32_t));
    State *s = read(sizeof(State));
    Place *places = read(counts[0] * sizeof(Place));
    BatchPacket *packets = read(counts[1] * sizeof(BatchPacket));
    Relay *relays = read(counts[2] * sizeof(Relay));
    BatchRow *rows = calloc(counts[1], sizeof(BatchRow));
    skyless_track(s, places, packets, relays, rows, counts[1], counts[3]);
    fwrite(rows, sizeof(BatchRow), counts[1], stdout);
    fwrite(s, sizeof(State), 1, stdout);
    return 0;
}
"""
"""Reads a state and packets, and writes what becomes of them."""


def needs(*programs):
    """The mark of tests that are skipped where one of these programs is missing."""
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


def runner(folder, compiler, *flags):
    """The program ``RUNNER``."""
    source, made = folder / "run.c", folder / "run"
    source.write_text(RUNNER)
    subprocess.run([compiler, *EXACT, *flags, NATIVE / "skyless_core.c", source, "-o", made], check=True)
    return made


def in_webassembly(wasm):
    """The command that does what ``RUNNER`` does by WebAssembly."""
    sizes = [str(ctypes.sizeof(one)) for one in (State, Place, BatchPacket, Relay, BatchRow)]
    return ["node", Path(__file__).with_name("run_core.mjs"), wasm, *sizes]


def disturbed(episode, seed):
    """Some packets are lost and some late; one anchor's are late from some time on."""
    draw, frames = np.random.default_rng(seed), np.arange(len(episode.packets.anchors))
    late_m = np.where(draw.random(len(frames)) < 0.05, draw.exponential(1.0, len(frames)), 0.0)
    late_m[(episode.packets.anchors == 2) & (frames > 60)] += 0.5
    return kept(late(episode.packets, late_m), draw.random(len(frames)) > 0.1)


def batch_of(packets, places_m):
    """Packets of an episode as the batch takes them: places, packets, relays."""
    places, given, relays = (
        np.zeros(count, np.dtype(made))
        for made, count in ((Place, len(places_m)), (BatchPacket, len(packets.anchors)), (Relay, len(packets.relays)))
    )
    places["anchor"], places["position_m"], places["std_m"] = np.arange(len(places_m)), places_m, -1.0
    given["place"], given["sequence"], given["end"] = packets.anchors, packets.sequences, packets.ends
    given["rx_ticks"], given["tx_ticks"] = packets.rx_ticks, packets.tx_ticks
    given["variance_factor"] = 1.0
    for column, name in enumerate(("listener", "anchor", "sequence", "rx_ticks")):
        relays[name] = packets.relays[:, column]
    return places, given, relays


def input_of(estimator, packets, places_m):
    """What ``RUNNER`` reads."""
    tables = batch_of(packets, places_m)
    counts = np.array([*map(len, tables), 1], np.int32)
    return b"".join([counts.tobytes(), bytes(estimator.state), *(table.tobytes() for table in tables)])


def track(command, given):
    """What ``RUNNER`` makes of its input: rows and the state."""
    output = subprocess.run(command, input=given, capture_output=True, check=True).stdout
    end = len(output) - ctypes.sizeof(State)
    return np.frombuffer(output[:end], np.dtype(BatchRow)), State.from_buffer_copy(output[end:])


def same_rows(one, other):
    """Both signs of zero are the same."""
    return all(np.array_equal(one[name], other[name]) for name in one.dtype.names)
