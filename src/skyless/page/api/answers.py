"""What the HTTP interface takes and gives, one struct for each; the OpenAPI document is made from them."""

from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from skyless.core.alarm_rule import AlarmRule
from skyless.core.site import Outline, Site
from skyless.page.event_list import Level, SiteEvent
from skyless.run.mqtt.messages import Matrix, Vector

Name = Annotated[str, Meta(max_length=200)]
Names = Annotated[str, Meta(max_length=20_000, description="Names of tags, separated by commas; empty means all.")]


class SiteQuery(Struct, frozen=True, forbid_unknown_fields=True):
    """What every route takes."""

    site: (
        Annotated[int, Meta(ge=0, le=65_535, description="The site's number; by default one that is alive.")]
        | UnsetType
    ) = UNSET


class FormatQuery(SiteQuery, frozen=True):
    """JSON in the site's own frame, or GeoJSON."""

    format: Annotated[
        Literal["json", "geojson"], Meta(description="geojson: WGS 84; status 409 where the site is not georeferenced.")
    ] = "json"


class TagsQuery(SiteQuery, frozen=True):
    """Which tags."""

    group: Annotated[Name, Meta(description="Only tags whose asset is in this group.")] = ""
    zone: Annotated[Name, Meta(description="Only tags in the zone with this identifier.")] = ""
    find: Annotated[Name, Meta(description="Only tags with this in their name or their asset's.")] = ""
    limit: Annotated[int, Meta(ge=1, le=1000, description="How many at most.")] = 100
    after: Annotated[Name, Meta(description="Only names after this one: next of the last answer.")] = ""


class TagQuery(SiteQuery, frozen=True, kw_only=True):
    """One tag."""

    tag: Annotated[Name, Meta(description="The tag's name.")]


class EventsQuery(SiteQuery, frozen=True):
    """Which events."""

    limit: Annotated[int, Meta(ge=1, le=1000, description="How many at most, the newest first.")] = 100
    before: (
        Annotated[int, Meta(ge=1, le=2**53, description="Only events with a smaller id: before of the last answer.")]
        | UnsetType
    ) = UNSET


class AlarmQuery(SiteQuery, frozen=True, kw_only=True):
    """One alarm."""

    rule: Annotated[Name, Meta(description="The rule's identifier.")]
    subject: Annotated[Name, Meta(description="What the alarm is about.")]


class SpanQuery(SiteQuery, frozen=True, kw_only=True):
    """A time range."""

    begin: Annotated[
        str, Meta(min_length=1, max_length=100, description="What people type (yesterday, 14:00), ISO 8601, or Unix s.")
    ] = msgspec.field(name="from")
    end: Annotated[str, Meta(max_length=100, description="The same; by default what follows from the other.")] = (
        msgspec.field(name="to", default="")
    )


class TrackQuery(SpanQuery, frozen=True, kw_only=True):
    """The way of one tag."""

    tag: Annotated[str, Meta(min_length=1, max_length=200, description="The tag's name.")]
    points: Annotated[int, Meta(ge=2, le=20_000, description="How many points at most.")] = 2000


class HeatmapQuery(SpanQuery, frozen=True, kw_only=True):
    """A grid."""

    cell_m: Annotated[float, Meta(ge=0.05, le=50.0, description="Side of a cell.")] = 0.25
    tag: Names = ""


class DwellQuery(SpanQuery, frozen=True, kw_only=True):
    """Tags and a zone."""

    tag: Names = ""
    zone: Annotated[Name, Meta(description="Only the zone with this identifier.")] = ""


class OccupancyQuery(SpanQuery, frozen=True, kw_only=True):
    """A zone, and steps of time."""

    zone: Annotated[Name, Meta(description="Only the zone with this identifier.")] = ""
    step_s: Annotated[float, Meta(ge=1.0, le=86_400.0, description="Length of a step.")] = 300.0


class ContactsQuery(SpanQuery, frozen=True, kw_only=True):
    """A tag, and what counts as near."""

    tag: Annotated[str, Meta(min_length=1, max_length=200, description="The tag's name.")]
    distance_m: Annotated[float, Meta(ge=0.1, le=100.0, description="Tags that are nearer were in contact.")] = 2.0


class StreamQuery(SiteQuery, frozen=True):
    """Which tags a stream is about."""

    tags: Names = ""
    group: Annotated[Name, Meta(description="Only tags whose asset is in this group.")] = ""


def listed(key: str, kind: type) -> type[Struct]:
    """An answer with one field, a list."""
    return msgspec.defstruct(f"{kind.__name__.title()}List", [(key, tuple[kind, ...])], frozen=True)  # type: ignore[valid-type]


class ErrorAnswer(Struct, frozen=True):
    """Every answer with a status of 400 or more."""

    error: str
    """A sentence for people."""


class SiteAnswer(Struct, frozen=True):
    """The site, and how it is."""

    site: Site
    """As in its file, without the outline."""
    outline_m: Outline | None
    simulated: bool
    level: Level | Literal["waiting"]
    text: str
    """What is wrong, for people; empty where all is well."""
    tags: int
    tags_with_fix: int
    connected: bool
    """Whether the page's server is connected to the broker."""
    history: bool
    """Whether it has a history."""
    version: str


class Anchor(Struct, frozen=True):
    """One anchor."""

    id: int
    position_m: Vector
    online: bool | None
    """None where it has not reported."""


class TagFix(Struct, frozen=True):
    """The newest usable fix of a tag."""

    tag: str
    unix_s: float
    """When its last frame ended, by the clock of the page's server."""
    age_s: float
    position_m: Vector
    covariance_m2: Matrix
    velocity_mps: Vector | None
    std_m: float
    """One-sigma radial error."""
    hpl_m: float | None
    """Horizontal protection level."""
    alert: str | None
    method: str
    anchors: tuple[int, ...]


class Tag(Struct, frozen=True):
    """One tag, with its asset's name."""

    tag: str
    name: str
    group: str
    icon: str
    colour: str
    online: bool | None
    """None where it has not reported."""
    zones: tuple[str, ...]
    """Identifiers of the zones that it is in."""
    fix: TagFix | None
    """None where it has had no usable one within five seconds."""


class TagsAnswer(Struct, frozen=True):
    """Tags by name."""

    tags: tuple[Tag, ...]
    next: str | None
    """What to ask for ``after``; None where these are the last."""


class ZoneTags(Struct, frozen=True):
    """A zone, and who is in it."""

    id: str
    name: str
    polygon_m: tuple[tuple[float, float], ...]
    colour: str | None
    tags: tuple[str, ...]


class EventsAnswer(Struct, frozen=True):
    """Events, the newest first."""

    events: tuple[SiteEvent, ...]
    before: int | None
    """What to ask for ``before``; None where these are the oldest."""


class AlarmRulesAnswer(Struct, frozen=True):
    """The rules of alarms."""

    rules: tuple[AlarmRule, ...]
    """Those that were made on the page."""
    file_rules: tuple[AlarmRule, ...]
    """Those of the site's file."""
    site: str


class Acknowledgement(Struct, frozen=True):
    """Somebody has seen an alarm."""

    id: Name
    """Of the occurrence that was seen."""
    by: Name
