"""Which broker runs on this machine, for programs without ``--mqtt``: those that start a broker state it in a file.

The file is locked while its broker runs, so that one of a program that was killed is recognised, however it ended. It
lies in a folder of the user alone: nobody else can send programs to another broker.
"""

import contextlib
import fcntl
import os
import tempfile
import time
from pathlib import Path
from typing import IO, Final

from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress, mqtt_address
from skyless.nodes.process import locked

_ATTEMPTS: Final = 20
_WAIT_S: Final = 0.01


class StatedAddress:
    """A broker's address, stated until ``withdraw``; nothing is stated where no file can be written."""

    def __init__(self, address: MqttAddress) -> None:
        self._file: Path | None = None
        self._lock: IO[str] | None = None
        with contextlib.suppress(OSError):
            file = _folder() / f"broker-{address.port}"
            self._lock = _locked(file)
            self._lock.truncate(0)
            self._lock.write(str(address))
            self._lock.flush()
            self._file = file

    def withdraw(self) -> None:
        """The broker has ended."""
        if self._file is not None:
            self._file.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.close()


def _locked(file: Path) -> IO[str]:
    """The file, locked: one who looks for a broker may have it for a moment, and the last broker may remove it.

    Raises:
        OSError: it cannot be written, or another broker states its address there.
    """
    for attempt in range(_ATTEMPTS):
        time.sleep(_WAIT_S if attempt else 0.0)
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            lock = locked(file)
            if os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                return lock
    return locked(file)


def running_broker() -> MqttAddress | None:
    """The broker that was started last of those that run on this machine; None without any."""
    with contextlib.suppress(OSError):
        files = sorted(_folder().glob("broker-*"), key=lambda file: file.stat().st_mtime, reverse=True)
        for file in files:
            address = _address_in(file)
            if address is not None:
                return address
    return None


def _address_in(file: Path) -> MqttAddress | None:
    """The address in a file; None where its broker has ended. The file stays: a broker may be about to lock it."""
    try:
        with file.open(encoding="utf-8") as stated:
            try:
                fcntl.flock(stated, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return mqtt_address(stated.read())
    except (OSError, SkylessError, UnicodeError):  # it has just ended, or begins at this moment
        pass
    return None


def _folder() -> Path:
    """The user's folder for files that last no longer than a session.

    Raises:
        OSError: there is none that is the user's alone.
    """
    shared = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(shared) / "skyless" if shared and Path(shared).is_absolute() else None
    if folder is None or not os.access(folder.parent, os.W_OK | os.X_OK):
        folder = Path(tempfile.gettempdir()) / f"skyless-run-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(f"{folder} can be written by others")
    return folder
