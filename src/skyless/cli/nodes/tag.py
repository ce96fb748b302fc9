"""``skyless tag``: tags as a program."""

import contextlib
import re
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import (
    IntegrityRisk,
    NotNegative,
    Positive,
    finite_numbers,
    integrity_of,
    known_method,
    see_that_a_height_is_given,
)
from skyless.cli.nodes.options import DEFAULT_MQTT, Mqtt, MqttCa, broker, say
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD
from skyless.nodes.open_radio import DEFAULT_RADIO, is_simulated, is_sniffer, open_radios, open_sniffers

if TYPE_CHECKING:
    from skyless.mqtt.address import MqttAddress
    from skyless.nodes.packet_tags import PacketTagSettings
    from skyless.nodes.tag import TagSettings

app = App(name="tag", help_epilogue="Example: skyless tag tag1")
_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


@app.default
def tag(
    *names: Annotated[str, Parameter(name="NAMES")],
    radio: str = DEFAULT_RADIO,
    method: str = DEFAULT_METHOD,
    qa: Positive = 0.3,
    integrity_risk: IntegrityRisk | None = None,
    alert_limit_m: Positive | None = None,
    max_acceleration: NotNegative | None = None,
    height_std: NotNegative | None = None,
    publish_hz: Annotated[float, Parameter(validator=Number(gt=0, lte=1000))] = 50.0,
    site_id: Annotated[int | None, Parameter(validator=Number(gte=0, lt=0xFFFE))] = None,
    anchors: Path | None = None,
    height: str | None = None,
    mqtt: Mqtt = DEFAULT_MQTT,
    mqtt_ca: MqttCa = None,
) -> None:
    """Run listening tags until Ctrl-C.

    A tag needs to know nothing: what it hears tells it the site. It computes a fix with every message, broker or no
    broker, and tells of them on MQTT under skyless/v1/SITE/tag/NAME/fix.

    Parameters
    ----------
    names
        Names of one or more tags: letters, digits, - and _.
    radio
        The tags' radio. ether:HOST:PORT: the emulated air of skyless ether. serial:PATH: a board of Skyless.
        spi:BUS.DEVICE,irq=PIN,reset=PIN: a DW1000 on this computer's SPI. model:HOST:PORT: a model of one on that air.
        listener:PATH: the listener of uwb-apps. sniffer:PATH: a Bitcraze sniffer, for TDoA2 and TDoA3 systems.
        Several tags have several paths, with commas; PATH@BAUD gives another rate.
    method
        How positions are computed (sniffers: always joint).
    qa
        Agility of the tags in m²/s³ (joint).
    integrity_risk
        Probability, for each fix, that the error exceeds its protection level (joint); 1e-4 by default.
    alert_limit_m
        Fixes with a higher protection level than so many metres carry an alert (joint).
    max_acceleration
        The largest acceleration of the tags in m/s², for protection levels that cover their hardest turns (joint).
    height_std
        Standard deviation of the tags' height from the one that is given, in metres, which fixes and levels then
        count (joint); 0 by default, for sniffers 0.5 where the height is only taken for the anchors'.
    publish_hz
        Fixes a second and tag on MQTT at most.
    site_id
        The only site to listen to; by default the first one heard. For sniffers what topics call the system, by
        default 0; it should be no other site's.
    anchors
        Sniffers only: table of the system's anchors, id,x_m,y_m,z_m, as skyless replay and calibrate take it.
    height
        Sniffers only: the tags' height in metres, free (estimated) or auto, the default: estimated unless the anchors
        lie too flat, then theirs.
    mqtt
        Broker for fixes and health, or none.
    mqtt_ca
        Certificates (PEM) to trust for mqtts.
    """
    from skyless.nodes.process import run
    from skyless.nodes.tag import TagSettings

    address = broker(mqtt, mqtt_ca)
    if not names or len(set(names)) < len(names) or not all(map(_NAME.fullmatch, names)):
        given = repr(" ".join(names)) if names else "missing"
        raise SkylessError(
            f"NAMES is {given}; it should be one or more names, each once, of 1 to 32 letters, digits, - or _"
        )
    known_method(method)
    if is_sniffer(radio):
        if not (integrity_risk is None and alert_limit_m is None and max_acceleration is None):
            raise SkylessError("--integrity-risk, --alert-limit-m and --max-acceleration are not for sniffers")
        serve = _on_sniffers(radio, names, _system(anchors, height, height_std, site_id, qa, publish_hz), address)
    elif anchors is not None or height is not None:
        raise SkylessError("--anchors and --height are for sniffers; other tags hear from the air where anchors stand")
    else:
        asked = integrity_of(integrity_risk, alert_limit_m, max_acceleration, method, height_std)
        settings = TagSettings(method, qa, site_id, integrity=asked, publish_hz=publish_hz)
        serve = _on_radios(radio, names, settings, address)
    with contextlib.suppress(KeyboardInterrupt):
        run(serve, punctual=True)


def _on_radios(
    radio: str, names: tuple[str, ...], settings: "TagSettings", address: "MqttAddress | None"
) -> "Coroutine[Any, Any, None]":
    """Tags that hear beacons."""
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.nodes.tag import Tags

    radios = open_radios(radio, "tag", names)
    compile_kernels(settings.method)
    return Tags(settings, radios, address, say).run()


def _on_sniffers(
    radio: str, names: tuple[str, ...], settings: "PacketTagSettings", address: "MqttAddress | None"
) -> "Coroutine[Any, Any, None]":
    """Tags that hear the packets of another system."""
    from skyless.evaluation.compile_ahead import compile_packet_kernels
    from skyless.nodes.packet_tags import PacketTags

    radios = open_sniffers(radio, names)
    compile_packet_kernels()
    return PacketTags(settings, radios, address, say, simulated=lambda: is_simulated(radio)).run()


def _system(
    table: Path | None, height: str | None, height_std_m: float | None, site: int | None, qa: float, publish_hz: float
) -> "PacketTagSettings":
    """What sniffers cannot hear. Raises SkylessError."""
    from skyless.evaluation.observability import GUESSED_STD_M, plane_height_m
    from skyless.nodes.packet_tags import TDOA_SITE, PacketTagSettings
    from skyless.recordings.anchor_table import read_anchors, read_calibration

    if table is None:
        raise SkylessError("--anchors is missing; a sniffer needs a table of the system's anchors: id,x_m,y_m,z_m")
    places, std_m = read_anchors(table), 0.0
    if height in (None, "auto"):
        height_m = plane_height_m(places)
        if height_m is not None:
            std_m = GUESSED_STD_M
            say(f"the anchors lie too flat to tell the height; tags are taken to be at theirs: --height {height_m:.2f}")
    else:
        height_m = None if height == "free" else _metres(str(height))
    see_that_a_height_is_given(height_std_m, height_m)
    return PacketTagSettings(
        places,
        site=TDOA_SITE if site is None else site,
        qa=qa,
        height_m=height_m,
        height_std_m=std_m if height_std_m is None else height_std_m,
        calibration=read_calibration(table),
        publish_hz=publish_hz,
    )


def _metres(height: str) -> float:
    try:
        return finite_numbers("height", height, (1,))[0]
    except SkylessError:
        raise SkylessError(f"--height is {height!r}; it should be metres, free or auto") from None
