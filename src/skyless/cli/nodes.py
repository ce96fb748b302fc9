"""What the commands of a running site share."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import Parameter

from skyless.cli.options import finite_numbers
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.outputs.address import MqttAddress
    from skyless.site.model import Site

DEFAULT_MQTT: Final = "mqtt://127.0.0.1:1883"
Mqtt = Annotated[str, Parameter(env_var="SKYLESS_MQTT")]
MqttCa = Annotated[Path | None, Parameter(env_var="SKYLESS_MQTT_CA")]


def broker(mqtt: str, mqtt_ca: Path | None) -> "MqttAddress | None":
    """The broker of ``--mqtt``; None for ``none``. Raises SkylessError."""
    from skyless.outputs.address import mqtt_address

    if mqtt == "none":
        if mqtt_ca is not None:
            raise SkylessError("--mqtt is 'none'; give a broker's address together with --mqtt-ca")
        return None
    return mqtt_address(mqtt, mqtt_ca)


def site_named(site: str) -> "Site":
    """The site in a file, or the built-in ``lab``, with other noise than 100 ps as ``lab:PS``. Raises SkylessError."""
    from skyless.site.lab import lab_site
    from skyless.site.load import load_site

    name, colon, noise_ps = site.partition(":")
    if name != "lab":
        return load_site(Path(site))
    return lab_site(*finite_numbers("site", noise_ps, (1,))) if colon else lab_site()


def listen_address(text: str, default_port: int) -> tuple[str, int]:
    """HOST:PORT, or one of both. Raises SkylessError."""
    host, colon, digits = text.rpartition(":")
    if not colon:
        host, digits = ("", text) if text.isdecimal() else (text, str(default_port))
    if not digits.isdecimal() or not 0 <= int(digits) < 65_536:
        raise SkylessError(f"--listen is {text!r}; it should be HOST:PORT, such as 127.0.0.1:{default_port}")
    return host.strip("[]") or "127.0.0.1", int(digits)


def say(line: str) -> None:
    """Tell a person."""
    print(line, file=sys.stderr, flush=True)
