"""Checks of the computer: Python and libraries, serial ports, clock, processors, disk."""

import ctypes
import getpass
import grp
import os
import platform
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from skyless.core.errors import SkylessError
from skyless.core.extras import EXTRA_OF
from skyless.core.native.library import UNCOMPILED_VARIABLE, is_compiled, library
from skyless.core.processors import cores
from skyless.core.version import installed_version
from skyless.run.doctor.check import Check, judged
from skyless.run.process import data_folder

_PORTS: Final = ("ttyACM*", "ttyUSB*")
_STA_UNSYNC: Final = 0x0040
_TIME_ERROR: Final = 5
_CLOCK_ERROR_S: Final = 0.1
"""Fixes are compared with other computers' clocks to this; with keys a wrong clock means no fixes."""


def host_checks(devices: Path = Path("/dev")) -> tuple[Check, ...]:
    """All checks that need neither broker nor radio."""
    return (_python(), _library(), *port_checks(devices), clock_check(), _load(), disk_check(data_folder()))


def _python() -> Check:
    extras: dict[str, bool] = {}
    for name, extra in EXTRA_OF.items():
        extras[extra] = extras.get(extra, True) and find_spec(name) is not None
    have, lack = ([extra for extra, there in sorted(extras.items()) if there is wanted] for wanted in (True, False))
    finding = (
        f"Skyless {installed_version()}, Python {platform.python_version()} on {platform.machine()}; extras installed: "
        f"{', '.join(have) or 'none'}; not installed: {', '.join(lack) or 'none'}."
    )
    return Check("Python", "ok", finding)


def _library() -> Check:
    if not is_compiled():
        advice = f"Unset {UNCOMPILED_VARIABLE}, which is for tests."
        return Check("estimator", "warning", "The estimator runs as Python, some thousand times slower.", advice)
    try:
        return Check("estimator", "ok", f"The compiled estimator {Path(str(library()._name)).name} is in use.")
    except SkylessError as error:
        return Check("estimator", "failed", f"{error}.", "Install Skyless again.")


def port_checks(devices: Path = Path("/dev")) -> tuple[Check, ...]:
    """Which serial ports there are, and whether this user may open them."""
    ports = [port for pattern in _PORTS for port in sorted(devices.glob(pattern))]
    if not ports:
        return (Check("serial ports", "not checked", "There is no serial port (ttyACM*, ttyUSB*) on this computer."),)
    return tuple(_port(port) for port in ports)


def _port(port: Path) -> Check:
    name = f"port {port.name}"
    if os.access(port, os.R_OK | os.W_OK):
        return Check(name, "ok", f"{port} may be opened.")
    try:
        group = grp.getgrgid(port.stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "dialout"
    advice = f"Type: sudo usermod -aG {group} {_user()}; then log in again."
    return Check(name, "failed", f"{port} may not be opened by this user.", advice)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "USER"


class _Timex(ctypes.Structure):
    """The first fields of Linux's ``struct timex``, and space for the others."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long), ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long), ("status", ctypes.c_int), ("others", ctypes.c_char * 512),
    )  # fmt: skip


def clock_check() -> Check:
    """Whether the system says that something synchronises its clock (``adjtimex``)."""
    if not sys.platform.startswith("linux"):
        return Check("clock", "not checked", "This system does not say whether its clock is synchronised.")
    timex = _Timex()
    state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    if state < 0:
        return Check("clock", "not checked", f"adjtimex: {os.strerror(ctypes.get_errno())}.")
    error_s = timex.maxerror * 1e-6
    if state == _TIME_ERROR or timex.status & _STA_UNSYNC:
        advice = "Start NTP or chrony: timedatectl set-ntp true. In a container the host's clock counts."
        return Check("clock", "warning", "The system says that nothing synchronises its clock.", advice)
    finding = f"The clock is synchronised; the system states an error of at most {error_s * 1e3:.1f} ms."
    return judged("clock", error_s, _CLOCK_ERROR_S, float("inf"), finding, "See chronyc tracking or timedatectl.")


def _load() -> Check:
    share = os.getloadavg()[0] / cores()
    finding = f"Programs wanted {share:.0%} of the {cores()} processors over the last minute."
    return judged(
        "processors", share, 1.0, float("inf"), finding, "End other programs: positions come late without headroom."
    )


def disk_check(folder: Path) -> Check:
    """What is free where recordings and the broker's store are."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    finding = f"{free_gb:.1f} GB are free at {folder}."
    return judged("disk", -free_gb, -1.0, -0.1, finding, "Free some space: recordings and the broker's store need it.")
