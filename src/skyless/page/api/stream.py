"""The stream of a site over a WebSocket: the newest fix of each tag, and what happens (``docs/http.md``).

Each stream looks at the site ten times a second and keeps no queue: after a pause, its reader gets the newest state.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Final

import msgspec
from msgspec import Struct
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocket

from skyless.core.version import installed_version
from skyless.page.api.parameters import SiteQuery, TagNames, names, read_query
from skyless.page.api.present import usable
from skyless.page.live import LiveSite
from skyless.page.sites import Sites
from skyless.page.sockets import POLICY_VIOLATION, TRY_LATER, send, serve_socket
from skyless.run.limits import PAGE as LIMITS
from skyless.run.mqtt.messages import AlarmMessage

PERIOD_S: Final = 0.1
_PAUSES: Final = 9.0  # of very many tags a stream is sent less often, so that it takes a tenth of a processor at most
_MAX_REASON_BYTES: Final = 120  # of the 123 that the protocol allows


class StreamQuery(SiteQuery, frozen=True):
    """Which tags a stream is about."""

    tags: TagNames = ""


class SiteStream:
    """What one reader has been sent."""

    def __init__(self, live: LiveSite, tags: frozenset[str]) -> None:
        """An empty set of tags means all."""
        self._live, self._tags = live, tags
        self._fixes = 0  # serial of the last fix
        self._event = live.event_list.last
        self._alarms: dict[tuple[str, str], AlarmMessage] = {}  # by rule and subject

    def hello(self) -> bytes:
        """The first message."""
        live = self._live
        name = None if live.site is None else live.site.site.name
        fields = {"version": installed_version(), "site": live.number, "name": name, "history": live.has_history}
        return msgspec.json.encode({"type": "hello", **fields})

    def new(self) -> list[bytes]:
        """What is new to the reader."""
        return [*self._new_fixes(), *self._new_zone_events(), *self._new_alarms()]

    def _carries(self, *tags: str) -> bool:
        return not (self._tags and self._tags.isdisjoint(tags))

    def _new_fixes(self) -> list[bytes]:
        serial, self._fixes = self._fixes, self._live.state.serial
        if serial == self._fixes:
            return []
        fixes = usable(given for given in self._live.recent_fixes(after=serial) if self._carries(given[0].tag))
        return [msgspec.json.encode({"type": "fixes", "fixes": fixes})] if fixes else []

    def _new_zone_events(self) -> list[bytes]:
        number, self._event = self._event, self._live.event_list.last
        events = (event.zone_event for event, _ in self._live.event_list.since(number))
        return [_message("zone_event", event) for event in events if event is not None and self._carries(event.tag)]

    def _new_alarms(self) -> list[bytes]:
        now = {(alarm.rule, alarm.subject): alarm for alarm in self._live.alarms.messages}
        before, self._alarms = self._alarms, now
        changed = [(alarm, False) for key, alarm in now.items() if before.get(key) != alarm]
        changed += [(alarm, True) for key, alarm in before.items() if key not in now]
        return [
            _message("alarm", alarm, over=over)
            for alarm, over in changed
            if not alarm.tags or self._carries(*alarm.tags)
        ]


def _message(kind: str, value: Struct, **more: object) -> bytes:
    return msgspec.json.encode({"type": kind, **more, **msgspec.structs.asdict(value)})


def endpoint(sites: Sites) -> Callable[[WebSocket], Awaitable[None]]:
    """The WebSocket's handler."""
    open_streams: set[WebSocket] = set()

    async def serve(socket: WebSocket) -> None:
        await socket.accept()
        try:
            query = read_query(socket.query_params, StreamQuery)
            live = sites.of(query.site_text)
        except HTTPException as error:
            await socket.close(POLICY_VIOLATION, error.detail.encode()[:_MAX_REASON_BYTES].decode(errors="ignore"))
            return
        if len(open_streams) >= LIMITS.streams:
            await socket.close(TRY_LATER, f"{LIMITS.streams} streams are open")
            return
        open_streams.add(socket)
        live.streams += 1
        try:
            await serve_socket(socket, _send_news(socket, SiteStream(live, frozenset(names(query.tags)))))
        finally:
            open_streams.discard(socket)
            live.streams -= 1

    return serve


async def _send_news(socket: WebSocket, stream: SiteStream) -> None:
    messages, spent_s = [stream.hello()], 0.0
    while True:
        await send(socket, messages)
        await asyncio.sleep(max(PERIOD_S, _PAUSES * spent_s))
        begin_s = time.monotonic()
        messages = stream.new()
        spent_s = time.monotonic() - begin_s
