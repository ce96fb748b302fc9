"""Options that the commands of a running site share."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import finite_numbers, options
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.mqtt.address import MqttAddress
    from skyless.site.model import Site

_DEFAULT_MQTT: Final = "mqtt://127.0.0.1:1883"

MqttCa = Annotated[Path | None, Parameter(env_var="SKYLESS_MQTT_CA")]
SiteId = Annotated[int, Parameter(validator=Number(gte=0, lt=0xFFFE))]
WalkingSpeed = Annotated[float, Parameter(validator=Number(gt=0, lte=10))]


@options
class MqttOptions:
    """The broker of a running site. What a program uses it for stands in the help of its command."""

    mqtt: Annotated[str | None, Parameter(env_var="SKYLESS_MQTT")] = None
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""

    def address(self) -> "MqttAddress | None":
        """The broker's address; None for ``none``. Raises SkylessError.

        By default it is that of the broker that runs on this machine, which is said in one line; else the usual one.
        """
        from skyless.mqtt.address import mqtt_address
        from skyless.nodes.broker_address import running_broker

        if self.mqtt is None and self.mqtt_ca is None:
            found = running_broker()
            if found is not None:
                log(f"broker {found}, which runs on this machine (--mqtt names another)")
                return found
        if self.mqtt is None:
            return mqtt_address(_DEFAULT_MQTT, self.mqtt_ca)
        if self.mqtt == "none":
            if self.mqtt_ca is not None:
                raise SkylessError("--mqtt is 'none'; give a broker's address together with --mqtt-ca")
            return None
        return mqtt_address(self.mqtt, self.mqtt_ca)


def site_named(site: str) -> "Site":
    """The site in a file, or the built-in ``lab``, with other noise than 100 ps as ``lab:PS``. Raises SkylessError."""
    from skyless.site.lab import lab_site
    from skyless.site.load import load_site

    name, colon, noise_ps = site.partition(":")
    if name != "lab":
        return load_site(Path(site))
    try:
        return lab_site(finite_numbers("site", noise_ps, (1,))[0]) if colon else lab_site()
    except SkylessError:
        raise SkylessError(f"--site is {site!r}; it should be a site file, lab, or lab:PICOSECONDS") from None


def listen_address(text: str, usual_port: int) -> tuple[str, int | None]:
    """HOST:PORT, or one of both; the port is None where it is not given. Raises SkylessError."""
    host, colon, digits = text.rpartition(":")
    if text.isdecimal():
        host = "127.0.0.1"
    elif not colon or text.endswith("]") or (":" in host and not host.startswith("[")):
        host, digits = text, ""
    host = host.strip("[]")
    if not host or (digits and not (digits.isdecimal() and len(digits) < 6 and int(digits) < 65_536)):
        raise SkylessError(
            f"--listen is {text!r}; it should be HOST:PORT, as 127.0.0.1:{usual_port} or [::1]:{usual_port}"
        )
    return host, int(digits) if digits else None


def log(line: str) -> None:
    """Show a line to a person, on standard error."""
    print(line, file=sys.stderr, flush=True)
