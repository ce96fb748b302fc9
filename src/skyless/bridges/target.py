"""Targets: other programs or devices that get a site's fixes, named by an address.

An address is ``SCHEME://HOST:PORT?KEY=VALUE`` or ``SCHEME:PATH?KEY=VALUE``. A target whose readers get bytes consists
of an ``Encoder``, which does no I/O, and a sender (``targets.py``).
"""

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite
from typing import Final
from urllib.parse import parse_qsl, unquote, urlsplit

from msgspec import Struct

from skyless.core.alert import Alert
from skyless.core.errors import SkylessError
from skyless.core.site import FloorSite, GeoreferenceSite, Site, WallSite
from skyless.run.mqtt.address import MqttAddress, hide_password
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AnchorHealth,
    Asset,
    FixMessage,
    Matrix,
    StatusMessage,
    TagHealth,
    Vector,
    Zone,
)
from skyless.run.process import RateLimit
from skyless.run.site_table import THRESHOLDS, SiteTable

MIN_STD_M: Final = 0.01
"""Smallest standard deviation per axis in outputs: the gates of other programs reject fixes with honest millimetres."""

_FORBIDDING: Final = (Alert.NOT_EXCLUDED, Alert.LIMIT)
"""Alerts of fixes unfit for navigation."""


class BridgedSite(Struct, frozen=True):
    """A bridge's knowledge of the site."""

    id: int
    name: str
    simulated: bool
    """Whether its radios are emulated."""
    anchors_m: dict[int, Vector]
    """Positions of the placed anchors in the site's frame."""
    georeference: GeoreferenceSite | None = None
    zones: tuple[Zone, ...] = ()
    master: int | None = None
    """The master anchor of the site file; None if there is none, or it is unknown."""
    walls: tuple[WallSite, ...] = ()
    """Unknown to a tag by itself."""
    assets: Mapping[str, Asset] = {}
    """What tags are attached to, by tag."""
    floors: tuple[FloorSite, ...] = ()


def bridged_site(
    site: Site, zones: tuple[Zone, ...] = (), *, simulated: bool, assets: Mapping[str, Asset] | None = None
) -> BridgedSite:
    """The ``BridgedSite`` of a whole site, as published on MQTT."""
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    earth = site.georeference
    return BridgedSite(
        site.id, site.name, simulated, anchors_m, earth, zones, site.master, site.walls, assets or {}, site.floors or ()
    )


def is_usable(fix: FixMessage) -> bool:
    """Whether its position may be passed on: it is finite, and no alert forbids its use."""
    return fix.alert not in _FORBIDDING and all(map(isfinite, (*fix.position_m, *fix.covariance_m2)))


def floored(covariance_m2: Matrix) -> Matrix:
    """The covariance of a position with a variance of at least ``MIN_STD_M`` squared in each axis."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = covariance_m2
    least = MIN_STD_M**2
    return max(xx, least), xy, xz, yx, max(yy, least), yz, zx, zy, max(zz, least)


def require_georeference(site: BridgedSite, target: str) -> GeoreferenceSite:
    """The site's georeference, for a target with global positions. Raises SkylessError if the site has none."""
    if site.georeference is None:
        raise SkylessError(
            f"{target} gives positions on the Earth, and site {site.id} ({site.name}) does not say where it is: its "
            "site file should have [georeference] with latitude_deg, longitude_deg, height_m and heading_deg"
        )
    return site.georeference


class BridgeContext(Struct, frozen=True):
    """What a target may need of the program that it runs in."""

    log: Callable[[str], None]
    """Shows a line to a person."""
    mqtt: MqttAddress | None = None
    """The site's broker, where there is one."""


class Target:
    """Base of all targets; ignores everything. The hub calls it from the event loop, and it must not block."""

    one_tag = False
    """Whether its readers cannot distinguish tags."""

    def __init__(self, text: str) -> None:
        self.text = text
        """Its address, for messages."""
        self.dropped: Counter[str] = Counter()
        """What readers missed, by reason."""

    def use(self, table: SiteTable) -> None:
        """The hub's table, which has usable fixes only; given before anything else."""

    def on_site(self, site: BridgedSite) -> None:
        """The site is known or has changed. Raises SkylessError if it lacks what this target needs."""

    def on_fix(self, fix: FixMessage) -> None:
        """Process a usable fix; called at most at the target's ``hz``, and not before the site is known."""

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        """A known tag has no fresh usable fix; called again each second."""

    def on_gone(self, tag: str, unix_s: float) -> None:
        """A tag has gone: it has been silent for long, or its program has ended."""

    def on_second(self, unix_s: float) -> None:
        """Another second has passed."""

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Process the state of a tag or an anchor, once a second."""

    def on_status(self, status: StatusMessage) -> None:
        """A program of the site has connected or left."""

    def on_alarm(self, alarm: AlarmMessage) -> None:
        """Process an alarm's present state: raised, ended, acknowledged, or retained from before."""

    async def run(self) -> None:
        """Serve until cancelled."""


