"""Gives the fixes of a site to targets: usable ones at each target's rate, and that there is none.

No I/O, and the time is passed in.
"""

from collections.abc import Callable, Sequence
from math import inf
from typing import Final

from msgspec import Struct

from skyless.bridges.target import BridgedSite, Target, is_usable
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import AlarmMessage, AnchorHealth, FixMessage, StatusMessage, TagHealth
from skyless.run.rate_limit import RateLimit

NO_FIX_S: Final = 1.0
"""A tag has no fix once its last usable one is older, ..."""

_MISSED: Final = 2.5
"""... where its fixes are rarer, once it is older than this number of their intervals, ..."""

_LONGEST_S: Final = 10.0
"""... but than this in any case."""

SILENCE_CHECK_S: Final = 0.25
"""Interval in which ``on_tick`` is to be called."""

_SECOND_S: Final = 1.0 - 0.1 * SILENCE_CHECK_S
"""After so long a second has gone by: ticks come late now and then."""

_FORGET_S: Final = 3600.0
"""A tag without a fix for so long is not spoken of any more."""


class Route(Struct):
    """A target, and what the user wants it to get."""

    target: Target
    tag: str | None
    """The only tag; None for all, or for the first where the target carries one."""
    hz: float
    rates: dict[str, RateLimit] = {}
    """Rate limit of each tag."""
    others: bool = False
    """Whether it needs no line that there are more tags than the target carries: there was one, or the user chose."""
    refused: str = ""
    """What the site lacks that the target needs, so that it gets nothing; empty where it serves the site."""
    has_ended: bool = False
    """Whether it has been closed: a broker's link still receives while it takes leave."""
    faults: int = 0
    """How often it failed."""


class _Tag(Struct):
    """What is known of one tag."""

    usable_s: float
    """When its last usable fix came, or when it was first heard of."""
    reason: str
    """Why there is none."""
    intervals_s: tuple[float, float] = (0.0, 0.0)
    """Between its last three usable fixes: a single long one is an outage, two are its rate."""
    reported_s: float = -inf
    """When targets were informed that it has none."""


class Hub:
    """Distributes what comes from one site."""

    def __init__(self, routes: Sequence[Route], log: Callable[[str], None]) -> None:
        self.routes = tuple(routes)
        self.site: BridgedSite | None = None
        self.fixes = 0
        self._log = log
        self._tags: dict[str, _Tag] = {}
        self._second_s = -inf
        """When the last second began."""

    def on_site(self, site: BridgedSite) -> None:
        """The site is known, or has changed.

        Raises:
            SkylessError: it lacks what each of the targets needs; where it lacks what some need, that is logged.
        """
        if site == self.site:
            return
        self.site = site
        reasons = []
        for route in self.routes:
            before, route.refused = route.refused, _refusal(route.target, site)
            if route.refused not in ("", before):
                reasons.append(route.refused)
        if self.routes and all(route.refused for route in self.routes):
            raise SkylessError(self.routes[0].refused)
        for reason in reasons:
            self._log(reason)

    def on_fix(self, fix: FixMessage, now_s: float) -> None:
        """A tag's fix; ``now_s`` is the host's monotonic clock. One before the site is known is not given."""
        tag = self._tags.setdefault(fix.tag, _Tag(now_s, "no fix yet"))
        if not is_usable(fix):
            tag.reason = fix.alert or "position is not finite"
            return
        tag.intervals_s = (tag.intervals_s[1], now_s - tag.usable_s)
        tag.usable_s, tag.reason = now_s, "no fix"
        if self.site is None:
            return
        self.fixes += 1
        for route in self.routes:
            if self._carries(route, fix.tag) and self._is_due(route, fix.tag, now_s):
                self._guard(route, lambda target: target.on_fix(fix))

    def on_health(self, health: TagHealth | AnchorHealth, now_s: float) -> None:
        """State of a tag or an anchor."""
        if isinstance(health, TagHealth):
            tag = self._tags.setdefault(health.tag, _Tag(now_s, "no fix yet"))
            if health.reason is not None:
                tag.reason = health.reason
        for route in self.routes:
            if not isinstance(health, TagHealth) or route.tag in (None, health.tag):
                self._guard(route, lambda target: target.on_health(health))

    def on_status(self, status: StatusMessage) -> None:
        """A program of the site has come or gone."""
        for route in self.routes:
            if status.kind != "tag" or route.tag in (None, status.name):
                self._guard(route, lambda target: target.on_status(status))

    def on_alarm(self, alarm: AlarmMessage) -> None:
        """An alarm as it is now. A target of one tag gets those that concern it."""
        for route in self.routes:
            if route.tag is None or route.tag in alarm.tags:
                self._guard(route, lambda target: target.on_alarm(alarm))

    def on_tick(self, now_s: float, unix_s: float) -> None:
        """To be called every ``SILENCE_CHECK_S``."""
        for name, tag in tuple(self._tags.items()):
            age_s = now_s - tag.usable_s
            if age_s > _FORGET_S:
                self._forget(name)
            elif age_s >= _silence_s(tag.intervals_s) and now_s - tag.reported_s >= _SECOND_S and self.site is not None:
                tag.reported_s = now_s
                self._give_no_fix(name, unix_s, tag.reason)
        if now_s - self._second_s >= _SECOND_S:
            self._second_s = now_s
            for route in self.routes:
                self._guard(route, lambda target: target.on_second(unix_s))

    def _forget(self, tag: str) -> None:
        del self._tags[tag]
        for route in self.routes:
            route.rates.pop(tag, None)

    def _give_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        for route in self.routes:
            if route.tag in (None, tag):  # one that carries a single tag waits for a tag that has fixes
                self._guard(route, lambda target: target.on_no_fix(tag, unix_s, reason))

    def _guard(self, route: Route, call: Callable[[Target], None]) -> None:
        """Call a target; a fault in it costs neither a fix nor another target."""
        if route.refused or route.has_ended:
            return
        try:
            call(route.target)
        except Exception as error:  # noqa: BLE001 - whatever it is, the others go on
            route.faults += 1
            if route.faults == 1:
                self._log(f"{route.target.text} failed ({error!r}); it is logged once")

    @staticmethod
    def _is_due(route: Route, tag: str, now_s: float) -> bool:
        if tag not in route.rates:
            route.rates[tag] = RateLimit(route.hz)
        return route.rates[tag].is_due(now_s)

    def _carries(self, route: Route, tag: str) -> bool:
        """Whether a target gets the fixes of a tag; one that carries a single one keeps to the first that has any."""
        if route.tag is None and route.target.one_tag:
            route.tag = tag
        if route.tag in (None, tag):
            return True
        if route.target.one_tag and not route.others:
            route.others = True
            self._log(f"{route.target.text} carries one tag, {route.tag}; ?tag=NAME chooses another, as {tag}")
        return False


def open_hub(routes: Sequence[Route], log: Callable[[str], None]) -> Hub:
    """The hub of routes. Raises SkylessError: two of them have the same address."""
    texts = [route.target.text for route in routes]
    for text in texts:
        if texts.count(text) > 1:
            raise SkylessError(f"the target {text!r} is given twice; give it once")
    return Hub(routes, log)


def _refusal(target: Target, site: BridgedSite) -> str:
    """Why a target cannot serve a site; empty where it can."""
    try:
        target.on_site(site)
    except SkylessError as error:
        return str(error)
    return ""


def _silence_s(intervals_s: tuple[float, float]) -> float:
    """How long a tag whose last fixes came at these intervals must be silent to have none."""
    return min(max(NO_FIX_S, _MISSED * min(intervals_s)), _LONGEST_S)
