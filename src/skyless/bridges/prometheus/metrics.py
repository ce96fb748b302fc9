"""The figures of a site as they are at the moment of a scrape. No I/O; the time is passed in.

Counters only rise, also where a tag or an anchor has been started again. Ages are those of the moment. Other gauges are
given while what they come from is fresh, so that nothing old looks present.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, TypeVar

import skyless
from skyless.bridges.feed import BridgedSite
from skyless.bridges.prometheus.exposition import Labels, Sample, family, histograms
from skyless.bridges.target_url import TAG_NAME
from skyless.mqtt.messages import AnchorHealth, Counters, FixMessage, StatusMessage, TagHealth

GAUGE_AGE_S: Final = 5.0
"""Gauges of an older fix or an older health are not given."""

LATENCY_BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)

_FIXES: Final = "skyless_tag_fixes_total"

_MOST_NAMES: Final = 2000
_MOST_REASONS: Final = 50
"""Reasons of dropped frames that are counted for one node."""


class Rising:
    """A counter of a node that begins at 0 whenever the node is started."""

    def __init__(self) -> None:
        self._before = self._now = 0

    @property
    def total(self) -> int:
        """Over all of the node's runs."""
        return self._before + self._now

    def update(self, value: int, *, restarted: bool = False) -> None:
        """Its value in the node's present run; a lower one than before, without a restart, is a late message's."""
        if restarted:
            self._before, self._now = self.total, 0
        self._now = max(self._now, value)


class _Node:
    """Counters of a tag or an anchor, and when it was heard of."""

    def __init__(self) -> None:
        self.online: bool | None = None
        """None as long as nobody has said."""
        self.uptime_s = 0.0
        self.health_s = 0.0
        """When its last health came."""
        self.counters: dict[str, Rising] = {}
        """By the metric's name."""
        self.dropped: dict[str, Rising] = {}

    def update(
        self, uptime_s: float, now_s: float, values: Mapping[str, int], dropped: Mapping[str, int], mqtt: Counters
    ) -> None:
        """Process the counters of its health."""
        restarted = uptime_s < self.uptime_s
        self.uptime_s, self.health_s = uptime_s, now_s
        link = {
            "skyless_mqtt_published_total": mqtt.published,
            "skyless_mqtt_dropped_total": mqtt.dropped,
            "skyless_mqtt_reconnects_total": mqtt.reconnects,
        }
        for name, value in {**values, **link}.items():
            self.counters.setdefault(name, Rising()).update(value, restarted=restarted)
        for reason, value in dropped.items():
            if reason in self.dropped or len(self.dropped) < _MOST_REASONS:
                self.dropped.setdefault(reason, Rising()).update(value, restarted=restarted)


class _Tag(_Node):
    """What is known of a tag."""

    def __init__(self) -> None:
        super().__init__()
        self.health: TagHealth | None = None
        self.fix: FixMessage | None = None
        self.fix_s = 0.0
        """When the last fix ended, by the clock of arrivals."""
        self.latency_counts = [0] * (len(LATENCY_BOUNDS_S) + 1)
        self.latency_sum_s = 0.0


class _Anchor(_Node):
    """What is known of an anchor."""

    def __init__(self) -> None:
        super().__init__()
        self.health: AnchorHealth | None = None


_N = TypeVar("_N", bound=_Node)


