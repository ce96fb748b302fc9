"""Replay of a running site: every tag's receptions again, judged against the truth."""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, cast

import msgspec
import numpy as np
from msgspec import Struct, structs

from skyless.core.air.beacon import Beacon, encode
from skyless.core.air.frame import Diagnostics, Heard, Malformed, Reception
from skyless.core.air.masterless_packets import Packet
from skyless.core.any_receiver import AnyReceiver, decode_any
from skyless.core.errors import ConfigurationError
from skyless.core.fix import Fix
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.site import Site
from skyless.core.tag.receiver import NOT_DROPS
from skyless.core.ticks import WRAP_TICKS, wrap
from skyless.files import Drops
from skyless.research.replays.captures import OnFix, OnMeasured, ReplayReport, common_figures
from skyless.run.mqtt.messages import RawReception, ReceptionsMessage, SegmentStart
from skyless.run.recordings.reception_log import receiver_of
from skyless.run.recordings.recording import HostClock, McapRecording, tags_to_replay
from skyless.sim.evaluation.figures import FixSamples, Judged, figures_of
from skyless.site.tables import Truth

# A recorded site once more, as if its anchors had had other antenna delays.
#
# A node's TX stamp is what its counter shows plus its TX delay, its RX stamp the same less its RX delay. An anchor's
# clock rests on its RX stamps of the master and on the master's TX stamps, so its site time moves with all three.

_SITE_TIME_MASK: Final = (1 << 48) - 1


class DelayChange(Struct, frozen=True):
    """New minus old antenna delays of one anchor, ticks."""

    tx_ticks: int
    rx_ticks: int


_UNCHANGED: Final = DelayChange(0, 0)


def delay_changes(recorded: Site, wanted: Site) -> dict[int, DelayChange]:
    """Changes of the anchors that both sites have."""
    old = {anchor.id: anchor for anchor in recorded.anchors}
    return {
        new.id: DelayChange(
            new.tx_antenna_delay_ticks - old[new.id].tx_antenna_delay_ticks,
            new.rx_antenna_delay_ticks - old[new.id].rx_antenna_delay_ticks,
        )
        for new in wanted.anchors
        if new.id in old
    }


def with_delays(reception: Reception, changes: dict[int, DelayChange]) -> Reception:
    """The reception with its frame as the sender would have filled it."""
    beacon = decode_any(reception.frame)
    if isinstance(beacon, Malformed):
        return reception
    own = changes.get(beacon.anchor, _UNCHANGED)
    heard = tuple(_relay(one, own) for one in beacon.heard)
    tx_ticks = wrap(beacon.tx_ticks + own.tx_ticks)
    if isinstance(beacon, Beacon):
        frame = encode(structs.replace(beacon, tx_ticks=tx_ticks, heard=heard))
        return structs.replace(reception, frame=frame)
    master = changes.get(beacon.master, _UNCHANGED)
    later = master.tx_ticks if beacon.anchor == beacon.master else own.tx_ticks + own.rx_ticks + master.tx_ticks
    time = beacon.master_time
    if time is not None:
        time = structs.replace(time, tx_subticks_master=(time.tx_subticks_master + 256 * later) & _SITE_TIME_MASK)
    master_heard = None if beacon.master_heard is None else _relay(beacon.master_heard, own)
    changed = structs.replace(beacon, tx_ticks=tx_ticks, master_time=time, master_heard=master_heard, heard=heard)
    return structs.replace(reception, frame=protocol1_codec.encode(changed))


def _relay(heard: Heard, own: DelayChange) -> Heard:
    return structs.replace(heard, rx_ticks=wrap(heard.rx_ticks - own.rx_ticks))


# One tag of a recording once more: its receptions through a receiver with its settings.


class _Heard(Struct, frozen=True):
    """A reception whose time is unknown so far, and its fix if it made one."""

    reception: Reception
    fix: Fix | None


