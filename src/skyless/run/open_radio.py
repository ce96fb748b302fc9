"""Open radios by their names in ``--radio``, and log how each one works."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, Literal

from msgspec import Struct

from skyless.core.air.masterless_packets import Point
from skyless.core.errors import SkylessError
from skyless.radio.emulated import DEFAULT_PORT, EtherConnection, Join
from skyless.radio.interface import AntennaDelays, Gone, Hint, Radio, Restarted
from skyless.run.process import Log

if TYPE_CHECKING:
    from skyless.radio.dw1000.spi import SpiPort
    from skyless.radio.foreign.foreign_radios import SnifferRadio, UciRadio
    from skyless.radio.foreign.phone_radio import PhoneRadio

# ruff: noqa: PLC0415 - a tag loads its own kind of radio only

DEFAULT_RADIO: Final = f"ether:127.0.0.1:{DEFAULT_PORT}"
_SEARCH: Final = 0
"""Instead of a baud rate: look for the board at all of them."""
_FOREIGN_BAUD: Final = 115_200
"""Baud rate of listeners and FiRa boards; a real sniffer's USB port accepts any rate."""
_EXPECTED: Final = (
    "ether:HOST[:PORT], serial:PATH[@BAUD], spi:BUS.DEVICE[,irq=PIN][,reset=PIN], model:HOST[:PORT], "
    "listener:PATH[@BAUD], sniffer:PATH[@BAUD], uci:PATH[@BAUD] or phone://HOST[:PORT]"
)
PHONE_PORT: Final = 7470

PACKET_DRIVERS: Final = ("sniffer", "uci", "phone")
"""Radios that receive packets of another system instead of beacons."""
STATED_POSITIONS: Final = ("uci", "phone")
"""Radios whose receptions may state anchor positions."""


def is_simulated(spec: str) -> bool:
    """Whether a radio of that name is simulated: emulated, a model, or behind a pseudo-terminal.

    Check again after a radio has restarted: the path may lead to another device.
    """
    port = spec.partition(":")[2].partition(",")[0].partition("@")[0]
    return driver_of(spec) in ("ether", "model") or os.path.realpath(port).startswith("/dev/pts/")


def driver_of(spec: str) -> str:
    """What stands before the colon of a radio's name."""
    return spec.partition(":")[0]


def open_radios(
    spec: str,
    kind: Literal["anchor", "tag"],
    names: tuple[str, ...],
    delays: Sequence[AntennaDelays] | None = None,
    *,
    phases: bool | None = None,
    computes: bool = False,
) -> tuple[Radio, ...]:
    """Create radios for the nodes of one process, in the order of their names, without connecting them.

    ``delays`` are the antenna delays to which the nodes' radios are set. ``phases``: whether receptions should include
    the carrier phase, if the radio can measure it; None means only for tags. ``computes``: whether boards on serial
    ports compute their own positions.

    Raises:
        SkylessError: there is no such radio; the message says what would be right.
    """
    driver, _, where = spec.partition(":")
    join = Join(kind, names, tuple(one.tx_ticks for one in delays or ()))
    settings = delays or [AntennaDelays()] * len(names)
    phases = kind == "tag" if phases is None else phases
    if driver in ("ether", "model"):
        nodes = EtherConnection(*host_and_port(spec, where, DEFAULT_PORT), join).radios
        if driver == "ether":
            return nodes
        from skyless.radio.dw1000.radio import Dw1000Radio
        from skyless.run.dw1000_model import ModelPort

        return tuple(
            Dw1000Radio(ModelPort(node, own), node.name, own, phases=phases)
            for node, own in zip(nodes, settings, strict=True)
        )
    if driver == "spi":
        from skyless.radio.dw1000.radio import Dw1000Radio

        if len(names) != 1:
            raise SkylessError(f"--radio is {spec!r}; a chip on SPI carries one node, not {len(names)}")
        return (Dw1000Radio(spi_port(spec, where), names[0], settings[0], phases=phases),)
    if driver == "serial":
        from skyless.radio.serial.link import BAUDS
        from skyless.radio.serial.serial_radio import UNTIL_NEXT_START, SerialRadio

        ports, transmits = _ports(spec, where, _SEARCH, names), kind == "anchor"
        computing = UNTIL_NEXT_START if computes else None
        return tuple(
            SerialRadio(
                path, (baud,) if baud else BAUDS, name, own, transmits=transmits, phases=phases, computing=computing
            )
            for (path, baud), name, own in zip(ports, names, settings, strict=True)
        )
    if driver in ("listener", "sniffer", "uci", "phone") and kind == "anchor":
        raise SkylessError(f"--radio is {spec!r}; it should be one that can transmit: a {driver} only listens")
    if driver == "listener":
        from skyless.radio.foreign.foreign_radios import ListenerRadio

        ports = _ports(spec, where, _FOREIGN_BAUD, names)
        return tuple(ListenerRadio(*port, name) for port, name in zip(ports, names, strict=True))
    raise SkylessError(f"--radio is {spec!r}; it should be {_EXPECTED}")


