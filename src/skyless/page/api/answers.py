"""What the HTTP interface answers where no message of MQTT and no answer of the history is the same."""

from typing import Annotated

from msgspec import Meta, Struct

from skyless.core.site import AlarmRule
from skyless.page.condition.monitor import Condition
from skyless.page.event_list import SiteEvent
from skyless.run.mqtt.messages import AlarmRulesMessage, Asset, FixMessage, SiteMessage, Vector, Zone

_Text = Annotated[str, Meta(max_length=200)]


class ErrorAnswer(Struct, frozen=True):
    """Every answer with a status of 400 or more."""

    error: str
    """A sentence for people."""


class SiteAnswer(SiteMessage, frozen=True, kw_only=True):
    """The site as on MQTT, and how it is."""

    condition: Condition
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


class Tag(Asset, frozen=True, kw_only=True):
    """One tag, with its asset."""

    online: bool | None
    """None where it has not reported."""
    zones: tuple[str, ...]
    """Identifiers of the zones that it is in."""
    fix: FixMessage | None
    """None where it has had no usable one within five seconds."""


class TagsAnswer(Struct, frozen=True):
    """Tags by name."""

    tags: tuple[Tag, ...]
    next: str | None
    """What to ask for ``after``; None where these are the last."""


class ZoneTags(Zone, frozen=True, kw_only=True):
    """A zone, and who is in it."""

    tags: tuple[str, ...]


class EventsAnswer(Struct, frozen=True):
    """Events, the newest first."""

    events: tuple[SiteEvent, ...]
    before: int | None
    """What to ask for ``before``; None where these are the oldest."""


class AlarmRulesAnswer(AlarmRulesMessage, frozen=True, kw_only=True):
    """The rules of alarms."""

    file_rules: tuple[AlarmRule, ...]
    """Those of the site's file."""


class Acknowledgement(Struct, frozen=True):
    """Somebody has seen an alarm."""

    id: _Text
    """Of the occurrence that was seen."""
    by: _Text
