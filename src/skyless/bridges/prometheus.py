"""``prometheus:``: serves metrics of a site at ``/metrics``, in Prometheus's text format, version 0.0.4.

Counters only rise, even if a tag or an anchor is restarted. Ages are those at the moment of the scrape. Other gauges
are included only while their source is fresh, so that old values do not look current.
Format: https://prometheus.io/docs/instrumenting/exposition_formats/#text-based-format.
"""

import asyncio
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from email.parser import BytesHeaderParser
from math import inf, isinf, isnan
from typing import Final, Literal

from skyless.bridges.target import TAG_NAME, BridgeContext, BridgedSite, Target, TargetUrl, cannot_listen
from skyless.core.version import installed_version
from skyless.run.mqtt.address import is_loopback
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, StatusMessage, TagHealth
from skyless.run.web import BRIDGES as LIMITS
from skyless.run.web import is_own_host, own_names

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

Labels = Mapping[str, str]
Sample = tuple[Labels, float]
"""Labels by name, and the value."""

GAUGE_AGE_S: Final = 5.0
"""Gauges from a fix or health message older than this are left out."""

LATENCY_BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)

_MAX_NAMES: Final = 2000
_MAX_REASONS: Final = 50
"""Largest number of reasons for dropped frames that are counted for one node."""

_FIXES: Final = "skyless_tag_fixes_total"
_PORT: Final = 9464

# Metrics whose values are fields of a message: the metric's name, the message's field, and a line of help.

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

_ESCAPES: Final = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})


def family(name: str, kind: Literal["counter", "gauge"], text: str, samples: Iterable[Sample]) -> list[str]:
    """Return the lines of one metric; none if it has no samples. ``text`` is one line of help."""
    lines = [_sample(name, labels, value) for labels, value in samples]
    return [*_header(name, kind, text), *lines] if lines else []


def histograms(
    name: str, text: str, bounds: Sequence[float], samples: Iterable[tuple[Labels, Sequence[int], float]]
) -> list[str]:
    """Return the lines of a histogram. A sample has labels, the number of values in each bucket, and their sum.

    ``bounds`` are the upper ends of the buckets in rising order; the last bucket, which has no bound, is added.
    """
    lines = []
    for labels, counts, total in samples:
        below = 0
        for bound, count in zip((*bounds, inf), counts, strict=True):
            below += count
            lines.append(_sample(f"{name}_bucket", {**labels, "le": _number(bound)}, below))
        lines += [_sample(f"{name}_sum", labels, total), _sample(f"{name}_count", labels, below)]
    return [*_header(name, "histogram", text), *lines] if lines else []


def _header(name: str, kind: str, text: str) -> list[str]:
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]


def _sample(name: str, labels: Labels, value: float) -> str:
    inside = ",".join(f'{key}="{text.translate(_ESCAPES)}"' for key, text in labels.items())
    return f"{name}{{{inside}}} {_number(value)}" if inside else f"{name} {_number(value)}"


def _number(value: float) -> str:
    if isnan(value):
        return "NaN"
    if isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(value)


class Rising:
    """The total of a node's counter, which begins at 0 whenever the node is started."""

    def __init__(self) -> None:
        self._before = self._now = 0

    @property
    def total(self) -> int:
        """The sum over all of the node's runs."""
        return self._before + self._now

    def update(self, value: int, *, restarted: bool = False) -> None:
        """Set the value in the node's present run. Without a restart a lower value, from a late message, is ignored."""
        if restarted:
            self._before, self._now = self.total, 0
        self._now = max(self._now, value)


