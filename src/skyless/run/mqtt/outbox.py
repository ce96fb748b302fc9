"""What waits to be sent to a broker: bounded, so that a slow or absent one costs memory only up to a limit."""

import math
import re
from collections import OrderedDict, deque
from typing import Final

from msgspec import Struct

_TOPIC: Final = re.compile(r"[^\s+#\x00-\x1f\x7f]{1,250}")
"""What every broker accepts; nats-server accepts no blanks."""


class Limits(Struct, frozen=True):
    """How much may wait. Payload bytes."""

    topics: int = 1000
    """Topics of QoS 0, each with its newest message, and as many that are retained."""
    topic_bytes: int = 16_000_000
    messages: int = 20_000
    """Messages of QoS 1."""
    bytes: int = 64_000_000
    window: int = 64
    """Messages of QoS 1 that may be sent and not yet acknowledged."""
    payload: int = 8_000_000
    """The largest message; the embedded broker takes no larger one."""


class Waiting(Struct, frozen=True, gc=False):
    """One message on its way."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    until_s: float = math.inf
    """One of QoS 0 is not sent after this, by the clock of its sender."""


class Outbox:
    """Messages not yet sent, and those of QoS 1 not yet acknowledged.

    Of QoS 0 the newest message of a topic stays, and the oldest topics go when there are too many. Of QoS 1 all stay in
    their order, and the oldest that is not on its way goes when there are too many. Retained messages are a topic's
    state: the newest one stays, to be sent again after each reconnect.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._newest: OrderedDict[str, Waiting] = OrderedDict()
        self._newest_bytes = 0
        self._queue: deque[Waiting] = deque()
        self._queue_bytes = 0
        self._again: deque[Waiting] = deque()
        self._flying: dict[int, Waiting] = {}
        self._retained: dict[str, Waiting] = {}
        self._retained_bytes = 0
        self._to_retain: dict[str, Waiting] = {}
        self.dropped = 0
        self.late = 0
        """Those of the dropped that had waited for too long."""
        self.sent = 0
        """Messages of QoS 0 given to the connection, and messages of QoS 1 acknowledged."""

    def add(self, topic: str, payload: bytes, qos: int, *, retain: bool, until_s: float = math.inf) -> str | None:
        """Add a message; returns the fault of one that no broker would accept.

        One of QoS 0 that has not been taken at ``until_s``, by the clock of ``next_message``, is dropped.
        """
        fault = self._fault(topic, payload)
        if fault is not None:
            self.dropped += 1
            return fault
        message = Waiting(topic, payload, qos, retain, until_s)
        if retain:
            self._retain(message)
        elif qos:
            self._queue.append(message)
            self._queue_bytes += len(payload)
            self._shorten_queue()
        else:
            self._replace(message)
        return None

    def next_message(self, now_s: float) -> Waiting | None:
        """The next message to send; None when nothing is left, or the window is full."""
        open_window = len(self._flying) < self._limits.window
        if self._again:
            return self._again.popleft()
        if self._to_retain and (open_window or not next(iter(self._to_retain.values())).qos):
            return self._to_retain.pop(next(iter(self._to_retain)))
        if self._queue and open_window:
            return self._queue.popleft()
        while self._newest:
            message = self._newest.popitem(last=False)[1]
            self._newest_bytes -= len(message.payload)
            if now_s <= message.until_s:
                return message
            self.dropped += 1
            self.late += 1
        return None

    def mark_sent(self, message: Waiting, number: int) -> None:
        """The connection has the message, under this number."""
        if message.qos:
            self._flying[number] = message
        else:
            self.sent += 1

    def acknowledge(self, number: int) -> None:
        """The broker has the message of QoS 1 with this number."""
        message = self._flying.pop(number, None)
        if message is None:
            return
        self.sent += 1
        if not message.retain:
            self._queue_bytes -= len(message.payload)

    def restart(self) -> None:
        """A new connection: send again what was not acknowledged, and what the broker should have retained."""
        self._again.extendleft(message for message in reversed(self._flying.values()) if not message.retain)
        self._flying.clear()
        self._to_retain = dict(self._retained)

    def forget(self, topic: str) -> None:
        """Stop sending the retained message of a topic: another node has published a newer one."""
        self._to_retain.pop(topic, None)
        old = self._retained.pop(topic, None)
        self._retained_bytes -= len(old.payload) if old else 0

    @property
    def unacknowledged(self) -> int:
        """Messages of QoS 1, and retained ones, that the broker does not have for certain."""
        return len(self._flying) + len(self._again) + len(self._queue) + len(self._to_retain)

    def _fault(self, topic: str, payload: bytes) -> str | None:
        if not _TOPIC.fullmatch(topic):
            return f"the topic {topic!r} is not one that every broker accepts"
        if len(payload) > self._limits.payload:
            return f"the message for {topic} has {len(payload)} bytes; {self._limits.payload} are the most"
        return None

    def _replace(self, message: Waiting) -> None:
        old = self._newest.get(message.topic)
        if old is not None:
            self._newest_bytes -= len(old.payload)
            self.dropped += 1
        self._newest[message.topic] = message
        self._newest_bytes += len(message.payload)
        while len(self._newest) > self._limits.topics or self._newest_bytes > self._limits.topic_bytes:
            self._newest_bytes -= len(self._newest.popitem(last=False)[1].payload)
            self.dropped += 1

    def _shorten_queue(self) -> None:
        sent = len(self._flying) + len(self._again)
        while self._queue and (
            len(self._queue) + sent > self._limits.messages or self._queue_bytes > self._limits.bytes
        ):
            self._queue_bytes -= len(self._queue.popleft().payload)
            self.dropped += 1

    def _retain(self, message: Waiting) -> None:
        """Replace the state of a topic."""
        self.forget(message.topic)
        more = len(self._retained) >= self._limits.topics
        if more or self._retained_bytes + len(message.payload) > self._limits.topic_bytes:
            self.dropped += 1
            return
        self._retained[message.topic] = message
        self._retained_bytes += len(message.payload)
        self._to_retain[message.topic] = message
