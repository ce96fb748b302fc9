"""``skyless demo``: a site with broker, ether, anchors, tags, page, survey and recorder as processes, and its watch."""

import asyncio
import contextlib
from pathlib import Path
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.cli.watch import Watch
from skyless.core.integrity import RISK, IntegrityRequirement
from skyless.core.site import Site
from skyless.run.broker import Broker, BrokerSettings, start_broker
from skyless.run.children import Child, Program
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import StatusMessage, WrongMessageError, read_message
from skyless.run.mqtt.topics import site_topic, status_topic, survey_topic, watch_topic
from skyless.run.process import Log, hold_any, outlasting, reserve_next, together

_HOST: Final = "127.0.0.1"
_PAGE_PORT: Final = 8080
_TAGS_PER_PROCESS: Final = 25
_BROKER_RESTART_S: Final = 0.2
_KEEPALIVE_S: Final = 10
_CLEAR_S: Final = 0.5  # retained messages have come by then

_SURVEY_DELAY_S: Final = 4.0
"""Nothing else waits for the survey. Started with the others it would delay the first fix by a second on two cores."""


class SiteRun(Struct, frozen=True):
    """What to run."""

    site: Site
    site_name: str
    """Argument of the programs' ``--site``."""
    tags: int
    speed_mps: float
    noise_ps: float | None
    seed: int
    method: str
    integrity: IntegrityRequirement
    broker: MqttAddress | None
    """None: an embedded one."""
    record: Path | None
    record_limit_mb: float
    apart: bool
    """Whether every anchor and every tag is a process of its own."""
    recordings: Path
    """Folder of recordings that the page shows."""
    carrier: bool = False
    """Whether radios measure the phase of the carrier."""
    history: Path | None = None
    """Folder of the history; None: none is kept."""


class WholeSite:
    """Starts everything and keeps it alive."""

    def __init__(self, asked: SiteRun, log: Log) -> None:
        self._asked, self._log = asked, log
        self.ether_port, self._ether_held = hold_any(_HOST)
        self.page_port, self._page_held = reserve_next(_HOST, _PAGE_PORT)
        self.address: MqttAddress | None = asked.broker
        self.watch: Watch | None = None
        self.children: list[Child] = []
        self.ready = asyncio.Event()  # the broker is there and the page is starting

    @property
    def page(self) -> str:
        """Address of the page."""
        return f"http://{_HOST}:{self.page_port}"

    async def run(self) -> None:
        """Keep everything alive until cancelled.

        Raises:
            SkylessError: the embedded broker cannot be started.
        """
        with self._ether_held, self._page_held:
            if self._asked.broker is not None:
                whole = self._run_with(self._asked.broker, None)
                await outlasting(_cleared_at_the_end(self._asked.broker, self._asked.site.id, self._log), whole)
            else:
                broker = await start_broker(BrokerSettings(temporary=True))
                await self._run_with(broker.address, broker)

    async def _run_with(self, address: MqttAddress, broker: Broker | None) -> None:
        self.address = address
        site = self._asked.site
        link = Link(address, "demo", site=site.id, kind="watch")
        self.watch = Watch(link, site.id, planar=site.tags.height_m is not None)
        options: tuple[str, ...] = ("--recordings", str(self._asked.recordings), "--site-id", str(site.id))
        if self._asked.history is not None:
            options += ("--history", str(self._asked.history))
        command = ("dashboard", *_mqtt(address), "--listen", f"{_HOST}:{self.page_port}", *options)
        programs = [*self._programs(address), Program("page", command)]
        self.children = [Child(program, self._log) for program in programs]
        self.ready.set()
        nodes = outlasting(link.run(), together(*(child.run() for child in self.children)))  # its end is published
        await (nodes if broker is None else outlasting(self._keep(broker), nodes))  # they publish their end to it

    async def _keep(self, broker: Broker) -> None:
        """Start the embedded broker again, on the same port and with the same store, whenever it ends."""
        settings = BrokerSettings(port=broker.address.port, data=broker.data)
        try:
            while True:
                code = await broker.wait()
                self._log(f"broker ended (exit code {code}); started again")
                await broker.stop(to_restart=True)
                await asyncio.sleep(_BROKER_RESTART_S)
                broker = await start_broker(settings)
        finally:
            await asyncio.shield(broker.stop())

    def _programs(self, address: MqttAddress) -> list[Program]:
        """All but the page."""
        asked, mqtt = self._asked, _mqtt(address)
        radio = ("--radio", f"ether:{_HOST}:{self.ether_port}")
        site = ("--site", asked.site_name)
        ether = ["ether", *site, *mqtt, "--listen", f"{_HOST}:{self.ether_port}", "--tags", str(asked.tags)]
        ether += ["--speed", str(asked.speed_mps), "--seed", str(asked.seed)]
        if asked.noise_ps is not None:
            ether += ["--noise-ps", str(asked.noise_ps)]
        if asked.carrier:
            ether.append("--carrier")
        programs = [Program("ether", tuple(ether))]
        anchors = [str(anchor.id) for anchor in asked.site.anchors]
        programs += [
            Program(_named("anchor", some), ("anchor", *some, *site, *radio, *mqtt))
            for some in _groups(anchors, 1 if asked.apart else len(anchors))
        ]
        computing, integrity = ["--method", asked.method], asked.integrity
        if integrity.risk != RISK:
            computing += ["--integrity-risk", str(integrity.risk)]
        if integrity.alert_limit_m is not None:
            computing += ["--alert-limit-m", str(integrity.alert_limit_m)]
        if integrity.max_acceleration_mps2 > 0.0:
            computing += ["--max-acceleration", str(integrity.max_acceleration_mps2)]
        tags = [f"tag{number}" for number in range(1, asked.tags + 1)]
        programs += [
            Program(_named("tag", some), ("tag", *some, *radio, *mqtt, *computing))
            for some in _groups(tags, 1 if asked.apart else _TAGS_PER_PROCESS)
        ]
        survey = ("survey", "--serve", *mqtt, "--site-id", str(asked.site.id))
        programs.append(Program("survey", survey, start_after_s=_SURVEY_DELAY_S))
        if asked.record is not None:
            limit = ("--limit-mb", str(asked.record_limit_mb))
            programs.append(
                Program("recorder", ("record", str(asked.record), *mqtt, *limit, "--site-id", str(asked.site.id)), 1)
            )
        if asked.history is not None:
            to = ("--to", str(asked.history), "--site-id", str(asked.site.id))
            programs.append(Program("history", ("history", "run", *to, *mqtt), start_after_s=_SURVEY_DELAY_S))
        return programs


