"""Run a script with the estimator's C compiled for ``float``, as a processor without double precision computes.

    python tests/native/with_float.py SCRIPT ARGUMENTS…

All that the library does is in single precision then: the start, the filter, faults and levels.
"""

import ctypes
import importlib
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import compile_core
from skyless.core import ticks
from skyless.core.native import arithmetic, library, records, views

FLAGS = ["-DSKYLESS_FLOAT", "-Wdouble-promotion", "-Werror"]
"""No number becomes a double on the way."""


def narrow_reals():
    """From here on a ``float`` of a record that is declared has 32 bits; those of the simulation keep 64."""
    importlib.import_module("skyless.sim.medium")
    records._C_TYPES[float] = ctypes.c_float
    for declared in (arithmetic, ticks):  # the simulation has imported them
        importlib.reload(declared)


def use_float(folder):
    """Before the estimator's records are declared: they and the library are in single precision."""
    narrow_reals()
    for part in (library.SOURCE, library.SOURCE.with_suffix(".h")):
        shutil.copy(part, folder)
    compile_core.compiled(folder, library.CORE, "libskyless_core.so", FLAGS)
    library.FOLDER = folder
    from skyless.core.estimator.estimator import Estimator

    # Fixes hold doubles.
    Estimator.rows = property(lambda self: views.view(self.state.fix).astype(np.float64).tobytes())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        use_float(Path(made))
        del sys.argv[0]
        sys.path.insert(0, str(Path(sys.argv[0]).parent))
        runpy.run_path(sys.argv[0], run_name="__main__")
