"""``skyless anchor``: one process with one or several anchors, each with its own radio and its own MQTT connection."""

import asyncio
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec.structs import replace

from skyless.air.beacon import Malformed
from skyless.air.frames import decode_any
from skyless.air.reception import Reception
from skyless.anchor import Anchor
from skyless.anchors.authentication import BeaconAuthentication
from skyless.anchors.factory import AnyAnchor, new_anchor
from skyless.anchors.slots import SlotsAnchor
from skyless.constants import TICK_RATE_HZ
from skyless.errors import SkylessError
from skyless.master_election import Role
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link
from skyless.mqtt.messages import AnchorHealth, Counters, PlacementMessage, RequestMessage
from skyless.mqtt.topics import health_topic, placement_topic, request_topic, site_topic, stamps_topic
from skyless.nodes.keys.anchor_keys import KEYS_S, AnchorKeys
from skyless.nodes.keys.anchor_report import AnchorReport, recent_faults
from skyless.nodes.process import HEALTH_S, Log, SitePublisher, every, keep, link_of, together
from skyless.nodes.radio_monitor import RadioMonitor
from skyless.nodes.stamp_log import StampLog
from skyless.radios.interface import Gone, Late, Radio, RadioEvent, Restarted, Sent
from skyless.site.check import check_site
from skyless.site.digest import is_same_but_placed, largest_change_m, site_digest
from skyless.site.model import Site
from skyless.site.slots import superframe_ticks_of
from skyless.slot_claims import SlotRole
from skyless.ticks import difference

MAX_MOVE_M: Final = 0.5
"""How far a survey may move an anchor with keys from its place in the site file: its codes vouch for the new place."""

MAX_LEAD_S: Final = 8e-3
LEAD_GAIN: Final = 1.25
LEAD_LOSS: Final = 0.998
"""Frames are handed over as long before their RMARKERs as the radio asks for at first. A host that is late does so
earlier: by the gain with each late one, up to the maximum, and back by the loss with each one sent. The cost of an
earlier frame is relayed stamps that are older by as much."""

ASK_AGAIN_S: Final = 5e-3
LOST_ANSWER_S: Final = 0.25
"""A radio that has not reported the end of a frame within this time will not report it."""

STAMPS_S: Final = 0.05
"""Interval at which stamps are looked through for a message that is due."""

_NOT_DROPS: Final = frozenset({"heard", "sent", "takeover", "claim-change", "phase-change"})

_decode_request: Final = msgspec.json.Decoder(RequestMessage).decode
_decode_placement: Final = msgspec.json.Decoder(PlacementMessage).decode

_ROLES: Final[dict[Role | SlotRole, Literal["master", "root", "anchor", "listening"]]] = {
    Role.MASTER: "master",
    Role.FOLLOWER: "anchor",
    Role.LISTENING: "listening",
    SlotRole.ROOT: "root",
    SlotRole.FOLLOWER: "anchor",
    SlotRole.LISTENING: "listening",
}


