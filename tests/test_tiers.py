"""A file is left out of a run by its text, before it is imported: that must find the marks which pytest finds."""

import ast
from pathlib import Path

import pytest

from conftest import TIERS, file_tiers

FILES = sorted(Path(__file__).parent.rglob("test_*.py"))


def marks(node):
    """Tiers among the marks of an expression."""
    named = {
        one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute) and ast.unparse(one.value) == "pytest.mark"
    }
    return named & TIERS.keys()


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_the_tiers_of_a_file_are_those_of_its_marks(file):
    text = file.read_text("utf-8")
    statements = ast.parse(text).body
    of_file = {
        tier
        for one in statements
        if isinstance(one, ast.Assign) and ast.unparse(one.targets[0]) == "pytestmark"
        for tier in marks(one.value)
    }
    of_tests = {tier for one in statements if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
                for decorator in one.decorator_list for tier in marks(decorator)}  # fmt: skip
    assert file_tiers(text) >= of_file | of_tests
    assert ("unit" in file_tiers(text)) == (not of_file)