def open_sniffers(
    spec: str, names: tuple[str, ...], anchors_m: Mapping[int, Point] | None = None
) -> "tuple[SnifferRadio | UciRadio | PhoneRadio, ...]":
    """Create sniffers, FiRa boards or the phone for the tags of one process, in the order of their names.

    ``anchors_m``: known positions of the system's anchors. Raises SkylessError.
    """
    from skyless.radio.foreign.foreign_radios import SnifferRadio, UciRadio
    from skyless.radio.foreign.uci import AnchorFrame

    driver, _, where = spec.partition(":")
    if driver == "phone":
        from skyless.radio.foreign.phone_radio import PhoneRadio

        host, port = host_and_port(spec, where.removeprefix("//"), PHONE_PORT)
        if len(names) != 1:
            raise SkylessError(f"--radio is {spec!r}; it is one phone, which is one tag, not {len(names)}")
        return (PhoneRadio(host, port, names[0], AnchorFrame(anchors_m)),)
    ports = zip(_ports(spec, where, _FOREIGN_BAUD, names), names, strict=True)
    if driver == "sniffer":
        return tuple(SnifferRadio(*port, name) for port, name in ports)
    frame = AnchorFrame(anchors_m)  # one for all, as their tags are of one site
    return tuple(UciRadio(*port, name, frame) for port, name in ports)


def _ports(spec: str, where: str, usual_baud: int, names: tuple[str, ...]) -> list[tuple[str, int]]:
    """Parse path and baud rate of each node's port, from PATH[@BAUD],PATH[@BAUD] and so on. Raises SkylessError."""
    from skyless.radio.serial.serial_port import check_path

    parts = where.split(",")
    if len(parts) != len(names) or not all(parts):
        wanted = "one port" if len(names) == 1 else f"{len(names)} ports, one for each node, with commas"
        raise SkylessError(f"--radio is {spec!r}; it should name {wanted}, as {spec.partition(':')[0]}:/dev/ttyACM0")
    ports = [_port(spec, part, usual_baud) for part in parts]
    if len({path for path, _ in ports}) < len(ports):
        raise SkylessError(f"--radio is {spec!r}; it should name each port once")
    for path, _ in ports:
        check_path(spec, path)
    return ports


def spi_port(spec: str, where: str) -> "SpiPort":
    """Parse BUS.DEVICE[,irq=PIN][,reset=PIN][,hz=RATE][,chip=PATH], and check the device. Raises SkylessError."""
    from skyless.radio.dw1000.spi import (
        DEFAULT_CHIP,
        DEFAULT_FAST_HZ,
        MAX_FAST_HZ,
        START_HZ,
        SpiBus,
        SpiPort,
        check_spi,
    )

    wires, _, rest = where.partition(",")
    bus, dot, device = wires.partition(".")
    options = [part.partition("=")[::2] for part in rest.split(",") if part]
    given = dict(options)
    for key in given:
        if sum(key == other for other, _ in options) > 1:
            raise SkylessError(f"--radio is {spec!r}; it should give {key} once")
    chip = given.pop("chip", DEFAULT_CHIP)
    numbers = {key: int(value) if value.isdecimal() and len(value) < 10 else -1 for key, value in given.items()}
    right = dot and bus.isdecimal() and device.isdecimal() and chip.startswith("/")
    if not right or not numbers.keys() <= {"irq", "reset", "hz"} or min(numbers.values(), default=0) < 0:
        raise SkylessError(f"--radio is {spec!r}; it should be spi:BUS.DEVICE, as spi:0.0,irq=25,reset=24,hz=8000000")
    if not START_HZ <= numbers.get("hz", DEFAULT_FAST_HZ) <= MAX_FAST_HZ:
        raise SkylessError(f"--radio is {spec!r}; it should have hz from {START_HZ} to {MAX_FAST_HZ}")
    has_lines = not numbers.keys().isdisjoint({"irq", "reset"})
    check_spi(spec, int(bus), int(device), chip if has_lines else None)
    return SpiPort(
        f"/dev/spidev{bus}.{device}",
        lambda: SpiBus(
            int(bus),
            int(device),
            irq_pin=numbers.get("irq"),
            reset_pin=numbers.get("reset"),
            fast_hz=numbers.get("hz", DEFAULT_FAST_HZ),
            gpio_chip=chip,
        ),
    )


