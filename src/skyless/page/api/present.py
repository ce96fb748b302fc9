"""Answers about the site as it is now, and what changes it."""

import asyncio
from collections.abc import Iterable
from typing import Final

from msgspec.structs import asdict, replace
from starlette.exceptions import HTTPException

from skyless.bridges.target import is_usable
from skyless.core.version import installed_version
from skyless.page.api.answers import (
    Acknowledgement,
    AlarmRulesAnswer,
    Anchor,
    EventsAnswer,
    SiteAnswer,
    Tag,
    TagsAnswer,
    ZoneTags,
)
from skyless.page.api.parameters import After, Before, Find, Group, Limit, RuleId, Subject, TagName, ZoneId
from skyless.page.live import LiveSite
from skyless.run.assets import read_csv, write_csv
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AlarmRulesMessage,
    Asset,
    AssetsMessage,
    FixMessage,
)

_ALL: Final = 2**53
_STORED_S: Final = 5.0
_POLL_S: Final = 0.02


def site(live: LiveSite) -> SiteAnswer:
    """The site, and how it is."""
    return SiteAnswer(
        **asdict(live.require_site()),
        condition=live.condition,
        connected=live.connected,
        history=live.has_history,
        version=installed_version(),
    )


def anchors(live: LiveSite) -> tuple[Anchor, ...]:
    """Its anchors."""
    return tuple(
        Anchor(anchor.id, (anchor.x_m, anchor.y_m, anchor.z_m), _online(live, "anchor", str(anchor.id)))
        for anchor in live.require_site().site.anchors
    )


def _online(live: LiveSite, kind: str, name: str) -> bool | None:
    status = live.state.statuses.get((kind, name))
    return None if status is None else status.online


def tags(
    live: LiveSite, *, group: Group = "", zone: ZoneId = "", find: Find = "", limit: Limit = 100, after: After = ""
) -> TagsAnswer:
    """Tags by name, in pages."""
    find = find.casefold()
    found: list[str] = []
    for name in sorted(name for name in _names(live) if name > after):
        asset = live.assets.by_tag.get(name, Asset(name))
        if group and asset.group != group:
            continue
        if find not in name.casefold() and find not in asset.name.casefold():
            continue
        if zone and zone not in _zones(live, name):
            continue
        found.append(name)
        if len(found) > limit:
            break
    shown = found[:limit]
    return TagsAnswer(_tags(live, shown), shown[-1] if len(found) > limit else None)


def _names(live: LiveSite) -> set[str]:
    return {name for kind, name in live.state.statuses if kind == "tag"}.union(live.state.tags)


def tag(live: LiveSite, *, tag: TagName) -> Tag:
    """One tag."""
    if tag not in _names(live):
        raise HTTPException(404, f"tag is {tag[:60]!r}; no tag of this name has reported at this site")
    return _tags(live, [tag])[0]


def _tags(live: LiveSite, names: list[str]) -> tuple[Tag, ...]:
    fixes = {fix.tag: fix for fix in usable(given for given in live.recent_fixes() if given[0].tag in names)}
    return tuple(
        Tag(
            **asdict(live.assets.by_tag.get(name, Asset(name))),
            online=_online(live, "tag", name),
            zones=_zones(live, name),
            fix=fixes.get(name),
        )
        for name in names
    )


def _zones(live: LiveSite, tag: str) -> tuple[str, ...]:
    return tuple(zone.id for zone in live.monitor.zones_with(tag))


def fixes(live: LiveSite) -> tuple[FixMessage, ...]:
    """The newest usable fix of each tag."""
    return tuple(sorted(usable(live.recent_fixes()), key=lambda fix: fix.tag))


def usable(given: Iterable[tuple[FixMessage, float]]) -> list[FixMessage]:
    """Those of fixes that may be used, with the time by the server's clock, which is given with each."""
    return [replace(fix, unix_s=round(ended_unix_s, 4)) for fix, ended_unix_s in given if is_usable(fix)]


def zones(live: LiveSite) -> tuple[ZoneTags, ...]:
    """Zones, and who is in them."""
    inside = {name: _zones(live, name) for name in sorted(live.state.tags)}
    return tuple(
        ZoneTags(**asdict(zone), tags=tuple(name for name, zones in inside.items() if zone.id in zones))
        for zone in live.monitor.zones
    )


def events(live: LiveSite, *, limit: Limit = 100, before: Before = _ALL) -> EventsAnswer:
    """What has happened, the newest first, in pages."""
    found = live.event_list.before(before, limit + 1)
    return EventsAnswer(tuple(found[:limit]), found[limit - 1].id if len(found) > limit else None)


def assets(live: LiveSite) -> AssetsMessage:
    """What tags are attached to."""
    return live.assets.message


def put_assets(live: LiveSite, *, body: AssetsMessage) -> AssetsMessage:
    """Replace all assets."""
    live.require_site()
    live.assets.store(body.assets, body.site)
    return live.assets.message


def assets_csv(live: LiveSite) -> bytes:
    """The assets as a table."""
    return write_csv(live.assets.message.assets)


def put_assets_csv(live: LiveSite, *, body: bytes) -> AssetsMessage:
    """Replace all assets by a table."""
    return put_assets(live, body=AssetsMessage(read_csv(body)))


def alarms(live: LiveSite) -> tuple[AlarmMessage, ...]:
    """Alarms that are not over."""
    return live.alarms.messages


def alarm_rules(live: LiveSite) -> AlarmRulesAnswer:
    """The rules of alarms."""
    name = "" if live.site is None else live.site.site.name
    return AlarmRulesAnswer(live.alarms.rules, name, file_rules=live.alarms.file_rules)


def put_alarm_rules(live: LiveSite, *, body: AlarmRulesMessage) -> AlarmRulesAnswer:
    """Replace the rules that were made on the page."""
    live.require_site()
    live.alarms.store_rules(body.rules, body.site)
    return replace(alarm_rules(live), rules=body.rules)  # they hold from the next tick on


async def acknowledge(live: LiveSite, *, rule: RuleId, subject: Subject, body: Acknowledgement) -> Acknowledgement:
    """Acknowledge an alarm: answered when the broker has it."""
    live.acknowledge(rule, subject, body.id, body.by)
    try:
        async with asyncio.timeout(_STORED_S):
            while not live.alarms.is_acknowledged(rule, subject, body.id):
                await asyncio.sleep(_POLL_S)
    except TimeoutError:
        raise HTTPException(503, "the broker has not taken it yet; look whether the alarm is acknowledged") from None
    return body
