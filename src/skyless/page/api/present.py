"""Answers about the site as it is now, and what changes it."""

from collections.abc import Iterable, Sequence
from typing import Final

from msgspec import UNSET, Struct
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
    TagFix,
    TagsAnswer,
    ZoneTags,
)
from skyless.page.api.call import Call
from skyless.page.live import LiveSite, NoSiteError
from skyless.run.assets import read_csv, write_csv
from skyless.run.mqtt.messages import Asset, AssetsMessage, FixMessage, SiteMessage

Listed = dict[str, Sequence[Struct]]

OLDEST_S: Final = 5.0
"""A tag whose last fix is older has none."""


def _known(live: LiveSite) -> SiteMessage:
    if live.site is None:
        raise NoSiteError("no site is known yet")
    return live.site


def site(call: Call) -> SiteAnswer:
    """The site."""
    message, condition = _known(call.live), call.live.condition
    return SiteAnswer(
        site=message.site,
        outline_m=message.outline_m or None,
        simulated=message.simulated,
        level=condition.level,
        text=condition.text,
        tags=condition.tags,
        tags_with_fix=condition.tags_with_fix,
        connected=call.live.connected,
        history=call.live.has_history,
        version=installed_version(),
    )


def anchors(call: Call) -> Listed | bytes:
    """Its anchors."""
    if call.query.format == "geojson":
        return call.live.features("anchors")
    return {
        "anchors": [
            Anchor(anchor.id, (anchor.x_m, anchor.y_m, anchor.z_m), _online(call.live, "anchor", str(anchor.id)))
            for anchor in _known(call.live).site.anchors
        ]
    }


def _online(live: LiveSite, kind: str, name: str) -> bool | None:
    status = live.state.statuses.get((kind, name))
    return None if status is None else status.online


def tags(call: Call) -> TagsAnswer:
    """Tags, a page of them."""
    live, query = call.live, call.query
    statuses = {name for kind, name in live.state.statuses if kind == "tag"}
    found: list[str] = []
    for name in sorted(statuses.union(live.state.tags)):
        asset = live.assets.by_tag.get(name, Asset(name))
        if name <= query.after and query.after:
            continue
        if query.group and asset.group != query.group:
            continue
        if query.find.casefold() not in name.casefold() and query.find.casefold() not in asset.name.casefold():
            continue
        if query.zone and query.zone not in _zones(live, name):
            continue
        found.append(name)
        if len(found) > query.limit:
            break
    shown = found[: query.limit]
    return TagsAnswer(_tags(live, shown), shown[-1] if len(found) > len(shown) else None)


def tag(call: Call) -> Tag:
    """One tag."""
    live, name = call.live, call.query.tag
    if name not in live.state.tags and ("tag", name) not in live.state.statuses:
        raise HTTPException(404, f"tag is {name[:60]!r}; no tag of this name has reported at this site")
    return _tags(live, [name])[0]


def _tags(live: LiveSite, names: list[str]) -> tuple[Tag, ...]:
    wanted = set(names)
    recent = live.state.fixes_since(live.now_s, OLDEST_S)
    fixes = {fix.tag: fix for fix in usable(live, (given for given in recent if given[0].tag in wanted))}
    found = []
    for name in names:
        asset = live.assets.by_tag.get(name, Asset(name))
        what = (asset.name, asset.group, asset.icon, asset.colour)
        found.append(Tag(name, *what, _online(live, "tag", name), _zones(live, name), fixes.get(name)))
    return tuple(found)


def _zones(live: LiveSite, tag: str) -> tuple[str, ...]:
    return tuple(zone.id for zone in live.monitor.zones_with(tag))


def fixes(call: Call) -> Listed | bytes:
    """The newest usable fix of each tag."""
    if call.query.format == "geojson":
        return call.live.features("fixes")
    recent = call.live.state.fixes_since(call.live.now_s, OLDEST_S)
    return {"fixes": usable(call.live, sorted(recent, key=lambda given: given[0].tag))}


def usable(live: LiveSite, given: Iterable[tuple[FixMessage, float]]) -> list[TagFix]:
    """Those of fixes that may be used; each is given with when it ended."""
    unix_s = live.unix_s
    return [
        TagFix(
            tag=fix.tag,
            unix_s=round(ended_unix_s, 4),
            age_s=round(max(unix_s - ended_unix_s, 0.0), 3),
            position_m=fix.position_m,
            covariance_m2=fix.covariance_m2,
            velocity_mps=fix.velocity_mps,
            std_m=fix.std_m,
            hpl_m=fix.hpl_m,
            alert=fix.alert,
            method=fix.method,
            anchors=fix.anchors,
        )
        for fix, ended_unix_s in given
        if is_usable(fix)
    ]


def zones(call: Call) -> Listed | bytes:
    """The zones."""
    live = call.live
    if call.query.format == "geojson":
        return live.features("zones")
    inside = {name: _zones(live, name) for name in sorted(live.state.tags)}
    return {
        "zones": [
            ZoneTags(**asdict(zone), tags=tuple(name for name, zones in inside.items() if zone.id in zones))
            for zone in live.monitor.zones
        ]
    }


def events(call: Call) -> EventsAnswer:
    """What has happened, a page of it."""
    before = None if call.query.before is UNSET else call.query.before
    found = call.live.event_list.before(before, call.query.limit + 1)
    shown = tuple(found[: call.query.limit])
    return EventsAnswer(shown, shown[-1].id if len(found) > len(shown) else None)


def assets(call: Call) -> AssetsMessage:
    """What tags are attached to."""
    return call.live.assets_message


def assets_csv(call: Call) -> bytes:
    """The same as a table."""
    return write_csv(call.live.assets.assets)


def put_assets(call: Call) -> AssetsMessage:
    """Replace all assets."""
    _known(call.live)
    call.live.store_assets(call.body.assets, call.body.site)
    return call.live.assets_message


def put_assets_csv(call: Call) -> AssetsMessage:
    """Replace all assets by those of a table."""
    _known(call.live)
    call.live.store_assets(read_csv(call.body))
    return call.live.assets_message


def alarms(call: Call) -> Listed:
    """Alarms that are not over."""
    return {"alarms": call.live.alarms.messages}


def alarm_rules(call: Call) -> AlarmRulesAnswer:
    """The rules of alarms."""
    name = "" if call.live.site is None else call.live.site.site.name
    return AlarmRulesAnswer(tuple(call.live.alarms.rules), tuple(call.live.alarms.file_rules), name)


def put_alarm_rules(call: Call) -> AlarmRulesAnswer:
    """Replace the rules that were made on the page."""
    _known(call.live)
    call.live.store_alarm_rules(call.body.rules, call.body.site)
    return replace(alarm_rules(call), rules=call.body.rules)  # they hold from the next tick on


def acknowledge(call: Call) -> Acknowledgement:
    """Somebody has seen an alarm."""
    call.live.acknowledge(call.query.rule, call.query.subject, call.body.id, call.body.by)
    acknowledged: Acknowledgement = call.body
    return acknowledged
