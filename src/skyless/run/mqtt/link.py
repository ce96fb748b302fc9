"""A link to an MQTT broker, which never delays its owner."""

import asyncio
import logging
import math
import os
import platform
import random
import secrets
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Final

import msgspec
from msgspec import Struct
from paho.mqtt.matcher import MQTTMatcher

from skyless.core.version import installed_version
from skyless.run.mqtt.address import MqttAddress, may_subscribe
from skyless.run.mqtt.connection import (
    Connection,
    Introduction,
    Limits,
    Outbox,
    Reactions,
    RefusedError,
    open_connection,
    trouble_with,
)
from skyless.run.mqtt.messages import Counters, StatusMessage
from skyless.run.mqtt.topics import status_topic

_log = logging.getLogger("skyless.run.mqtt")
_encode: Final = msgspec.json.Encoder().encode

Handler = Callable[[str, bytes], None]
"""Called from the event loop with topic and payload; must return quickly."""

READER_KEEPALIVE_S: Final = 20
NODE_KEEPALIVE_S: Final = 10
"""How long a broker may be silent. A link sends a ping after half of this time, and the broker disconnects a client
that has been silent for three quarters of it; so a busy event loop may delay a ping by a quarter. With 10 s, bridges
lost their connections."""

_MAX_TOPICS: Final = 10_000
_FIRST_WAIT_S: Final = 0.1
_LONGEST_WAIT_S: Final = 5.0
_LONGEST_WAIT_LOOPBACK_S: Final = 0.5
_LEAVE_S: Final = 1.0
_SAME_TROUBLE_S: Final = 30.0
_ECHO_S: Final = 5.0
"""Time within which the broker should have returned a link's own status."""
RESEND_S: Final = 30.0
"""Longest time between repetitions of a status or a site, which a bridged broker may have missed or lost."""
_QUICK_START_S: Final = 0.5
"""A first connection made within this time is not logged."""


