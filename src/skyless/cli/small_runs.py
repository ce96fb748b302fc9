"""Small runs of the commands that compute with kernels of their own: what ``skyless warm`` compiles."""

import contextlib
import io
import shlex
import tempfile
from typing import Final

from skyless.errors import SkylessError

_HALL: Final = "site new hall.toml --spacing 12 --width 48 --depth 36"
_RUNS: Final = {
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
        f"{_HALL.replace('hall', 'free')} --free",
        "simulate --site free.toml --tags 1 --duration 3 --json",
        "simulate --scenario room --duration 3 --json",
    ),
    "studies": (
        "study efficiency --episodes 1 --processes 1 --json",
        "study sitetime --worlds 2 --seconds 1 --processes 1 --quick --json",
    ),
    "paper": ("paper --quick --out report --json",),
    "bench": ("bench --quick --json",),
}

RUNS: Final = tuple(_RUNS)
"""Names of all of them."""


def run(name: str) -> None:
    """Run the commands of a name in a folder that is removed afterwards, and drop what they print.

    Raises:
        SkylessError: a command failed.
    """
    from skyless.cli.main import main

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for line in _RUNS[name]:
            problem = io.StringIO()
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(problem):
                code = main(shlex.split(line))
            if code not in {0, 1}:  # 1: something that was simulated or planned is not good enough
                raise SkylessError(f"skyless {line}: {problem.getvalue().strip() or f'exit code {code}'}")
