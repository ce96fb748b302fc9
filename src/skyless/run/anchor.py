"""``skyless anchor``: one process with one or several anchors, each with its own radio and its own MQTT connection."""

import asyncio
import secrets
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, Literal

from msgspec.structs import replace

from skyless.core.air.frame import Malformed, Reception
from skyless.core.any_anchor import AnchorMachine, new_anchor
from skyless.core.any_receiver import decode_any
from skyless.core.errors import SkylessError
from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.protocol1.anchor import Role
from skyless.core.site import Site, is_same_but_placed, largest_change_m, site_digest
from skyless.core.ticks import TICK_RATE_HZ, difference
from skyless.radio.interface import Gone, Late, Radio, RadioEvent, Restarted, Sent
from skyless.radio.tag_reports import Reported
from skyless.run.keys import KEYS_S, AnchorKeys, AnchorReport
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    NOT_DROPS,
    AnchorHealth,
    Counters,
    Leases,
    PlacementMessage,
    RequestMessage,
    Stamp,
    StampsMessage,
)
from skyless.run.mqtt.topics import health_topic, placement_topic, request_topic, site_topic, stamps_topic
from skyless.run.open_radio import RadioMonitor
from skyless.run.process import HEALTH_S, Log, SitePublisher, every, keep, link_of, reader, together
from skyless.site.file.check import check_site

MAX_MOVE_M: Final = 0.5
"""How far a survey may move an anchor with keys from its place in the site file: its codes vouch for the place."""

MAX_LEAD_S: Final = 8e-3
MAX_LEAD_RATIO: Final = 1.6
LEAD_GAIN: Final = 1.25
LEAD_LOSS: Final = 0.998
"""The lead is the time between handing over a frame and its RMARKER. It begins with the radio's ``lead_s``, grows by
the gain with each late frame, up to the maximum or that multiple of the radio's, and shrinks by the loss with each
frame sent. A longer lead makes relayed stamps older."""

ASK_AGAIN_S: Final = 5e-3
LOST_ANSWER_S: Final = 0.25
"""A radio that has not reported the end of a frame within this time never will."""

STAMPS_S: Final = 0.05
"""Interval at which stamps are checked for a message that is due."""

STAMPS_INTERVAL_S: Final = 0.2
"""Stamps of this period go into one message."""

MAX_PENDING_STAMPS: Final = 4096
"""Largest number of uncollected stamps; beyond it the oldest are dropped and counted."""

_ROLES: Final[dict[Role, Literal["master", "anchor", "listening"]]] = {
    Role.MASTER: "master",
    Role.FOLLOWER: "anchor",
    Role.LISTENING: "listening",
}