def _port(spec: str, part: str, usual_baud: int) -> tuple[str, int]:
    path, at, digits = part.rpartition("@")
    if not at:
        return part, usual_baud
    if not path or not digits.isdecimal() or len(digits) > 8 or int(digits) < 300:
        raise SkylessError(f"--radio is {spec!r}; it should be PATH@BAUD with a rate from 300, as /dev/ttyACM0@1000000")
    return path, int(digits)


def host_and_port(spec: str, where: str, default_port: int) -> tuple[str, int]:
    """Parse HOST[:PORT] of a radio's name; the host defaults to 127.0.0.1. Raises SkylessError."""
    host, colon, digits = where.rpartition(":") if where.count(":") != 0 else (where, "", "")
    port = int(digits) if digits.isdecimal() and len(digits) < 6 else 0
    scheme = spec.removesuffix(where)
    if colon and not 0 < port < 65_536:
        raise SkylessError(f"--radio is {spec!r}; it should be {scheme}HOST[:PORT] with a port from 1 to 65535")
    if "/" in host:
        raise SkylessError(f"--radio is {spec!r}; it should be {scheme}HOST[:PORT], and {host} is no host")
    return host.strip("[]") or "127.0.0.1", port or default_port


UNUSABLE_S: Final = 5.0
"""It is logged if a node has received nothing usable for this long."""
REPEAT_S: Final = 60.0
"""The same line is not logged again within this time, however often reception changes."""

_MEANING: Final = {
    "foreign-site": "those are of another site than asked for",
    "unknown-anchor": "those are of anchors that the site, or the table of anchors, does not know",
    "not-a-beacon": "those are frames of another system",
    "unknown-version": "those anchors run another release",
    "bad-fcs": "those are damaged: too weak, or their end is cut off",
    "too-short": "those are frames of another system, or cut off",
    "stale-master": "those follow a master that has been replaced",
    "rx-error": "frames that cannot be read: too weak, reflected, or sent with other settings",
    "malformed-line": "lines of another format, or another rate",
    "bytes-of-no-record": "bytes of another format, or another rate",
    "garbled-record": "the line loses bytes",
    "late-reception": "those were too old at their turn: this computer is too slow",
}


class _Counts(Struct, frozen=True):
    """Counts at one moment."""

    now_s: float
    received: int
    used: int
    drops: Counter[str]


class RadioMonitor:
    """Watches the radio of one node. ``advice`` returns the radio's hint in case nothing at all was received."""

    def __init__(self, name: str, ready: str, log: Log, advice: Callable[[], str]) -> None:
        """``ready``: words for what the node does once its radio has started."""
        self.restarts = 0
        self._name, self._ready, self._log, self._advice = name, ready, log, advice
        self._present = False
        self._since: _Counts | None = None
        self._reported: tuple[str, str] | None = None
        self._logged_s: dict[tuple[str, str], float] = {}

    def on_event(self, event: Restarted | Gone | Hint) -> None:
        """Log a change of the radio's state; after ``Restarted`` counts may begin again at 0."""
        if isinstance(event, Restarted):
            self.restarts += 1
            self._present, self._since = True, None
            self._log(f"{self._name}: {self._ready}" + (" again" if self.restarts > 1 else ""))
        elif isinstance(event, Gone):
            self._present = False
            self._log(f"{self._name}: {event.reason}; still looking for it")
        else:
            self._log(f"{self._name}: {event.text}")

    def check(self, now_s: float, received: int, used: int, drops: Mapping[str, int]) -> None:
        """Log likely causes if nothing was usable for ``UNUSABLE_S``; call this every second or so.

        ``now_s`` is the host's monotonic clock; ``received`` and ``used`` count frames, ``drops`` unusable ones by
        reason, all since ``Restarted`` or before.
        """
        if not self._present or (self._since is not None and now_s - self._since.now_s < UNUSABLE_S):
            return
        before, self._since = self._since, _Counts(now_s, received, used, Counter(drops))
        if before is None:
            return
        if used != before.used:
            self._reported = None
            return
        self._report(now_s, received - before.received, self._since.drops - before.drops)

    def _report(self, now_s: float, received: int, drops: Counter[str]) -> None:
        reason, count = drops.most_common(1)[0] if drops else ("", 0)
        most = f"; most counted: {reason} ({count})" if reason else ""
        meaning = f", {_MEANING[reason]}" if reason in _MEANING else ""
        subject = "" if received else self._advice()
        key = subject, reason
        if key == self._reported:
            return
        self._reported = key
        if now_s - self._logged_s.get(key, -REPEAT_S) >= REPEAT_S:
            self._logged_s[key] = now_s
            what = subject or f"{received} frames have come"
            self._log(f"{self._name}: nothing usable for {UNUSABLE_S:.0f} s; {what}{most}{meaning}")
