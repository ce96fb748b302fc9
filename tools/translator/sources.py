"""Texts: modules of Python taken apart, and names, comments and lines of C."""

import ast
import inspect
import io
import textwrap
import tokenize
from itertools import pairwise
from types import ModuleType
from typing import Final, NamedTuple

WIDTH: Final = 120
INDENT: Final = "    "
RESERVED: Final = frozenset({
    "auto", "case", "char", "const", "default", "do", "double", "enum", "exp", "extern", "float", "floor", "goto",
    "hypot",
    "index", "inline", "int", "log", "long", "real", "register", "remove", "restrict", "short", "signed", "sizeof",
    "sqrt",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile",
})  # fmt: skip
"""Names that mean something else in C; an underscore is appended."""


class Source(NamedTuple):
    """A module's text, taken apart."""

    module: ModuleType
    nodes: dict[str, ast.FunctionDef | ast.ClassDef]
    docs: dict[str, str]
    """Of constants."""
    comments: dict[int, tuple[bool, str]]
    """By line: whether it stands alone, and its text."""
    values: dict[str, ast.expr]
    """Of constants."""
    imported: dict[str, str]
    """From which modules names are."""


def source_of(module: ModuleType, known: dict[str, Source] = {}) -> Source:  # noqa: B006 - a cache
    """The text of a module."""
    if module.__name__ not in known:
        text = inspect.getsource(module)
        body = ast.parse(text).body
        nodes = {node.name: node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        docs, comments, values = {}, {}, {}
        imported: dict[str, str] = {}
        for node, behind in pairwise(body):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and (doc := doc_of(behind)):
                docs[node.target.id] = doc
        for node in body:
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {one.name: node.module for one in node.names}
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
                values[node.target.id] = node.value
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT and "noqa" not in token.string:
                comments[token.start[0]] = (not token.line[: token.start[1]].strip(), token.string[1:].strip())
        known[module.__name__] = Source(module, nodes, docs, comments, values, imported)
    return known[module.__name__]


def doc_of(node: ast.stmt) -> str:
    """The text of a statement that is nothing but a text."""
    match node:
        case ast.Expr(value=ast.Constant(value=str() as text)):
            return inspect.cleandoc(text)
    return ""


def c_name(name: str) -> str:
    """A name as C has it."""
    name = name.lstrip("_")
    return f"{name}_" if name in RESERVED else name


def comment(text: str, indent: str = "") -> list[str]:
    """A comment of one or more lines."""
    if "\n" not in text and len(indent) + len(text) + 6 <= WIDTH:
        return [f"{indent}/* {text} */"]
    lines = [f"{indent} * {line}".rstrip() for line in text.split("\n")]
    lines[0] = f"{indent}/* {text.split(chr(10), maxsplit=1)[0]}"
    return [*lines[:-1], f"{lines[-1]} */"] if len(lines) > 1 else [f"{lines[0]} */"]


def wrapped(line: str) -> list[str]:
    """A line of code in lines that are short enough."""
    if len(line) <= WIDTH or "/*" in line:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.wrap(
        line, WIDTH, initial_indent="", subsequent_indent=indent + 2 * INDENT, break_long_words=False,
        break_on_hyphens=False, drop_whitespace=True,
    )  # fmt: skip
