"""The version of the installed package, and a digest of its source."""

from functools import cache


def installed_version() -> str:
    """Version of the installed package; read on demand, because ``importlib.metadata`` is slow to import."""
    from importlib.metadata import version  # noqa: PLC0415

    return version("skyless")


@cache
def program_digest() -> str:
    """Digest of the package's own source: checkouts of the same version may compute different results."""
    from hashlib import sha256  # noqa: PLC0415
    from pathlib import Path  # noqa: PLC0415

    package, found = Path(__file__).parents[1], sha256()
    for file in sorted((*package.rglob("*.py"), *package.rglob("*.c"))):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]
