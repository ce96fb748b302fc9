"""``skyless anchor``: one process with one or several anchors, each with its own radio and its own MQTT connection."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

from skyless.master_election import Role
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link
from skyless.mqtt.messages import AnchorHealth, Counters, SiteMessage
from skyless.mqtt.topics import floor_plan_topic, health_topic, site_topic
from skyless.nodes.anchor import AnchorNode
from skyless.nodes.process.running import HEALTH_S, AskedAgain, Log, every, keep, link_of, together
from skyless.radios.interface import Radio
from skyless.site.model import Site

_ROLES: Final[dict[Role, Literal["master", "anchor", "listening"]]] = {
    Role.MASTER: "master",
    Role.FOLLOWER: "anchor",
    Role.LISTENING: "listening",
}


class Anchors:
    """The anchors of one process."""

    def __init__(
        self,
        site: Site,
        radios: Sequence[Radio],
        address: MqttAddress | None,
        say: Log,
        *,
        simulated: Callable[[], bool],
        floor_plan: Path | None = None,
    ) -> None:
        """``simulated`` is asked again when a radio has come back: something else may stand behind its port."""
        self._site, self._floor_plan, self._say = site, floor_plan, say
        self._simulated = AskedAgain(simulated)
        self.nodes = tuple(AnchorNode(site, int(radio.name), radio, say) for radio in radios)
        self._links = tuple(link_of(address, node.id, site=site.id, kind="anchor") for node in self.nodes)
        self._told_simulated: bool | None = None

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [node.run() for node in self.nodes]
        parts += [keep(link, self._say) for link in self._links if link is not None]
        await together(*parts, every(HEALTH_S, self._tell))

    def _tell(self) -> None:
        unix_s, now_s = time.time(), time.monotonic()
        simulated = self._simulated.at(sum(node.restarts for node in self.nodes))
        for node, link in zip(self.nodes, self._links, strict=True):
            node.look(now_s)
            if link is not None:
                if node.machine.is_master and simulated is not self._told_simulated:
                    self._tell_site(link, simulated, unix_s)
                link.publish(
                    health_topic(self._site.id, "anchor", node.id), health_of(node, link.counters, unix_s, now_s)
                )

    def _tell_site(self, link: Link, simulated: bool, unix_s: float) -> None:
        """The master tells the site; retained, so that whoever comes later knows it at once."""
        self._told_simulated = simulated
        message = SiteMessage(self._site, simulated, unix_s)
        link.publish(site_topic(self._site.id), message, qos=1, retain=True)
        if self._floor_plan is not None:
            link.publish(floor_plan_topic(self._site.id), self._floor_plan.read_bytes(), qos=1, retain=True)


def health_of(node: AnchorNode, mqtt: Counters, unix_s: float, now_s: float) -> AnchorHealth:
    """How an anchor does; ``now_s`` is the host's monotonic clock."""
    machine = node.machine
    state = machine.synchronisation
    now_ticks = node.radio.now_ticks()
    reading = None if now_ticks is None else machine.site_time(now_ticks)
    known = machine.is_master or (state.role is Role.FOLLOWER and state.beacons > 1)
    return AnchorHealth(
        anchor=node.id,
        unix_s=unix_s,
        uptime_s=now_s - node.started_s,
        role=_ROLES[state.role],
        master=state.master,
        term=state.term or 0,
        synchronised=known,
        offset_s=None if reading is None else reading[0],
        rate_ppm=state.rate_ppm if known else None,
        offset_std_m=state.offset_std_m if known else None,
        sent=machine.counters["sent"],
        late=node.late,
        heard=machine.counters["heard"],
        superframe=None if reading is None else reading[1],
        heard_age_s={str(anchor): now_s - heard_s for anchor, heard_s in sorted(node.heard_s.items())},
        counters=machine.counters | node.radio.counters,
        mqtt=mqtt,
    )
