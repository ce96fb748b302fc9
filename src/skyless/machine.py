"""What this computer has: the extras of Skyless that are installed, and processors."""

import os
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final

from skyless.core.errors import SkylessError

EXTRA_OF: Final = {
    "cryptography": "keys",
    "dateparser": "history",
    "duckdb": "history",
    "gpiod": "pi",
    "matplotlib": "site",
    "mcap": "site",
    "nats": "gather",
    "pandas": "pandas",
    "prometheus_client": "prometheus",
    "pyocd": "flash",
    "rosbags": "ros2",
    "scipy": "site",
    "spidev": "pi",
    "starlette": "page",
    "uvicorn": "page",
    "websockets": "page",
    "yaml": "research",
}
"""Extras of ``pyproject.toml`` by the name under which a library of theirs is imported."""


def how_to_install(extra: str) -> str:
    """Say how an extra is added to this environment: by ``scripts/run`` where that has made it, or from a checkout."""
    if (Path(sys.prefix) / "made-from").is_file():
        return f"scripts/run --extra {extra} ... in {Path(sys.prefix).parent} adds it"
    return f"pip install '.[{extra}]' in a checkout of Skyless adds it"


def what_to_install(error: ImportError, what: str = "this") -> str | None:
    """Say which extra brings the library that ``what`` needs and that could not be imported; None if none does."""
    library = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(library)
    return None if extra is None else f"{what} needs {library}, which is not installed: {how_to_install(extra)}"


def extra_module(name: str, what: str) -> ModuleType:
    """Import a module of a library that an extra brings. Raises SkylessError: ``what`` needs it, and it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise SkylessError(what_to_install(error, what)) from None


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
