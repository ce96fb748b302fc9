"""Checks of the computer: serial ports and their permissions, and whether its clock is synchronised."""

import ctypes
import getpass
import os
import struct
import sys
from pathlib import Path
from typing import Final

from skyless.run.doctor.check import Check

_PORTS: Final = ("ttyACM*", "ttyUSB*")
_TIMEX: Final = "@Illl"
"""The first fields of Linux's ``struct timex``: modes, offset, freq, maxerror."""
_TIMEX_BYTES: Final = 512  # more than it has
_TIME_ERROR: Final = 5


def port_checks(devices: Path = Path("/dev")) -> tuple[Check, ...]:
    """Which serial ports there are, and whether this user may open them."""
    ports = [port for pattern in _PORTS for port in sorted(devices.glob(pattern))]
    if not ports:
        finding = "There is no serial port (ttyACM*, ttyUSB*) on this computer."
        return (Check("serial ports", "not checked", finding, "Plug a board in, if this computer should have one."),)
    return tuple(_port(port) for port in ports)


def _port(port: Path) -> Check:
    if os.access(port, os.R_OK | os.W_OK):
        return Check(f"port {port.name}", "ok", f"{port} may be opened.")
    try:
        group, user = port.group(), getpass.getuser()
    except (OSError, KeyError):
        group, user = "dialout", "USER"
    advice = f"Type: sudo usermod -aG {group} {user}; then log in again."
    return Check(f"port {port.name}", "failed", f"{port} may not be opened by this user.", advice)


def clock_check() -> Check:
    """Whether the system says that something synchronises its clock (``adjtimex``)."""
    if not sys.platform.startswith("linux"):
        return Check("clock", "not checked", "This system does not say whether its clock is synchronised.")
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    if state < 0:
        return Check("clock", "not checked", f"adjtimex: {os.strerror(ctypes.get_errno())}.")
    if state == _TIME_ERROR:
        advice = "Start NTP or chrony: timedatectl set-ntp true. In a container the host's clock counts."
        return Check("clock", "warning", "The system says that nothing synchronises its clock.", advice)
    _, _, _, max_error_us = struct.unpack_from(_TIMEX, timex)
    finding = f"The clock is synchronised; the system states an error of at most {max_error_us * 1e-3:.1f} ms."
    return Check("clock", "ok", finding)
