"""The page's server: its routes, its start and its shutdown."""

import asyncio
import contextlib
import errno
import logging
import mimetypes
import signal
import socket
import time
from collections.abc import Callable, Coroutine, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import quote

import msgspec
import uvicorn
from msgspec import Struct, field
from msgspec.structs import replace
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import Site
from skyless.page._alarms import NoAlarmError
from skyless.page.api import questions
from skyless.page.api.questions import Past
from skyless.page.api.routes import api_routes, read_bytes
from skyless.page.connections import (
    GOING_AWAY,
    SEND_TIMEOUT_S,
    TRY_LATER,
    AccessRules,
    Connection,
    FailedAccepts,
    Guard,
    end_unfinished,
    json_answer,
    send,
    serve_socket,
)
from skyless.page.live import LiveSite, TooManyPagesError
from skyless.page.playback import Playback, RecordingFile
from skyless.page.sites import Sites
from skyless.page.state import PageRequest, SiteSurvey, read_request
from skyless.page.tasks import KINDS, MovedAnchors, OverlayTask, TaskProcess, WhatIfTask
from skyless.run.mqtt.messages import SurveyFactsMessage, SurveySaveMessage, WrongMessageError
from skyless.run.process import ending_signals, reserve
from skyless.run.survey.checked_facts import BadFactsError
from skyless.run.web import PAGE as LIMITS
from skyless.run.zones import read_zones
from skyless.site.alarm_rules import BadAlarmRulesError
from skyless.site.file.check import image_kind, image_size

if TYPE_CHECKING:
    from skyless.page.gathered import Gathered
    from skyless.page.hub import ShownSites
    from skyless.run.hub import HubSites

_PAGE: Final = Path(__file__).parent / "browser"
_MAX_STATES_S: Final = 60.01
_MAX_WHAT_IF_S: Final = 60.0

_T = TypeVar("_T")
_Endpoint = Callable[[Request], Coroutine[Any, Any, Response]]

_STATUSES: Final[dict[type[Exception], int]] = {
    WrongMessageError: 400,
    BadFactsError: 400,
    BadAlarmRulesError: 400,
    NoAlarmError: 404,
}


class Services(Struct, frozen=True):
    """Services of the server."""

    sites: Sites
    playback: Playback
    past: Past = Past(None)
    overlays: TaskProcess = field(default_factory=partial(TaskProcess, "skyless.page.overlay_process"))
    sheets: TaskProcess = field(default_factory=partial(TaskProcess, "skyless.page.sheet_process"))
    what_ifs: TaskProcess = field(default_factory=partial(TaskProcess, "skyless.page.what_if_process"))
    gathered: "Gathered | None" = None
    """The batches of a broker with a gather."""
    hub: "ShownSites | None" = None
    """The same as ``sites`` if they are a hub's."""


def make_app(services: Services, rules: AccessRules, page: Path = _PAGE) -> Starlette:
    """Create the server's application."""
    mimetypes.add_type("text/javascript", ".js")  # some systems map it otherwise, and browsers refuse the modules
    mimetypes.add_type("text/javascript", ".mjs")
    mimetypes.add_type("application/wasm", ".wasm")

    hub = services.hub

    async def index(request: Request) -> Response:
        lists = hub is not None and not hub.has(request.query_params.get("site"))
        path = page / ("sites.html" if lists else "index.html")
        if not path.is_file():
            raise HTTPException(404, "this installation has no page")
        return FileResponse(path)

    routes = [
        Route("/", index),
        *(() if hub is None else (Route("/api/sites", partial(_hub_sites, hub.known)),)),
        Route("/fixes.geojson", _fixes),
        Route("/api/floor_plan", _floor_plan),
        Route("/api/floor_plan", _put_floor_plan, methods=["PUT"]),
        Route("/api/overlay", _overlay, methods=["GET", "POST"]),
        Route("/api/sheet", _sheet, methods=["POST"]),
        Route("/api/zones", _put_zones, methods=["PUT"]),
        Route("/api/survey/facts", _surveying(SiteSurvey.facts_message, "too many facts"), methods=["PUT"]),
        Route("/api/survey/save", _surveying(SiteSurvey.save_message, "the request is too long"), methods=["POST"]),
        Route("/api/recordings", _recordings),
        Route("/api/recordings/{name}", _recorded(Playback.summary, json_answer)),
        Route("/api/recordings/{name}/events", _recorded(Playback.events, json_answer)),
        Route("/api/recordings/{name}/file", _recorded(Playback.open_file, _download)),
        Route("/api/recordings/{name}/states", _recorded_states),
        Route("/api/recordings/{name}/floor_plan", _recorded(Playback.floor_plan, _image)),
        Route("/api/recordings/{name}/what_if", _what_if),
        *api_routes(services.sites, services.past),
        WebSocketRoute("/live", _live),
        *(() if services.gathered is None else (WebSocketRoute("/live2", _live2),)),
        Mount("/page", StaticFiles(directory=page, check_dir=False)),
    ]
    app = Starlette(
        routes=routes,
        middleware=[Middleware(Guard, rules=rules)],
        exception_handlers=dict.fromkeys((HTTPException, *_STATUSES), _error),
    )
    app.state.services = services
    return app


