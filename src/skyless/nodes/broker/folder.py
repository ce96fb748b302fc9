"""Where the embedded broker may listen and store."""

import contextlib
import fcntl
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

from skyless.errors import SkylessError
from skyless.nodes.broker.settings import BrokerSettings
from skyless.nodes.process.folders import data_folder
from skyless.nodes.process.ports import claim, is_free

FIRST_PORT: Final = 1883
_PORTS_TO_TRY: Final = 100

SCRATCH: Final = "skyless-broker-"
"""How the name of a temporary folder begins."""


def locked_folder(settings: BrokerSettings) -> tuple[Path, IO[str]]:
    """The private folder of the broker's store, locked; without ``data`` a temporary one where the usual one fails."""
    if settings.data is not None:
        try:
            return settings.data, _lock(settings.data)
        except BlockingIOError:
            raise SkylessError(f"--data is {str(settings.data)!r}, which another broker uses") from None
        except OSError as error:
            raise SkylessError(f"--data is {str(settings.data)!r}, which cannot be used: {error.strerror}") from None
    with contextlib.suppress(OSError):
        usual = data_folder() / "broker"
        return usual, _lock(usual)
    scratch = Path(tempfile.mkdtemp(prefix=SCRATCH))
    return scratch, _lock(scratch)


def _lock(folder: Path) -> IO[str]:
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    file = (folder / "lock").open("w", encoding="utf-8")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise
    return file


def ports(settings: BrokerSettings) -> Iterator[int]:
    """Which ports to try."""
    if settings.port is not None:
        yield settings.port
    else:
        yield from range(FIRST_PORT, FIRST_PORT + _PORTS_TO_TRY)


def all_taken(settings: BrokerSettings) -> str:
    """What to say when none of them is free."""
    if settings.port is not None:
        return f"--port is {settings.port}, where another program listens; without --port a free one is taken"
    return (
        f"ports {FIRST_PORT} to {FIRST_PORT + _PORTS_TO_TRY - 1} of {settings.listen} are all taken; --port names one"
    )


def claimed(host: str, port: int) -> socket.socket | None:
    """What keeps another broker from taking the port at the same moment; None: somebody has it.

    Raises:
        SkylessError: the host is no address of this machine, or the port is not ours to take.
    """
    held = claim(host, port)
    if held is None:
        return None
    try:
        if is_free(host, port):
            return held
    except PermissionError:
        raise SkylessError(f"--port is {port}, which only the system may use; it should be 1024 or more") from None
    except OSError:
        raise SkylessError(f"--listen is {host!r}; it should be an address of this machine") from None
    held.close()
    return None
