"""Run a script with the estimator's C compiled for ``float``, as a processor without double precision computes.

    python tests/native/with_float.py SCRIPT ARGUMENTS…

All that the library does is in single precision then: the start, the filter, faults and levels.
"""

import ctypes
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import compile_core
from skyless.core.native import library, records, views

FLAGS = ["-DSKYLESS_FLOAT", "-Wdouble-promotion", "-Werror"]
"""No number becomes a double on the way."""


def use_float(folder):
    """Before any record is declared: a ``float`` of a record has 32 bits, as in the library."""
    for part in (library.SOURCE, library.SOURCE.with_suffix(".h")):
        shutil.copy(part, folder)
    library.LIBRARIES = (compile_core.compiled(folder, "float.so", FLAGS),) * 2
    records._C_TYPES[float] = ctypes.c_float
    from skyless.core.estimator.estimator import Estimator

    # Fixes hold doubles.
    Estimator.rows = property(lambda self: views.view(self.state.fix).astype(np.float64).tobytes())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        use_float(Path(made))
        del sys.argv[0]
        sys.path.insert(0, str(Path(sys.argv[0]).parent))
        runpy.run_path(sys.argv[0], run_name="__main__")
