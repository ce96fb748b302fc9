"""The server's addresses: the page, its data, and the live stream."""

import asyncio
import mimetypes
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyless.dashboard.guard import Guard, Rules
from skyless.dashboard.live import Live
from skyless.dashboard.overlays import KINDS, NoOverlayError, Overlays
from skyless.dashboard.playback import NoRecordingError, Playback
from skyless.dashboard.zones import BadZonesError, read_zones

PAGE: Final = Path(__file__).parent / "page"
MOST_PAGES: Final = 50
DEAD_S: Final = 10.0
"""A page that takes nothing for so long is given up."""

MOST_STATES_S: Final = 60.01
_LARGEST_BODY: Final = 1_000_000
_TRY_LATER: Final = 1013


class Parts(Struct, frozen=True):
    """What the server serves."""

    live: Live
    overlays: Overlays
    playback: Playback


def make_app(parts: Parts, rules: Rules, page: Path = PAGE) -> Starlette:
    """The server's application."""
    mimetypes.add_type("text/javascript", ".js")  # systems may know better, and then no module loads
    mimetypes.add_type("text/javascript", ".mjs")
    routes = [
        Route("/", _file(page / "index.html")),
        Route("/api/floor_plan", _floor_plan),
        Route("/api/overlay", _overlay),
        Route("/api/zones", _put_zones, methods=["PUT"]),
        Route("/api/recordings", _recordings),
        Route("/api/recordings/{name}", _recording),
        Route("/api/recordings/{name}/states", _recorded_states),
        Route("/api/recordings/{name}/floor_plan", _recorded_floor_plan),
        WebSocketRoute("/live", _live),
        Mount("/page", _Files(directory=page, check_dir=False)),
    ]
    app = Starlette(
        routes=routes,
        middleware=[Middleware(Guard, rules=rules)],
        exception_handlers={HTTPException: _http_error},
    )
    app.state.parts = parts
    return app


class _Files(StaticFiles):
    """Browsers ask each time whether a file has changed."""

    def file_response(self, *args: object, **kwargs: object) -> Response:
        response = super().file_response(*args, **kwargs)  # type: ignore[arg-type]
        response.headers["Cache-Control"] = "no-cache"
        return response


def _file(path: Path) -> Callable[[Request], Awaitable[Response]]:
    async def answer(_request: Request) -> Response:
        if not path.is_file():
            return _error(404, "this installation has no page")
        return FileResponse(path, headers={"Cache-Control": "no-cache"})

    return answer


def _error(status: int, text: str) -> Response:
    return JSONResponse({"error": text}, status_code=status)


async def _http_error(_request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return _error(status, error.detail if isinstance(error, HTTPException) else "something went wrong")


def _json(value: object) -> Response:
    return Response(msgspec.json.encode(value), media_type="application/json")


def _parts(request: Request | WebSocket) -> Parts:
    parts: Parts = request.app.state.parts
    return parts


async def _floor_plan(request: Request) -> Response:
    return _image(_parts(request).live.floor_plan)


def _image(image: bytes | None) -> Response:
    kind = image_type(image) if image is not None else None
    if image is None or kind is None:
        return _error(404, "no floor plan is known")
    return Response(image, media_type=kind)


def image_type(image: bytes) -> str | None:
    """Media type of a PNG or JPEG; None for anything else, which browsers shall not see."""
    if image.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    return "image/jpeg" if image.startswith(b"\xff\xd8\xff") else None


async def _overlay(request: Request) -> Response:
    overlays, live = _parts(request).overlays, _parts(request).live
    kind = request.query_params.get("kind", "pdop")
    if kind not in KINDS:
        return _error(400, f"kind is {kind!r}; it should be one of {', '.join(KINDS)}")
    step_m = _number(request, "step_m", 0.25, 0.01, 100.0)
    if live.site is None:
        return _error(404, "no site is known yet")
    try:
        return _json(await overlays.get(live.site.site, live.floor_plan, live.board.methods(), kind, step_m))
    except NoOverlayError as error:
        return _error(422, str(error))


def _number(request: Request, name: str, default: float, least: float, most: float) -> float:
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = float("nan")
    if not least <= value <= most:
        raise HTTPException(400, f"{name} is {text!r}; it should be a number from {least:g} to {most:g}")
    return value


async def _put_zones(request: Request) -> Response:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _LARGEST_BODY:
            return _error(413, "these are too many zones")
    live = _parts(request).live
    try:
        live.draw_zones(read_zones(body))
    except BadZonesError as error:
        return _error(400, str(error))
    return _json({"zones": live.watch.zones})


async def _recordings(request: Request) -> Response:
    return _json(await asyncio.to_thread(_parts(request).playback.recordings))


async def _recording(request: Request) -> Response:
    try:
        return _json(await asyncio.to_thread(_parts(request).playback.summary, request.path_params["name"]))
    except NoRecordingError as error:
        return _error(404, str(error))


async def _recorded_floor_plan(request: Request) -> Response:
    try:
        return _image(await asyncio.to_thread(_parts(request).playback.floor_plan, request.path_params["name"]))
    except NoRecordingError as error:
        return _error(404, str(error))


async def _recorded_states(request: Request) -> Response:
    begin_s = _number(request, "from_s", 0.0, 0.0, 1e9)
    end_s = _number(request, "to_s", begin_s + 10.0, 0.0, 1e9)
    rate_hz = _number(request, "rate_hz", 20.0, 0.1, 100.0)
    if not begin_s <= end_s <= begin_s + MOST_STATES_S:
        return _error(400, f"to_s is {end_s:g}; it should be at most 60 s after from_s, which is {begin_s:g}")
    playback, name = _parts(request).playback, request.path_params["name"]
    try:
        states = await asyncio.to_thread(playback.states, name, begin_s, end_s, rate_hz)
    except NoRecordingError as error:
        return _error(404, str(error))
    return Response(b'{"states":[' + b",".join(states) + b"]}", media_type="application/json")


async def _live(socket: WebSocket) -> None:
    live = _parts(socket).live
    if len(live.pages) >= MOST_PAGES:
        await socket.close(_TRY_LATER, "too many pages are open")
        return
    await socket.accept()
    page = live.join()
    reading = asyncio.create_task(_read(socket, page.close, lambda: page.put("pong", b'{"type":"pong"}')))
    try:
        while not page.closed:
            messages = await page.take(live.board)
            async with asyncio.timeout(DEAD_S):
                for message in messages:
                    await socket.send_text(message)
        await socket.close(1001)
    except (WebSocketDisconnect, RuntimeError, TimeoutError):
        pass  # the page went away meanwhile, or is dead
    finally:
        live.leave(page)
        reading.cancel()


async def _read(socket: WebSocket, closed: Callable[[], None], pong: Callable[[], None]) -> None:
    """Answer pings until the page goes."""
    try:
        while True:
            if await socket.receive_text() == "ping":
                pong()
    except (WebSocketDisconnect, KeyError, RuntimeError):
        closed()
