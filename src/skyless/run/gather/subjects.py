"""Subjects and streams of NATS (``docs/batches.md``). ``{}`` is the site's number, or ``*`` for all sites.

MQTT topics are subjects with dots instead of slashes. nats-server writes a dot within a level of a topic as ``//``.
"""

import platform
import re
from typing import Final

JSON_FIXES: Final = "skyless.v1.{}.tag.*.fix"
STATUSES: Final = "skyless.v1.{}.*.*.status"
SITES: Final = "skyless.v1.{}.site"
FIXES: Final = "skyless.v2.{}.fixes.*"
"""Batches; the last level is the sender's host."""
NAMES: Final = "skyless.v2.{}.names.*"
"""``TagName``; the last level is the tag's number."""
SUMMARY: Final = "skyless.v2.{}.summary"

STATE: Final = (
    "skyless.v1.{}.site",
    "skyless.v1.{}.floor_plan",
    "skyless.v1.{}.floor_plan.*",
    "skyless.v1.{}.*.*.status",
    "skyless.v1.{}.zones",
    "skyless.v1.{}.assets",
    "skyless.v1.{}.alarm_rules",
    "skyless.v1.{}.survey.state",
    "skyless.v1.{}.survey.placement",
    "skyless.v1.{}.survey.watch",
)
"""Retained messages of MQTT of which the newest matters."""
EVENTS: Final = ("skyless.v1.{}.zone.*.event", "skyless.v1.{}.alarm.*.*.state")
"""Messages of MQTT of which each is an event."""

FIX_STREAM: Final = "FIX_{}"
NAMES_STREAM: Final = "NAMES_{}"
STATE_STREAM: Final = "STATE_{}"
EVENT_STREAM: Final = "EVENTS_{}"

"""Streams of a site at its own server; a hub's have the same names, and there a reader asks for the site's subjects."""
SOURCED: Final = "sourced.{}"
"""How the subjects begin under which a site's messages come to the streams of a hub."""
DOMAIN: Final = "site{}"
"""JetStream's domain of a site."""

NAME_REQUESTS: Final = "$JS.API.DIRECT.GET.*.skyless.v2.*.names.*"
"""Where the server is asked for the name of one number."""
PAGE_INBOX: Final = "_INBOX_PAGE"
"""How the subjects begin under which pages are answered."""

EVERY: Final = "*"


def at(pattern: str, site: int | str, last: int | str = "") -> str:
    """A subject or stream of a site, with its last level where the pattern leaves it open."""
    subject = pattern.format(site)
    return f"{subject[:-1]}{last}" if last else subject


def own_host() -> str:
    """Name of the own computer as one level of a subject."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", platform.node()) or "host"


def tag_in(subject: str) -> str:
    """Name of the tag in a subject of ``JSON_FIXES``, as in the MQTT topic."""
    return subject.split(".")[4].replace("//", ".")


def subject_of(topic: str) -> str:
    """The subject of a topic of MQTT, or the pattern of a topic filter."""
    levels = (level.replace(".", "//") for level in topic.split("/"))
    return ".".join("*" if level == "+" else level for level in levels)


def topic_of(subject: str) -> str:
    """The topic of MQTT of a subject."""
    return "/".join(level.replace("//", ".") for level in subject.split("."))


def site_in(subject: str) -> int | None:
    """Number of the site in a subject, or None where it has none."""
    level = subject.split(".")[2]
    return int(level) if level.isdecimal() and len(level) < 6 else None
