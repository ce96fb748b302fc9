"""The tables of ``docs/limits.md`` are those of the structs in which the servers have their limits."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "limits.md").read_text(encoding="utf-8")
STRUCTS = {
    "PageLimits": "skyless.run.web",
    "HistoryLimits": "skyless.run.web",
    "BridgeLimits": "skyless.run.web",
    "BrokerLimits": "skyless.run.broker",
}


def table(module, struct):
    """The rows of a struct's fields: name, value and what its docstring says."""
    tree = ast.parse(Path(import_module(module).__file__).read_text(encoding="utf-8"))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == struct)
    limits = getattr(import_module(module), struct)()
    rows = ["| limit | value | of what |", "|---|---|---|"]
    for field, text in zip(body[1::2], body[2::2], strict=True):
        words, value = " ".join(text.value.value.split()).replace("``", "`"), getattr(limits, field.target.id)
        rows.append(f"| `{field.target.id}` | {value:,.0f} | {words} |")
    return "\n".join(rows)


@pytest.mark.parametrize(("struct", "module"), STRUCTS.items())
def test_each_table_is_that_of_its_struct(struct, module):
    rows = table(module, struct)
    assert rows in DOCUMENT, f"docs/limits.md should have:\n{rows}"