class Encoder:
    """Base of encoders: each element of a result is one datagram or one write. No I/O; reads no clock."""

    one_tag = False
    """See ``Target``."""

    dropped: Counter[str]
    """That of its ``Target``: what it could not encode, by reason."""

    def greeting(self) -> list[bytes]:
        """Sent to a reader that has just connected."""
        return []

    def on_site(self, site: BridgedSite) -> list[bytes]:  # noqa: ARG002 - most only keep it
        """See ``Target``."""
        return []

    def on_fix(self, fix: FixMessage) -> list[bytes]:  # noqa: ARG002 - see above
        """See ``Target``."""
        return []

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - see above
        """See ``Target``."""
        return []

    def on_second(self, unix_s: float) -> list[bytes]:  # noqa: ARG002 - see above
        """See ``Target``."""
        return []

    def on_bytes(self, data: bytes, unix_ns: int) -> list[bytes]:  # noqa: ARG002 - see above
        """Process a reader's bytes, over UDP or a serial port, and their time. Returns the answer."""
        return []


def cannot_listen(text: str, host: str, port: int, error: OSError) -> SkylessError:
    """The error of a server that cannot start; asyncio's own text is longer and says the same."""
    reason = os.strerror(error.errno) if error.errno is not None and error.errno > 0 else error
    return SkylessError(f"the target {text!r} cannot listen on {host}:{port}: {reason}")


