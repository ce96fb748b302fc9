"""``skyless flash``: put the firmware onto a DWM1001, with OpenOCD or pyocd and a debug probe."""

import os
import re
import shlex
import shutil
import sys
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT, Popen
from tempfile import NamedTemporaryFile
from typing import Final, Literal

from cyclopts import App

from skyless.arguments import Options
from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import log
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.version import installed_version
from skyless.files import read_lines
from skyless.machine import how_to_install

app = App(name="flash", help_epilogue="Example: skyless flash --dry-run, then skyless flash")

_BUILT: Final = Path(__file__).parents[4] / "firmware" / "build" / "skyless-dwm1001.hex"  # in a checkout
_IN_WHEEL: Final = Path(__file__).parents[2] / "radio" / "serial" / _BUILT.name
_USB: Final = Path("/sys/bus/usb/devices")
_SEGGER: Final = "1366"
_VECTORS_BYTES: Final = 64  # the image's name follows (firmware/source/startup.c)
_INTERFACES: Final = {
    "jlink": ("-f", "interface/jlink.cfg"),
    "cmsis-dap": ("-f", "interface/cmsis-dap.cfg"),
    "pi": ("-c", "adapter driver linuxgpiod; adapter gpio swclk -chip 0 11; adapter gpio swdio -chip 0 25"),
}
_AGAIN: Final = "check the board's power, its wires and that this user may use the probe, and run skyless flash again"


class FlashOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless flash``."""

    image: Path | None = None
    """The firmware, an Intel HEX file; by default what make has built in a checkout, or the one in the wheel."""
    probe: Literal["jlink", "cmsis-dap", "pi"] | None = None
    """Debug probe, by default the one that is plugged in: jlink (a DWM1001-DEV has one), cmsis-dap, or pi, which is a
    Raspberry Pi's header with SWCLK at GPIO 11 and SWDIO at GPIO 25."""
    serial: str = ""
    """Serial number of the probe, where several are plugged in."""
    dry_run: bool = False
    """Show what would run and what it would erase, and change nothing."""
    yes: bool = False
    """Do not ask before the board is erased."""


@app.default
@command
def flash(*, asked: FlashOptions, output: JsonOptions) -> None:
    """Put the firmware onto a DWM1001 through a debug probe: erase the module, write and verify."""
    image = (asked.image or (_BUILT if _BUILT.exists() else _IN_WHEEL)).absolute()
    if asked.image is None and not image.exists():
        raise SkylessError("there is no firmware yet: make -C firmware builds it in a checkout; or --image FILE")
    content, (probe, serial), say = firmware(image), _probe(asked), log if output.json else print
    with NamedTemporaryFile(prefix="skyless-read-back-") as read_back:
        words = _command(probe, serial, image, f"savemem 0 {len(content)} {read_back.name}")
        say(f"image:   {image}, version {installed_version()}, {len(content)} bytes")
        say(f"probe:   {probe} {serial}\nruns:    {shlex.join(words)}")
        say("erases:  all flash and UICR of the module: its firmware (Qorvo's PANS in a new one) and its settings")
        if not (asked.dry_run or asked.yes):
            if sys.stdin is None or not sys.stdin.isatty():
                raise SkylessError("nothing was erased: there is no terminal to ask at; --yes flashes without asking")
            print("Erase the module and write the image? [y/N] ", end="", file=sys.stderr, flush=True)
            if sys.stdin.readline().strip().lower() not in {"y", "yes"}:
                raise SkylessError("nothing was erased, as the answer was not yes")
        if not asked.dry_run:
            said = _run(words)
            if "** Verified OK **" not in said and Path(read_back.name).read_bytes() != content:
                raise SkylessError(f"the module does not hold what was written: {_AGAIN}")
            say("written and verified; next: unplug the board and plug it in again, then")
            say("skyless selftest --radio serial:/dev/ttyACM0")
    if output.json:
        facts = {"image": image, "version": installed_version(), "probe": probe, "serial": serial or None}
        print_json(facts | {"command": words, "flashed": not asked.dry_run})


def read_hex(file: Path) -> dict[int, bytearray]:
    """The runs of bytes in an Intel HEX file, by address. Raises ConfigurationError."""
    runs: dict[int, bytearray] = {}
    base, end = 0, -1
    for number, line in enumerate(read_lines(file), start=1):
        raw = bytes.fromhex(line[1:]) if re.fullmatch(":([0-9A-Fa-f]{2}){5,}", line) else b"\1"
        kind, data = raw[3:4], raw[4:-1]
        if sum(raw) & 0xFF or raw[0] != len(data) or kind > b"\5" or (kind in (b"\2", b"\4") and len(data) != 2):
            raise ConfigurationError(file, f"line {number}", line, "a record of Intel HEX with its check sum")
        if kind == b"\1":
            return runs
        if kind == b"\0":
            if (start := base + int.from_bytes(raw[1:3], "big")) != end:
                run = runs[start] = bytearray()
            run += data
            end = start + len(data)
        elif kind in (b"\2", b"\4"):
            base = int.from_bytes(data, "big") << (4 if kind == b"\2" else 16)
    raise ConfigurationError(file, "the file", "cut off", "Intel HEX up to its last record, :00000001FF")


