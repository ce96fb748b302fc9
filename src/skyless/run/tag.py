"""``skyless tag``: one process with one or several tags, each with its own radio and its own MQTT connection."""

import asyncio
import re
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.motion_sample import MotionSample
from skyless.core.tag.receiver import NOT_DROPS, Receiver, SiteListener, TagReceiver
from skyless.core.trusted_receiver import GivenFix, SiteTrust, Trust, TrustedReceiver
from skyless.radio.interface import NOTABLE_SHARE, Gone, Hint, Radio, RadioEvent, Restarted
from skyless.radio.tag_reports import BoardFix, BoardReceiver, Reported
from skyless.run.fix_log import FIX_LEAVES_S, FixListener, FixLog, PhaseLog
from skyless.run.keys import Remembered, TagMemory, TagReport, trust_reason
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import NODE_KEEPALIVE_S, Link
from skyless.run.mqtt.messages import Counters, FixMessage, RequestMessage, TagHealth
from skyless.run.mqtt.topics import fix_topic, health_topic, receptions_topic, request_topic
from skyless.run.open_radio import RadioMonitor
from skyless.run.process import HEALTH_S, Log, Usage, data_folder, every, keep, reader, together
from skyless.run.recordings.reception_log import ReceptionLog, receiver_settings

RECEPTIONS_S: Final = 0.05
"""Interval at which raw receptions are checked for messages that are due."""

VERIFIED_S: Final = 2.0
"""Beacons received longer ago than this no longer count as verified."""

HealthListener = Callable[[TagHealth, SiteListener], None]
"""Called with a tag's state, and with its receiver, which knows the site."""


class TagSettings(Struct, frozen=True):
    """How a tag computes and what it publishes."""

    method: str = DEFAULT_METHOD
    site: int | None = None
    """The only site to listen to; None for the first that is heard."""
    integrity: IntegrityRequirement = IntegrityRequirement()
    publish_hz: float = 50.0
    """Largest rate of fixes on MQTT; ``serial`` counts all fixes."""
    trust: SiteTrust | None = None
    """Which beacons and fixes are accepted; None without the site's public key."""
    from_board: bool = False
    """Whether boards compute with settings of their own, so that only ``publish_hz`` is used here."""


