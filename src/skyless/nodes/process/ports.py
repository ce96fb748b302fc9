"""Ports of this machine: which are free, and which of several programs that start at once may have one."""

import errno
import socket
import sys
from typing import Final

_CLAIM: Final = "\0skyless-{}:{}"
"""Linux's abstract sockets have one owner each, in the same namespace as its ports, and go with their process."""


def is_free(host: str, port: int) -> bool:
    """Whether one could listen there.

    Raises:
        OSError: nobody could: no address of this machine, or a port that only the system may use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return False
            raise
    return True


def claim(host: str, port: int) -> socket.socket | None:
    """What keeps other programs of Skyless from taking a port as long as it is open; None: one of them has it."""
    held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    if sys.platform.startswith("linux"):
        try:
            held.bind(_CLAIM.format(host, port))
        except OSError:
            held.close()
            return None
    return held


def claim_next(host: str, first: int) -> tuple[int, socket.socket]:
    """The first free port from this one on that no other program of Skyless has claimed; and the claim."""
    port = first
    while True:
        held = claim(host, port)
        if held is not None:
            if is_free(host, port):
                return port, held
            held.close()
        port += 1


def hold_any(host: str) -> tuple[int, socket.socket]:
    """A free port, which the system gives to nobody as long as the socket is open, but to who asks for this one."""
    held = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind((host, 0))
    return int(held.getsockname()[1]), held


def any_port(host: str) -> int:
    """A port that is free now."""
    port, held = hold_any(host)
    held.close()
    return port