async def _error(_request: Request, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        return json_answer({"error": error.detail}, error.status_code)
    return json_answer({"error": str(error)}, _STATUSES[type(error)])


def _services(request: Request | WebSocket) -> Services:
    services: Services = request.app.state.services
    return services


def _live_of(request: Request) -> LiveSite:
    """The site that ``?site=NUMBER`` names. Raises HTTPException."""
    return _services(request).sites.of(request.query_params.get("site"))


async def _hub_sites(known: "HubSites", _request: Request) -> Response:
    return json_answer(
        {"hub": str(known.address), "connected": known.connected, "sites": known.sites(time.monotonic())}
    )


async def _fixes(request: Request) -> Response:
    return questions.collection(_live_of(request), "fixes")


async def _floor_plan(request: Request) -> Response:
    """The image of the whole site, or of the floor that ``?floor=NUMBER`` names."""
    floor = request.query_params.get("floor")
    number = None if floor is None else round(_number(request, "floor", 0, -128, 127))
    return _image(_live_of(request).plans.get(number))


def _image(image: bytes | None) -> Response:
    kind = None if image is None else image_kind(image)
    if kind is None:
        raise HTTPException(404, "no floor plan is known")
    return Response(image, media_type=f"image/{kind}")


async def _overlay(request: Request) -> Response:
    live = _live_of(request)
    kind = request.query_params.get("kind", "pdop")
    if kind not in KINDS:
        raise HTTPException(400, f"kind is {kind!r}; it should be one of {', '.join(KINDS)}")
    step_m = _number(request, "step_m", 0.25, 0.01, 100.0)
    site = await _planned(request, live)
    plan = live.plans.get(None)
    plan_px = None if plan is None else image_size(plan)
    answer = await _services(request).overlays.run(OverlayTask(site, kind, step_m, plan_px))
    return Response(answer, media_type="application/json")


async def _planned(request: Request, live: LiveSite) -> Site:
    """The site with its anchors moved as in the request's body; unchanged without a body."""
    site = live.require_site().whole_site
    body = await read_bytes(request, LIMITS.body_bytes, "too many anchors")
    if not body:
        return site
    try:
        return msgspec.json.decode(body, type=MovedAnchors).site_of(site)
    except (msgspec.MsgspecError, ValueError, RecursionError, ConfigurationError) as error:
        raise HTTPException(400, str(error)) from None


async def _sheet(request: Request) -> Response:
    """The installer's sheet of the site, with its anchors moved as in the request's body."""
    site = await _planned(request, _live_of(request))
    answer = await _services(request).sheets.run(replace(site, floor_plan=None))
    return Response(msgspec.json.decode(answer, type=bytes), media_type="application/pdf")


def _number(request: Request, name: str, default: float, least: float, most: float) -> float:
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = float("nan")
    if not least <= value <= most:
        raise HTTPException(400, f"{name} is {text!r}; it should be a number from {least:g} to {most:g}")
    return value


async def _put_floor_plan(request: Request) -> Response:
    image = await read_bytes(
        request, LIMITS.floor_plan_bytes, f"the image is larger than {LIMITS.floor_plan_bytes // 10**6} MB"
    )
    if image_size(image) is None:
        raise HTTPException(400, "this is no image that can be read; it should be a PNG or JPEG")
    _live_of(request).store_floor_plan(image)
    return json_answer({"bytes": len(image)})


def _surveying(read: Callable[[SiteSurvey, bytes], SurveyFactsMessage | SurveySaveMessage], fault: str) -> _Endpoint:
    """Create an endpoint that publishes its body to the survey program; ``fault``: why one is too long."""

    async def respond(request: Request) -> Response:
        live = _live_of(request)
        message = read(live.survey, await read_bytes(request, LIMITS.body_bytes, fault))
        live.publish_survey(message)
        return json_answer(message)

    return respond


async def _put_zones(request: Request) -> Response:
    body = await read_bytes(request, LIMITS.body_bytes, "too many zones")
    live = _live_of(request)
    message = read_zones(body)
    live.store_zones(message.zones, message.site)
    return json_answer({"zones": live.monitor.zones})


async def _recordings(request: Request) -> Response:
    return json_answer(await asyncio.to_thread(_services(request).playback.recordings))


def _recorded(read: Callable[[Playback, str], _T], answer: Callable[[_T], Response]) -> _Endpoint:
    """Create an endpoint that answers with a part of a recording, read in a thread."""

    async def respond(request: Request) -> Response:
        return answer(await asyncio.to_thread(read, _services(request).playback, request.path_params["name"]))

    return respond


def _download(found: RecordingFile) -> Response:
    headers = {
        "Content-Disposition": f"attachment; filename*=utf-8''{quote(found.name, safe='')}",
        "Content-Length": str(found.size_bytes),
    }
    return StreamingResponse(found.pieces(), media_type="application/octet-stream", headers=headers)


async def _recorded_states(request: Request) -> Response:
    begin_s = _number(request, "from_s", 0.0, 0.0, 1e9)
    end_s = _number(request, "to_s", begin_s + 10.0, 0.0, 1e9)
    rate_hz = _number(request, "rate_hz", 20.0, 0.1, 100.0)
    if not begin_s <= end_s <= begin_s + _MAX_STATES_S:
        raise HTTPException(400, f"to_s is {end_s:g}; it should be at most 60 s after from_s, which is {begin_s:g}")
    playback, name = _services(request).playback, request.path_params["name"]
    states = await asyncio.to_thread(playback.states, name, begin_s, end_s, rate_hz)
    return Response(b'{"states":[' + b",".join(states) + b"]}", media_type="application/json")


async def _what_if(request: Request) -> Response:
    playback, tag = _services(request).playback, request.query_params.get("tag", "")
    from_s = _number(request, "from_s", 0.0, 0.0, 1e9)
    seconds = _number(request, "seconds", 30.0, 1.0, _MAX_WHAT_IF_S)
    path, start_s = await asyncio.to_thread(playback.path_and_start, request.path_params["name"])
    answer = await _services(request).what_ifs.run(WhatIfTask(path, tag, start_s + from_s, seconds))
    return Response(answer, media_type="application/json")


def _live_for(socket: WebSocket) -> LiveSite:
    """The requested site; if it is gone, another one, for a page that was open before the server's start."""
    sites = _services(socket).sites
    try:
        return sites.of(socket.query_params.get("site"))
    except HTTPException:
        return sites.of(None)


async def _live2(socket: WebSocket) -> None:
    live, gathered = _live_for(socket), _services(socket).gathered
    await socket.accept()
    if gathered is not None:
        await gathered.serve(socket, live)


async def _live(socket: WebSocket) -> None:
    live = _live_for(socket)
    await socket.accept()  # browsers tell a page only why its socket was closed, not why it was refused
    try:
        address = socket.client.host if socket.client is not None else ""
        page = live.open_page(address, live2=_services(socket).gathered is not None)
    except TooManyPagesError as error:
        await socket.close(TRY_LATER, str(error))
        return

    def receive(text: str) -> None:
        live.keep_page(page)
        wanted = None if text == "ping" else read_request(text, PageRequest)
        if text == "ping":
            page.replace("pong", b'{"type":"pong"}')
        elif wanted is not None:
            page.ask(wanted)

    async def send_news() -> None:
        while not page.closed:
            await send(socket, await page.drain(live.state))
        await socket.close(GOING_AWAY, page.reason)

    try:
        await serve_socket(socket, send_news(), receive)
    finally:
        live.pages.discard(page)


# Running the dashboard: its socket, its work, and its shutdown.

PORT: Final = 8080
_PING_S: Final = 5.0
_GRACE_S: Final = 0.4
_SEND_BUFFER_BYTES: Final = 262_144  # data for a slow page that waits in the kernel and is sent before anything newer


def bind(host: str, port: int | None) -> socket.socket:
    """Open a socket at the address; without a port at 8080, or the next free one. Raises SkylessError if it cannot."""
    if port is not None:
        return _bind(host, port)
    for number in range(PORT, PORT + 50):
        held = reserve(host, number)
        if held is None:  # reserved by a demo that is starting
            continue
        with held, contextlib.suppress(_PortInUseError):
            return _bind(host, number)
    return _bind(host, 0)


class _PortInUseError(SkylessError):
    """Another program uses the port."""


def _bind(host: str, port: int) -> socket.socket:
    text = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, _, _, address = addresses[0]
        sock = socket.socket(family, kind)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)  # every page's socket inherits it
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the system's own time-out applies
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * SEND_TIMEOUT_S))
            sock.bind(address)
            sock.listen(socket.SOMAXCONN)  # two sockets may be bound to one port, but only one can listen
        except BaseException:
            sock.close()
            raise
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            raise _PortInUseError(
                f"--listen is {text!r}; another program uses this port; without --listen a free one is taken"
            ) from None
        reason = error.strerror if isinstance(error, OSError) else error
        raise SkylessError(f"--listen is {text!r}, where this machine cannot listen: {reason}") from None
    return sock


