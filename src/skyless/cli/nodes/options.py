"""Common options of the commands of a running site."""

import contextlib
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from skyless.arguments import Options, number, read_numbers, whole, wrong
from skyless.cli.common import plain
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import AccuracySite, Site
from skyless.machine import extra_module
from skyless.run.broker import running_broker
from skyless.run.gather.subjects import NatsAddress, nats_address
from skyless.run.mqtt.address import MqttAddress, mqtt_address

_MAX_LIVE_HZ: Final = 4000.0
"""Beacons per second above which the emulated air is expected to fall behind; two cores kept up with 1000."""

HubUrl = Annotated[str | None, Parameter(env_var="SKYLESS_HUB")]
MqttCa = Annotated[Path | None, Parameter(env_var="SKYLESS_MQTT_CA")]
SiteId = Annotated[int, whole(0, 0xFFFD)]
WalkingSpeed = Annotated[float, number(above=0.0, most=10.0)]


class MqttOptions(Options, frozen=True, kw_only=True):
    """The broker of a running site."""

    mqtt: Annotated[str | None, Parameter(env_var="SKYLESS_MQTT")] = None
    """Broker to connect to, mqtt://HOST[:PORT] or mqtts://[USER@]HOST[:PORT], or none; by default the one on this
    machine. The password is taken from SKYLESS_MQTT_PASSWORD."""
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""

    def address(self) -> MqttAddress | None:
        """The broker's address; None for ``none``. Raises SkylessError.

        The default is the broker running on this machine, which is then logged, else the usual address.
        """
        if self.mqtt is None and self.mqtt_ca is None and (found := running_broker()) is not None:
            log(f"broker {found}, which runs on this machine (--mqtt names another)")
            return found
        if self.mqtt == "none":
            if self.mqtt_ca is not None:
                raise SkylessError("--mqtt is 'none'; give a broker's address together with --mqtt-ca")
            return None
        return mqtt_address(self.mqtt or "mqtt://127.0.0.1:1883", self.mqtt_ca)

    def required(self, right: str) -> MqttAddress:
        """The broker's address. Raises SkylessError for ``none``; ``right`` says what it should be."""
        if (address := self.address()) is None:
            raise SkylessError(f"--mqtt is 'none'; it should be {right}")
        address.tls_context()
        return address


def hub_address(hub: str, ca: Path | None) -> NatsAddress:
    """The hub's servers from ``--hub``. Raises SkylessError, also without nats-py."""
    extra_module("nats", "--hub")
    address = nats_address(hub, "--hub", ca)
    address.tls_context()
    return address


class SiteOptions(MqttOptions, frozen=True, kw_only=True):
    """A running site."""

    site_id: SiteId | None = None
    """Number of the site; by default the one whose programs are online."""


class GatherOptions(Options, frozen=True, kw_only=True):
    """Options for gathering a site with thousands of tags."""

    site_id: SiteId | None = None
    """Number of the site that is gathered; by default the first one of which anything is heard."""
    keep_gb: Annotated[float, number(above=0.0, most=100_000.0)] = 8.0
    """Gigabytes of fixes that the broker keeps for readers that come later, at most those of 24 hours."""


def site_named(site: str) -> Site:
    """Load a site file, or a built-in site: ``lab``, or ``paper``, the same with the paper's protocol.

    ``lab:PS`` sets a noise other than 100 ps. Raises SkylessError.
    """
    from skyless.sim.lab import lab_site, paper_lab_site
    from skyless.site.file.load import load_site

    name, colon, noise_ps = site.partition(":")
    if name not in {"lab", "paper"}:
        return load_site(Path(site))
    try:
        noise = read_numbers("--site", noise_ps, (1,))[0] if colon else 100.0
    except SkylessError:
        raise wrong("--site", site, f"a site file, lab, paper, or {name}:PICOSECONDS") from None
    return lab_site(noise) if name == "lab" else paper_lab_site(noise, AccuracySite())


def listen_address(text: str, usual_port: int) -> tuple[str, int | None]:
    """Parse HOST:PORT, or one of both; the port is None if not given. Raises SkylessError."""
    host, colon, digits = text.rpartition(":")
    if text.isdecimal():
        host = "127.0.0.1"
    elif not colon or text.endswith("]") or (":" in host and not host.startswith("[")):
        host, digits = text, ""
    host = host.strip("[]")
    if not host or (digits and not (digits.isdecimal() and len(digits) < 6 and int(digits) < 65_536)):
        raise wrong("--listen", text, f"HOST:PORT, as 127.0.0.1:{usual_port} or [::1]:{usual_port}")
    return host, int(digits) if digits else None


def run_until_stopped(program: Coroutine[Any, Any, None], *, punctual: bool = False) -> None:
    """Run a program until it ends, or Ctrl-C or a signal ends it. ``punctual``: see ``skyless.run.process.run``."""
    from skyless.run.process import run

    with contextlib.suppress(KeyboardInterrupt):
        run(program, punctual=punctual)


def log(line: str) -> None:
    """Print a line for people on standard error; it may contain text from the network."""
    print(plain(line, "\n"), file=sys.stderr, flush=True)


def name_unplaced(site: Site) -> None:
    """Log the anchors that are not simulated, as they have no position."""
    if site.unplaced:
        names = ", ".join(str(anchor.id) for anchor in site.unplaced)
        log(f"not simulated, as the site file has no position: anchor {names}")


def check_live(site: Site, method: str = DEFAULT_METHOD) -> None:
    """Check that tags of an emulated site can have fixes, and warn if it sends too much for real time.

    Raises SkylessError.
    """
    from skyless.core.any_anchor import beacon_period_s
    from skyless.sim.evaluation.scenarios import check_can_be_simulated

    check_can_be_simulated(site, method)
    name_unplaced(site)
    sent_hz = len(site.anchors) / beacon_period_s(site)
    if sent_hz > _MAX_LIVE_HZ:
        log(
            f"warning: {len(site.anchors)} anchors send {sent_hz:.0f} beacons/s, too many to emulate in real time: "
            "fixes will be late or none; skyless simulate does not need real time"
        )
