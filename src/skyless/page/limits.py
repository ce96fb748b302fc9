"""What the page's server takes at most (``docs/limits.md``)."""

from typing import Final

from msgspec import Struct


class PageLimits(Struct, frozen=True):
    """Beyond them a client gets an answer that names the limit."""

    connections: int = 600
    """Connections in all: well below the 1,024 open files that a program usually may have."""
    connections_per_address: int = 200
    """Connections of one computer."""
    request_s: float = 10.0
    """For how long a connection may be without a whole request; one that waits makes room before."""
    body_s: float = 60.0
    """For how long a body may come."""
    accepts_log_s: float = 60.0
    """Interval between lines about connections that the system could not accept."""
    pages: int = 400
    """Open pages."""
    pages_per_address: int = 100
    """Open pages of one computer."""
    streams: int = 200
    """Open streams of the HTTP interface."""
    message_bytes: int = 16_384
    """A message of a page or stream."""
    body_bytes: int = 1_000_000
    """The body of a request; that of assets or rules may have twice the bytes of a table of assets."""
    floor_plan_bytes: int = 8_000_000
    """A floor plan, as on MQTT. The page's ``survey/plan.js`` has the same limit."""
    sites: int = 20
    """Sites of one broker that are shown."""
    site_idle_s: float = 600.0
    """A site without zones or alarm rules is let go when nobody has looked at it for this long."""
    questions: int = 20
    """Questions to the history that wait for their turn."""
    question_s: float = 60.0
    """For how long a question to the history is answered, its waiting included."""
    answer_bytes: int = 16_000_000
    """An answer of the history, or of another process of the server."""


LIMITS: Final = PageLimits()
