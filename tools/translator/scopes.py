"""In which blocks of a function its variables are declared."""

import ast
from collections.abc import Iterator, Sequence
from typing import Any


class Scopes:
    """Where the variables of a function are declared: in each block that assigns them before it uses them."""

    def __init__(self, statements: Sequence[ast.stmt], parameters: Sequence[str]) -> None:
        block = list(_uses(statements))
        names = {one.id for one in _flat(block)} - set(parameters)
        self.first: set[int] = set()
        """Places at which variables are declared, by the identity of their nodes."""
        self.hoisted: set[str] = set()
        """Variables that are declared at the beginning of the function."""
        for name in names:
            found: set[int] = set()
            if self._declare(name, block, found):
                self.first |= found
            else:
                self.hoisted.add(name)

    def _declare(self, name: str, block: list[Any], found: set[int]) -> bool:
        """Find where a variable is declared in a block; False where it is used before it is assigned there."""
        direct = [one for one in block if isinstance(one, ast.Name) and one.id == name]
        inner = [one for one in block if isinstance(one, list) and any(use.id == name for use in _flat(one))]
        if not direct:
            return all(self._declare(name, one, found) for one in inner)
        first = next(one for one in block if one in direct or one in inner)
        found.add(id(first))
        return first in direct and isinstance(first.ctx, ast.Store)


def assigned(statements: Sequence[ast.stmt]) -> set[str]:
    """Variables that get a value in some statements."""
    return {one.id for one in _flat(list(_uses(statements))) if isinstance(one.ctx, ast.Store)}


def _uses(statements: Sequence[ast.stmt]) -> Iterator[Any]:
    """Names in the order in which a block uses them; those of blocks in it as lists."""
    for node in statements:
        match node:
            case ast.If() | ast.While():
                yield from _names(node.test)
                yield list(_uses(node.body))
                yield list(_uses(node.orelse))
            case ast.For():
                yield from _names(node.iter)
                yield [*_names(node.target), *_uses(node.body)]
            case ast.AugAssign():
                yield from _names(node.value)
                yield from (ast.Name(name.id, ast.Load()) for name in _names(node.target))
            case ast.Assign():
                yield from _names(node.value)
                for target in node.targets:
                    yield from _names(target)
            case ast.AnnAssign():
                yield from _names(node.value or node.target)
                yield from _names(node.target)
            case _:
                yield from _names(node)


def _names(node: ast.AST) -> list[ast.Name]:
    return [one for one in ast.walk(node) if isinstance(one, ast.Name)]


def _flat(block: list[Any]) -> Iterator[ast.Name]:
    for one in block:
        if isinstance(one, list):
            yield from _flat(one)
        else:
            yield one