TAG_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""Valid names of tags."""

_HOST: Final = "//HOST:PORT"
_USER: Final = "USER@"
_PATH: Final = "PATH"
"""Parts of an address as named in messages."""


class TargetUrl:
    """One address; each part is checked when read, and ``check_all_read`` refuses parts that nobody has read."""

    def __init__(self, text: str) -> None:
        """Raises SkylessError."""
        self.text = hide_password(text)
        """The address as given, without a password, for messages."""
        scheme, colon, _ = text.partition(":")
        try:
            parts = urlsplit(text)
            self._port = parts.port
        except ValueError:
            raise self.wrong("a port between 1 and 65535 after the host") from None
        if not colon or not scheme:
            raise self.wrong("SCHEME://HOST:PORT or SCHEME:PATH, as nmea+tcp://:10110")
        self.scheme = scheme.lower()
        self._netloc, self._host, self._path = parts.netloc, parts.hostname or "", unquote(parts.path)
        if self._port == 0:
            raise self.wrong("a port between 1 and 65535 after the host")
        if parts.fragment:
            raise self.wrong("without #")
        pairs = parse_qsl(parts.query, keep_blank_values=True)
        self._options = dict(pairs)
        if len(self._options) < len(pairs):
            raise self.wrong("each key once")
        self._parts: set[str] = set()
        """Parts that have been read; ``_read`` has the keys."""
        self._read: set[str] = set()

    def host(self, default: str = "127.0.0.1") -> str:
        """The host, by default ``default``."""
        self._parts.add(_HOST)
        return self._host or default

    def port(self, default: int) -> int:
        """The port, by default ``default``."""
        return self._port or default

    def netloc(self) -> str:
        """``USER:PASSWORD@HOST:PORT`` as given; empty if absent."""
        self._parts |= {_HOST, _USER}
        return self._netloc

    def path(self) -> str:
        """Path of a port or a link; empty if absent."""
        self._parts.add(_PATH)
        return self._path

    def text_option(self, key: str, default: str = "") -> str:
        """The value of a key, unchanged."""
        self._read.add(key)
        return self._options.get(key, default)

    def number(self, key: str, default: float, least: float, most: float) -> float:
        """A number within limits. Raises SkylessError."""
        text = self.text_option(key)
        try:
            value = float(text) if key in self._options else default
        except ValueError:
            value = float("nan")
        if not isfinite(value) or not least <= value <= most:
            raise self._wrong_value(key, f"a number from {least:g} to {most:g}")
        return value

    def whole_number(self, key: str, default: int, least: int, most: int) -> int:
        """A whole number within limits. Raises SkylessError."""
        value = self.number(key, default, least, most)
        if value % 1:
            raise self._wrong_value(key, f"a whole number from {least} to {most}")
        return int(value)

    def has(self, key: str) -> bool:
        """Whether a key is given, even without a value."""
        self._read.add(key)
        return key in self._options

    def choice(self, key: str, names: Sequence[str], default: str) -> str:
        """One of several words. Raises SkylessError."""
        value = self.text_option(key, default)
        if value not in names:
            raise self._wrong_value(key, f"{', '.join(names[:-1])} or {names[-1]}")
        return value

    def tag(self) -> str | None:
        """The selected tag; None for all. Raises SkylessError."""
        name = self.text_option("tag")
        if "tag" in self._options and not TAG_NAME.fullmatch(name):
            raise self._wrong_value("tag", "a tag's name: 1 to 32 letters, digits, - or _")
        return name or None

    def check_all_read(self) -> None:
        """Refuse unread parts and keys. Raises SkylessError."""
        given = {
            _HOST: bool(self._host) or self._port is not None,
            _USER: "@" in self._netloc,
            _PATH: self._path not in ("", "/"),
        }
        if not self._parts.issuperset(part for part, is_given in given.items() if is_given):
            raise self.wrong(f"{self.scheme}:{''.join(part for part in (_HOST, _PATH) if part in self._parts)}")
        for key in self._options:
            if key not in self._read:
                known = ", ".join(sorted(self._read))
                raise SkylessError(f"the target {self.text!r} has {key!r}; its keys are {known}")

    def wrong(self, expected: str) -> SkylessError:
        """The error for an unusable address."""
        return SkylessError(f"the target is {self.text!r}; it should be {expected}")

    def _wrong_value(self, key: str, expected: str) -> SkylessError:
        given = f"{key}={self._options[key]}" if key in self._options else f"no {key}="
        return SkylessError(f"the target {self.text!r} has {given}; it should be {expected}")


# Gives the fixes of a site to targets: usable ones at each target's rate, and that there is none.
#
# No I/O, and the time is passed in.

SILENCE_CHECK_S: Final = 0.25
"""Interval at which to call ``on_tick``."""

_SECOND_S: Final = 1.0 - 0.1 * SILENCE_CHECK_S
"""Threshold for another second, as ticks are sometimes late."""


class Route(Struct):
    """A target, and what the user wants it to get."""

    target: Target
    tag: str | None
    """The selected tag; None for all, or for the first if the target carries only one."""
    hz: float
    rates: dict[str, RateLimit] = {}
    """Rate limit of each tag."""
    others: bool = False
    """Whether the hint that there are more tags is unnecessary: it was given, or the user chose a tag."""
    refused: str = ""
    """What the site lacks for this target, which then gets nothing; empty if it is served."""
    has_ended: bool = False
    """Whether it has been closed: a broker's link still receives while disconnecting."""
    faults: int = 0
    """Number of failures."""


