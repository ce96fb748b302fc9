"""Files that a reader finds whole: the old one or the new one, never a part."""

import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file to be written, which takes the place of ``path`` if the block ends without an error.

    A device or a pipe is written to itself. Raises OSError.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield scratch
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file. Raises OSError."""
    replace_files({path: data})


def replace_files(files: Mapping[Path, bytes]) -> None:
    """Write files, in their order; none where not all fit. Raises OSError."""
    with ExitStack() as stack:
        for path, data in reversed(list(files.items())):  # the last one that is entered is put in place first
            stack.enter_context(whole_file(path)).write_bytes(data)