class TagNode:
    """Runs a receiver on a radio. ``publish`` is called with the fixes to be published."""

    def __init__(
        self,
        settings: TagSettings,
        radio: Radio,
        publish: FixListener,
        log: Log,
        before: Callable[[TagReceiver, Reception], None] | None = None,
        clock: Callable[[], float] | None = None,
        memory: TagMemory | None = None,
    ) -> None:
        """``before`` is called before each reception with receiver and reception.

        ``clock`` gives the host's monotonic time in s, as ``host_s`` of the receptions; None for ``time.monotonic``.
        ``memory``: the site's keys known from earlier runs.
        """
        self.settings, self.radio = settings, radio
        self._before, self._clock = before, time.monotonic if clock is None else clock
        self.name = radio.name
        self._memory = memory
        self._trusted = self._new_trusted()
        self._receiver = self.new_receiver()
        self._board = BoardReceiver() if settings.from_board else None
        self._report = None if settings.trust is None else TagReport(radio.name, settings.trust.site, log)
        self._log, self._has_logged_multipath = log, False
        self._motion_note: str | None = None
        self.motion_counters: Counter[str] = Counter()
        """Unusable messages of the motion sensor, by reason."""
        self._heard_s = 0.0  # when the last reception was processed
        self.receptions = 0  # including those that were too old when their turn came
        self.fix_log = FixLog(self.name, publish, settings.publish_hz, self._clock)
        self.phases = PhaseLog()
        self.monitor = RadioMonitor(f"tag {self.name}", "listening", log, radio.advice)

    def new_receiver(self) -> AnyReceiver:
        """Create a receiver that has heard nothing yet."""
        asked = self.settings
        return AnyReceiver(asked.method, site=asked.site, integrity=asked.integrity)

    def _new_trusted(self) -> TrustedReceiver | None:
        """Create the receiver that verifies beacons, with the site's remembered keys; None without a public key."""
        asked = self.settings
        trust = asked.trust
        if trust is None:
            return None
        known = Remembered() if self._memory is None else self._memory.remembered
        newest = replace(trust, least_serial=max(trust.least_serial, known.serial))
        # Only protocol 2 has beacons that can be verified.
        return TrustedReceiver(newest, lambda: Receiver(site=asked.site, integrity=asked.integrity), known.certificates)

    @property
    def receiver(self) -> SiteListener:
        """The receiver whose fixes are published."""
        return self._hearing if self._board is None else self._board

    @property
    def _hearing(self) -> TagReceiver:
        return self._receiver if self._trusted is None else self._trusted.receiver

    @property
    def drops(self) -> Counter[str]:
        """Unusable receptions, by reason."""
        counters = self.receiver.counters.items()
        dropped = Counter({reason: count for reason, count in counters if reason not in NOT_DROPS})
        refused = Counter[str]() if self._trusted is None else self._trusted.counters
        return dropped + refused + self.radio.counters + self.fix_log.lateness.drops + self.motion_counters

    @property
    def reason(self) -> str:
        """Why there is no fix, if there is none."""
        trusted = self._trusted
        needs_trust = trusted is not None and trusted.trust.trust is not Trust.OPEN
        return (trust_reason(trusted) if trusted and needs_trust else None) or str(self.receiver.reason)

    @property
    def _multipath_m(self) -> tuple[float, float] | None:
        """The receiver's, unless the radio's line spoils so much that ranges say nothing about the site."""
        lost = self.radio.counters["lost-record"]
        return None if lost > NOTABLE_SHARE * (self.receptions + lost) else self.receiver.multipath_m

    def complete(self, health: TagHealth) -> TagHealth:
        """Add phases, multipath and verification to the health message."""
        trusted, phases = self._trusted, self.receiver.phase_anchors
        health = replace(
            health, phases=self.phases.last, carrier_phase_anchors=phases, on_board=self._board is not None
        )
        if (note := self.receiver.motion_note) is not None:
            health = replace(health, notes=(*health.notes, note))
        if (multipath := self._multipath_m) is not None:
            health = replace(health, multipath_std_m=multipath[0], multipath_distance_m=multipath[1])
        if trusted is None:
            return health
        return replace(
            health,
            trust=trusted.trust.trust.value,
            is_verified=self._is_verified(trusted),
            faults={str(anchor): str(fault) for anchor, fault in sorted(trusted.faults().items())},
            clock_error_s=trusted.verifier.clock.error_s,
        )

    def check_trust(self) -> None:
        """Log changes in the verification of beacons, and remember the site's keys."""
        trusted = self._trusted
        if trusted is None or self._report is None:
            return
        self._report.update(trusted, self._clock(), is_verified=self._is_verified(trusted))
        if self._memory is not None:
            self._memory.keep(trusted.verifier.keys.serial, trusted.verifier.keys.certificates)

    def _is_verified(self, trusted: TrustedReceiver) -> bool:
        return trusted.is_verified and self._clock() - self._heard_s < VERIFIED_S

    def hear_motion(self, sample: MotionSample) -> None:
        """Process what the tag's motion sensor shows, at a time of the host's monotonic clock."""
        self._hearing.hear_motion(sample)

    def check_reception(self, now_s: float) -> None:
        """Log likely causes if nothing usable is received and, once, if ranges vary more than the site file states.

        ``now_s`` is the host's monotonic clock.
        """
        self.monitor.check(now_s, self.receptions, self.receiver.counters["heard"], self.drops)
        note = self.receiver.motion_note
        kind = None if note is None else re.sub(r"[0-9.]+", "", note)
        if kind != self._motion_note:
            self._motion_note = kind
            self._log(f"tag {self.name}: {note or 'nothing is wrong with the motion sensor any more'}")
        if not self._has_logged_multipath and (found := self._multipath_m) is not None:
            self._has_logged_multipath = True
            std_m, distance_m = found
            self._log(
                f"tag {self.name}: ranges change by {100 * std_m:.0f} cm within {100 * distance_m:.0f} cm walked, more"
                f" than the site file states; place_std_m = {std_m:.2f} and place_distance_m = {distance_m:.2f} in its"
                " [accuracy] would let all tags start with that"
            )

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self.on_event)

    def on_event(self, event: RadioEvent) -> None:
        """Process an event of the radio."""
        if isinstance(event, Reception):
            self._receive(event)
        elif isinstance(event, Reported) and self._board is not None:
            self._take(event, self._board)
        elif isinstance(event, Restarted | Gone | Hint):
            self.monitor.on_event(event)
            if isinstance(event, Restarted) and self.receptions:
                self.check_trust()
                self._receiver, self._trusted = self.new_receiver(), self._new_trusted()
                self._board = self._board and BoardReceiver()

    def _receive(self, reception: Reception) -> None:
        self.receptions += 1
        if reception.host_s is not None and not self.fix_log.lateness.admits(reception.host_s, self._clock()):
            return
        if self._before is not None:
            self._before(self._hearing, reception)
        given = self._fixes_of(reception)
        done_s = self._heard_s = self._clock()
        due_s = done_s if reception.host_s is None else reception.host_s
        self.phases.add(reception.frame, due_s, done_s, made_fix=bool(given))
        for one in given:
            ended_s = one.reception.host_s
            self.fix_log.add(one.fix, due_s if ended_s is None else ended_s, done_s, due_s)

    def _take(self, event: Reported, board: BoardReceiver) -> None:
        report, fix = event.report, board.take(event.report)
        self.receptions = board.counters.total() - board.counters["fixes"]
        if fix is not None and isinstance(report, BoardFix):
            self.fix_log.add(fix, event.host_s - report.latency_s, event.host_s)

    def _fixes_of(self, reception: Reception) -> list[GivenFix]:
        """Process a reception, and return the fixes that it makes possible."""
        if self._trusted is not None:
            host_s = reception.host_s
            unix_s = time.time() if host_s is None else host_s + self.fix_log.unix_less_host_s
            return self._trusted.hear(reception, unix_s)
        fix = self._receiver.hear(reception)
        return [] if fix is None else [GivenFix(fix, reception)]


