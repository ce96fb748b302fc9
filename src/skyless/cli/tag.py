"""``skyless tag``: tags as a program."""

import contextlib
import re
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.nodes import DEFAULT_MQTT, Mqtt, MqttCa, broker, say
from skyless.cli.options import Positive, known_method
from skyless.errors import SkylessError
from skyless.methods import DEFAULT_METHOD
from skyless.radios.open import DEFAULT_RADIO

app = App(name="tag", help_epilogue="Example: skyless tag tag1")
_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


@app.default
def tag(
    *names: Annotated[str, Parameter(name="NAMES")],
    radio: str = DEFAULT_RADIO,
    method: str = DEFAULT_METHOD,
    qa: Positive = 0.3,
    publish_hz: Annotated[float, Parameter(validator=Number(gt=0, lte=1000))] = 50.0,
    site_id: Annotated[int | None, Parameter(validator=Number(gte=0, lt=0xFFFE))] = None,
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
        The tags' radio: ether:HOST:PORT is the emulated air of skyless ether, serial:PATH a board.
    method
        How positions are computed.
    qa
        Agility of the tags in m²/s³ (tracker).
    publish_hz
        Fixes a second and tag on MQTT at most.
    site_id
        The only site to listen to; by default the first one heard.
    mqtt
        Broker for fixes and health, or none.
    mqtt_ca
        Certificates (PEM) to trust for mqtts.
    """
    from skyless.experiments.warm import compile_kernels
    from skyless.nodes.loop import run
    from skyless.nodes.tag import TagSettings
    from skyless.nodes.tags import Tags
    from skyless.radios.open import open_radios

    address = broker(mqtt, mqtt_ca)
    if not names or len(set(names)) < len(names) or not all(map(_NAME.fullmatch, names)):
        given = repr(" ".join(names)) if names else "missing"
        raise SkylessError(
            f"NAMES is {given}; it should be one or more names, each once, of 1 to 32 letters, digits, - or _"
        )
    known_method(method)
    radios = open_radios(radio, "tag", names)
    compile_kernels(method)
    settings = TagSettings(method=method, qa=qa, site=site_id, publish_hz=publish_hz)
    with contextlib.suppress(KeyboardInterrupt):
        run(Tags(settings, radios, address, say).run(), punctual=True)
