"""``prometheus:``: serves the figures of a site at ``/metrics``, in Prometheus's text format, version 0.0.4.

Counters only rise, even if a tag or an anchor restarts. Ages are those at the scrape. Other gauges are given while
their source is fresh, so that nothing old looks current.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from email.parser import BytesHeaderParser
from typing import Final, TypeVar

from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from skyless.bridges.target import TAG_NAME, BridgeContext, BridgedSite, Target, TargetUrl, cannot_listen
from skyless.core.version import installed_version
from skyless.run.mqtt.address import is_loopback
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, StatusMessage, TagHealth
from skyless.run.site_table import THRESHOLDS, Node, SiteTable
from skyless.run.web import BRIDGES as LIMITS
from skyless.run.web import is_own_host, own_names

_T = TypeVar("_T")

Labels = Mapping[str, str]
Samples = Iterable[tuple[Labels, float | None]]
"""Labels by name, and the value; None is omitted."""

LATENCY_BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)

_MAX_NAMES: Final = 2000
_MAX_REASONS: Final = 50
"""Most reasons of dropped frames counted per node."""

_FIXES: Final = "skyless_tag_fixes_total"
_PORT: Final = 9464

# What is given as it stands in a message: the metric's name, the message's field, and a line of help.

_Plain = tuple[tuple[str, str, str], ...]
_TAG_COUNTERS: Final[_Plain] = (
    (_FIXES, "fixes", "Fixes that the tag has made."),
    ("skyless_tag_receptions_total", "receptions", "Beacons that the tag has received."),
    ("skyless_tag_late_total", "late", "Receptions and fixes that the tag dropped because they were too old."),
)
_FIX_GAUGES: Final[_Plain] = (
    ("skyless_tag_error_std_metres", "std_m", "One-sigma radial error of the tag's last fix."),
    ("skyless_tag_pdop", "pdop", "Position dilution of precision of the tag's last fix."),
)
_TAG_GAUGES: Final[_Plain] = (
    ("skyless_tag_cpu_ratio", "cpu", "Share of a processor core that the tag uses."),
    ("skyless_tag_memory_bytes", "memory_bytes", "Resident memory of the tag's process."),
)
_KEY_GAUGES: Final[_Plain] = (
    ("skyless_tag_verified", "is_verified", "Whether beacons that a tag with a public key just received are verified."),
    (
        "skyless_tag_clock_error_seconds",
        "clock_error_s",
        "How far the clock of the tag's host is ahead of the site's, where that is more than its bound.",
    ),
)
_ANCHOR_COUNTERS: Final[_Plain] = (
    ("skyless_anchor_sent_total", "sent", "Beacons that the anchor has sent."),
    ("skyless_anchor_late_total", "late", "Transmissions of the anchor that came too late and were skipped."),
    ("skyless_anchor_heard_total", "heard", "Beacons of other anchors that the anchor has received."),
)
_ANCHOR_GAUGES: Final[_Plain] = (
    ("skyless_anchor_synchronised", "synchronised", "Whether the anchor follows the site's time, so that it may send."),
    (
        "skyless_anchor_offset_std_metres",
        "offset_std_m",
        "Standard deviation of the anchor's clock against the site's time, as a distance.",
    ),
    (
        "skyless_anchor_missed_ratio",
        "missed_share",
        "Share of the anchor's transmissions of the last second that came too late.",
    ),
    (
        "skyless_anchor_chain_end_timestamp_seconds",
        "chain_ends_unix_s",
        "When the anchor's last key chain ends, in Unix time.",
    ),
)
_LINK_COUNTERS: Final[_Plain] = (
    ("skyless_mqtt_published_total", "published", "Messages that the node has sent to the broker."),
    ("skyless_mqtt_dropped_total", "dropped", "Messages that the node dropped because the broker was slow or away."),
    ("skyless_mqtt_reconnects_total", "reconnects", "Connections that the node has made again."),
)


class Rising:
    """A node's counter, which restarts at 0 with the node."""

    def __init__(self) -> None:
        self._before = self._now = 0

    @property
    def total(self) -> int:
        """Over all runs of the node."""
        return self._before + self._now

    def update(self, value: int, *, restarted: bool = False) -> None:
        """Update from the node's present run; a decrease without a restart is due to a late message."""
        if restarted:
            self._before, self._now = self.total, 0
        self._now = max(self._now, value)


