"""Radios by name, as ``--radio`` gives them."""

from typing import Final, Literal

from skyless.errors import SkylessError
from skyless.radios.emulated import EtherConnection
from skyless.radios.ether_wire import DEFAULT_PORT, Join
from skyless.radios.radio import Radio

DEFAULT_RADIO: Final = f"ether:127.0.0.1:{DEFAULT_PORT}"


def is_simulated(spec: str) -> bool:
    """Whether nothing real flies over a radio of that name."""
    return spec.split(":", 1)[0] == "ether"


def open_radios(spec: str, kind: Literal["anchor", "tag"], names: tuple[str, ...]) -> tuple[Radio, ...]:
    """Radios for the nodes of one process, in the order of their names; nothing is connected yet.

    Raises:
        SkylessError: there is no such radio; the message says what would be right.
    """
    driver, _, place = spec.partition(":")
    if driver == "ether":
        host, port = host_and_port(spec, place, DEFAULT_PORT)
        return EtherConnection(host, port, Join(kind, names)).radios
    raise SkylessError(f"--radio is {spec!r}; it should be ether:HOST[:PORT]")


def host_and_port(spec: str, place: str, default_port: int) -> tuple[str, int]:
    """HOST[:PORT] of a radio's name, the host 127.0.0.1 where none is given. Raises SkylessError."""
    host, colon, digits = place.rpartition(":") if place.count(":") != 0 else (place, "", "")
    port = int(digits) if digits.isdecimal() and len(digits) < 6 else 0
    if colon and not 0 < port < 65_536:
        raise SkylessError(f"--radio is {spec!r}; it should be ether:HOST[:PORT] with a port from 1 to 65535")
    return host.strip("[]") or "127.0.0.1", port or default_port
