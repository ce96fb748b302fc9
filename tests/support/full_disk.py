"""A disk that becomes full."""

from errno import ENOSPC
from pathlib import Path

import pytest


def full_disk(monkeypatch: pytest.MonkeyPatch, failing: int) -> list[Path]:
    """Let the ``failing``-th write of a whole file fail; returns the files that were to be written."""
    written: list[Path] = []
    write_bytes = Path.write_bytes

    def until_the_disk_is_full(path: Path, data: bytes) -> int:
        written.append(path)
        if len(written) == failing:
            raise OSError(ENOSPC, "No space left on device", str(path))
        return write_bytes(path, data)

    monkeypatch.setattr(Path, "write_bytes", until_the_disk_is_full)
    return written
