"""The pages of the reference that are made from the code: all commands with their options, and the Python interface."""

import inspect
from collections.abc import Callable

import skyless
from skyless.cli.main import program


def commands() -> str:
    """Markdown: every command with its usage, options and example, as ``--help`` shows them."""
    return "\n" + program().generate_docs(output_format="markdown", heading_level=2).split("\n", 1)[1]


def python() -> str:
    """Markdown with directives of autodoc: every name of ``skyless.__all__`` with its signature and docstring."""
    parts = [_directive(name) for name in sorted(skyless.__all__, key=str.lower)]
    return "\n```{eval-rst}\n" + "\n".join(parts) + "```\n"


def _directive(name: str) -> str:
    value = getattr(skyless, name)
    kind = "autoclass" if inspect.isclass(value) else "autofunction" if inspect.isroutine(value) else "autodata"
    target = f"{value.__module__}.{value.__qualname__}" if kind != "autodata" else f"skyless.{name}"
    members = "   :members:\n" if kind == "autoclass" else ""
    return f".. {kind}:: {target}\n{members}"


PAGES: dict[str, Callable[[], str]] = {"docs/reference/commands": commands, "docs/reference/python": python}
"""What makes the rest of a page, by its name."""
