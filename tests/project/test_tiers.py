"""A file is left out of a run by its text, before it is imported: that must find the mark which pytest finds."""

import ast
from pathlib import Path

import pytest

from support.tiers import TIERS, file_tiers


@pytest.mark.parametrize("file", sorted(Path(__file__).parents[1].rglob("test_*.py")), ids=lambda file: file.name)
def test_the_tier_of_a_file_is_that_of_its_mark(file):
    text = file.read_text("utf-8")
    marks = [one for one in ast.parse(text).body if isinstance(one, ast.Assign) and "pytestmark" in ast.unparse(one)]
    names = {part.attr for mark in marks for part in ast.walk(mark) if isinstance(part, ast.Attribute)} & TIERS.keys()
    assert names <= file_tiers(text)
    assert ("unit" in file_tiers(text)) == (not names)