class Hub:
    """Distributes one site's messages to its targets."""

    def __init__(self, routes: Sequence[Route], log: Callable[[str], None]) -> None:
        self.routes = tuple(routes)
        self.table = SiteTable(-inf)
        for route in self.routes:
            route.target.use(self.table)
        self.site: BridgedSite | None = None
        self.fixes = 0
        self._log = log
        self._reasons: dict[str, str] = {}
        """Why tags have no usable fix."""
        self._due_s: dict[str, float] = {}
        """When targets are next notified that a tag has no fix."""
        self._second_s = -inf
        """Beginning of the current second."""

    def on_site(self, site: BridgedSite) -> None:
        """The site is known or has changed.

        Raises SkylessError: it lacks what every target needs; what only some need is logged.
        """
        if site == self.site:
            return
        self.site = site
        reasons = []
        for route in self.routes:
            before, route.refused = route.refused, ""
            try:
                route.target.on_site(site)
            except SkylessError as error:
                route.refused = str(error)
            if route.refused not in ("", before):
                reasons.append(route.refused)
        if self.routes and all(route.refused for route in self.routes):
            raise SkylessError(self.routes[0].refused)
        for reason in reasons:
            self._log(reason)

    def on_fix(self, fix: FixMessage, now_s: float) -> None:
        """Distribute a tag's fix; ``now_s``: the host's monotonic clock. Fixes before the site is known are ignored."""
        if not is_usable(fix):
            self._expect(fix.tag, now_s, fix.alert or "position is not finite")
            return
        if self.table.add_fix(fix, now_s) is None:
            return
        self._reasons[fix.tag] = "no fix"
        self._due_s[fix.tag] = now_s
        if self.site is None:
            return
        self.fixes += 1
        for route in self.routes:
            if self._carries(route, fix.tag) and route.rates.setdefault(fix.tag, RateLimit(route.hz)).is_due(now_s):
                self._guard(route, lambda target: target.on_fix(fix))

    def on_health(self, health: TagHealth | AnchorHealth, now_s: float) -> None:
        """Distribute the state of a tag or an anchor."""
        tag = health.tag if isinstance(health, TagHealth) else None
        if isinstance(health, TagHealth):
            self._expect(health.tag, now_s, health.reason)
            self.table.add_health("tag", health.tag, health, now_s)
        else:
            self.table.add_health("anchor", str(health.anchor), health, now_s)
        self._give(tag, lambda target: target.on_health(health))

    def _expect(self, tag: str, now_s: float, reason: str | None) -> None:
        """Note that a tag should have fixes, and why it has none."""
        node = self.table.add("tag", tag)
        if node is None:
            return  # too many
        node.begin(now_s)
        if tag not in self._reasons:
            self._reasons[tag], self._due_s[tag] = "no fix yet", now_s + THRESHOLDS.fresh_s
        if reason is not None:
            self._reasons[tag] = reason

    def on_status(self, status: StatusMessage, now_s: float, unix_s: float) -> None:
        """A program of the site has connected or left."""
        if self.table.add_status(status, now_s) and status.kind == "tag":
            self._give(status.name, lambda target: target.on_gone(status.name, unix_s))
        self._give(status.name if status.kind == "tag" else None, lambda target: target.on_status(status))

    def on_alarm(self, alarm: AlarmMessage) -> None:
        """Distribute an alarm's present state. A target with a selected tag gets those that concern it."""
        for route in self.routes:
            if route.tag is None or route.tag in alarm.tags:
                self._guard(route, lambda target: target.on_alarm(alarm))

    def on_tick(self, now_s: float, unix_s: float) -> None:
        """Report silent tags and seconds; call every ``SILENCE_CHECK_S``."""
        for name in self.table.tick(now_s):
            self._give(name, lambda target: target.on_gone(name, unix_s))  # noqa: B023 - called at once
        for name, reason in tuple(self._reasons.items()):
            tag = self.table.get("tag", name)
            if tag is None:
                del self._reasons[name], self._due_s[name]
                for route in self.routes:
                    route.rates.pop(name, None)
            elif self.table.presence(tag, now_s) in ("fresh", "asleep"):
                continue
            elif now_s >= self._due_s[name] and self.site is not None:
                self._due_s[name] = now_s + _SECOND_S
                self._give(name, lambda target: target.on_no_fix(name, unix_s, reason))  # noqa: B023 - see above
        if now_s - self._second_s >= _SECOND_S:
            self._second_s = now_s
            self._give(None, lambda target: target.on_second(unix_s))

    def _give(self, tag: str | None, call: Callable[[Target], None]) -> None:
        """Call the targets that get a tag, also those that carry one and wait for its first fix; for None all."""
        for route in self.routes:
            if tag is None or route.tag in (None, tag):
                self._guard(route, call)

    def _guard(self, route: Route, call: Callable[[Target], None]) -> None:
        """Call a target; a fault in it costs neither fixes nor other targets."""
        if route.refused or route.has_ended:
            return
        try:
            call(route.target)
        except Exception as error:  # noqa: BLE001 - whatever it is, the others go on
            route.faults += 1
            if route.faults == 1:
                self._log(f"{route.target.text} failed ({error!r}); it is logged once")

    def _carries(self, route: Route, tag: str) -> bool:
        """Whether a target gets the fixes of a tag; one that carries only one keeps the first tag with a fix."""
        if route.tag is None and route.target.one_tag:
            route.tag = tag
        if route.tag in (None, tag):
            return True
        if route.target.one_tag and not route.others:
            route.others = True
            self._log(f"{route.target.text} carries one tag, {route.tag}; ?tag=NAME chooses another, as {tag}")
        return False


def open_hub(routes: Sequence[Route], log: Callable[[str], None]) -> Hub:
    """Create the hub of these routes. Raises SkylessError if two have the same address."""
    texts = [route.target.text for route in routes]
    for text in texts:
        if texts.count(text) > 1:
            raise SkylessError(f"the target {text!r} is given twice; give it once")
    return Hub(routes, log)
