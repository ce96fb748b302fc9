"""Put faults into the product, one at a time, and see whether the tests find them.

``scripts/faults`` draws ten places of the source, always the same ones (``--seed`` others), changes each in a copy of
the last commit as ``scripts/mutate`` changes a module, and runs the tests there: those of the fault's own room first,
then all others, until one fails. It should pass without the fault. ``--only-say`` lists the faults.
"""

import argparse
import random
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import pytest
from msgspec import Struct

from mutate import ROOT, SOURCE, Mutant, mutants_of

LEAST_SHARE: Final = 0.9
"""Of the faults, those that the tests should find."""


class Fault(Struct, frozen=True):
    """A mutant of a file of the source."""

    file: str
    """Relative to the repository."""
    room: str
    """The folder of tests that is its own."""
    mutant: Mutant

    @property
    def name(self) -> str:
        """Place and change."""
        return f"{self.file}:{self.mutant.line}: {self.mutant.name}"


def drawn(number: int, seed: int) -> list[Fault]:
    """Faults in files that are drawn by their number of lines."""
    files = sorted(SOURCE.rglob("*.py"))
    lines = [path.read_text("utf-8").count("\n") for path in files]
    generator, found = random.Random(seed), list[Fault]()
    while len(found) < number:
        (path,) = generator.choices(files, lines)
        if mutants := mutants_of(path):
            file = path.relative_to(ROOT)
            found.append(Fault(str(file), file.parts[2], generator.choice(mutants)))
    return found


def found_by(copy: Path, fault: Fault) -> str:
    """The first test that fails twice with a fault in the copy, and passes without it; empty if none does."""
    own = f"tests/{fault.room}" if (copy / "tests" / fault.room).is_dir() else "tests/project"
    (copy / fault.file).write_text(fault.mutant.text, "utf-8")
    _compile(copy, fault)
    test = ""
    for options in (f"-n 2 --tiers unit,site {own}", f"-n 2 --tiers unit,site --ignore={own}", "--tiers live"):
        if not test and (failed := _first_failure(copy, options)):
            test = failed if _first_failure(copy, f"--tiers unit,site,live {shlex.quote(failed)}") else ""
    (copy / fault.file).write_bytes((ROOT / fault.file).read_bytes())
    _compile(copy, fault)
    if test and _first_failure(copy, f"--tiers unit,site,live {shlex.quote(test)}"):
        raise SystemExit(f"{test} fails without a fault")
    return test


def _compile(copy: Path, fault: Fault) -> None:
    """Make what is compiled from the core again."""
    if fault.room == "core":
        for tool in ("make_core.py", "compile_core.py"):
            _run(copy, f"SKYLESS_UNCOMPILED=1 PYTHONPATH=src .venv/bin/python tools/{tool}")


def _first_failure(copy: Path, options: str) -> str:
    """The first test that fails; empty if all pass."""
    code, said = _run(copy, f".venv/bin/pytest -x -q --tb=no -rfE {options}")
    for line in said.splitlines():
        if line.startswith(("FAILED ", "ERROR ")):
            return line.split(" ", 1)[1].split(" - ")[0]
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise SystemExit(f"the tests do not run: {said}")
    return ""


def _run(copy: Path, command: str) -> tuple[int, str]:
    """Run a command in the copy as a user's shell would; its exit status, and what it said."""
    shell = f". scripts/environment; forget_developers_settings; make_environment dev; {command}"
    ended = subprocess.run(
        ["bash", "-c", shell], cwd=copy, check=False, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    return ended.returncode, ended.stdout


def main() -> int:
    """Draw faults, and say which ones are found, and by which test."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=10, help="how many faults (default: 10)")
    parser.add_argument("--seed", type=int, default=1, help="so that others are drawn (default: 1)")
    parser.add_argument("--only-say", action="store_true", help="list them without running a test")
    asked = parser.parse_args()
    faults = drawn(asked.number, asked.seed)
    if asked.only_say:
        print(*(fault.name for fault in faults), sep="\n")
        return 0
    found = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "skyless"
        subprocess.run(["git", "clone", "--quiet", ROOT, copy], check=True)
        for fault in faults:
            test = found_by(copy, fault)
            found += bool(test)
            print(f"{fault.name}\n  {test or 'IS NOT FOUND'}", flush=True)
    print(f"{found} of {len(faults)} faults are found")
    return 0 if found >= LEAST_SHARE * len(faults) else 1


if __name__ == "__main__":
    sys.exit(main())