class Link:
    """A node's MQTT connection, restored whenever it is lost while ``run`` runs.

    If one of the address's brokers refuses or does not answer, it tries the next. It publishes the node's status,
    retained and with a last will. Messages wait in an ``Outbox`` while the broker is slow or away. Everything runs in
    one event loop. Subscribers may get a message of QoS 1 twice if a connection breaks.
    """

    def __init__(
        self,
        address: MqttAddress,
        name: int | str,
        *,
        site: int | str,
        kind: str,
        persistent: bool = False,
        client_key: str = "",
        keepalive_s: int = READER_KEEPALIVE_S,
        limits: Limits | None = None,
    ) -> None:
        """``persistent`` lets the broker keep messages of QoS 1 for this name until the link is stopped.

        Two persistent links with one client identifier would end each other's connection, and a stranger who knows the
        identifier could do so. Therefore the secret ``client_key`` becomes part of it.

        Raises SkylessError: the address names a file of certificates that cannot be used.
        """
        self.address = address
        self.connected = False
        self.trouble: str | None = "not connected yet"
        """Why there is no connection; None while there is one."""
        self.refused: set[str] = set()
        """Topic filters that the broker refuses, because of the user or for lack of room."""
        self.on_state: list[Callable[[bool], None]] = []
        """Called with ``connected`` whenever it changes."""
        self._tls = address.tls_context()
        self._keepalive_s = keepalive_s
        key = client_key if persistent else secrets.token_hex(4)
        self._client = f"skyless-{site}-{kind}-{name}" + (f"-{key}" if key else "")
        self._persistent = persistent
        self._status_topic = status_topic(site, kind, name)
        self._offline = StatusMessage(online=False, kind=kind, name=str(name))
        self._outbox = Outbox(limits or Limits())
        self._subscriptions = Subscriptions()
        self._reactions = Reactions(self._subscriptions.receive, self._acknowledged, self._pump, self._subscribed)
        self._connection: Connection | None = None
        self._brokers = address.brokers
        """Brokers of the address, rotated so that the present one is first."""
        self._reconnects = -1
        self._reported_dropped = 0
        self._away_since_s = time.monotonic()
        self._logged: tuple[str, float] = ("", 0.0)
        self._logged_fault = False
        self._stopping = False
        self._online, self._has_echo = b"", False
        self.subscribe(self._status_topic, self._correct_status)

    @property
    def counters(self) -> Counters:
        """Messages sent and dropped, and reconnects."""
        return Counters(self._outbox.sent, self._outbox.dropped, max(0, self._reconnects))

    @property
    def late(self) -> int:
        """Messages dropped because they could not be sent in time."""
        return self._outbox.late

    @property
    def unread_s(self) -> float:
        """For how long messages from the broker have continuously waited to be read; 0 if none wait."""
        since_s = None if self._connection is None else self._connection.unread_since_s
        return 0.0 if since_s is None else asyncio.get_running_loop().time() - since_s

    @property
    def unacknowledged(self) -> int:
        """Number of messages of QoS 1, and retained ones, that the broker may not have."""
        return self._outbox.unacknowledged

    def publish(
        self, topic: str, message: Struct | bytes, *, qos: int = 0, retain: bool = False, until_s: float = math.inf
    ) -> None:
        """Queue a message, and return at once. A struct becomes JSON.

        A message of QoS 0 that cannot be sent before ``until_s``, by the host's monotonic clock, is dropped.
        """
        payload = message if isinstance(message, bytes) else _encode(message)
        fault = self._outbox.add(topic, payload, qos, retain=retain, until_s=until_s)
        if fault is not None and not self._logged_fault:
            self._logged_fault = True
            _log.warning("not published: %s", fault)
        self._pump()

    def forget(self, topic: str) -> None:
        """Stop repeating a retained message after reconnects, because another node has written a newer one."""
        self._outbox.forget(topic)

    def subscribe(self, topic_filter: str, handler: Handler, qos: int = 0) -> None:
        """Call ``handler`` with every message that matches a filter, also after reconnects.

        A second handler for the same filter replaces the first. If filters of one link overlap, some brokers send a
        message once for each of them; all matching handlers are then called each time.
        """
        self._subscriptions.add(topic_filter, handler, qos)
        if self._connection is not None:
            self._connection.subscribe({topic_filter: qos})

    async def run(self) -> None:
        """Stay connected until cancelled; then send waiting messages, for at most a second, and disconnect."""
        failures = 0
        try:
            while True:
                begin_s = time.monotonic()
                if not await self._one_connection():
                    self._brokers = self._brokers[1:] + self._brokers[:1]
                elif time.monotonic() - begin_s > _LONGEST_WAIT_S:
                    failures = 0
                await asyncio.sleep(self._wait_s(failures // len(self._brokers)))
                failures += 1
        finally:
            self._down("stopped")
            if self.unacknowledged:
                _log.warning("stopped; the broker %s has not accepted %d messages", self.address, self.unacknowledged)

    async def _one_connection(self) -> bool:
        """Connect once, and wait until the connection is lost. Returns False if none was made."""
        broker = self._brokers[0]
        try:
            connection = await open_connection(broker, self._tls, self._introduction(), self._reactions)
        except (OSError, RefusedError) as error:
            self._log_trouble(trouble_with(broker, error))
            return False
        self._up(connection)
        try:
            await connection.lost.wait()
        except asyncio.CancelledError:
            await self._leave(connection)
            raise
        self._down(connection.reason)
        _log.warning("lost the broker %s: %s", broker, connection.reason)
        return True

    def _introduction(self) -> Introduction:
        will = self._status_topic, _encode(self._offline)
        return Introduction(self._client, self._keepalive_s, self._persistent, will)

    def _up(self, connection: Connection) -> None:
        connection.subscribe(self._subscriptions.filters)  # first: retained messages come before they are replaced
        self._connection = connection
        self._stopping = False
        self._reconnects += 1
        self._log_return()
        self._outbox.restart()
        self._has_echo = False
        self._publish_online()
        self._set_state(connected=True, trouble=None)
        self._pump()
        asyncio.get_running_loop().call_later(_ECHO_S, self._check_echo, connection)
        self._repeat_later(connection)

    def _down(self, reason: str) -> None:
        self._connection = None
        if self.connected:
            self._away_since_s = time.monotonic()
            self._set_state(connected=False, trouble=reason)

    def _set_state(self, *, connected: bool, trouble: str | None) -> None:
        self.connected, self.trouble = connected, trouble
        for callback in self.on_state:
            callback(connected)

    def _publish_online(self) -> None:
        status = StatusMessage(
            online=True,
            kind=self._offline.kind,
            name=self._offline.name,
            version=installed_version(),
            host=platform.node(),
            pid=os.getpid(),
            unix_s=time.time(),
        )
        self._online = _encode(status)
        self.publish(self._status_topic, self._online, qos=1, retain=True)

    def _repeat_later(self, connection: Connection) -> None:
        """Schedule a repetition of the status, at a random time because many links connect at the same moment."""
        asyncio.get_running_loop().call_later(RESEND_S * random.uniform(0.5, 1.0), self._repeat_status, connection)

    def _repeat_status(self, connection: Connection) -> None:
        if self._connection is connection and not self._stopping:
            self.publish(self._status_topic, self._online, qos=1, retain=True)
            if self.refused:  # a broker that was full may have room again
                filters = self._subscriptions.filters
                connection.subscribe({name: filters[name] for name in self.refused})
            self._repeat_later(connection)

    def _correct_status(self, _topic: str, payload: bytes) -> None:
        """Publish the status again after a late last will from an older connection."""
        self._has_echo = self._has_echo or payload == self._online
        if not self._stopping and b'"online":false' in payload:
            self._publish_online()

    def _check_echo(self, connection: Connection) -> None:
        """Warn if the broker drops acknowledged messages: MQTT 3.1.1 has no other answer to a missing permission."""
        if self._connection is connection and not self._has_echo and not self.unacknowledged:
            _log.warning(
                "the broker %s has not returned %s: its user may not publish it, or not read it",
                self._brokers[0],
                self._status_topic,
            )

    async def _leave(self, connection: Connection) -> None:
        self._stopping = True
        try:
            async with asyncio.timeout(_LEAVE_S):
                self.publish(self._status_topic, self._offline, qos=1, retain=True)
                while self._outbox.unacknowledged and not connection.lost.is_set():
                    await asyncio.sleep(0.005)
                if self._persistent:
                    connection.unsubscribe(self._subscriptions.filters)
                await connection.leave()
        except TimeoutError:
            pass
        finally:
            connection.abort("stopped")

    def _pump(self) -> None:
        connection = self._connection
        while connection is not None and connection.writable:
            message = self._outbox.next_message(time.monotonic())
            if message is None:
                return
            number = connection.publish(message.topic, message.payload, message.qos, retain=message.retain)
            self._outbox.mark_sent(message, number)

    def _subscribed(self, topic_filter: str, granted: bool) -> None:
        if granted:
            self.refused.discard(topic_filter)
        elif topic_filter not in self.refused:
            self.refused.add(topic_filter)
            user = self.address.user
            why = {
                True: "this user may read it, so the broker has no room for more subscriptions (its log says why)",
                False: f"the role {user} may not read it",
                None: "this user may not read it, or there is no room for more subscriptions (its log says why)",
            }[may_subscribe(user, topic_filter)]
            _log.warning("the broker %s has refused a subscription to %s: %s", self.address, topic_filter, why)

    def _acknowledged(self, number: int) -> None:
        self._outbox.acknowledge(number)
        self._pump()

    def _wait_s(self, failures: int) -> float:
        longest_s = _LONGEST_WAIT_LOOPBACK_S if self.address.loopback else _LONGEST_WAIT_S
        return min(longest_s, _FIRST_WAIT_S * 2.0 ** min(failures, 10)) * random.uniform(0.6, 1.0)

    def _log_trouble(self, trouble: str) -> None:
        """Log a problem once, and again every half minute while it lasts."""
        self.trouble = trouble
        now_s = time.monotonic()
        if trouble != self._logged[0] or now_s > self._logged[1] + _SAME_TROUBLE_S:
            self._logged = (trouble, now_s)
            _log.warning("%s", trouble)

    def _log_return(self) -> None:
        dropped = self._outbox.dropped - self._reported_dropped
        away_s = time.monotonic() - self._away_since_s
        if self._reconnects or (dropped and away_s > _QUICK_START_S):
            _log.warning("connected to %s after %.1f s; %d messages were dropped", self._brokers[0], away_s, dropped)
        self._reported_dropped += dropped
        self._logged = ("", 0.0)


class Subscriptions:
    """The handlers of one link, in a tree of the levels of their filters."""

    def __init__(self) -> None:
        self.filters: dict[str, int] = {}
        """Topic filters with their QoS."""
        self._handlers = MQTTMatcher()  # type: ignore[no-untyped-call]
        self._matching = lru_cache(_MAX_TOPICS)(self._match)

    def add(self, topic_filter: str, handler: Handler, qos: int) -> None:
        """Set the handler of a filter, replacing any previous one."""
        self.filters[topic_filter], self._handlers[topic_filter] = qos, handler
        self._matching.cache_clear()

    def _match(self, topic: str) -> tuple[Handler, ...]:
        return tuple(self._handlers.iter_match(topic))  # type: ignore[no-untyped-call]

    def receive(self, topic: str, payload: bytes) -> None:
        """Call all handlers whose filters match."""
        for handler in self._matching(topic):
            try:
                handler(topic, payload)
            except Exception:  # noqa: BLE001 - one bad handler must not cost the others the connection
                _log.exception("a message of %s could not be handled", topic)
