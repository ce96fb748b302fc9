"""WebSockets: a reader is sent messages until it closes, or accepts none for too long."""

import asyncio
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect

SEND_TIMEOUT_S: Final = 10.0
"""A reader that accepts no message for this long is disconnected."""

GOING_AWAY: Final = 1001
POLICY_VIOLATION: Final = 1008
TRY_LATER: Final = 1013


async def serve_socket(
    socket: WebSocket, sending: Coroutine[Any, Any, None], receive: Callable[[str], None] = lambda _text: None
) -> None:
    """Send, and hand over the texts that come, until either has ended."""

    async def read() -> None:
        while (message := await socket.receive())["type"] != "websocket.disconnect":
            receive(message.get("text") or "")

    parts = [asyncio.ensure_future(part) for part in (read(), sending)]
    try:
        done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
        for part in done:
            part.result()
    except (WebSocketDisconnect, RuntimeError, TimeoutError):
        pass  # it has gone, or does not respond
    finally:
        for part in parts:
            part.cancel()


async def send(socket: WebSocket, messages: Iterable[bytes], kind: str = "text") -> None:
    """Send messages as texts, or as ``bytes``. Raises TimeoutError where they are not accepted."""
    async with asyncio.timeout(SEND_TIMEOUT_S):
        for message in messages:
            await (socket.send_text(message.decode()) if kind == "text" else socket.send_bytes(message))