class _Node:
    """State and counters of a tag or an anchor."""

    def __init__(self) -> None:
        self.online: bool | None = None
        """None while unknown."""
        self.health: TagHealth | AnchorHealth | None = None
        self.health_s = 0.0
        """When its last health message arrived."""
        self.counters: dict[str, Rising] = {}
        """Counters by the metric's name."""
        self.dropped: dict[str, Rising] = {}
        self.fix: FixMessage | None = None
        self.fix_s = 0.0
        """When the last fix's last frame ended, by the clock of arrivals."""
        self.latency_counts = [0] * (len(LATENCY_BOUNDS_S) + 1)
        self.latency_sum_s = 0.0

    def on_health(self, health: TagHealth | AnchorHealth, now_s: float) -> None:
        """Process a health message and its counters."""
        restarted = self.health is not None and health.uptime_s < self.health.uptime_s
        self.health, self.health_s = health, now_s
        counters = _TAG_COUNTERS if isinstance(health, TagHealth) else _ANCHOR_COUNTERS
        values = {name: getattr(health, field) for name, field, _ in counters}
        values |= {name: getattr(health.mqtt, field) for name, field, _ in _LINK_COUNTERS}
        for name, value in values.items():
            self.counters.setdefault(name, Rising()).update(value, restarted=restarted)
        for reason, value in health.counters.items():
            if reason in self.dropped or len(self.dropped) < _MAX_REASONS:
                self.dropped.setdefault(reason, Rising()).update(value, restarted=restarted)


_Nodes = list[tuple[Labels, _Node]]


