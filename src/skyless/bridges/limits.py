"""What bridges that serve take at most (``docs/limits.md``)."""

from typing import Final

from msgspec import Struct


class BridgeLimits(Struct, frozen=True):
    """Beyond them a client is refused, or the oldest messages are dropped and counted."""

    clients: int = 32
    """Clients of Foxglove's protocol, connections to Prometheus's metrics."""
    readers: int = 64
    """Connections to one TCP server of lines."""
    request_bytes: int = 65_536
    """A message of a client of Foxglove's protocol."""
    head_bytes: int = 8_192
    """The head of a request for metrics."""
    answer_s: float = 5.0
    """After this time a connection to the metrics is ended, even in the middle of an answer."""
    waiting_messages: int = 500
    """Messages that wait for one client; beyond it the oldest are dropped."""
    channels: int = 2_000
    """Channels of Foxglove's protocol."""
    deliveries: int = 1_000
    """Mails or web hooks that wait; beyond it the oldest are dropped."""


LIMITS: Final = BridgeLimits()