class SiteMetrics:
    """Gathers the figures of one site."""

    def __init__(self, *, positions: bool = False) -> None:
        """``positions``: whether to give where tags are."""
        self.dropped: Counter[str] = Counter()
        """Messages of nodes that are not counted, by reason."""
        self._positions = positions
        self._site: BridgedSite | None = None
        self._tags: dict[str, _Tag] = {}
        self._anchors: dict[str, _Anchor] = {}

    def on_site(self, site: BridgedSite) -> None:
        """The site is known, or has changed."""
        self._site = site

    def on_fix(self, fix: FixMessage, now_s: float) -> None:
        """A usable fix, which comes at ``now_s`` of the clock of ``text``."""
        tag = self._known(self._tags, fix.tag, _Tag)
        if tag is None:
            return
        latency_s = max(fix.latency_s, 0.0)
        tag.fix, tag.fix_s = fix, now_s - latency_s
        tag.counters.setdefault(_FIXES, Rising()).update(fix.serial)
        tag.latency_counts[bisect_left(LATENCY_BOUNDS_S, latency_s)] += 1
        tag.latency_sum_s += latency_s

    def on_health(self, health: TagHealth | AnchorHealth, now_s: float) -> None:
        """State of a tag or an anchor."""
        if isinstance(health, TagHealth):
            tag = self._known(self._tags, health.tag, _Tag)
            if tag is not None:
                tag.health = health
                values = {
                    _FIXES: health.fixes,
                    "skyless_tag_receptions_total": health.receptions,
                    "skyless_tag_late_total": health.late,
                }
                tag.update(health.uptime_s, now_s, values, health.counters, health.mqtt)
            return
        anchor = self._known(self._anchors, str(health.anchor), _Anchor)
        if anchor is not None:
            anchor.health = health
            values = {
                "skyless_anchor_sent_total": health.sent,
                "skyless_anchor_late_total": health.late,
                "skyless_anchor_heard_total": health.heard,
            }
            anchor.update(health.uptime_s, now_s, values, health.counters, health.mqtt)

    def on_status(self, status: StatusMessage) -> None:
        """A tag or an anchor has come or gone."""
        node: _Node | None = None
        if status.kind == "tag":
            node = self._known(self._tags, status.name, _Tag)
        elif status.kind == "anchor":
            node = self._known(self._anchors, status.name, _Anchor)
        if node is not None:
            node.online = status.online

    def _known(self, nodes: dict[str, _N], name: str, make: type[_N]) -> _N | None:
        """The node of a name, a new one where there is none; None for what is no name, and where there are too many."""
        if name not in nodes:
            if not TAG_NAME.fullmatch(name):
                self.dropped["name"] += 1
            elif len(nodes) >= _MOST_NAMES:
                self.dropped["too-many-names"] += 1
            else:
                nodes[name] = make()
        return nodes.get(name)

    def text(self, now_s: float) -> str:
        """All of it in Prometheus's format."""
        lines = [*self._site_lines(), *self._tag_lines(now_s), *self._anchor_lines(now_s), *self._link_lines()]
        return "\n".join([*lines, ""])

    def _site_lines(self) -> list[str]:
        if self._site is None:
            return []
        labels = {
            "site": str(self._site.id),
            "name": self._site.name,
            "simulated": str(self._site.simulated).lower(),
            "version": skyless.__version__,
        }
        return family("skyless_site_info", "gauge", "The site, as labels; the value is 1.", [(labels, 1)])

    def _tag_lines(self, now_s: float) -> Iterator[str]:
        tags = [({"tag": name}, tag) for name, tag in sorted(self._tags.items())]
        fixed = [(labels, fix, now_s - tag.fix_s) for labels, tag in tags if (fix := tag.fix) is not None]
        fresh = [(labels, fix) for labels, fix, age_s in fixed if age_s <= GAUGE_AGE_S]
        healthy = [(labels, tag.health) for labels, tag in tags if tag.health and now_s - tag.health_s <= GAUGE_AGE_S]
        yield from family("skyless_tag_online", "gauge", "Whether the tag's program is connected.", _online(tags))
        for name, text in (
            (_FIXES, "Fixes that the tag has made."),
            ("skyless_tag_receptions_total", "Beacons that the tag has received."),
            ("skyless_tag_late_total", "Receptions and fixes of the tag that were dropped because they were too old."),
        ):
            yield from family(name, "counter", text, _totals(tags, name))
        text = "Frames that the tag has dropped, by reason."
        yield from family("skyless_tag_dropped_frames_total", "counter", text, _dropped(tags))
        text = "From the end of a fix's last frame to the fix; of those fixes that came to the bridge."
        latencies = [(labels, tag.latency_counts, tag.latency_sum_s) for labels, tag in tags if tag.fix is not None]
        yield from histograms("skyless_tag_latency_seconds", text, LATENCY_BOUNDS_S, latencies)
        text = "Time since the tag's last usable fix."
        yield from _gauge(
            "skyless_tag_fix_age_seconds", text, [(labels, max(age_s, 0.0)) for labels, _, age_s in fixed]
        )
        text = "One-sigma radial error of the tag's last fix."
        yield from _gauge("skyless_tag_error_std_metres", text, [(labels, fix.std_m) for labels, fix in fresh])
        text = "Anchors that the tag's last fix used."
        yield from _gauge("skyless_tag_anchors", text, [(labels, len(fix.anchors)) for labels, fix in fresh])
        text = "Position dilution of precision of the tag's last fix."
        yield from _gauge("skyless_tag_pdop", text, [(labels, fix.pdop) for labels, fix in fresh])
        text = "Protection level of the tag's last fix, horizontal or vertical."
        levels = [
            ({**labels, "axis": axis}, value)
            for labels, fix in fresh
            for axis, value in (("horizontal", fix.hpl_m), ("vertical", fix.vpl_m))
        ]
        yield from _gauge("skyless_tag_protection_level_metres", text, levels)
        text = "Share of a processor core that the tag uses."
        yield from _gauge("skyless_tag_cpu_ratio", text, [(labels, health.cpu) for labels, health in healthy])
        text = "Resident memory of the tag's process."
        yield from _gauge(
            "skyless_tag_memory_bytes", text, [(labels, health.memory_bytes) for labels, health in healthy]
        )
        yield from _trust_lines([(labels, health) for labels, health in healthy if health.trust is not None], fresh)
        if self._positions:
            text = "Position of the tag's last fix in the site's frame."
            positions = [
                ({**labels, "axis": axis}, value)
                for labels, fix in fresh
                for axis, value in zip("xyz", fix.position_m, strict=True)
            ]
            yield from _gauge("skyless_tag_position_metres", text, positions)

    def _anchor_lines(self, now_s: float) -> Iterator[str]:
        anchors = [({"anchor": name}, anchor) for name, anchor in sorted(self._anchors.items())]
        known = [(labels, health, now_s - a.health_s) for labels, a in anchors if (health := a.health) is not None]
        fresh = [(labels, health) for labels, health, age_s in known if age_s <= GAUGE_AGE_S]
        text = "Whether the anchor's program is connected."
        yield from family("skyless_anchor_online", "gauge", text, _online(anchors))
        for name, text in (
            ("skyless_anchor_sent_total", "Beacons that the anchor has sent."),
            ("skyless_anchor_late_total", "Transmissions of the anchor that came too late and were skipped."),
            ("skyless_anchor_heard_total", "Beacons of other anchors that the anchor has received."),
        ):
            yield from family(name, "counter", text, _totals(anchors, name))
        text = "Frames that the anchor has dropped, by reason."
        yield from family("skyless_anchor_dropped_frames_total", "counter", text, _dropped(anchors))
        text = "Time since the anchor's last health message."
        yield from _gauge(
            "skyless_anchor_health_age_seconds", text, [(labels, max(age_s, 0.0)) for labels, _, age_s in known]
        )
        text = "Whether the anchor follows the site's time, so that it may send."
        yield from _gauge(
            "skyless_anchor_synchronised", text, [(labels, float(health.synchronised)) for labels, health in fresh]
        )
        text = "Standard deviation of the anchor's clock against the site's time, as a distance."
        yield from _gauge(
            "skyless_anchor_offset_std_metres", text, [(labels, health.offset_std_m) for labels, health in fresh]
        )
        text = "Rate of the anchor's clock against the site's time, as a share."
        rates = [(labels, None if h.rate_ppm is None else h.rate_ppm * 1e-6) for labels, h in fresh]
        yield from _gauge("skyless_anchor_rate_ratio", text, rates)
        text = "Share of the anchor's transmissions of the last second that came too late."
        yield from _gauge(
            "skyless_anchor_missed_ratio", text, [(labels, health.missed_share) for labels, health in fresh]
        )
        text = "Whether the beacons of an anchor with keys have codes."
        keyed = [(labels, h) for labels, h in fresh if h.chain is not None or h.code_fault is not None]
        yield from _gauge("skyless_anchor_codes", text, [(labels, float(h.code_fault is None)) for labels, h in keyed])
        text = "When the anchor's last key chain ends, in Unix time."
        ends = [(labels, health.chain_ends_unix_s) for labels, health in fresh]
        yield from _gauge("skyless_anchor_chain_end_timestamp_seconds", text, ends)
        text = "Other anchors whose beacons an anchor with keys has lately not accepted, by fault."
        yield from _gauge("skyless_anchor_not_accepted", text, _faults([(labels, h.faults) for labels, h in keyed]))

    def _link_lines(self) -> Iterator[str]:
        groups: tuple[tuple[str, Mapping[str, _Node]], ...] = (("tag", self._tags), ("anchor", self._anchors))
        nodes = [({"kind": kind, "name": name}, node) for kind, group in groups for name, node in sorted(group.items())]
        for name, text in (
            ("skyless_mqtt_published_total", "Messages that the node has sent to the broker."),
            ("skyless_mqtt_dropped_total", "Messages that the node dropped because the broker was slow or away."),
            ("skyless_mqtt_reconnects_total", "Connections that the node has made again."),
        ):
            yield from family(name, "counter", text, _totals(nodes, name))