class _Node:
    """A tag or an anchor, and its counters, which only rise."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.counters: dict[str, Rising] = {}
        """By name of the metric."""
        self.dropped: dict[str, Rising] = {}

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Process the counters of its newest health message."""
        before = self.node.previous
        restarted = isinstance(before, TagHealth | AnchorHealth) and health.uptime_s < before.uptime_s
        counters = _TAG_COUNTERS if isinstance(health, TagHealth) else _ANCHOR_COUNTERS
        values = {name: getattr(health, field) for name, field, _ in counters}
        values |= {name: getattr(health.mqtt, field) for name, field, _ in _LINK_COUNTERS}
        for name, value in values.items():
            self.counters.setdefault(name, Rising()).update(value, restarted=restarted)
        for reason, value in health.counters.items():
            if reason in self.dropped or len(self.dropped) < _MAX_REASONS:
                self.dropped.setdefault(reason, Rising()).update(value, restarted=restarted)


_Nodes = Sequence[tuple[Labels, _Node]]


class SiteMetrics(Target):
    """Collects the figures of one site. No I/O; the time is passed in."""

    def __init__(self, table: SiteTable, *, text: str = "", positions: bool = False) -> None:
        """``positions``: whether to expose the tags' positions. Messages of uncounted nodes are ``dropped``."""
        super().__init__(text)
        self.table = table
        self.site: BridgedSite | None = None
        self._positions = positions
        about = "From the end of a fix's last frame to the fix; of those fixes that came to the bridge."
        self._latencies = Histogram(
            "skyless_tag_latency_seconds", about, ["tag"], buckets=LATENCY_BOUNDS_S, registry=None
        )
        self._tags: dict[str, _Node] = {}
        self._anchors: dict[str, _Node] = {}

    def use(self, table: SiteTable) -> None:
        """Show what the hub's table has."""
        self.table = table

    def on_site(self, site: BridgedSite) -> None:
        """The site is known, or has changed."""
        self.site = site

    def on_fix(self, fix: FixMessage) -> None:
        """Count a usable fix, which the table has."""
        tag = self._known("tag", fix.tag)
        if tag is not None:
            tag.counters.setdefault(_FIXES, Rising()).update(fix.serial)
            self._latencies.labels(fix.tag).observe(max(fix.latency_s, 0.0))

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Count what a tag or an anchor states, which the table has."""
        kind, name = ("tag", health.tag) if isinstance(health, TagHealth) else ("anchor", str(health.anchor))
        node = self._known(kind, name)
        if node is not None:
            node.on_health(health)

    def on_status(self, status: StatusMessage) -> None:
        """Show a tag or an anchor that has come or gone."""
        if status.kind in ("tag", "anchor"):
            self._known(status.kind, status.name)

    def _known(self, kind: str, name: str) -> _Node | None:
        """The node of this name, created if needed; None for an invalid name, or if there are too many."""
        nodes = self._tags if kind == "tag" else self._anchors
        if name not in nodes:
            if not TAG_NAME.fullmatch(name):
                self.dropped["name"] += 1
            elif len(nodes) >= _MAX_NAMES:
                self.dropped["too-many-names"] += 1
            else:
                nodes[name] = _Node(self.table.all(kind)[name])
        return nodes.get(name)

    def figures(self, now_s: float) -> str:
        """Everything in Prometheus's format."""
        return generate_latest(_Scrape(self._families(now_s))).decode()

    def _families(self, now_s: float) -> Iterator[Metric]:
        if self.site is not None:
            simulated = str(self.site.simulated).lower()
            labels = {"site": str(self.site.id), "name": self.site.name, "simulated": simulated}
            labels["version"] = installed_version()
            yield from _gauge("skyless_site_info", "The site, as labels; the value is 1.", [(labels, 1)])
        tags: _Nodes = [({"tag": name}, tag) for name, tag in sorted(self._tags.items())]
        anchors: _Nodes = [({"anchor": name}, anchor) for name, anchor in sorted(self._anchors.items())]
        yield from _node_families("tag", _TAG_COUNTERS, tags)
        yield from self._tag_families(tags, now_s)
        yield from _node_families("anchor", _ANCHOR_COUNTERS, anchors)
        yield from _anchor_families(anchors, now_s)
        links: _Nodes = [
            ({"kind": kind, "name": name}, node) for labels, node in (*tags, *anchors) for kind, name in labels.items()
        ]
        yield from _totals(_LINK_COUNTERS, links)

    def _tag_families(self, tags: _Nodes, now_s: float) -> Iterator[Metric]:
        table = self.table
        fixed = [(labels, fix, one.node) for labels, one in tags if (fix := one.node.fix) is not None]
        fresh = [(labels, fix) for labels, fix, tag in fixed if table.presence(tag, now_s) == "fresh"]
        for latencies in self._latencies.collect():
            latencies.samples = [one for one in latencies.samples if not one.name.endswith("_created")]
            if latencies.samples:
                yield latencies
        ages = [(labels, max(now_s - tag.fix_s + max(fix.latency_s, 0.0), 0.0)) for labels, fix, tag in fixed]
        yield from _gauge("skyless_tag_fix_age_seconds", "Time since the tag's last usable fix.", ages)
        there = [(labels, table.is_there(tag, now_s)) for labels, _, tag in fixed]
        yield from _gauge("skyless_tag_present", "Whether the tag is there: it has not been silent for long.", there)
        yield from _gauges(_FIX_GAUGES, fresh)
        used = [(labels, len(fix.anchors)) for labels, fix in fresh]
        yield from _gauge("skyless_tag_anchors", "Anchors that the tag's last fix used.", used)
        text = "Protection level of the tag's last fix, horizontal or vertical."
        levels = _by("axis", fresh, lambda fix: {"horizontal": fix.hpl_m, "vertical": fix.vpl_m})
        yield from _gauge("skyless_tag_protection_level_metres", text, levels)
        if self._positions:
            text = "Position of the tag's last fix in the site's frame."
            positions = _by("axis", fresh, lambda fix: dict(zip("xyz", fix.position_m, strict=True)))
            yield from _gauge("skyless_tag_position_metres", text, positions)
        healthy = [(labels, health) for labels, health in _fresh(tags, now_s) if isinstance(health, TagHealth)]
        yield from _gauges(_TAG_GAUGES, healthy)
        trusting = [(labels, health) for labels, health in healthy if health.trust is not None]
        yield from _gauges(_KEY_GAUGES, trusting)
        names = {labels["tag"] for labels, _ in trusting}
        shares = [(labels, 1.0 - fix.unverified) for labels, fix in fresh if labels["tag"] in names]
        text = "Share of the last second's beacons that were verified when the tag's last fix was made."
        yield from _gauge("skyless_tag_verified_ratio", text, shares)
        text = "Anchors whose beacons the tag has recently not accepted, by fault."
        yield from _gauge("skyless_tag_not_accepted", text, _by("reason", trusting, _faults))


