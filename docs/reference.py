"""The pages of the reference that are made from the code: all commands with their options, and the Python interface."""

import inspect
import re
from collections.abc import Callable

import skyless
from skyless.cli.main import program


def commands() -> str:
    """Markdown: every command with its usage and options, as ``--help`` shows them."""
    made = program().generate_docs(output_format="markdown", heading_level=1)
    body = re.sub(r"^## Table of Contents\n.*?(?=^\*\*)", "", made.split("\n", 1)[1], flags=re.DOTALL | re.MULTILINE)
    return f"\n{body}"


def python() -> str:
    """Markdown with directives of autodoc: every name of ``skyless.__all__`` with its signature and docstring."""
    parts = [_directive(name) for name in sorted(skyless.__all__, key=str.lower)]
    return "\n```{eval-rst}\n" + "\n".join(parts) + "```\n"


def _directive(name: str) -> str:
    value = getattr(skyless, name)
    kind = "autoclass" if inspect.isclass(value) else "autofunction" if inspect.isroutine(value) else "autodata"
    members = "   :members:\n" if kind == "autoclass" else ""
    return f".. {kind}:: skyless.{name}\n{members}"


PAGES: dict[str, Callable[[], str]] = {"docs/reference/commands": commands, "docs/reference/python": python}
"""What makes the rest of a page, by its name."""
