"""Which extra of the package brings a library that is not installed."""

from typing import Final

EXTRA_OF: Final = {
    "cryptography": "keys",
    "cyclonedds": "ros2",
    "distributed": "dask",
    "filterpy": "bench",
    "gpiod": "pi",
    "matplotlib": "site",
    "mcap": "site",
    "pandas": "pandas",
    "rosbags": "ros2",
    "scipy": "site",
    "spidev": "pi",
    "starlette": "page",
    "uvicorn": "page",
    "websockets": "page",
    "yaml": "research",
}
"""Extras of ``pyproject.toml`` by the name under which a library of theirs is imported."""


def what_to_install(module: str | None) -> str | None:
    """Say which extra brings a module that could not be imported; None if none does."""
    library = (module or "").partition(".")[0]
    extra = EXTRA_OF.get(library)
    return None if extra is None else f"this needs {library}, which is not installed: pip install 'skyless[{extra}]'"
