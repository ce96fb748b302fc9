"""``skyless flash-config``: settings of a board that is a tag by itself."""

import asyncio
from typing import Annotated, Any, Final, Literal

from cyclopts import App
from msgspec.structs import asdict, fields

from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import SiteId, log
from skyless.core.arguments import Option, Options, number, numbers, whole, wrong
from skyless.core.errors import SkylessError
from skyless.radio.serial.link import MODES, OUTPUTS, BoardSettings
from skyless.radio.serial.serial_port import check_path
from skyless.radio.serial.serial_radio import Computing, set_up

_BAUDS: Final = (1_000_000, 115_200, 230_400, 460_800, 921_600)

app = App(name="flash-config", help_epilogue="Example: skyless flash-config --mode tag --output nmea --rate-hz 10")


class BoardOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless flash-config``; those of a setting have its name in ``BoardSettings``, or are converted."""

    radio: str = "serial:/dev/ttyACM0"
    """Radio of a board that no other program uses, serial:PATH[@BAUD]; without BAUD all rates are tried."""
    defaults: bool = False
    """Begin with the settings of a new board instead of those that it has."""
    mode: Literal["radio", "tag"] | None = None
    """Mode of the board: radio, for a host's program, or tag, which computes its own position."""
    output: Literal["records", "nmea", "json", "none"] | None = None
    """What a tag says on its serial port: records for skyless tag --from-board, NMEA 0183, JSON lines, or nothing."""
    rate_hz: Literal[0, 1, 5, 10, 25, 50] | None = None
    """Fixes a second on the serial port at most; 0 for all."""
    baud: Literal[115_200, 230_400, 460_800, 921_600, 1_000_000] | None = None
    """Rate of the serial port, from the answer on."""
    bluetooth_ms: Annotated[int, whole(0, 10_240)] | None = None
    """Interval of the Bluetooth advertisements in ms, from 100; 0 for none."""
    site: Annotated[SiteId | None, Option("site-id")] = None
    """Number of the site, the only one to listen to; by default the first one heard."""
    tag: Annotated[int | None, Option("tag-number"), whole(0, 0xFFFF)] = None
    """Number of the tag in its outputs."""
    tx_delay_ticks: Annotated[int | None, Option("tx-delay"), whole(0, 0xFFFF)] = None
    """Antenna delay in transmission, in ticks of 15.65 ps."""
    rx_delay_ticks: Annotated[int | None, Option("rx-delay"), whole(0, 0xFFFF)] = None
    """Antenna delay in reception, in ticks of 15.65 ps."""
    z_bounds_m: Annotated[tuple[float, float] | None, Option("z-bounds"), numbers(2, form="low,high")] = None
    """Lowest and highest height of the tag in metres, where its height is estimated."""
    sleep_s: Annotated[float, number(least=0.0, most=3600.0)] | None = None
    """Seconds that the tag sleeps between two fixes; 0 for always on."""
    superframes: Annotated[int, whole(1, 100)] | None = None
    """Superframes that the tag listens to after each sleep."""
    receive: Literal["always", "expected"] | None = None
    """Whether the tag receives always, or only when beacons are expected."""
    qa_m2ps3: Annotated[float | None, Option("qa"), number(above=0.0, most=1000.0)] = None
    """Process noise for the tags' motion: spectral density of the acceleration in m²/s³."""
    integrity_risk: Annotated[float, number(least=1e-9, most=0.1)] | None = None
    """Probability, for each fix, that the error exceeds its protection level."""
    alert_limit_m: Annotated[float, number(least=0.0, most=1000.0)] | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert; 0 for none."""

    def check(self) -> None:
        """See that limits that belong together fit. Raises SkylessError."""
        if self.bluetooth_ms is not None and 0 < self.bluetooth_ms < 100:
            raise wrong("--bluetooth-ms", self.bluetooth_ms, "0, or at least 100")
        if self.sleep_s is not None and 0.0 < self.sleep_s < 1e-3:
            raise wrong("--sleep-s", self.sleep_s, "0, or at least 0.001")
        if self.z_bounds_m is not None and not -1e5 <= self.z_bounds_m[0] < self.z_bounds_m[1] - 1e-3 < 1e5:
            raise wrong("--z-bounds", self.z_bounds_m, "a lower and a higher height, within 100 km")

    def changes(self) -> dict[str, Any]:
        """The fields of ``BoardSettings`` that are asked for."""
        asked = {one.name: getattr(self, one.name, None) for one in fields(BoardSettings)}
        asked["mode"] = None if self.mode is None else MODES.index(self.mode)
        asked["output"] = None if self.output is None else OUTPUTS.index(self.output)
        asked["predicts"] = None if self.receive is None else int(self.receive == "expected")
        asked["sleep_ms"] = None if self.sleep_s is None else round(1000 * self.sleep_s)
        if self.z_bounds_m is not None:
            low_mm, high_mm = (round(1000 * bound_m) for bound_m in self.z_bounds_m)
            asked |= {"has_bounds": 1, "low_mm": low_mm, "high_mm": high_mm}
        return {name: value for name, value in asked.items() if value is not None}


@app.default
@command
def flash_config(*, asked: BoardOptions, output: JsonOptions) -> None:
    """Set up a board that computes its own position, and show its settings; without any to change it only shows them.

    The board keeps them in its flash. It also gets the time of this computer, until it is switched off.
    """
    kind, _, port = asked.radio.partition(":")
    path, _, baud = port.partition("@")
    if kind != "serial" or not path or not (baud or "1").isdecimal():
        raise SkylessError(
            f"--radio is {asked.radio!r}; it should be a board, serial:PATH[@BAUD], as serial:/dev/ttyACM0"
        )
    check_path(asked.radio, path)
    changes = (asdict(BoardSettings()) if asked.defaults else {}) | asked.changes()
    bauds = (int(baud),) if baud else _BAUDS
    found = asyncio.run(set_up(path, bauds, Computing(changes, keeps=bool(changes))))
    settings, shown = found.settings, asdict(found.settings)
    shown |= {"mode": MODES[settings.mode], "output": OUTPUTS[settings.output]}
    if output.json:
        print_json({"radio": f"serial:{path}@{settings.baud}", "in_flash": found.in_flash, "settings": shown})
        return
    for name, value in shown.items():
        print(f"{name:<15} {value}")
    if changes and not found.in_flash:
        raise SkylessError(f"the board at {path} could not keep them in its flash: they hold until it is switched off")
    log("flash holds these settings" if found.in_flash else "flash holds other settings, or none")