class AnchorNode:
    """Runs the machine of an anchor on a radio."""

    def __init__(
        self,
        site: Site,
        anchor_id: int,
        radio: Radio,
        log: Log,
        keys: AnchorKeys | None = None,
        *,
        allow_placement: bool = False,
    ) -> None:
        """``keys``: of its site; None for an anchor that sends without codes, which a survey may move anywhere.

        ``allow_placement``: so it may one with keys.
        """
        self.site, self.id, self.radio = site, anchor_id, radio
        self._radio_site, self._log = site, log
        """The radio is configured with the antenna delays of this site, and keeps them."""
        self._may_move = keys is None or allow_placement
        self._keys, self._report = keys, AnchorReport(anchor_id, log)
        self.authentication: BeaconAuthentication | None = None
        self.machine = self._new_machine()
        self.stamps = StampLog(anchor_id, secrets.token_hex(4))
        self.refused = Counter[str]()
        """Messages on MQTT that could not be used."""
        self._fault = ""
        """Why the last placement was refused."""
        self.monitor = RadioMonitor(f"anchor {anchor_id}", "on the air", log, radio.advice)
        self.started_s = time.monotonic()
        self.late = 0
        self.transmissions = TransmissionCount(site)
        self.lead_s = radio.lead_s
        """How long before its RMARKER the next frame is made."""
        self.heard_s: dict[int, float] = {}
        """When each other anchor was last heard, by the host's monotonic clock."""
        self._others = frozenset(anchor.id for anchor in site.all_anchors) - {anchor_id}
        self._received = 0
        self._timer: asyncio.TimerHandle | None = None

    def _new_machine(self) -> AnyAnchor:
        if self._keys is not None:
            self.authentication = BeaconAuthentication(self.site, self._keys.chains)
        machine = new_anchor(self._radio_site, self.id, self.radio.lead_s, self.authentication)
        if self.site is not self._radio_site:
            machine.place(self.site)
        return machine

    def place(self, message: PlacementMessage) -> bool:
        """Adopt the positions and delays of a survey; True if the site is another one from now on.

        One that was made for another site than the present one is ignored, as others keep to what their files say.
        """
        present, offered = site_digest(self.site), site_digest(message.site)
        if offered == present:
            return False
        fault = None
        if present not in (message.before, *message.earlier):
            fault = f"they are for site file {message.before}, not {present}"
        elif not is_same_but_placed(self.site, message.site):
            fault = "its anchors, slots or schedule are not those of the site file"
        elif not self._may_move and (change_m := largest_change_m(self._radio_site, message.site)) > MAX_MOVE_M:
            fault = (
                f"they differ from the site file by {change_m:.2f} m, and anchors with keys adopt up to "
                f"{MAX_MOVE_M:g} m; put the new site file here, or start with --allow-placement"
            )
        else:
            try:
                check_site(message.site, Path("placement"))
            except SkylessError as error:
                fault = str(error)
        if fault is not None:
            self.refused["placement-refused"] += 1
            if fault != self._fault:
                self._fault = fault
                self._log(f"anchor {self.id}: a survey's positions are ignored: {fault}")
            return False
        self.site = replace(message.site, outline_m=self.site.outline_m)
        self.machine.place(self.site)
        self._log(f"anchor {self.id}: positions and antenna delays of the survey adopted ({offered})")
        return True

    def on_request(self, _topic: str, payload: bytes) -> None:
        """A subscriber requests stamps; a request that cannot be read is counted."""
        try:
            self.stamps.request(_decode_request(payload), time.monotonic())
        except msgspec.MsgspecError:
            self.refused["bad-request"] += 1

    async def run(self) -> None:
        """Serve until cancelled."""
        try:
            await self.radio.run(self.on_event)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    def on_event(self, event: RadioEvent) -> None:
        """Process an event of the radio."""
        if isinstance(event, Reception):
            self._received += 1
            accepted = self.machine.counters["heard"]
            self.machine.hear(event)
            if self.authentication is None or self.machine.counters["heard"] > accepted:
                self._note(event)
        elif isinstance(event, Sent):
            self.transmissions.sent += 1
            self.lead_s = max(self.lead_s * LEAD_LOSS, self.radio.lead_s)
            self._schedule()
        elif isinstance(event, Late):
            self.late += 1
            self.transmissions.missed += 1
            self.lead_s = min(self.lead_s * LEAD_GAIN, MAX_LEAD_S)
            self._wait(ASK_AGAIN_S, self._schedule)
        else:
            self.monitor.on_event(event)
            if isinstance(event, Restarted):
                self.machine = self._new_machine()
                self.stamps.restart(secrets.token_hex(4))
                self._schedule()
            elif isinstance(event, Gone):
                self._wait(None, self._schedule)

    def check_reception(self, now_s: float) -> None:
        """Log where to look if it receives nothing usable; ``now_s`` is the host's monotonic clock."""
        counters = self.machine.counters
        drops = Counter({reason: count for reason, count in counters.items() if reason not in _NOT_DROPS})
        self.monitor.check(now_s, self._received, counters["heard"], drops + self.radio.counters)

    def check_codes(self, unix_s: float, now_s: float) -> None:
        """Log what has changed of codes; ``now_s`` is the host's monotonic clock."""
        if self._keys is not None and self.authentication is not None:
            accepted_s = max(self.heard_s.values(), default=self.started_s)
            self._report.update(self.authentication, self._keys.present(unix_s), accepted_s, unix_s, now_s)

    def with_codes(self, health: AnchorHealth) -> AnchorHealth:
        """An anchor's state with what it knows of key chains and codes."""
        keys, authentication = self._keys, self.authentication
        if keys is None or authentication is None:
            return health
        fault = authentication.fault()
        return replace(
            health,
            chain=keys.present(health.unix_s),
            chain_ends_unix_s=keys.ends_s,
            code_fault=None if fault is None else fault.value,
            faults={
                str(other): why.value for other, why in sorted(recent_faults(authentication, health.unix_s).items())
            },
        )

    def _note(self, reception: Reception) -> None:
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed) or beacon.site != self.site.id or beacon.anchor not in self._others:
            return
        self.heard_s[beacon.anchor] = time.monotonic()
        self.stamps.add(beacon.anchor, beacon.tx_ticks, reception.rx_ticks)

    def _wait(self, seconds: float | None, then: Callable[[], None]) -> None:
        """Call a function later, instead of the one planned before; None plans nothing."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if seconds is None else asyncio.get_running_loop().call_later(seconds, then)

    def _schedule(self) -> None:
        """Ask the machine for its next transmission."""
        now_ticks = self.radio.now_ticks()
        if now_ticks is not None and self.authentication is not None:
            self.authentication.set_time(now_ticks, time.time())
        tx_ticks = None if now_ticks is None else self.machine.next_transmission_ticks(now_ticks)
        self.transmissions.plan(tx_ticks)
        if now_ticks is None or tx_ticks is None:
            self._wait(ASK_AGAIN_S, self._schedule)
            return
        ahead_s = difference(tx_ticks, now_ticks) / TICK_RATE_HZ - self.lead_s
        self._wait(max(ahead_s, 0.0), lambda: self._transmit(tx_ticks))

    def _transmit(self, tx_ticks: int) -> None:
        """Hand the frame to the radio, and ask again if it never reports the frame's end."""
        self._wait(LOST_ANSWER_S, self._schedule)
        self.radio.transmit(self.machine.transmission(tx_ticks))


