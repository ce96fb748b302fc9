"""Put faults into the product, one at a time, and see whether the tests find them.

``scripts/faults`` draws ten places of the source, always the same ones (``--seed`` others), changes each in a copy of
the working tree as ``scripts/mutate`` changes a module, and runs the tests there: those of the fault's own room first,
then all others, until one fails. ``--only-say`` prints the faults; so one can put them in by hand.
"""

import argparse
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

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
    """The first test that fails with a fault in the copy; empty if none does."""
    (copy / fault.file).write_text(fault.mutant.text, "utf-8")
    try:
        if fault.room == "core":  # also in what is compiled from it
            for tool in ("make_core.py", "compile_core.py"):
                _run(copy, f"SKYLESS_UNCOMPILED=1 PYTHONPATH=src .venv/bin/python tools/{tool}")
        own = f"tests/{fault.room}" if (copy / "tests" / fault.room).is_dir() else "tests/project"
        for tests in (f"-n 2 --tiers unit,site {own}", f"-n 2 --tiers unit,site --ignore={own}", "--tiers live"):
            said = _run(copy, f".venv/bin/pytest -x -q --tb=no -rfE {tests}")
            failed = [line.split()[1] for line in said.splitlines() if line.startswith(("FAILED ", "ERROR "))]
            if failed:
                return failed[0]
    finally:
        _run(copy, "git checkout -q .")
    return ""


def _run(copy: Path, command: str) -> str:
    """Run a command in the copy as a user's shell would, and return what it said."""
    shell = f". scripts/environment; forget_developers_settings; make_environment dev; {command}"
    return subprocess.run(
        ["bash", "-c", shell], cwd=copy, check=False, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ).stdout


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