class TagReplay:
    """Processes the receptions of one tag in the order of the recording; each segment begins with a new receiver."""

    def __init__(
        self,
        tag: str,
        method: str | None = None,
        delays: dict[int, DelayChange] | None = None,
        integrity: IntegrityRequirement | None = None,
        stamps_only: bool = False,
    ) -> None:
        """``method`` and ``integrity``: instead of the tag's own; ``delays``: other antenna delays.

        ``stamps_only``: without phases.
        """
        self._delays, self._stamps_only = delays, stamps_only
        self._integrity = integrity
        self.tag = tag
        self.method = method
        """As recorded, once known, or as requested."""
        self.receptions = self.segments = 0
        self.begun_s: float | None = None
        """Unix time of the first reception."""
        self.samples = FixSamples()
        self.span_s = (0.0, 0.0)
        """First and last fix, Unix time."""
        self.anchors: Counter[int] = Counter()
        """How many fixes are of that many anchors."""
        self.drops: Drops = Counter()
        self.reason = "no-beacons"
        """The last reason for no fix."""
        self._asked = method
        self._receiver: AnyReceiver | None = None
        self._former: Counter[str] = Counter()
        """Counters of the receivers of earlier segments."""
        self._segment = ""
        self._next = 0
        self._clock: HostClock[_Heard] = HostClock()
        self.on_fix: OnFix | None = None
        """Gets each fix, with the end of its last frame, without the host's delays."""
        self.on_measured: OnMeasured | None = None
        """Gets each beacon as a packet without relays, and whether it made a fix."""

    def process(self, message: ReceptionsMessage) -> None:
        """Process a run of receptions, which gives the fixes that they, or earlier runs, make."""
        clock = self._clock
        fresh = self._unheard(message)
        if self._clock is not clock:
            self._tell(clock.rest())
        for raw in fresh:
            reception = reception_of(raw)
            if reception is None:
                self.drops["impossible-reception"] += 1
                continue
            self.receptions += 1
            if self._delays is not None:
                reception = with_delays(reception, self._delays)
            if self._stamps_only:
                reception = structs.replace(reception, carrier_phase_cycles=None)
            assert self._receiver is not None
            fix = self._receiver.hear(reception)
            self.reason = str(self._receiver.reason)
            self._tell(self._clock.add(reception, message.unix_less_host_s, _Heard(reception, fix)))

    def finish(self) -> None:
        """Give the last fixes, at the end of the recording."""
        self._tell(self._clock.rest())

    def _tell(self, found: list[tuple[_Heard, float]]) -> None:
        """Count and give the fixes of receptions whose Unix time is now known."""
        for made, unix_s in found:
            self.begun_s = unix_s if self.begun_s is None else self.begun_s
            if self.on_measured is not None:
                beacon, rx_ticks = decode_any(made.reception.frame), made.reception.rx_ticks
                if not isinstance(beacon, Malformed):
                    packet = Packet(None, beacon.anchor, beacon.sequence, beacon.tx_ticks, rx_ticks, ())
                    self.on_measured(self.tag, unix_s, packet, made.fix is not None)
            if made.fix is not None:
                self.span_s = (self.span_s[0] if self.samples.count else unix_s, unix_s)
                self.anchors[len(made.fix.anchors)] += 1
                self.samples.add(unix_s, made.fix)
                if self.on_fix is not None:
                    self.on_fix(self.tag, unix_s, made.fix)

    def all_drops(self) -> dict[str, int]:
        """What could not be used, by reason, including the receiver's own."""
        own = self._former if self._receiver is None else self._former + self._receiver.counters
        total = self.drops + Counter({reason: n for reason, n in own.items() if reason not in NOT_DROPS})
        return {str(reason): number for reason, number in sorted(total.items()) if number}

    def _unheard(self, message: ReceptionsMessage) -> tuple[RawReception, ...]:
        """The new receptions of a message, which may come twice, or after a loss."""
        if message.segment != self._segment:
            if message.start is None:
                self.drops["receptions-without-beginning"] += len(message.receptions)
                return ()
            self._begin(message.segment, message.start)
        skip = self._next - message.first
        if skip < 0:
            self.drops["gap-in-receptions"] += 1
        self._next = max(self._next, message.first + len(message.receptions))
        return message.receptions[max(skip, 0) :]

    def _begin(self, segment: str, start: SegmentStart) -> None:
        self._segment, self._next = segment, 0
        self.segments += 1
        self._clock = HostClock()
        if self._receiver is not None:
            self._former.update(self._receiver.counters)
        self._receiver = receiver_of(start.settings, self._asked, self._integrity)
        if self._receiver is None:
            self.drops["impossible-settings"] += 1
            self._receiver = AnyReceiver(self._asked or DEFAULT_METHOD, integrity=self._integrity)
        self.method = self._asked or str(start.settings.get("method"))


def reception_of(raw: RawReception) -> Reception | None:
    """A recorded reception; None if no radio can have made it."""
    if not 0 <= raw.rx_ticks < WRAP_TICKS or (raw.host_s is not None and not abs(raw.host_s) < 1e12):
        return None
    phase_cycles = raw.carrier_phase_cycles
    if phase_cycles is not None and not 0.0 <= phase_cycles < 1.0:
        return None
    diagnostics = Diagnostics(raw.rx_power_dbm, raw.first_path_power_dbm, raw.carrier_offset_ppm)
    measured = None if diagnostics == Diagnostics() else diagnostics
    return Reception(raw.frame, raw.rx_ticks, raw.host_s, measured, phase_cycles)


# Replay of a running site: every tag's receptions once more, judged against the truth.

SITE_FORMAT: Final = "skyless-mcap"


class TagReport(ReplayReport, frozen=True, kw_only=True):
    """Result of a tag's replay; times are Unix seconds."""

    tag: str
    segments: int
    """Runs of receptions without a gap."""
    mean_anchors: float | None
    """Number of anchors in a fix."""
    most_anchors: int


