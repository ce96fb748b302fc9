"""Files: reading what a user gives, with clear errors and counted drops; writing whole files or nothing."""

import gzip
import secrets
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from io import BufferedIOBase
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Final

from skyless.core.errors import ConfigurationError

CHUNK_BYTES: Final = 1 << 16
HEAD_BYTES: Final = 1 << 14
"""How much of a recording is looked at to recognise its format."""

MAX_LINE_BYTES: Final = 1 << 14

MAX_TEXT_BYTES: Final = 1 << 29
MAX_HEAD_BYTES: Final = 1 << 20
"""Limits of a text file read whole, and of its first line: devices do not end, and archives can unpack to far more."""

_GZIP_MAGIC: Final = b"\x1f\x8b"

Drops = Counter[str]


def open_source(path: str | PathLike[str]) -> BufferedIOBase:
    """Open a file for reading, through gzip if its first bytes are gzip's.

    Raises ConfigurationError: the file cannot be opened, or not read a second time, as a pipe.
    """
    try:
        if Path(path).is_fifo():
            raise ConfigurationError(path, "the file", "a pipe", "a file that can be read from its beginning again")
        with Path(path).open("rb") as stream:
            compressed = stream.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        return gzip.open(path, "rb") if compressed else Path(path).open("rb")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigurationError(path, "", None, f"a file that can be read ({reason})") from error


def read_lines(path: str | PathLike[str]) -> list[str]:
    """All lines of a text file that is small, or needed whole.

    Raises ConfigurationError: the file cannot be opened or read to its end.
    """
    faults: Drops = Counter()
    text = bytearray()
    with open_source(path) as stream:
        for chunk in chunks(stream, faults):
            text += chunk
            if len(text) > MAX_TEXT_BYTES or (len(text) > MAX_HEAD_BYTES and b"\n" not in text[:MAX_HEAD_BYTES]):
                raise ConfigurationError(path, "", None, f"lines of text, {MAX_TEXT_BYTES >> 20} MiB at most")
    if faults:
        raise ConfigurationError(path, "the file", next(iter(faults)), "a whole file")
    return text.decode("utf-8-sig", "replace").splitlines()


def read_head(path: str | PathLike[str]) -> bytes:
    """First bytes of a recording, decompressed; fewer where the file is shorter or corrupt."""
    with open_source(path) as stream:
        head = b""
        for chunk in chunks(stream, Counter()):
            head += chunk
            if len(head) >= HEAD_BYTES:
                break
        return head[:HEAD_BYTES]


def chunks(stream: BufferedIOBase, drops: Drops) -> Iterator[bytes]:
    """Yield the stream piece by piece; a compressed stream that breaks off or is corrupt ends there, and is counted."""
    while True:
        try:
            chunk = stream.read1(CHUNK_BYTES)  # what was readable before a fault is returned before it raises
        except EOFError:
            drops["compressed-stream-cut-off"] += 1
            return
        except (OSError, zlib.error):
            drops["unreadable-bytes"] += 1
            return
        if not chunk:
            return
        yield chunk


def lines(stream: BufferedIOBase, drops: Drops) -> Iterator[bytes]:
    r"""Yield the lines without their ends (\n or \r\n).

    A last line without an end is dropped and counted, as a number in it may be cut off; so are overlong lines.
    """
    cutter = LineCutter(drops)
    for chunk in chunks(stream, drops):
        yield from cutter.feed(chunk)
    cutter.finish()


class LineCutter:
    """Cuts a stream that comes in pieces into lines."""

    def __init__(self, drops: Drops) -> None:
        self._drops = drops
        self._rest = b""
        self._overlong = False

    def feed(self, chunk: bytes) -> Iterator[bytes]:
        """Lines that end in this piece."""
        parts = (self._rest + chunk).split(b"\n")
        self._rest = parts.pop()
        if self._overlong and parts:
            del parts[0]
            self._overlong = False
        if len(self._rest) > MAX_LINE_BYTES:
            if not self._overlong:
                self._drops["overlong-line"] += 1
            self._overlong = True
            self._rest = b""
        for line in parts:
            if len(line) > MAX_LINE_BYTES:
                self._drops["overlong-line"] += 1
            else:
                yield line[:-1] if line.endswith(b"\r") else line

    def finish(self) -> None:
        """Count what has no end."""
        if self._rest:
            self._drops["unfinished-line"] += 1
            self._rest = b""


# Tables of comma-separated values: the header, and what the readers of the streams share.


def header_of(head: bytes) -> tuple[str, ...]:
    """Column names in the first line of a table."""
    first = head.lstrip(b"\xef\xbb\xbf").partition(b"\n")[0]
    return tuple(name.strip() for name in first.decode("utf-8", "replace").split(","))


def has_columns(columns: Sequence[str], head: bytes) -> bool:
    """Whether the first line of a table names these columns."""
    return set(columns) <= set(header_of(head))


def rows(
    stream: BufferedIOBase, drops: Drops, columns: Sequence[str], names_of: Mapping[str, str] | None = None
) -> Iterator[list[bytes]]:
    """Yield the wanted columns of each row, in the wanted order; rows of another width are counted.

    ``names_of``: what columns with other names are called among those that are wanted.

    A stream whose first line lacks one of the columns yields nothing, and that is counted too.
    """
    source = lines(stream, drops)
    given = header_of(next(source, b""))
    names = [(names_of or {}).get(name, name) for name in given]
    if not set(columns) <= set(names):
        drops["header-without-the-columns"] += 1
        return
    positions = [names.index(column) for column in columns]
    width = len(names)
    in_order = positions == list(range(width))
    first = given[0].encode()
    for line in source:
        fields = line.split(b",")
        if len(fields) != width:
            drops["blank-line" if not line.strip() else "wrong-number-of-columns"] += 1
        elif fields[0] == first:
            drops["repeated-header"] += 1
        else:
            yield fields if in_order else [fields[position] for position in positions]


def finite(field: str, file: str | PathLike[str], line: int, column: str) -> float:
    """Number in one field of a file that the user names. Raises ConfigurationError: it is not a finite number."""
    try:
        value = float(field)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise ConfigurationError(file, f"line {line}, column {column}", field, "a finite number")
    return value


# Files that a reader finds whole: the old one or the new one, never a part.


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
