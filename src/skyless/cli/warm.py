"""``skyless warm``: compile all kernels ahead, for images and before a machine loses its network or its patience."""

import time
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.common.options import check_method
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import compile_with_counts
from skyless.cli.small_runs import RUNS
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.preparation.parts import Part

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
    from skyless.kernels.cache import kernel_folder
    from skyless.preparation.processes import missing

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
    from skyless.preparation.parts import EVERY_PART, Part, parts_of

    if method is not None:
        check_method(method)
        return parts_of(method)
    after = tuple(part.name for part in EVERY_PART)
    runs = (Part(name, "skyless.cli.small_runs:run", (name,), after=after) for name in RUNS)
    return (*EVERY_PART, *runs)