class AnchorNode:
    """Runs an anchor's state machine on a radio."""

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
        """``keys`` is None for an anchor without codes, which a survey may move anywhere.

        ``allow_placement`` lets a survey move an anchor with keys anywhere, too.
        """
        self.site, self.id, self.radio = site, anchor_id, radio
        self._radio_site, self._log = site, log
        """The site whose antenna delays the radio is configured with, and keeps."""
        self._may_move = keys is None or allow_placement
        self._keys, self._report = keys, AnchorReport(anchor_id, log)
        self.authentication: BeaconAuthentication | None = None
        self.machine = self._new_machine()
        self.stamps = StampLog(anchor_id, secrets.token_hex(4))
        self.refused = Counter[str]()  # messages on MQTT that could not be used
        self._fault = ""  # why the last placement was refused
        self.monitor = RadioMonitor(f"anchor {anchor_id}", "on the air", log, radio.advice)
        self.started_s = time.monotonic()
        self.late = 0
        self.transmissions = TransmissionCount(self.machine.interval_ticks)
        self.lead_s = radio.lead_s  # how long before its RMARKER the next frame is made
        self.heard_s: dict[int, float] = {}  # when each other anchor was last heard, by the host's monotonic clock
        self._others = frozenset(anchor.id for anchor in site.all_anchors) - {anchor_id}
        self._received = 0
        self._timer: asyncio.TimerHandle | None = None

    def _new_machine(self) -> AnchorMachine:
        if self._keys is not None:
            self.authentication = BeaconAuthentication(self._keys.chains)
        machine = new_anchor(self._radio_site, self.id, self.radio.lead_s, self.authentication)
        if self.site is not self._radio_site:
            machine.place(self.site)
        return machine

    def place(self, message: PlacementMessage) -> bool:
        """Adopt a survey's positions and delays, unless they are for another site. Returns whether they were new."""
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
                f"they change a range by {change_m:.2f} m from the site file's, and anchors with keys adopt up to "
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
        self.site = replace(message.site, outline_m=self.site.outline_m, alarms=self.site.alarms)
        self.machine.place(self.site)
        self._log(f"anchor {self.id}: positions and antenna delays of the survey adopted ({offered})")
        return True

    def on_request(self, message: RequestMessage) -> None:
        """Process a subscriber's request for stamps."""
        self.stamps.request(message, time.monotonic())

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
            self.lead_s = min(self.lead_s * LEAD_GAIN, max(MAX_LEAD_S, MAX_LEAD_RATIO * self.radio.lead_s))
            self._wait(ASK_AGAIN_S, self._schedule)
        elif not isinstance(event, Reported):
            self.monitor.on_event(event)
            if isinstance(event, Restarted):
                self.machine = self._new_machine()
                self.stamps.restart(secrets.token_hex(4))
                self._schedule()
            elif isinstance(event, Gone):
                self._wait(None, self._schedule)

    def check_reception(self, now_s: float) -> None:
        """Log likely causes if the anchor receives nothing usable. ``now_s`` is the host's monotonic clock."""
        counters = self.machine.counters
        drops = Counter({reason: count for reason, count in counters.items() if reason not in NOT_DROPS})
        self.monitor.check(now_s, self._received, counters["heard"], drops + self.radio.counters)

    def check_codes(self, unix_s: float, now_s: float) -> None:
        """Log changes in the state of codes. ``now_s`` is the host's monotonic clock."""
        if self._keys is not None and self.authentication is not None:
            accepted_s = max(self.heard_s.values(), default=self.started_s)
            self._report.update(self.authentication, self._keys.present(unix_s), accepted_s, unix_s, now_s)

    def with_codes(self, health: AnchorHealth) -> AnchorHealth:
        """Add the state of key chains and codes to the health message."""
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
                str(other): why.value for other, why in sorted(authentication.recent_faults(health.unix_s).items())
            },
        )

    def _note(self, reception: Reception) -> None:
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed) or beacon.site != self.site.id or beacon.anchor not in self._others:
            return
        self.heard_s[beacon.anchor] = time.monotonic()
        self.stamps.add(beacon.anchor, beacon.tx_ticks, reception.rx_ticks, reception.carrier_phase_cycles)

    def _wait(self, seconds: float | None, then: Callable[[], None]) -> None:
        """Call a function later, replacing any call that is planned. None only cancels."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if seconds is None else asyncio.get_running_loop().call_later(seconds, then)

    def _schedule(self) -> None:
        """Ask the machine for its next transmission, and plan to hand it over."""
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
        """Hand the frame to the radio, and schedule again if it never reports the frame's end."""
        self._wait(LOST_ANSWER_S, self._schedule)
        self.radio.transmit(self.machine.transmission(tx_ticks))


class StampLog:
    """An anchor's stamps of frames from other anchors, kept while somebody requests them.

    No I/O and no clock: times are passed in, by any monotonic clock.
    """

    def __init__(self, anchor: int, run: str) -> None:
        """``run`` names this start of the anchor's counter."""
        self._anchor, self._run = anchor, run
        self._leases = Leases()
        self._pending: deque[Stamp] = deque()
        self._missed = 0
        self._sent_s = 0.0

    def request(self, message: RequestMessage, now_s: float) -> None:
        """Process a request. A request without ``stamps`` ends its sender's lease."""
        if message.stamps:
            self._leases.grant(message.by, message.lease_s, now_s)
        else:
            self._leases.end(message.by)

    def restart(self, run: str) -> None:
        """Discard what was not collected, because the anchor's counter has restarted."""
        self._run, self._missed = run, 0
        self._pending.clear()

    def add(self, anchor: int, tx_ticks: int, rx_ticks: int, phase_cycles: float | None = None) -> None:
        """Add a reception from another anchor: its stated TX stamp and the own RX stamp (40 bits), and the phase."""
        if not self._leases.are_held:
            return
        if len(self._pending) >= MAX_PENDING_STAMPS:
            self._pending.popleft()
            self._missed += 1
        rounded = None if phase_cycles is None else round(phase_cycles, 4) % 1.0  # short as text
        self._pending.append(Stamp(anchor, tx_ticks, rx_ticks, rounded))

    def collect(self, now_s: float, unix_s: float) -> StampsMessage | None:
        """Return the next message if due. It is empty if the anchor has received no other anchor."""
        self._leases.expire(now_s)
        if not self._leases.are_held:
            self._pending.clear()
            self._missed = 0
            return None
        if 0.0 <= now_s - self._sent_s < STAMPS_INTERVAL_S:
            return None
        self._sent_s = now_s
        message = StampsMessage(self._anchor, self._run, unix_s, tuple(self._pending), self._missed)
        self._pending.clear()
        self._missed = 0
        return message


