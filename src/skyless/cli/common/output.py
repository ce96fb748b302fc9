"""What commands write: JSON for programs, text for people, files all at once."""

import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from rich.console import Console


def print_json(value: object) -> None:
    """Write a value as one line of JSON on standard output; NaN and infinities become null."""
    print(to_json(value))


def to_json(value: object) -> str:
    """Write a tree of structs, dataclasses, containers, NumPy values and paths as one line of JSON."""
    return msgspec.json.encode(value, enc_hook=_plain).decode()


def console() -> "Console":
    """Where tables for people go: standard output, without colour when it is not a terminal."""
    from rich.console import Console

    return Console(file=sys.stdout, highlight=False)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that a reader finds the old one or the whole new one, never a part."""
    handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(scratch).chmod(0o666 & ~_umask())
        Path(scratch).replace(path)
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise


def _plain(value: object) -> object:
    """What msgspec does not know: NumPy's scalars and arrays (which need not be imported for this), paths."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