class SiteMetrics:
    """Collects the metrics of one site. No I/O; the time is passed in."""

    def __init__(self, *, positions: bool = False) -> None:
        """``positions``: whether to include the tags' positions."""
        self.dropped: Counter[str] = Counter()
        """Messages that were ignored, by reason."""
        self.site: BridgedSite | None = None
        self._positions = positions
        self._tags: dict[str, _Node] = {}
        self._anchors: dict[str, _Node] = {}

    def on_fix(self, fix: FixMessage, now_s: float) -> None:
        """Process a usable fix that arrived at ``now_s``, on the clock of ``text``."""
        tag = self._known(self._tags, fix.tag)
        if tag is None:
            return
        latency_s = max(fix.latency_s, 0.0)
        tag.fix, tag.fix_s = fix, now_s - latency_s
        tag.counters.setdefault(_FIXES, Rising()).update(fix.serial)
        tag.latency_counts[bisect_left(LATENCY_BOUNDS_S, latency_s)] += 1
        tag.latency_sum_s += latency_s

    def on_health(self, health: TagHealth | AnchorHealth, now_s: float) -> None:
        """Process the state of a tag or an anchor."""
        is_tag = isinstance(health, TagHealth)
        name = health.tag if isinstance(health, TagHealth) else str(health.anchor)
        node = self._known(self._tags if is_tag else self._anchors, name)
        if node is not None:
            node.on_health(health, now_s)

    def on_status(self, status: StatusMessage) -> None:
        """Process a tag or an anchor going online or offline."""
        nodes = {"tag": self._tags, "anchor": self._anchors}.get(status.kind)
        node = None if nodes is None else self._known(nodes, status.name)
        if node is not None:
            node.online = status.online

    def _known(self, nodes: dict[str, _Node], name: str) -> _Node | None:
        """Return the node of a name, created if missing; None if the name is invalid or there are too many."""
        if name not in nodes:
            if not TAG_NAME.fullmatch(name):
                self.dropped["name"] += 1
            elif len(nodes) >= _MAX_NAMES:
                self.dropped["too-many-names"] += 1
            else:
                nodes[name] = _Node()
        return nodes.get(name)

    def text(self, now_s: float) -> str:
        """Return all metrics in Prometheus's format."""
        tags: _Nodes = [({"tag": name}, tag) for name, tag in sorted(self._tags.items())]
        anchors: _Nodes = [({"anchor": name}, anchor) for name, anchor in sorted(self._anchors.items())]
        groups = (("tag", self._tags), ("anchor", self._anchors))
        links: _Nodes = [({"kind": kind, "name": name}, one) for kind, of in groups for name, one in sorted(of.items())]
        lines = [
            *self._site_lines(),
            *self._tag_lines(tags, now_s),
            *self._anchor_lines(anchors, now_s),
            *_totals(_LINK_COUNTERS, links),
        ]
        return "\n".join([*lines, ""])

    def _site_lines(self) -> list[str]:
        if self.site is None:
            return []
        labels = {
            "site": str(self.site.id),
            "name": self.site.name,
            "simulated": str(self.site.simulated).lower(),
            "version": installed_version(),
        }
        return family("skyless_site_info", "gauge", "The site, as labels; the value is 1.", [(labels, 1)])

    def _tag_lines(self, tags: _Nodes, now_s: float) -> Iterator[str]:
        fixed = [(labels, fix, now_s - tag.fix_s) for labels, tag in tags if (fix := tag.fix) is not None]
        fresh = [(labels, fix) for labels, fix, age_s in fixed if age_s <= GAUGE_AGE_S]
        yield from family("skyless_tag_online", "gauge", "Whether the tag's program is connected.", _online(tags))
        yield from _totals(_TAG_COUNTERS, tags)
        text = "Frames that the tag has dropped, by reason."
        yield from family("skyless_tag_dropped_frames_total", "counter", text, _dropped(tags))
        text = "From the end of a fix's last frame to the fix; of those fixes that came to the bridge."
        latencies = [(labels, tag.latency_counts, tag.latency_sum_s) for labels, tag in tags if tag.fix is not None]
        yield from histograms("skyless_tag_latency_seconds", text, LATENCY_BOUNDS_S, latencies)
        text = "Time since the tag's last usable fix."
        ages = [(labels, max(age_s, 0.0)) for labels, _, age_s in fixed]
        yield from _gauge("skyless_tag_fix_age_seconds", text, ages)
        yield from _gauges(_FIX_GAUGES, fresh)
        text = "Anchors that the tag's last fix used."
        yield from _gauge("skyless_tag_anchors", text, [(labels, len(fix.anchors)) for labels, fix in fresh])
        text = "Protection level of the tag's last fix, horizontal or vertical."
        levels = [
            ({**labels, "axis": axis}, value)
            for labels, fix in fresh
            for axis, value in (("horizontal", fix.hpl_m), ("vertical", fix.vpl_m))
        ]
        yield from _gauge("skyless_tag_protection_level_metres", text, levels)
        healthy = [(labels, health) for labels, health in _fresh(tags, now_s) if isinstance(health, TagHealth)]
        yield from _gauges(_TAG_GAUGES, healthy)
        yield from _trust_lines([(labels, health) for labels, health in healthy if health.trust is not None], fresh)
        if self._positions:
            text = "Position of the tag's last fix in the site's frame."
            positions = [
                ({**labels, "axis": axis}, value)
                for labels, fix in fresh
                for axis, value in zip("xyz", fix.position_m, strict=True)
            ]
            yield from _gauge("skyless_tag_position_metres", text, positions)

    def _anchor_lines(self, anchors: _Nodes, now_s: float) -> Iterator[str]:
        fresh = [(labels, health) for labels, health in _fresh(anchors, now_s) if isinstance(health, AnchorHealth)]
        text = "Whether the anchor's program is connected."
        yield from family("skyless_anchor_online", "gauge", text, _online(anchors))
        yield from _totals(_ANCHOR_COUNTERS, anchors)
        text = "Frames that the anchor has dropped, by reason."
        yield from family("skyless_anchor_dropped_frames_total", "counter", text, _dropped(anchors))
        text = "Time since the anchor's last health message."
        ages = [(labels, max(now_s - one.health_s, 0.0)) for labels, one in anchors if one.health is not None]
        yield from _gauge("skyless_anchor_health_age_seconds", text, ages)
        yield from _gauges(_ANCHOR_GAUGES, fresh)
        text = "Rate of the anchor's clock against the site's time, as a share."
        rates = [(labels, None if h.rate_ppm is None else h.rate_ppm * 1e-6) for labels, h in fresh]
        yield from _gauge("skyless_anchor_rate_ratio", text, rates)
        text = "Whether the beacons of an anchor with keys have codes."
        keyed = [(labels, h) for labels, h in fresh if h.chain is not None or h.code_fault is not None]
        yield from _gauge("skyless_anchor_codes", text, [(labels, h.code_fault is None) for labels, h in keyed])
        text = "Other anchors whose beacons an anchor with keys has recently not accepted, by fault."
        yield from _gauge("skyless_anchor_not_accepted", text, _faults([(labels, h.faults) for labels, h in keyed]))


def _fresh(nodes: _Nodes, now_s: float) -> list[tuple[Labels, TagHealth | AnchorHealth]]:
    return [(labels, one.health) for labels, one in nodes if one.health and now_s - one.health_s <= GAUGE_AGE_S]