class SiteReplay:
    """All tags of a recording, or some of them."""

    def __init__(
        self,
        recording: McapRecording,
        tags: Iterable[str] | None = None,
        method: str | None = None,
        settle_s: float = 2.0,
        above_m: float | None = None,
        wanted: Site | None = None,
        integrity: IntegrityRequirement | None = None,
        stamps_only: bool = False,
    ) -> None:
        """Replay as the tags computed, or otherwise.

        ``method`` and ``integrity`` are used instead of the tags' own, the antenna delays of ``wanted`` instead of the
        anchors' own, and no phases with ``stamps_only``.

        Raises ConfigurationError: the recording has no raw receptions, none of such a tag, or is of another site.
        """
        summary = recording.summary()
        raw_tags = tags_to_replay(summary)
        for tag in tags or ():
            if tag not in raw_tags:
                raise ConfigurationError(summary.path, "tag", tag, f"one of {', '.join(raw_tags)}")
        self._recording = recording
        self._settle_s, self._above_m = settle_s, above_m
        site = recording.site
        self.height_m = None if site is None else site.site.tags.height_m
        self._begin_s = summary.start_s or 0.0
        self._truth = recorded_truth(recording)
        delays = None
        if wanted is not None:
            delays = delay_changes(recorded_site(recording, wanted.id), wanted)
        self.tags = {tag: TagReplay(tag, method, delays, integrity, stamps_only) for tag in tags or summary.raw_tags}

    def run(
        self,
        on_fix: OnFix | None,
        on_progress: Callable[[float], None],
        on_measured: OnMeasured | None = None,
    ) -> list[TagReport]:
        """Replay all; ``on_progress`` gets now and then the recording's seconds done so far."""
        begun_s = time.perf_counter()
        for replay in self.tags.values():
            replay.on_fix, replay.on_measured = on_fix, on_measured
        for number, found in enumerate(self._recording.messages({"receptions"})):
            if (heard := self.tags.get(found.channel.name)) is not None:
                heard.process(cast("ReceptionsMessage", found.message))
            if number % 256 == 0:
                on_progress(found.time_s - self._begin_s)
        for replay in self.tags.values():
            replay.finish()
        wall_s = time.perf_counter() - begun_s
        return [self._report(tag, wall_s) for tag in self.tags]

    def judged(self, tag: str) -> Judged:
        """Which fixes of a tag are judged."""
        replay = self.tags[tag]
        return Judged(
            truth=self._truth.get(tag),
            begin_s=replay.begun_s,
            end_s=replay.span_s[1],
            planar=self.height_m is not None,
            settle_s=self._settle_s,
            above_m=self._above_m,
        )

    def _report(self, tag: str, wall_s: float) -> TagReport:
        replay = self.tags[tag]
        fixes, (first_s, last_s) = replay.samples.count, replay.span_s
        figures = figures_of(replay.samples.table(), self.judged(tag), fixes)
        return TagReport(
            format=SITE_FORMAT,
            **common_figures(figures, replay.receptions, fixes, replay.all_drops(), wall_s),
            rate_hz=fixes / (last_s - first_s) if last_s > first_s else None,
            height_m=self.height_m,
            reason=None if fixes else replay.reason,
            tag=tag,
            method=replay.method,
            segments=replay.segments,
            mean_anchors=sum(count * number for count, number in replay.anchors.items()) / fixes if fixes else None,
            most_anchors=max(replay.anchors, default=0),
        )


def summary_of(reports: Sequence[TagReport]) -> dict[str, Any]:
    """One tag's report like that of any other recording; for several tags, sums and the reports by tag."""
    if len(reports) == 1:
        return {**msgspec.to_builtins(reports[0]), "height_note": "from the site"}
    return {
        "format": reports[0].format,
        "receptions": sum(report.receptions for report in reports),
        "fixes": sum(report.fixes for report in reports),
        "dropped": sum(report.dropped for report in reports),
        "wall_s": reports[0].wall_s,
        "tags": {report.tag: msgspec.to_builtins(report) for report in reports},
    }


def recorded_site(recording: McapRecording, identifier: int | None = None) -> Site:
    """The site of a recording.

    Raises ConfigurationError: the recording lacks its site, or has another one than ``identifier``.
    """
    found = recording.site
    if found is None:
        raise ConfigurationError(recording.summary().path, "the site", None, "in the recording")
    if identifier is not None and found.site.id != identifier:
        raise ConfigurationError(
            recording.summary().path, "the site's id", found.site.id, f"{identifier}, as in --site"
        )
    return found.site


def recorded_truth(recording: McapRecording) -> dict[str, Truth]:
    """True positions of each tag by Unix time; times that go back are left out."""
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    for moment in recording.truth():
        for tag, motion in moment.tags.items():
            known = rows[tag]
            if not known or moment.unix_s > known[-1][0]:
                known.append((moment.unix_s, *motion.position_m))
    tables = {tag: np.array(known) for tag, known in rows.items()}
    return {tag: Truth(table[:, 0], table[:, 1:], None) for tag, table in tables.items()}