def firmware(image: Path) -> bytes:
    """What an image writes from address 0 on. Raises SkylessError: it is no firmware, or of another version."""
    content = bytes(read_hex(image).get(0, b""))
    name = re.match(rb"skyless-dwm1001 ([!-~]+)\0", content[_VECTORS_BYTES:])
    if name is None:
        raise ConfigurationError(image, "", None, "firmware of Skyless for a DWM1001, as make -C firmware builds it")
    if (version := name[1].decode()) != (own := installed_version()):
        should = f"it should be {own}: build it again with make -C firmware in a checkout of that version"
        raise SkylessError(f"{image} is firmware of version {version}, and Skyless is {own}; {should}")
    return content


def _probe(asked: FlashOptions) -> tuple[str, str]:
    """Kind of the probe, and its serial number if several are plugged in. Raises SkylessError."""
    found = []
    for folder in sorted(file.parent for file in _USB.glob("*/idVendor") if asked.probe != "pi"):
        files = [folder / name for name in ("idVendor", "product", "serial")]
        vendor, product, serial = (file.read_text("utf-8").strip() if file.exists() else "" for file in files)
        if vendor == _SEGGER or "CMSIS-DAP" in product.upper():
            found.append(("jlink", serial.lstrip("0")) if vendor == _SEGGER else ("cmsis-dap", serial))
    fitting = [one for one in found if asked.probe in (None, one[0]) and asked.serial in ("", one[1])]
    if len(fitting) == 1:
        return fitting[0] if len(found) > 1 else (fitting[0][0], "")
    if asked.probe and not fitting:  # a probe that is named need not be listed here
        return asked.probe, asked.serial
    if not found:
        raise SkylessError(
            "no debug probe is plugged in: plug in a DWM1001-DEV, which has one, or a probe with wires to the module, "
            "or wire the module to this Raspberry Pi and give --probe pi"
        )
    probes = ", ".join(" ".join(one) for one in found)
    raise SkylessError(f"--serial is {asked.serial!r}; it should choose one of the debug probes here: {probes}")


def _command(probe: str, serial: str, image: Path, read_back: str) -> list[str]:
    """The command line that erases, writes and verifies. Raises SkylessError: the tool is missing."""
    path = os.pathsep.join((os.environ.get("PATH", os.defpath), str(Path(sys.executable).parent)))
    if tool := shutil.which("openocd", path=path):
        named, number = (re.sub(r"([^\w./+-])", r"\\\1", word) for word in (str(image), serial))  # for Tcl
        select = (f"adapter serial {number}; " if serial else "") + "transport select swd"
        recover = "if {[catch nrf52_recover]} nrf52_recover"  # newer chips may refuse the first one: anomaly 176
        write = f"init; {recover}; program {named} verify reset exit"
        return [tool, *_INTERFACES[probe], "-c", select, "-f", "target/nrf52.cfg", "-c", write]
    if (tool := shutil.which("pyocd", path=path)) and probe != "pi":
        uid = ("-u", serial) if serial else ()
        steps = ("erase", f"load {shlex.quote(str(image))}", read_back, "reset")  # pyocd itself does not verify
        options = ("-v", "-W", *uid, "-t", "nrf52832", "-M", "halt", "-O", "auto_unlock=true")
        return [tool, "commander", *options, *(word for step in steps for word in ("-c", step))]
    other = f", or pyocd: {how_to_install('flash')}" if probe != "pi" else ""
    raise SkylessError(f"flashing needs OpenOCD: apt install openocd{other}")


def _run(words: list[str]) -> str:
    """Run the tool, show what it says and return that. Raises SkylessError: it failed."""
    said = []
    with Popen(words, stdin=DEVNULL, stdout=PIPE, stderr=STDOUT, text=True, errors="replace") as tool:
        try:
            for line in tool.stdout or ():
                log(line.rstrip().expandtabs())
                said.append(line.strip())
        except KeyboardInterrupt:
            tool.kill()  # OpenOCD ends at other signals only when it has written
            tool.wait()
            log("interrupted: the board holds a part of the image, or nothing; run skyless flash again")
            raise
    if tool.returncode:
        errors = [line for line in said if re.match(r"Error|\d+ [CE] ", line)] or [line for line in said if line]
        raise SkylessError(f"{Path(words[0]).name} failed ({(errors or ['it said nothing'])[-1]}): {_AGAIN}")
    return "\n".join(said)
