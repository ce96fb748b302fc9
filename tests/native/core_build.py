"""What tests of the generated C share: a library with all functions, packets, and a program that runs them."""

import ctypes
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))

from estimator_builders import kept, late

from skyless.core.estimator.process import BatchPacket, BatchRow, Place, Relay
from skyless.core.estimator.state import State
from skyless.core.native import library
from skyless.core.native.records import c_type

NATIVE = Path(library.__file__).parent
EXACT = ("-std=c99", "-ffp-contract=off", "-fno-math-errno")

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


def library_of_all(folder, compiler="gcc", *flags):
    """A library of all functions, also those that are called inside only."""
    made = folder / "all.so"
    own = ("-DINTERNAL=", "-shared", "-fPIC", "-Wl,-Bsymbolic")  # not libc's, which has some of these names as well
    command = [compiler, *EXACT, *flags, *own, NATIVE / "skyless_core.c", "-o", made]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(made))


def runner(folder, compiler, *flags, emulator=()):
    """The command of the program ``RUNNER``."""
    source, made = folder / "run.c", folder / "run"
    source.write_text(RUNNER)
    parts = [NATIVE / "skyless_core.c", source]
    subprocess.run([compiler, *EXACT, *flags, f"-I{NATIVE}", *parts, "-o", made], check=True)
    return [*emulator, str(made)]


def disturbed(episode, seed):
    """Some packets are lost and some late; one anchor's are late from some time on."""
    draw, frames = np.random.default_rng(seed), np.arange(len(episode.packets.anchors))
    late_m = np.where(draw.random(len(frames)) < 0.05, draw.exponential(1.0, len(frames)), 0.0)
    late_m[(episode.packets.anchors == 2) & (frames > 60)] += 0.5
    return kept(late(episode.packets, late_m), draw.random(len(frames)) > 0.1)


def batch_of(packets, places_m):
    """Packets of an episode as the batch takes them: places, packets, relays."""
    places = np.zeros(len(places_m), np.dtype(Place))
    places["anchor"], places["position_m"], places["std_m"] = np.arange(len(places_m)), places_m, -1.0
    given, relays = (
        np.zeros(len(packets.anchors), np.dtype(BatchPacket)),
        np.zeros(len(packets.relays), np.dtype(Relay)),
    )
    given["place"], given["sequence"], given["end"] = packets.anchors, packets.sequences, packets.ends
    given["rx_ticks"], given["tx_ticks"] = packets.rx_ticks, packets.tx_ticks
    given["variance_factor"] = 1.0
    for column, name in enumerate(("listener", "anchor", "sequence", "rx_ticks")):
        relays[name] = packets.relays[:, column]
    return places, given, relays


def input_of(estimator, packets, places_m):
    """What ``RUNNER`` reads."""
    places, given, relays = batch_of(packets, places_m)
    counts = np.array([len(places), len(given), len(relays), 1], np.int32)
    return b"".join(
        part.tobytes() for part in (counts, np.frombuffer(estimator.state, np.uint8), places, given, relays)
    )


def rows_and_state(output, count):
    """What ``RUNNER`` writes."""
    size = count * ctypes.sizeof(BatchRow)
    return np.frombuffer(output[:size], np.dtype(BatchRow)), State.from_buffer_copy(output[size:])


def has(*programs):
    """Whether all of these programs are here."""
    return all(shutil.which(program) for program in programs)


def damaged_programs(folder):
    """The two programs beside this file, by name; they end at an access out of bounds, an overflow and the like."""
    real = ["-DSKYLESS_FLOAT"] if c_type(float) is ctypes.c_float else []
    checks = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    command, core = ["gcc", *EXACT, *real, *checks, f"-I{NATIVE}"], folder / "core.o"
    subprocess.run([*command, "-c", NATIVE / "skyless_core.c", "-o", core], check=True)
    made = {name: folder / name for name in ("damaged", "damaged_frames")}
    for name, program in made.items():
        subprocess.run([*command, core, Path(__file__).with_name(f"{name}.c"), "-o", program], check=True)
    return made