class TransmissionCount:
    """Counts an anchor's transmissions that were sent, and those missed, including skipped slots."""

    def __init__(self, interval_ticks: float) -> None:
        self.sent = self.missed = 0
        self._interval_ticks = interval_ticks
        """Ticks between two transmissions; 0 if they are at random instants."""
        self._planned_ticks: int | None = None

    def plan(self, tx_ticks: int | None) -> None:
        """Note the next planned transmission; None if it is unknown. Skipped slots count as missed."""
        before, self._planned_ticks = self._planned_ticks, tx_ticks
        if tx_ticks is not None and before is not None and self._interval_ticks:
            self.missed += max(0, round(difference(tx_ticks, before) / self._interval_ticks) - 1)

    def drain(self) -> float:
        """Return the share of transmissions missed since the last call."""
        share = self.missed / max(self.sent + self.missed, 1)
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
        plans: Mapping[int | None, Path] | None = None,
        keys: AnchorKeys | None = None,
        allow_placement: bool = False,
    ) -> None:
        """``simulated`` is called again after each restart of a radio, as its port may lead to another device."""
        self._site, self._log, self._keys = site, log, keys
        self._site_publisher = SitePublisher(site, simulated, plans)
        self.nodes = tuple(
            AnchorNode(site, int(radio.name), radio, log, keys, allow_placement=allow_placement) for radio in radios
        )
        self._links = tuple(self._link(node, address) for node in self.nodes)

    def _link(self, node: AnchorNode, address: MqttAddress | None) -> Link | None:
        link = link_of(address, node.id, site=self._site.id, kind="anchor")
        if link is not None:
            asked = reader(RequestMessage, node.on_request, partial(node.refused.update, ("bad-request",)))
            placed = reader(
                PlacementMessage, partial(self._place, node), partial(node.refused.update, ("bad-placement",))
            )
            link.subscribe(request_topic(self._site.id), asked)
            link.subscribe(placement_topic(self._site.id), placed, qos=1)
        return link

    def _place(self, node: AnchorNode, message: PlacementMessage) -> None:
        """Let an anchor adopt a placement, and publish the resulting site."""
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
        """Reload key chains whose files have changed."""
        if self._keys is not None:
            if self._keys.update():
                for node in self.nodes:
                    if node.authentication is not None:
                        node.authentication.set_chains(self._keys.chains)
            self._keys.warn(time.time())

    def _publish_stamps(self) -> None:
        for node, link in zip(self.nodes, self._links, strict=True):
            if link is not None and (message := node.stamps.collect(time.monotonic(), time.time())) is not None:
                link.publish(stamps_topic(self._site.id, node.id), message, qos=1)

    def healths(self, unix_s: float, now_s: float) -> list[AnchorHealth]:
        """Return the state of all anchors since the last call. ``now_s`` is the host's monotonic clock."""
        pairs = zip(self.nodes, self._links, strict=True)
        return [
            health_of(node, Counters(0, 0, 0) if link is None else link.counters, unix_s, now_s) for node, link in pairs
        ]

    def _publish_health(self) -> None:
        """Publish the health of all anchors, and the site by the anchor that is responsible for it (``leads``)."""
        unix_s, now_s = time.time(), time.monotonic()
        self._site_publisher.update(sum(node.monitor.restarts for node in self.nodes))
        for node, link in zip(self.nodes, self._links, strict=True):
            node.check_reception(now_s)
            node.check_codes(unix_s, now_s)
            if link is not None:
                if leads(node.machine, is_first=node is self.nodes[0]):
                    self._site_publisher.publish(link)
                else:  # another anchor publishes it, and this one's copy may become outdated
                    link.forget(site_topic(self._site.id))
                health = health_of(node, link.counters, unix_s, now_s)
                link.publish(health_topic(self._site.id, "anchor", node.id), health)


def leads(machine: AnchorMachine, *, is_first: bool) -> bool:
    """Whether an anchor publishes the site: the master, or the first anchor of its process if there is no master."""
    state = machine.clock(None)
    return is_first if state is None else state.role is Role.MASTER


def health_of(node: AnchorNode, mqtt: Counters, unix_s: float, now_s: float) -> AnchorHealth:
    """State of an anchor since the last call. ``now_s`` is the host's monotonic clock."""
    machine = node.machine
    state = machine.clock(node.radio.now_ticks())
    is_known = state is not None and state.is_known
    health = AnchorHealth(
        anchor=node.id,
        unix_s=unix_s,
        uptime_s=now_s - node.started_s,
        role="anchor" if state is None else _ROLES[state.role],
        master=None if state is None else state.master,
        term=None if state is None else state.term or 0,
        synchronised=state is None or state.is_known,
        offset_s=None if state is None else state.offset_s,
        rate_ppm=state.rate_ppm if state is not None and is_known else None,
        offset_std_m=state.offset_std_m if state is not None and is_known else None,
        sent=machine.counters["sent"],
        late=node.late,
        heard=machine.counters["heard"],
        superframe=None if state is None else state.superframe,
        heard_age_s={str(anchor): now_s - heard_s for anchor, heard_s in sorted(node.heard_s.items())},
        counters=machine.counters | node.radio.counters | node.refused,
        mqtt=mqtt,
        mode=node.site.schedule.mode,
        missed_share=node.transmissions.drain(),
    )
    return node.with_codes(health)
