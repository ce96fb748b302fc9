"""Run a script with records as large as on the board, and with numbers of 32 or 64 bits.

python tests/firmware/with_board_sizes.py float|double SCRIPT ARGUMENTS…
"""

import importlib
import re
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

sys.path += [str(Path(__file__).parents[2] / "tools"), str(Path(__file__).parents[1] / "native")]

from with_float import narrow_reals

import compile_core
from skyless.core.native import library, records, views

SIZES = Path(__file__).parents[2] / "firmware" / "source" / "core_sizes.h"
BY_HAND = f'-DSKYLESS_BY_HAND="{SIZES.with_name("core_by_hand.h")}"'
_INCLUDED = ("-include", "stdbool.h", "-include", str(SIZES))
DOUBLE = (f"-DMOST_WAITING={records.MOST_WAITING}", *_INCLUDED)
"""Options of a compiler for such records, with as many updates that wait as on a computer."""
FLOAT = ("-DSKYLESS_FLOAT", BY_HAND, *_INCLUDED)


def use_board_sizes(real, folder):
    """Before any record is declared; with a library of the core that has the same."""
    for name, value in re.findall(r"^#define (\w+) (\w+)$", SIZES.read_text(), re.MULTILINE):
        if name == "MOST_WAITING" and real == "double":
            continue
        setattr(records, name, value == "true" if value in {"true", "false"} else int(value))
    if real == "float":
        narrow_reals()
    else:
        importlib.import_module("skyless.sim.medium")  # its library, before that of the core is another one
    for part in (library.SOURCE, library.SOURCE.with_suffix(".h")):
        shutil.copy(part, folder)
    compile_core.compiled(folder, library.CORE, "libskyless_core.so", FLOAT if real == "float" else (*DOUBLE, BY_HAND))
    library.FOLDER = folder
    if real == "float":
        from skyless.core.estimator.estimator import Estimator

        # Fixes hold doubles.
        Estimator.rows = property(lambda self: views.view(self.state.fix).astype("float64").tobytes())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        use_board_sizes(sys.argv[1], Path(made))
        del sys.argv[:2]
        sys.path[:0] = [str(Path(sys.argv[0]).parent), str(SIZES.parents[1])]
        runpy.run_path(sys.argv[0], run_name="__main__")