async def _cleared_at_the_end(address: MqttAddress, site: int, log: Log) -> None:
    """Wait until cancelled. Then clear what the site's programs, which have ended, have left retained at the broker."""
    try:
        await asyncio.Event().wait()
    finally:
        try:
            await asyncio.shield(_clear_retained(address, site))
        except (OSError, RefusedError) as error:
            log(f"{trouble_with(address, error)}: the demo's site stays there")


async def _clear_retained(address: MqttAddress, site: int) -> None:
    left: set[str] = set()

    def note(topic: str, payload: bytes) -> None:
        with contextlib.suppress(WrongMessageError):  # of another program than the demo's
            if payload and not (topic.endswith("/status") and read_message(payload, StatusMessage).online):
                left.add(topic)

    who = Introduction("", _KEEPALIVE_S)
    connection = await open_connection(address, address.tls_context(), who, Reactions(message=note))
    own = (site_topic(site), survey_topic(site), watch_topic(site), status_topic(site, "+", "+"))
    connection.subscribe(dict.fromkeys(own, 1))
    await asyncio.sleep(_CLEAR_S)
    for topic in left:
        connection.publish(topic, b"", 1, retain=True)
    await connection.leave()


def _mqtt(address: MqttAddress) -> tuple[str, ...]:
    """The options that name the broker. A password is in the programs' environment."""
    option = ("--mqtt", str(replace(address, password=None)))
    return option if address.ca is None else (*option, "--mqtt-ca", str(address.ca))


def _groups(names: list[str], size: int) -> list[list[str]]:
    return [names[first : first + size] for first in range(0, len(names), size)]


def _named(kind: str, names: list[str]) -> str:
    """The name of a process in messages."""
    return f"{kind} {names[0]}" if len(names) == 1 else f"{kind}s {names[0]} to {names[-1]}"
