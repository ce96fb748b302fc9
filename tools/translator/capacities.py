"""Constants and lengths that follow from a target's sizes (``core.native.sizes``), which C has as expressions."""

import ast
import sys
from types import ModuleType

from skyless.core.native import records
from translator.sources import source_of


def home_of(module: ModuleType, name: str) -> ModuleType:
    """The module that defines what a module calls by a name."""
    while name in source_of(module).imported:
        module = sys.modules[source_of(module).imported[name]]
    return module


def follows(module: ModuleType, node: ast.AST | None) -> bool:
    """Whether sizes are in an expression of a module, or in constants in it."""
    for name in names_in(node):
        home = home_of(module, name)
        if home is records or follows(home, source_of(home).values.get(name)):
            return True
    return False


def names_in(node: ast.AST | None) -> list[str]:
    """Names in an expression."""
    return [one.id for one in ast.walk(node) if isinstance(one, ast.Name)] if node else []


def expression(node: ast.expr) -> str:
    """An expression of whole numbers as C has it."""
    if isinstance(node, ast.IfExp):
        return f"{expression(node.test)} ? {expression(node.body)} : {expression(node.orelse)}"
    return ast.unparse(node).replace("//", "/")
