"""Ports of this machine: which are free, and which of several programs that start together may have one."""

import errno
import socket
import sys
from typing import Final

_CLAIM: Final = "\0skyless-{}:{}"
"""Linux's abstract sockets have one owner each, in the same namespace as its ports, and end with their process."""


def is_free(host: str, port: int) -> bool:
    """Whether a program could listen there.

    Raises:
        OSError: none could: no address of this machine, or a port that only the system may use.
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
    """A socket that reserves a port among the programs of Skyless while it is open; None: one of them has it."""
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
    """A free port and its socket: while that is open, the system assigns the port to no program by itself."""
    held = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind((host, 0))
    return int(held.getsockname()[1]), held