def _anchor_families(anchors: _Nodes, now_s: float) -> Iterator[Metric]:
    fresh = [(labels, health) for labels, health in _fresh(anchors, now_s) if isinstance(health, AnchorHealth)]
    ages = [(labels, max(now_s - one.node.health_s, 0.0)) for labels, one in anchors if one.node.health is not None]
    yield from _gauge("skyless_anchor_health_age_seconds", "Time since the anchor's last health message.", ages)
    yield from _gauges(_ANCHOR_GAUGES, fresh)
    text = "Rate of the anchor's clock against the site's time, as a share."
    rates = [(labels, None if h.rate_ppm is None else h.rate_ppm * 1e-6) for labels, h in fresh]
    yield from _gauge("skyless_anchor_rate_ratio", text, rates)
    keyed = [(labels, h) for labels, h in fresh if h.chain is not None or h.code_fault is not None]
    text = "Whether the beacons of an anchor with keys have codes."
    yield from _gauge("skyless_anchor_codes", text, [(labels, h.code_fault is None) for labels, h in keyed])
    text = "Other anchors whose beacons an anchor with keys has recently not accepted, by fault."
    yield from _gauge("skyless_anchor_not_accepted", text, _by("reason", keyed, _faults))


def _node_families(kind: str, counters: _Plain, nodes: _Nodes) -> Iterator[Metric]:
    """What tags and anchors have in common."""
    online = [(labels, one.node.online) for labels, one in nodes]
    yield from _gauge(f"skyless_{kind}_online", f"Whether the {kind}'s program is connected.", online)
    yield from _totals(counters, nodes)
    text = f"Frames that the {kind} has dropped, by reason."
    dropped = _by("reason", nodes, lambda node: {why: one.total for why, one in sorted(node.dropped.items())})
    yield from _family(CounterMetricFamily, f"skyless_{kind}_dropped_frames_total", text, dropped)


def _fresh(nodes: _Nodes, now_s: float) -> list[tuple[Labels, TagHealth | AnchorHealth]]:
    recent = [(labels, one.node) for labels, one in nodes if now_s - one.node.health_s < THRESHOLDS.report_s]
    return [(labels, one.health) for labels, one in recent if isinstance(one.health, TagHealth | AnchorHealth)]


def _faults(health: TagHealth | AnchorHealth) -> dict[str, int]:
    """Number of anchors for each fault stated by a node."""
    return dict(sorted(Counter(health.faults.values()).items())[:_MAX_REASONS])