def _trust_lines(
    trusting: Iterable[tuple[Labels, TagHealth]], fresh: Iterable[tuple[Labels, FixMessage]]
) -> Iterator[str]:
    """Of tags with the site's public key."""
    trusting = list(trusting)
    names = {labels["tag"] for labels, _ in trusting}
    text = "Whether beacons that a tag with the site's public key received lately are verified."
    yield from _gauge("skyless_tag_verified", text, [(labels, float(h.is_verified)) for labels, h in trusting])
    text = "Share of the last second's beacons that were verified when the tag's last fix was made."
    shares = [(labels, 1.0 - fix.unverified) for labels, fix in fresh if labels["tag"] in names]
    yield from _gauge("skyless_tag_verified_ratio", text, shares)
    text = "How far the clock of the tag's host is ahead of the site's, where that is more than its bound."
    yield from _gauge("skyless_tag_clock_error_seconds", text, [(labels, h.clock_error_s) for labels, h in trusting])
    text = "Anchors whose beacons the tag has lately not accepted, by fault."
    yield from _gauge("skyless_tag_not_accepted", text, _faults([(labels, h.faults) for labels, h in trusting]))


def _faults(nodes: Iterable[tuple[Labels, Mapping[str, str]]]) -> list[tuple[Labels, float]]:
    """The number of anchors for each fault that a node states."""
    return [
        ({**labels, "reason": fault}, count)
        for labels, faults in nodes
        for fault, count in sorted(Counter(faults.values()).items())[:_MOST_REASONS]
    ]


def _gauge(name: str, text: str, values: Iterable[tuple[Labels, float | None]]) -> list[str]:
    samples = [(labels, float(value)) for labels, value in values if value is not None]
    return family(name, "gauge", text, samples)


def _online(nodes: Iterable[tuple[Labels, _Node]]) -> list[Sample]:
    return [(labels, int(node.online)) for labels, node in nodes if node.online is not None]


def _totals(nodes: Iterable[tuple[Labels, _Node]], name: str) -> list[Sample]:
    return [(labels, node.counters[name].total) for labels, node in nodes if name in node.counters]


def _dropped(nodes: Iterable[tuple[Labels, _Node]]) -> list[Sample]:
    return [
        ({**labels, "reason": reason}, counter.total)
        for labels, node in nodes
        for reason, counter in sorted(node.dropped.items())
    ]