async def serve(services: Services, rules: AccessRules, sock: socket.socket, sites: Coroutine[Any, Any, None]) -> None:
    """Serve pages until Ctrl-C, SIGTERM or SIGHUP. ``sites`` keeps the sites connected."""
    config = uvicorn.Config(
        make_app(services, rules),
        http=Connection,
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # on the same machine it would only cost time
        ws_ping_interval=_PING_S,
        ws_ping_timeout=SEND_TIMEOUT_S,
        ws_max_size=LIMITS.message_bytes,
        timeout_graceful_shutdown=1,
    )
    server = _Server(config)
    jobs = [sites, end_unfinished(server.server_state.connections)]
    if services.gathered is not None:
        jobs.append(services.gathered.run(services.sites))
    work = [asyncio.create_task(job) for job in jobs]
    loop = asyncio.get_running_loop()
    logging.getLogger("asyncio").addFilter(FailedAccepts())
    for number in (signal.SIGINT, *ending_signals()):
        loop.add_signal_handler(number, _stop, server, services)
    serving = asyncio.create_task(server.serve(sockets=[sock]))
    try:
        await asyncio.wait([serving, *work], return_when=asyncio.FIRST_COMPLETED)
    finally:
        _stop(server, services)
        for task in work:
            task.cancel()
        ended = await asyncio.gather(serving, *work, return_exceptions=True)
    for result in ended:
        if isinstance(result, Exception):
            raise result


def _stop(server: "_Server", services: Services) -> None:
    """Shut down soon, even if pages do not respond."""
    if not server.should_exit:
        server.should_exit = True
        for live in services.sites.all:
            live.close()
        for part in (services.playback, services.overlays, services.what_ifs, services.sheets, services.past):
            part.stop()
        asyncio.get_running_loop().call_later(_GRACE_S, server.drop_connections)


class _Server(uvicorn.Server):
    """A server that leaves signals to its owner."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def drop_connections(self) -> None:
        self.force_exit = True
        for connection in list(self.server_state.connections):
            transport = getattr(connection, "transport", None)
            if transport is not None:
                transport.abort()