def _by(
    label: str, sources: Iterable[tuple[Labels, _T]], read: Callable[[_T], Mapping[str, float | None]]
) -> Iterator[tuple[Labels, float | None]]:
    """Samples of each source by one more label."""
    for labels, source in sources:
        for key, value in read(source).items():
            yield {**labels, label: key}, value


def _family(
    kind: type[GaugeMetricFamily] | type[CounterMetricFamily], name: str, text: str, samples: Samples
) -> Iterator[Metric]:
    """One metric; none without samples. ``text`` is one line of help."""
    given = [(labels, float(value)) for labels, value in samples if value is not None]
    if given:
        family = kind(name, text, labels=list(given[0][0]))
        for labels, value in given:
            family.add_metric(list(labels.values()), value)
        yield family


def _gauge(name: str, text: str, samples: Samples) -> Iterator[Metric]:
    return _family(GaugeMetricFamily, name, text, samples)


def _gauges(plain: _Plain, messages: Iterable[tuple[Labels, object]]) -> Iterator[Metric]:
    for name, field, text in plain:
        yield from _gauge(name, text, [(labels, getattr(message, field)) for labels, message in messages])


def _totals(plain: _Plain, nodes: _Nodes) -> Iterator[Metric]:
    for name, _, text in plain:
        totals = [(labels, one.counters[name].total) for labels, one in nodes if name in one.counters]
        yield from _family(CounterMetricFamily, name, text, totals)


class _Scrape(Collector):
    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


class Prometheus(SiteMetrics):
    """An HTTP server with one page; each connection carries one request.

    Written by hand, because libraries' servers wait indefinitely for the end of a request: here each connection has a
    limit of time and bytes, and if there are too many the oldest is closed, so that none can block a scrape.
    """

    def __init__(self, url: TargetUrl, _context: BridgeContext) -> None:
        """``prometheus://[HOST][:PORT]``; with ``position=yes`` it gives where tags are. Raises SkylessError.

        ``hosts=`` has further names by which others reach it, with commas.
        """
        names = [name.lower() for name in url.text_option("hosts").split(",") if name]
        positions = url.choice("position", ("no", "yes"), "no") == "yes"
        super().__init__(SiteTable(0.0), text=url.text, positions=positions)
        self._host, self.port = url.host(), url.port(_PORT)
        """The port in use; with 0 configured, known once the server runs."""
        self._names = {*own_names(self._host), *names}
        self._open: dict[asyncio.StreamWriter, None] = {}
        """Oldest first."""

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError if it cannot listen there."""
        try:
            server = await asyncio.start_server(self._serve, self._host, self.port, limit=LIMITS.head_bytes)
        except OSError as error:
            raise cannot_listen(self.text, self._host, self.port, error) from None
        self.port = server.sockets[0].getsockname()[1]
        try:
            await asyncio.Event().wait()  # serve_forever, when cancelled, waits until all connections have ended
        finally:
            server.close()
            for writer in tuple(self._open):
                writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._open) >= LIMITS.clients:
            oldest = next(iter(self._open))
            del self._open[oldest]
            oldest.transport.abort()
        self._open[writer] = None
        try:
            async with asyncio.timeout(LIMITS.answer_s):
                request = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(request))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            self.dropped["request"] += 1
        finally:
            self._open.pop(writer, None)
            writer.transport.abort()

    def _answer(self, request: bytes) -> bytes:
        headers = BytesHeaderParser().parsebytes(request.partition(b"\r\n")[2])
        if "host" in headers and not is_own_host(str(headers["host"]), self._names, remote=not is_loopback(self._host)):
            self.dropped["host"] += 1
            return _response("421 Misdirected Request", "unknown host name; ?hosts=NAME in the target admits it\n")
        if "origin" in headers or headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            self.dropped["origin"] += 1
            return _response("403 Forbidden", "pages of other sites are refused\n")
        method, _, rest = request.partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if method not in (b"GET", b"HEAD"):
            return _response("405 Method Not Allowed", "only GET is answered here\n")
        if path == b"/metrics":
            whole = _response("200 OK", self.figures(time.monotonic()), CONTENT_TYPE_PLAIN_0_0_4)
        else:
            whole = _response("404 Not Found", "the figures are at /metrics\n")
        return whole if method == b"GET" else whole.partition(b"\r\n\r\n")[0] + b"\r\n\r\n"


def _response(status: str, text: str, content_type: str = "text/plain; charset=utf-8") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


make_target: Final = Prometheus
