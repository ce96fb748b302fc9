"""Subjects and streams of NATS, version 2 (``docs/batches.md``).

MQTT topics are subjects with dots instead of slashes; nats-server writes a dot within a level of a topic as ``//``.
"""

import platform
import re
from typing import Final

ROOT: Final = "skyless.v2"
EVERY: Final = "*"
NAME_LEVEL: Final = 4
"""Level of a tag's or node's name in the subjects of version 1."""


def own_host() -> str:
    """Name of the own computer as one level of a subject."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", platform.node()) or "host"


def level_of(subject: str, level: int) -> str:
    """A level as it was in the MQTT topic."""
    return subject.split(".")[level].replace("//", ".")


def json_fixes(site: int | str) -> str:
    """``FixMessage`` of each tag, version 1."""
    return f"skyless.v1.{site}.tag.*.fix"


def statuses(site: int | str) -> str:
    """``StatusMessage`` of each program, version 1."""
    return f"skyless.v1.{site}.*.*.status"


def site_messages(site: int | str) -> str:
    """``SiteMessage``, version 1."""
    return f"skyless.v1.{site}.site"


def fixes(site: int | str, host: str = ">") -> str:
    """Batches of fixes that a host sends; by default those of every host."""
    return f"{ROOT}.{site}.fixes.{host}"


def name_of(site: int | str, number: int | str = EVERY) -> str:
    """``TagName`` of a number."""
    return f"{ROOT}.{site}.names.{number}"


def numbers_request(site: int | str) -> str:
    """A request for the numbers of tags, ``NumbersRequest``; gather answers with ``Numbers``."""
    return f"{ROOT}.{site}.numbers"


def live(site: int | str) -> str:
    """Every batch of the site, once more, kept by no stream."""
    return f"{ROOT}.{site}.live"


def summary(site: int | str) -> str:
    """``Summary``, once a second."""
    return f"{ROOT}.{site}.summary"


def fixes_stream(site: int) -> str:
    """The stream of a site's batches."""
    return f"FIX_{site}"


def names_stream(site: int) -> str:
    """The stream of a site's names, one message for each number."""
    return f"NAMES_{site}"


def lock_bucket(site: int) -> str:
    """The bucket of keys and values in which a running gather states itself."""
    return f"GATHER_{site}"
