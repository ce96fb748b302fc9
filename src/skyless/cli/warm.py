"""``skyless warm``: compile all kernels ahead, for images and before a machine loses its network or its patience."""

import contextlib
import io
import shlex
import tempfile
import time
from typing import TYPE_CHECKING, Final

from cyclopts import App

from skyless.cli.common.output import print_json
from skyless.cli.common.progress import compile_with_counts
from skyless.core.arguments import check_choice
from skyless.core.errors import SkylessError
from skyless.core.method_names import METHODS

if TYPE_CHECKING:
    from skyless.core.kernels.processes import Part

app = App(name="warm", help_epilogue="Example: skyless warm --json")


@app.default
def warm(*, method: str | None = None, json: bool = False) -> None:
    """Compile every kernel that any command needs, so that no later start has to; where all are there, do nothing.

    They are kept in the first of these folders that can be written: NUMBA_CACHE_DIR, next to the program,
    XDG_CACHE_HOME, ~/.cache/skyless. Afterwards it may be read-only. They fit this kind of processor; with
    NUMBA_CPU_NAME=generic, then for all later starts too, any of the same architecture.

    Parameters
    ----------
    method
        How positions are computed: only what anchors, tags and the simulation need with this method; by default
        everything.
    json
        Write one JSON object instead of a line.
    """
    from skyless.core.kernels.cache import kernel_folder
    from skyless.core.kernels.processes import missing

    parts = _parts(method)
    folder = kernel_folder()
    begun_s = time.monotonic()
    wanted = missing(parts)
    if wanted and not folder.writable:
        raise SkylessError(f"{folder.path.parent} cannot be written; let NUMBA_CACHE_DIR name a folder that can")
    failures = compile_with_counts(parts) if wanted else ()
    if failures:
        raise SkylessError("\nskyless: ".join(failures))
    if json:
        where = {"folder": str(folder.path), "temporary": folder.temporary}
        print_json({**where, "compiled": [part.name for part in wanted], "wall_s": time.monotonic() - begun_s})
    elif wanted:
        print(f"compiled in {time.monotonic() - begun_s:.0f} s, kept in {folder.path}")
    else:
        print(f"nothing to do: everything is compiled, in {folder.path}")


def _parts(method: str | None) -> "tuple[Part, ...]":
    from skyless.core.kernels.processes import EVERY_PART, Part, parts_of

    if method is not None:
        check_choice("--method", method, METHODS)
        return parts_of(method)
    after = tuple(part.name for part in EVERY_PART)
    runs = (Part(name, "skyless.cli.warm:run", (name,), after=after) for name in RUNS)
    return (*EVERY_PART, *runs)


_HALL: Final = "site new hall.toml --spacing 12 --width 48 --depth 36"
RUNS: Final = {
    "plan": (
        "site new lab.toml",
        "plan lab.toml --step 2 --json",
        "plan lab.toml --step 2 --method weighted --json",
        "plan lab.toml --step 2 --method weighted --optimise 4 --search-seconds 1 --json",
    ),
    "halls": (
        _HALL,
        "plan hall.toml --json",
        "simulate --site hall.toml --tags 1 --duration 3 --json",
        f"{_HALL.replace('hall', 'paper')} --paper",
        "simulate --site paper.toml --tags 1 --duration 3 --json",
        "simulate --scenario room --duration 3 --json",
    ),
    "studies": ("study efficiency --episodes 1 --processes 1 --json",),
    "paper": ("paper --quick --out report --json",),
    "bench": ("bench --quick --json",),
}
"""Small runs of the commands that compute with kernels of their own."""


def run(name: str) -> None:
    """Run the commands of a name in a folder that is removed afterwards, and drop what they print.

    Raises:
        SkylessError: a command failed.
    """
    from skyless.cli.main import main

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for line in RUNS[name]:
            problem = io.StringIO()
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(problem):
                code = main(shlex.split(line))
            if code not in {0, 1}:  # 1: something that was simulated or planned is not good enough
                raise SkylessError(f"skyless {line}: {problem.getvalue().strip() or f'exit code {code}'}")
