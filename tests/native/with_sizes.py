"""Run a script or a module with the estimator's C compiled for other numbers, or sizes of records, than a computer's.

    python tests/native/with_sizes.py float|board|board-double SCRIPT.py|MODULE ARGUMENTS…

``float``: single precision, as a processor without double precision computes. ``board``: this, records as large as on
the board, and the functions that it has by hand. ``board-double``: such records in double precision.
"""

import ctypes
import importlib
import re
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tools"))

import compile_core
from skyless.core import ticks
from skyless.core.native import arithmetic, library, records, views

ROOT = Path(__file__).parents[2]
SIZES = ROOT / "firmware" / "source" / "core_sizes.h"
BY_HAND = f'-DSKYLESS_BY_HAND="{SIZES.with_name("core_by_hand.h")}"'
_INCLUDED = ("-include", "stdbool.h", "-include", str(SIZES))
BOARD = ("-DSKYLESS_FLOAT", BY_HAND, *_INCLUDED)
BOARD_DOUBLE = (f"-DMOST_WAITING={records.MOST_WAITING}", *_INCLUDED)
"""With as many updates that wait as on a computer."""
FLAGS = {
    "float": ("-DSKYLESS_FLOAT", "-Wdouble-promotion", "-Werror"),  # no number becomes a double on the way
    "board": BOARD,
    "board-double": (*BOARD_DOUBLE, BY_HAND),
}


def use_sizes(kind, folder):
    """Before the estimator's records are declared: they, and a library that is compiled into the folder, have these."""
    for name, value in re.findall(r"^#define (\w+) (\w+)$", SIZES.read_text(), re.MULTILINE) * (kind != "float"):
        if (kind, name) != ("board-double", "MOST_WAITING"):
            setattr(records, name, value == "true" if value in {"true", "false"} else int(value))
    importlib.import_module("skyless.sim.medium")  # the simulation's library, and its numbers, stay as they are
    if kind != "board-double":
        records._C_TYPES[float] = ctypes.c_float
        for declared in (arithmetic, ticks):  # the simulation has imported them
            importlib.reload(declared)
    for part in (library.SOURCE, library.SOURCE.with_suffix(".h")):
        shutil.copy(part, folder)
    compile_core.compiled(folder, library.CORE, "libskyless_core.so", FLAGS[kind])
    library.FOLDER = folder
    if kind != "board-double":
        from skyless.core.estimator.estimator import Estimator

        # Fixes hold doubles.
        Estimator.rows = property(lambda self: views.view(self.state.fix).astype("float64").tobytes())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        use_sizes(sys.argv[1], Path(made))
        del sys.argv[:2]
        if sys.argv[0].endswith(".py"):
            folders = ("firmware", *(f"tests/{room}" for room in ("core", "native", "radio", "firmware")))
            sys.path[:0] = [str(Path(sys.argv[0]).parent), *(str(ROOT / folder) for folder in folders)]
            runpy.run_path(sys.argv[0], run_name="__main__")
        else:
            runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
