"""Files that a reader finds whole: the old one or the new one, never a part."""

import secrets
from collections.abc import Collection, Iterator, Mapping
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


def replace_files(files: Mapping[Path, bytes], secret: Collection[Path] = ()) -> None:
    """Write files, in their order; none where not all fit. Raises OSError.

    ``secret``: those of them that only their owner may read.
    """
    with ExitStack() as stack:
        for path, data in reversed(list(files.items())):  # the last one that is entered is put in place first
            scratch = stack.enter_context(whole_file(path))
            if path in secret:
                scratch.touch(0o600)
            scratch.write_bytes(data)