class Tag:
    """A tag and its link, which is made when the tag's site is known, and again at another site."""

    def __init__(
        self,
        settings: TagSettings,
        radio: Radio,
        address: MqttAddress | None,
        log: Log,
        on_fix: FixListener | None = None,
        on_health: HealthListener | None = None,
    ) -> None:
        """``on_fix`` and ``on_health`` are called with all fixes and states to publish, with or without a broker."""
        self._address, self._log, self._on_fix, self._on_health = address, log, on_fix, on_health
        self.link: Link | None = None
        self._site: int | None = None
        self._late_before = 0  # fixes that became too old in links to other sites
        self._link_tasks: list[asyncio.Task[None]] = []
        self._fix_topic = self._health_topic = self._receptions_topic = ""
        asked = receiver_settings(settings.method, settings.site, integrity=settings.integrity)
        self.reception_log = ReceptionLog(radio.name, asked, secrets.token_hex(4))
        memory = None if settings.trust is None else TagMemory(settings.trust, data_folder())
        self.node = TagNode(settings, radio, self._publish, log, self.reception_log.add, memory=memory)

    async def run(self) -> None:
        """Serve until cancelled."""
        try:
            await self.node.run()
        finally:
            for task in self._link_tasks:
                task.cancel()
            await asyncio.gather(*self._link_tasks, return_exceptions=True)

    def _publish(self, message: FixMessage) -> None:
        if self._on_fix is not None:
            self._on_fix(message)
        self._connect()
        if self.link is not None:
            self.link.publish(self._fix_topic, message, until_s=self.node.fix_log.due_s + FIX_LEAVES_S)

    def _connect(self) -> None:
        site = self.node.receiver.site
        if self._address is None or site is None or site == self._site:
            return
        for task in self._link_tasks:
            task.cancel()  # the link then publishes at the former site that the tag is offline
        self._link_tasks = [task for task in self._link_tasks if not task.done()]
        self._site = site
        self._late_before += 0 if self.link is None else self.link.late
        self.link = Link(self._address, self.node.name, site=site, kind="tag", keepalive_s=NODE_KEEPALIVE_S)
        self._fix_topic = fix_topic(site, self.node.name)
        self._health_topic = health_topic(site, "tag", self.node.name)
        self._receptions_topic = receptions_topic(site, self.node.name)
        count_wrong = partial(self.reception_log.counters.update, ("bad-request",))
        self.link.subscribe(request_topic(site), reader(RequestMessage, self._on_request, count_wrong))
        self._link_tasks.append(asyncio.ensure_future(keep(self.link, self._log)))

    def _on_request(self, request: RequestMessage) -> None:
        self.reception_log.request(request, time.monotonic())

    def publish_receptions(self) -> None:
        """Publish the requested raw receptions that are due."""
        if self.link is None:
            return
        unix_less_host_s = self.node.fix_log.unix_less_host_s
        while (message := self.reception_log.collect(time.monotonic(), unix_less_host_s)) is not None:
            self.link.publish(self._receptions_topic, message, qos=1)

    def publish_health(self, cpu: float, memory_bytes: int) -> None:
        """Publish the tag's state."""
        node = self.node
        node.fix_log.update_clock_offset()
        self._connect()
        node.check_reception(time.monotonic())
        node.check_trust()
        counted = node.fix_log.health(
            method=node.settings.method,
            receptions=node.receptions,
            reason=node.reason,
            counters=node.drops | self.reception_log.counters,
            mqtt=Counters(0, 0, 0) if self.link is None else self.link.counters,
            cpu=cpu,
            memory_bytes=memory_bytes,
            late_in_link=self._late_before + (0 if self.link is None else self.link.late),
        )
        health = node.complete(counted)
        if self._on_health is not None:
            self._on_health(health, node.receiver)
        if self.link is not None:
            self.link.publish(self._health_topic, health)


class Tags:
    """The tags of one process."""

    def __init__(
        self,
        settings: TagSettings,
        radios: Sequence[Radio],
        address: MqttAddress | None,
        log: Log,
        on_fix: FixListener | None = None,
        on_health: HealthListener | None = None,
    ) -> None:
        """``on_fix`` and ``on_health`` as in ``Tag``."""
        self.tags = tuple(Tag(settings, radio, address, log, on_fix, on_health) for radio in radios)
        self._usage = Usage()

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [tag.run() for tag in self.tags]
        await together(*parts, every(HEALTH_S, self._publish_health), every(RECEPTIONS_S, self._publish_receptions))

    def _publish_health(self) -> None:
        share, memory_bytes = self._usage.sample()
        for tag in self.tags:
            tag.publish_health(share / len(self.tags), memory_bytes)

    def _publish_receptions(self) -> None:
        for tag in self.tags:
            tag.publish_receptions()
