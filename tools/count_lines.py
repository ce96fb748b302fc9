"""Count the lines under git of each part of the project, and fail above the limits of ``[tool.skyless.size]``."""

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PARTS: Final = {
    "source": ("src/*.py", "ros2/*.py"),
    "page": ("src/*.js", "src/*.css", "src/*.html", ":(exclude)*/vendor/*"),
    "tests": ("tests/*.py", "tests/*.mjs", "tests/*.cjs", "tests/*.c"),
    "documents": ("*.md",),
    "benchmarks": ("benchmarks/*.py",),
}
"""Files of each part, as patterns of git, in which a star stands for folders, too."""


def lines_of(patterns: tuple[str, ...]) -> int:
    """Lines of the files under git, as they are in the working tree."""
    names = subprocess.run(["git", "ls-files", "-z", *patterns], cwd=ROOT, capture_output=True, check=True).stdout
    files = (ROOT / name.decode() for name in names.split(b"\0") if name)
    return sum(file.read_bytes().count(b"\n") for file in files if file.exists())


def main() -> int:
    """Say which parts are larger than their limit."""
    limits = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["skyless"]["size"]
    too_large = 0
    for part, patterns in PARTS.items():
        if (lines := lines_of(patterns)) > limits[part]:
            too_large = 1
            print(
                f"{part}: {lines} lines; [tool.skyless.size] of pyproject.toml allows {limits[part]} (CONTRIBUTING.md)"
            )
    return too_large


if __name__ == "__main__":
    sys.exit(main())
