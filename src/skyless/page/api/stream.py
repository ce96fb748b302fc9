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
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyless.core.version import installed_version
from skyless.page.api.parameters import Group, SiteQuery, TagNames, names, read_query
from skyless.page.api.present import usable
from skyless.page.live import LiveSite, NoSiteError
from skyless.page.sites import LiveSites
from skyless.run.mqtt.messages import AlarmMessage

PERIOD_S: Final = 0.1
_PAUSES: Final = 9.0  # of very many tags a stream is sent less often, so that it takes a tenth of a processor at most
MAX_STREAMS: Final = 200
STREAM_TIMEOUT_S: Final = 10.0
"""A reader that accepts no message for this long is disconnected."""

_POLICY_VIOLATION: Final = 1008
_TRY_LATER: Final = 1013
_MAX_REASON_BYTES: Final = 120  # of the 123 that the protocol allows


class StreamQuery(SiteQuery, frozen=True):
    """Which tags a stream is about."""

    tags: TagNames = ""
    group: Group = ""


class SiteStream:
    """What one reader has been sent."""

    def __init__(self, live: LiveSite, tags: frozenset[str], group: str) -> None:
        """An empty set of tags and an empty group mean all."""
        self._live, self._tags, self._group = live, tags, group
        self._fixes = 0  # serial of the last fix
        self._event = live.event_list.last
        self._alarms: dict[tuple[str, str], AlarmMessage] = {}  # by rule and subject

    def hello(self) -> bytes:
        """The first message."""
        site = self._live.site
        fields = {
            "type": "hello",
            "version": installed_version(),
            "site": self._live.number,
            "name": None if site is None else site.site.name,
            "history": self._live.has_history,
        }
        return msgspec.json.encode(fields)

    def new(self) -> list[bytes]:
        """What is new to the reader."""
        messages = self._new_zone_events() + self._new_alarms()
        serial, self._fixes = self._fixes, self._live.state.serial
        if serial != self._fixes:
            newest = self._live.recent_fixes(after=serial)
            found = usable(given for given in newest if self._carries(given[0].tag))
            if found:
                messages.insert(0, msgspec.json.encode({"type": "fixes", "fixes": found}))
        return messages

    def _carries(self, tag: str) -> bool:
        if self._tags and tag not in self._tags:
            return False
        asset = self._live.assets.by_tag.get(tag) if self._group else None
        return not self._group or (asset is not None and asset.group == self._group)

    def _new_zone_events(self) -> list[bytes]:
        number, self._event = self._event, self._live.event_list.last
        events = (event.zone_event for event in self._live.event_list.since(number))
        return [_message("zone_event", event) for event in events if event is not None and self._carries(event.tag)]

    def _new_alarms(self) -> list[bytes]:
        now = {(alarm.rule, alarm.subject): alarm for alarm in self._live.alarms.messages}
        before, self._alarms = self._alarms, now
        changed = [(alarm, False) for key, alarm in now.items() if before.get(key) != alarm]
        changed += [(alarm, True) for key, alarm in before.items() if key not in now]
        return [
            _message("alarm", alarm, over=over)
            for alarm, over in changed
            if not alarm.tags or any(map(self._carries, alarm.tags))
        ]


def _message(kind: str, value: Struct, **more: object) -> bytes:
    return msgspec.json.encode({"type": kind, **more, **msgspec.structs.asdict(value)})


def endpoint(sites: LiveSites) -> Callable[[WebSocket], Awaitable[None]]:
    """The WebSocket's handler."""
    open_streams: set[WebSocket] = set()

    async def serve(socket: WebSocket) -> None:
        await socket.accept()
        try:
            query = read_query(socket.query_params, StreamQuery)
            live = sites.of(query.site_text)
        except (HTTPException, NoSiteError) as error:
            reason = error.detail if isinstance(error, HTTPException) else str(error)
            await socket.close(_POLICY_VIOLATION, reason.encode()[:_MAX_REASON_BYTES].decode(errors="ignore"))
            return
        if len(open_streams) >= MAX_STREAMS:
            await socket.close(_TRY_LATER, f"{MAX_STREAMS} streams are open")
            return
        open_streams.add(socket)
        try:
            await _serve(socket, SiteStream(live, frozenset(names(query.tags)), query.group))
        finally:
            open_streams.discard(socket)

    return serve


async def _serve(socket: WebSocket, reader: SiteStream) -> None:
    reading = asyncio.create_task(_until_closed(socket))
    try:
        messages, spent_s = [reader.hello()], 0.0
        while not reading.done():
            async with asyncio.timeout(STREAM_TIMEOUT_S):
                for message in messages:
                    await socket.send_text(message.decode())
            await asyncio.wait([reading], timeout=max(PERIOD_S, _PAUSES * spent_s))
            begin_s = time.monotonic()
            messages = reader.new()
            spent_s = time.monotonic() - begin_s
    except (WebSocketDisconnect, RuntimeError, TimeoutError):
        pass  # it has gone, or does not read
    finally:
        reading.cancel()


async def _until_closed(socket: WebSocket) -> None:
    """Read, and drop, what the reader sends until it closes."""
    try:
        while True:
            await socket.receive()
    except (WebSocketDisconnect, RuntimeError):
        return
