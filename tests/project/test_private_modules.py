"""Modules whose names begin with an underscore serve their own folder only."""

import re
from pathlib import Path

SOURCES = Path(__file__).parents[2] / "src"
PRIVATE = re.compile(r"^\s*from (skyless[\w.]*)(?:\.| import )_[a-z]\w*", re.MULTILINE)


def test_only_their_own_folder_imports_them():
    found = 0
    for file in SOURCES.rglob("*.py"):
        folder = ".".join(file.parent.relative_to(SOURCES).parts)
        for owner in PRIVATE.findall(file.read_text(encoding="utf-8")):
            assert owner == folder, f"{file} imports a private module of {owner}"
            found += 1
    assert found
