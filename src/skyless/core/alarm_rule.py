"""A rule that raises alarms at a site, as in its file (``[[alarms]]``) or on MQTT."""

from typing import Literal

from msgspec import Struct

RuleKind = Literal[
    "inside", "outside", "silent", "near", "crowded", "anchor-offline", "anchor-moved", "protection-level", "battery"
]
"""A tag is in a zone; a tag is not in it; a tag sends no fixes; two tags are near each other; too many tags are in a
zone; an anchor is offline; an anchor has moved; a tag's protection level is too large; a tag's battery is low."""

Severity = Literal["info", "warning", "critical"]


class AlarmRule(Struct, frozen=True, forbid_unknown_fields=True):
    """When an alarm is raised, for which tags, and when it ends. Each tag, pair, zone or anchor has its own alarm."""

    id: str
    """1 to 32 letters, digits, dashes and underscores; unique at the site."""
    kind: RuleKind
    name: str = ""
    """What people read; by default the identifier."""
    zone: str | None = None
    """Identifier of the zone; kinds ``inside``, ``outside`` and ``crowded``."""
    tags: tuple[str, ...] = ()
    """Names of tags, and of groups of assets as ``group:NAME``; empty means all."""
    others: tuple[str, ...] = ()
    """Kind ``near``: whom a tag of ``tags`` must not come near to; empty means any other tag."""
    limit: float | None = None
    """``near``: distance in metres; ``crowded``: the most tags allowed; ``protection-level``: metres; ``battery``:
    share from 0 to 1."""
    hysteresis: float = 0.0
    """By how much the value must be back within the limit before the alarm ends, in the limit's unit."""
    after_s: float = 0.0
    """For how long the condition must have held."""
    clear_after_s: float = 1.0
    """For how long it must not have held before the alarm ends."""
    severity: Severity = "warning"
    hours: str = ""
    """When the rule holds, in the local time of the page's server, as ``mon-fri 06:00-18:00, sat 08:00-12:00``; empty
    means always."""
