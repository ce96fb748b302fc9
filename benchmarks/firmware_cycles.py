"""What the firmware's paths cost on the emulated processor: the table of docs/hardware.md.

python benchmarks/firmware_cycles.py [--write]

``--write`` puts the table into docs/hardware.md, between the lines that mark its place.
"""

import argparse
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "firmware"))

from emulator.build import build
from emulator.processor.cycle_table import cycle_table

PAGE = Path(__file__).parents[1] / "docs" / "hardware.md"
PLACE = re.compile(r"(<!-- cycles: benchmarks/firmware_cycles.py --write -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(description="Cycles of the firmware's paths, emulated.")
    parser.add_argument("--write", action="store_true", help="into docs/hardware.md")
    arguments = parser.parse_args()
    table = cycle_table(build("all"))
    if not arguments.write:
        print(table, end="")
        return
    text, count = PLACE.subn(lambda place: f"{place[1]}\n{table}\n{place[2]}", PAGE.read_text("utf-8"))
    if count != 1:
        raise SystemExit(f"{PAGE} should have one place for the table, and has {count}")
    PAGE.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