class TransmissionCount:
    """Transmissions of an anchor that were sent and that were missed, with those that never came to be handed over."""

    def __init__(self, site: Site) -> None:
        self.sent = self.missed = 0
        plan = site.schedule
        self._interval_ticks = 0.0 if plan.mode == "free" else superframe_ticks_of(site) / plan.frames_per_node
        """Between two transmissions; 0 where they are at random instants."""
        self._planned_ticks: int | None = None

    def plan(self, tx_ticks: int | None) -> None:
        """The next transmission is planned, or may not be planned yet; slots that were passed over are missed."""
        before, self._planned_ticks = self._planned_ticks, tx_ticks
        if tx_ticks is not None and before is not None and self._interval_ticks:
            self.missed += max(0, round(difference(tx_ticks, before) / self._interval_ticks) - 1)

    def drain(self) -> float:
        """Share of transmissions since the last call that were missed."""
        planned = self.sent + self.missed
        share = self.missed / planned if planned else 0.0
        self.sent = self.missed = 0
        return share


class Anchors:
    """The anchors of one process."""

    def __init__(
        self,
        site: Site,
        radios: Sequence[Radio],
        address: MqttAddress | None,
        log: Log,
        *,
        simulated: Callable[[], bool],
        floor_plan: Path | None = None,
        keys: AnchorKeys | None = None,
        allow_placement: bool = False,
    ) -> None:
        """``simulated`` is asked again when a radio has restarted: its port may lead to another device."""
        self._site, self._log, self._keys = site, log, keys
        self._site_publisher = SitePublisher(site, simulated, floor_plan)
        self.nodes = tuple(
            AnchorNode(site, int(radio.name), radio, log, keys, allow_placement=allow_placement) for radio in radios
        )
        self._links = tuple(self._link(node, address) for node in self.nodes)

    def _link(self, node: AnchorNode, address: MqttAddress | None) -> Link | None:
        """An anchor's connection to the broker."""
        link = link_of(address, node.id, site=self._site.id, kind="anchor")
        if link is not None:
            link.subscribe(request_topic(self._site.id), node.on_request, qos=1)
            link.subscribe(placement_topic(self._site.id), lambda _, payload: self._on_placement(node, payload), qos=1)
        return link

    def _on_placement(self, node: AnchorNode, payload: bytes) -> None:
        """Let an anchor adopt a placement; one that cannot be read is counted."""
        if not payload:
            return  # it was withdrawn
        try:
            message = _decode_placement(payload)
        except msgspec.MsgspecError:
            node.refused["bad-placement"] += 1
            return
        if node.place(message):
            self._site_publisher.place(node.site)

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [node.run() for node in self.nodes]
        parts += [keep(link, self._log) for link in self._links if link is not None]
        parts += [every(HEALTH_S, self._publish_health), every(STAMPS_S, self._publish_stamps)]
        if self._keys is not None:
            parts.append(every(KEYS_S, self.update_keys))
        await together(*parts)

    def update_keys(self) -> None:
        """Use other key chains where their files have changed."""
        if self._keys is None:
            return
        if self._keys.update():
            for node in self.nodes:
                if node.authentication is not None:
                    node.authentication.set_chains(self._keys.chains)
        self._keys.warn(time.time())

    def _publish_stamps(self) -> None:
        """Publish the stamps that were requested and are due."""
        now_s, unix_s = time.monotonic(), time.time()
        for node, link in zip(self.nodes, self._links, strict=True):
            message = None if link is None else node.stamps.collect(now_s, unix_s)
            if link is not None and message is not None:
                link.publish(stamps_topic(self._site.id, node.id), message, qos=1)

    def healths(self, unix_s: float, now_s: float) -> list[AnchorHealth]:
        """State of all anchors since their last one; ``now_s`` is the host's monotonic clock."""
        pairs = zip(self.nodes, self._links, strict=True)
        return [
            health_of(node, Counters(0, 0, 0) if link is None else link.counters, unix_s, now_s) for node, link in pairs
        ]

    def _publish_health(self) -> None:
        """Health of all anchors, and the site by its master or root, or by the first anchor of each process."""
        unix_s, now_s = time.time(), time.monotonic()
        self._site_publisher.update(sum(node.monitor.restarts for node in self.nodes))
        for node, link in zip(self.nodes, self._links, strict=True):
            node.check_reception(now_s)
            node.check_codes(unix_s, now_s)
            if link is not None:
                if leads(node.machine, is_first=node is self.nodes[0]):
                    self._site_publisher.publish(link)
                else:  # another one does; what this one knows may become old
                    link.forget(site_topic(self._site.id))
                health = health_of(node, link.counters, unix_s, now_s)
                link.publish(health_topic(self._site.id, "anchor", node.id), health)