def _trust_lines(
    trusting: Sequence[tuple[Labels, TagHealth]], fresh: Iterable[tuple[Labels, FixMessage]]
) -> Iterator[str]:
    """Lines of metrics of tags that have the site's public key."""
    names = {labels["tag"] for labels, _ in trusting}
    yield from _gauges(_KEY_GAUGES, trusting)
    text = "Share of the last second's beacons that were verified when the tag's last fix was made."
    shares = [(labels, 1.0 - fix.unverified) for labels, fix in fresh if labels["tag"] in names]
    yield from _gauge("skyless_tag_verified_ratio", text, shares)
    text = "Anchors whose beacons the tag has recently not accepted, by fault."
    yield from _gauge("skyless_tag_not_accepted", text, _faults([(labels, h.faults) for labels, h in trusting]))


def _faults(nodes: Iterable[tuple[Labels, Mapping[str, str]]]) -> list[tuple[Labels, float]]:
    """Number of anchors with each fault, by node."""
    return [
        ({**labels, "reason": fault}, count)
        for labels, faults in nodes
        for fault, count in sorted(Counter(faults.values()).items())[:_MAX_REASONS]
    ]


def _gauge(name: str, text: str, values: Iterable[tuple[Labels, float | None]]) -> list[str]:
    samples = [(labels, float(value)) for labels, value in values if value is not None]
    return family(name, "gauge", text, samples)


def _gauges(plain: _Plain, messages: Sequence[tuple[Labels, object]]) -> Iterator[str]:
    for name, field, text in plain:
        yield from _gauge(name, text, [(labels, getattr(message, field)) for labels, message in messages])


def _totals(plain: _Plain, nodes: _Nodes) -> Iterator[str]:
    for name, _, text in plain:
        totals = [(labels, one.counters[name].total) for labels, one in nodes if name in one.counters]
        yield from family(name, "counter", text, totals)


def _online(nodes: _Nodes) -> list[Sample]:
    return [(labels, int(node.online)) for labels, node in nodes if node.online is not None]


def _dropped(nodes: _Nodes) -> list[Sample]:
    return [
        ({**labels, "reason": reason}, counter.total)
        for labels, node in nodes
        for reason, counter in sorted(node.dropped.items())
    ]


class Prometheus(Target):
    """An HTTP server with one page; each connection carries one request.

    It uses no library, as servers of libraries wait forever for the end of a request. Here each connection has limits
    of time and bytes, and if there are too many, the oldest is closed, so that none keeps a scrape out.
    """

    def __init__(self, text: str, host: str, port: int, names: Collection[str] = (), *, positions: bool) -> None:
        """``names`` are further host names by which clients reach it, besides this computer's names and addresses."""
        super().__init__(text)
        self._names = {*own_names(host), *names}
        self.metrics = SiteMetrics(positions=positions)
        self.dropped = self.metrics.dropped
        self.port = port
        """The port in use while the server runs, also if 0 was given."""
        self._host = host
        self._open: dict[asyncio.StreamWriter, None] = {}
        """Open connections, the oldest first."""

    def on_site(self, site: BridgedSite) -> None:
        """Keep the site."""
        self.metrics.site = site

    def on_fix(self, fix: FixMessage) -> None:
        """Count a fix."""
        self.metrics.on_fix(fix, time.monotonic())

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Keep a tag's or anchor's state."""
        self.metrics.on_health(health, time.monotonic())

    def on_status(self, status: StatusMessage) -> None:
        """Keep whether a tag or an anchor is online."""
        self.metrics.on_status(status)

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError if it cannot listen."""
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
            whole = _response("200 OK", self.metrics.text(time.monotonic()), CONTENT_TYPE)
        else:
            whole = _response("404 Not Found", "the figures are at /metrics\n")
        return whole if method == b"GET" else whole.partition(b"\r\n\r\n")[0] + b"\r\n\r\n"


def _response(status: str, text: str, content_type: str = "text/plain; charset=utf-8") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


def make_target(url: TargetUrl, _context: BridgeContext) -> Prometheus:
    """Create the target for ``prometheus://[HOST][:PORT]``. Raises SkylessError.

    ``position=yes`` includes the tags' positions; ``hosts=`` lists further host names of this server, with commas.
    """
    names = [name.lower() for name in url.text_option("hosts").split(",") if name]
    positions = url.choice("position", ("no", "yes"), "no") == "yes"
    return Prometheus(url.text, url.host(), url.port(_PORT), names, positions=positions)
