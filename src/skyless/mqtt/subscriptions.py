"""Who gets which message: handlers by topic filter."""

import logging
from collections.abc import Callable
from typing import Final

from paho.mqtt.client import topic_matches_sub

Handler = Callable[[str, bytes], None]
"""Called from the event loop with topic and payload; must return quickly."""

_log = logging.getLogger("skyless.mqtt")

_MOST_TOPICS: Final = 10_000


class Subscriptions:
    """The handlers of one link; those of each topic are looked for once."""

    def __init__(self) -> None:
        self.filters: dict[str, int] = {}
        """Topic filters, each with its QoS."""
        self._handlers: dict[str, Handler] = {}
        self._found: dict[str, tuple[Handler, ...]] = {}

    def add(self, topic_filter: str, handler: Handler, qos: int) -> None:
        """Let a handler have all messages of a filter, in the place of the one before."""
        self.filters[topic_filter], self._handlers[topic_filter] = qos, handler
        self._found.clear()

    def receive(self, topic: str, payload: bytes) -> None:
        """Give a message to all whose filter it matches."""
        handlers = self._found.get(topic)
        if handlers is None:
            handlers = self._find(topic)
        for handler in handlers:
            try:
                handler(topic, payload)
            except Exception:  # noqa: BLE001 - one bad handler must not cost the others the connection
                _log.exception("a message of %s could not be handled", topic)

    def _find(self, topic: str) -> tuple[Handler, ...]:
        if len(self._found) >= _MOST_TOPICS:
            self._found.clear()
        found = tuple(handler for name, handler in self._handlers.items() if topic_matches_sub(name, topic))
        self._found[topic] = found
        return found