def leads(machine: AnyAnchor, *, is_first: bool) -> bool:
    """Whether an anchor publishes the site: the master or the root; in mode free the first of its process."""
    if isinstance(machine, Anchor):
        return machine.is_master
    return machine.synchronisation.role is SlotRole.ROOT if isinstance(machine, SlotsAnchor) else is_first


def health_of(node: AnchorNode, mqtt: Counters, unix_s: float, now_s: float) -> AnchorHealth:
    """State of an anchor since the last call; ``now_s`` is the host's monotonic clock."""
    machine = node.machine
    now_ticks = node.radio.now_ticks()
    health = AnchorHealth(
        anchor=node.id,
        unix_s=unix_s,
        uptime_s=now_s - node.started_s,
        role="anchor",
        master=None,
        term=None,
        synchronised=True,
        offset_s=None,
        rate_ppm=None,
        offset_std_m=None,
        sent=machine.counters["sent"],
        late=node.late,
        heard=machine.counters["heard"],
        superframe=None,
        heard_age_s={str(anchor): now_s - heard_s for anchor, heard_s in sorted(node.heard_s.items())},
        counters=machine.counters | node.radio.counters | node.refused,
        mqtt=mqtt,
        mode=node.site.schedule.mode,
        missed_share=node.transmissions.drain(),
    )
    if isinstance(machine, Anchor):
        return _with_master(health, machine, now_ticks)
    health = node.with_codes(health)
    return _with_root(health, machine, now_ticks) if isinstance(machine, SlotsAnchor) else health


def _with_master(health: AnchorHealth, machine: Anchor, now_ticks: int | None) -> AnchorHealth:
    """What an anchor of protocol 1 knows of its master."""
    state = machine.synchronisation
    reading = None if now_ticks is None else machine.site_time(now_ticks)
    known = machine.is_master or (state.role is Role.FOLLOWER and state.beacons > 1)
    return replace(
        health,
        role=_ROLES[state.role],
        master=state.master,
        term=state.term or 0,
        synchronised=known,
        offset_s=None if reading is None else reading[0],
        rate_ppm=state.rate_ppm if known else None,
        offset_std_m=state.offset_std_m if known else None,
        superframe=None if reading is None else reading[1],
    )


def _with_root(health: AnchorHealth, machine: SlotsAnchor, now_ticks: int | None) -> AnchorHealth:
    """What an anchor in slots knows of the slot time."""
    state = machine.synchronisation
    reading = None if now_ticks is None else machine.slot_time(now_ticks)
    return replace(
        health,
        role=_ROLES[state.role],
        term=state.term,
        synchronised=reading is not None,
        offset_s=None if reading is None else reading[0],
        rate_ppm=None if reading is None else state.rate_ppm,
        superframe=None if reading is None else reading[1],
        root=state.root,
        hop=state.hop,
        parents=state.parents,
    )
