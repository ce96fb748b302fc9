"""A server of a made-up site for the page's tests and for work on the page.

By hand: ``PYTHONPATH=tests .venv/bin/python tests/dashboard/page_server.py [tags]``, then open what it prints.
"""

import asyncio
import contextlib
import json
import mimetypes
import socket
import sys
import threading
import time
from pathlib import Path

import msgspec
import page_history
import page_site as made_up
import uvicorn
from starlette.applications import Starlette
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocketDisconnect

import skyless
from skyless.run.site_table import THRESHOLDS
from support.processes import free_port

PAGE = Path(skyless.__file__).parent / "page" / "browser"
RECORDED_S = 90.0
FIRST_FIX_S = 2.0
PLAN = {"image": "hall.png", "width_m": 24.0, "x_m": 0.0, "y_m": -1.0}
DOCK = {"id": "dock", "name": "Dock", "polygon_m": [[14, 2.5], [21, 2.5], [21, 6], [14, 6]], "colour": "#c2763a"}


class PageServer:
    """Serves on a free port of loopback in a thread of its own; its attributes are the switches of the tests."""

    def __init__(
        self, tags=3, rate_hz=10.0, zones=(DOCK,), site=True, floor_plan=None, mode="master", survey=None, placed=True
    ):
        self.tags, self.rate_hz, self.site = tags, rate_hz, site
        self.zones = [dict(zone) for zone in zones]
        self.floor_plan = floor_plan
        self.mode = mode
        self.survey = survey
        self.placed = placed
        self.stored = []
        self.silent_tags = set()
        self.tag_reports, self.anchor_reports, self.verified = {}, {}, {}
        """Changes to healths, and how far fixes are verified: age of that and share of other beacons, by tag."""
        self.refuse = False
        self.mute = False
        self.answers_pings = True
        self.zone_error = None
        self.condition = made_up.condition()
        self.log = []
        self.full = False
        self.overlay_error = None
        self.overlay_waits = False
        self.overlays, self.sheets = [], []
        self.recorded_plan = None
        self.recorded_site = True
        self.recorded_waits = False
        self.events_note = False
        self.live2 = None
        """Answers what a page says on the stream of very many tags; without it there is no such stream."""
        self.hub = None
        """What ``/api/sites`` answers; with it the server is at a hub."""
        self.history = False
        self.history_error = None
        self.history_waits = set()
        """Kinds of questions that are not answered now; and all that were asked, kinds with queries."""
        self.history_asked = []
        self.site_name = "Hall 7"
        self.zone_events = []
        self.assets, self.rules, self.file_rules, self.alarms = [], [], [], []
        self.more_alarms = 0
        self.refusal = None
        """Why assets or rules are refused; the requests that were not are in ``puts``, what pages show in ``asked``."""
        self.puts, self.asked = [], []
        self.started = time.time()
        self.sockets = {}
        self.port = _usual_port()
        self._loop = None
        self._server = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        while not (self._server and self._server.started):
            assert self._thread.is_alive(), f"no server on port {self.port}"
            time.sleep(0.01)
        return self

    def __exit__(self, *_):
        self._server.should_exit = True
        self._thread.join(5)

    @property
    def address(self):
        return f"http://127.0.0.1:{self.port}/"

    def cut(self):
        """Close every live socket and take no new one until ``refuse`` is false again."""
        self.refuse = True
        for websocket in list(self.sockets):
            asyncio.run_coroutine_threadsafe(websocket.close(1012), self._loop).result(5)

    def send(self, message):
        """Send a message to every page."""
        for websocket, lock in list(self.sockets.items()):
            asyncio.run_coroutine_threadsafe(_send(websocket, lock, message), self._loop).result(5)

    def _run(self):
        config = uvicorn.Config(self._app(), port=self.port, log_level="warning", ws="websockets-sansio")
        self._server = uvicorn.Server(config)
        self._server.install_signal_handlers = lambda: None
        asyncio.run(self._serve())

    async def _serve(self):
        self._loop = asyncio.get_running_loop()
        await self._server.serve()

    def _app(self):
        mimetypes.add_type("text/javascript", ".js")

        async def index(request):
            lists = self.hub is not None and "site" not in request.query_params
            return _guarded(FileResponse(PAGE / ("sites.html" if lists else "index.html")))

        async def hub_sites(_request):
            return JSONResponse(self.hub)

        async def floor_plan(_request):
            return Response(self.floor_plan, media_type="image/png")

        async def recorded_plan(_request):
            if self.recorded_plan is None:
                return JSONResponse({"error": "no floor plan is known"}, status_code=404)
            return Response(self.recorded_plan, media_type="image/png")

        async def put_floor_plan(request):
            self.survey.image = await request.body()
            return JSONResponse({"bytes": len(self.survey.image)})

        async def put_facts(request):
            self.survey.use(await request.json())
            return JSONResponse(self.survey.given[-1])

        async def save(request):
            self.survey.save((await request.json())["serial"])
            return JSONResponse({"serial": self.survey.saves[-1]})

        async def overlay(request):
            query = request.query_params
            while self.overlay_waits:
                await asyncio.sleep(0.02)
            if self.overlay_error:
                return JSONResponse({"error": self.overlay_error}, status_code=422)
            body = await request.body()
            self.overlays.append((float(query["step_m"]), json.loads(body)["anchors"] if body else []))
            return JSONResponse(made_up.overlay(query["kind"], float(query["step_m"])))

        async def sheet(request):
            self.sheets.append((await request.json())["anchors"])
            return Response(b"%PDF-1.7 a sheet", media_type="application/pdf")

        async def put_zones(request):
            body = await request.json()
            if self.zone_error:
                return JSONResponse({"error": self.zone_error}, status_code=400)
            self.stored.append(body)
            self.zones = body["zones"]
            return JSONResponse({"zones": self.zones})

        async def put_assets(request):
            return await keep(request, "assets")

        async def put_rules(request):
            return await keep(request, "rules")

        async def keep(request, what):
            body = await request.json()
            if self.refusal:
                return JSONResponse({"error": self.refusal}, status_code=400)
            self.puts.append(body)
            setattr(self, what, body[what])
            return JSONResponse({what: body[what]})

        async def acknowledge(request):
            body = await request.json()
            named = [alarm for alarm in self.alarms if alarm["id"] == body["id"]]
            assert [(one["rule"], one["subject"]) for one in named] == [tuple(request.path_params.values())]
            named[0] |= {"acknowledged_unix_s": time.time(), "acknowledged_by": body["by"]}
            self.puts.append(body)
            return JSONResponse(body)

        async def assets(_request):
            return JSONResponse({"assets": self.assets})

        async def assets_csv(_request):
            head = ["tag", "name", "group", "icon", "colour", "owner", "notes"]
            lines = [head, *([asset.get(key, "") for key in head] for asset in self.assets)]
            return Response("".join(f"{','.join(line)}\r\n" for line in lines), media_type="text/csv")

        async def alarm_rules(_request):
            return JSONResponse({"rules": self.rules, "file_rules": self.file_rules})

        async def recordings(_request):
            start = {"bytes": 48_300_000, "start_unix_s": 1_780_000_000.0, "complete": True}
            what = {"site": "Hall 7", "tags": 2, "fixes": 1800}
            return JSONResponse([{"name": "walk.mcap", "duration_s": RECORDED_S, **start, **what}])

        async def recording(request):
            if request.path_params["name"] != "walk.mcap":
                return JSONResponse({"error": "there is no such recording"}, status_code=404)
            start = 1_780_000_000.0
            site = made_up.site_message(start, PLAN if self.recorded_plan else None) if self.recorded_site else None
            return JSONResponse({
                "name": request.path_params["name"], "site": site, "start_unix_s": start,
                "end_unix_s": start + RECORDED_S, "tags": made_up.names(2), "zones": [DOCK],
                "fix_spans_unix_s": [[start + FIRST_FIX_S, start + 55.0], [start + 60.0, start + RECORDED_S]],
            })  # fmt: skip

        async def events(_request):
            while self.recorded_waits:
                await asyncio.sleep(0.02)
            found = made_up.recorded_events(1_780_000_000.0)
            return JSONResponse({"events": found, "complete": not self.events_note})

        async def file(request):
            headers = {"Content-Disposition": f"attachment; filename={request.path_params['name']}"}
            return Response(b"recorded", media_type="application/octet-stream", headers=headers)

        async def states(request):
            query = request.query_params
            while self.recorded_waits:
                await asyncio.sleep(0.02)
            return JSONResponse({"states": _recorded(float(query["from_s"]), float(query["to_s"]), query["rate_hz"])})

        async def history(request):
            kind, query = request.path_params["kind"], dict(request.query_params)
            self.history_asked.append((kind, query))
            while kind in self.history_waits and not await request.is_disconnected():
                await asyncio.sleep(0.02)
            if not self.history or self.history_error:
                error = self.history_error or "this server keeps no history"
                return JSONResponse({"error": error}, status_code=422 if self.history else 404)
            found, status = page_history.answer(kind, query)
            return JSONResponse(found, status_code=status)

        return Starlette(
            routes=[
                Route("/", index),
                Route("/api/sites", hub_sites),
                Route("/api/floor_plan", floor_plan),
                Route("/api/floor_plan", put_floor_plan, methods=["PUT"]),
                Route("/api/survey/facts", put_facts, methods=["PUT"]),
                Route("/api/survey/save", save, methods=["POST"]),
                Route("/api/overlay", overlay, methods=["GET", "POST"]),
                Route("/api/sheet", sheet, methods=["POST"]),
                Route("/api/zones", put_zones, methods=["PUT"]),
                Route("/api/v1/assets", assets),
                Route("/api/v1/assets", put_assets, methods=["PUT"]),
                Route("/api/v1/assets.csv", assets_csv),
                Route("/api/v1/alarm_rules", alarm_rules),
                Route("/api/v1/alarm_rules", put_rules, methods=["PUT"]),
                Route("/api/v1/alarms/{rule}/{subject}/acknowledge", acknowledge, methods=["POST"]),
                Route("/api/recordings", recordings),
                Route("/api/recordings/{name}", recording),
                Route("/api/recordings/{name}/events", events),
                Route("/api/recordings/{name}/file", file),
                Route("/api/recordings/{name}/states", states),
                Route("/api/recordings/{name}/floor_plan", recorded_plan),
                Route("/api/v1/history/{kind}", history),
                WebSocketRoute("/live", self._live),
                WebSocketRoute("/live2", self._live2),
                Mount("/page", _Modules(directory=PAGE)),
            ]
        )

    async def _live(self, websocket):
        if self.refuse:
            return await websocket.close()
        await websocket.accept()
        if self.full:
            return await websocket.close(1013, "too many pages are open: 100 of this computer, 100 in all")
        lock = asyncio.Lock()
        await _send(websocket, lock, self._hello())
        await _send(websocket, lock, {"type": "log", "events": self.log})
        for message in self.site_messages():
            await _send(websocket, lock, message)
        self.sockets[websocket] = lock
        jobs = [
            asyncio.create_task(job(websocket, lock))
            for job in (self._states, self._health, self._conditions, self._surveys, self._pongs)
        ]
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
        for job in jobs:
            job.cancel()
        await asyncio.gather(*jobs, return_exceptions=True)
        self.sockets.pop(websocket, None)
        return None

    def site_messages(self):
        """The messages of assets, rules and alarms."""
        return [
            {"type": "assets", "assets": self.assets},
            {"type": "alarm_rules", "rules": self.rules, "file_rules": self.file_rules},
            {"type": "alarms", "alarms": self.alarms, "more": self.more_alarms},
        ]

    def send_site_messages(self):
        """Send them to every page, after a change."""
        for message in self.site_messages():
            self.send(message)

    async def _live2(self, websocket):
        await websocket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                asked = json.loads(await websocket.receive_text())
                for message in self.live2(asked):
                    await websocket.send_bytes(message)

    def _hello(self):
        plan = PLAN if self.floor_plan else None
        site = made_up.site_message(self.started, plan, self.mode, self.placed) if self.site else None
        if site:
            site["site"]["name"] = self.site_name
        more = {
            "thresholds": msgspec.to_builtins(THRESHOLDS),
            "zones": self.zones,
            "events": self.zone_events,
            "mqtt": True,
            "history": self.history,
            "hub": self.hub is not None,
            "live2": self.live2 is not None,
        }
        return {"type": "hello", "version": "0.1.0", "site": site, **more}

    async def _states(self, websocket, lock):
        while True:
            named = enumerate(made_up.names(self.tags))
            now = time.time()
            since = now - self.started
            rows = [
                made_up.state_row(name, n, since, now, self.verified.get(name, (None, None)))
                for n, name in named
                if name not in self.silent_tags
            ]
            if rows and not self.mute:
                await _send(websocket, lock, {"type": "state", "unix_s": now, "tags": rows})
            await asyncio.sleep(max(0.0, now + 1 / self.rate_hz - time.time()))

    async def _health(self, websocket, lock):
        while True:
            if not self.mute:
                await _send(websocket, lock, self.health(time.time()))
            await asyncio.sleep(1.0)

    async def _conditions(self, websocket, lock):
        while True:
            if not self.mute and self.condition:
                await _send(websocket, lock, self.condition | {"unix_s": time.time()})
            await asyncio.sleep(0.2)

    async def _surveys(self, websocket, lock):
        while True:
            if self.survey and not self.survey.silent and not self.mute:
                await _send(websocket, lock, self.survey.message())
            await asyncio.sleep(0.2)

    def health(self, now):
        """A health message: one anchor is not synchronised, and one is offline."""
        since = now - self.started
        anchors = [made_up.anchor_health(n, since, now - (20 if n == 8 else 0), n != 5) for n in range(1, 9)]
        if self.mode != "master":
            anchors = [made_up.anchor_health_2(n, since, now) for n in range(1, 9)]
        anchors = [health | self.anchor_reports.get(health["anchor"], {}) for health in anchors]
        tags = []
        for number, name in enumerate(made_up.names(self.tags)):
            reason = "too-few-anchors" if name in self.silent_tags else None
            tags.append(made_up.tag_health(name, number, since, now, reason) | self.tag_reports.get(name, {}))
        ether = {"unix_s": now, "simulated_s": since, "transmissions": int(476 * since), "late": 0, "at_anchors": {},
                 "at_tags": {}, "stalls": 0, "overruns": 0}  # fmt: skip
        old = self.mode == "master"
        ages = {"anchors": {str(n): 20.0 if n == 8 and old else 0.1 for n in range(1, 9)}, "ether": {"air": 0.1},
                "tags": dict.fromkeys(made_up.names(self.tags), 0.1)}  # fmt: skip
        nodes = made_up.nodes()
        conditions = {}
        for health in anchors:
            name = str(health["anchor"])
            here = health["synchronised"] or health["role"] == "master"
            conditions[name] = "bad" if ages["anchors"][name] > THRESHOLDS.report_s else "good" if here else "warn"
        known = {"anchors": anchors, "tags": tags, "ether": ether, "nodes": nodes, "ages": ages}
        return {"type": "health", "whole": True, "conditions": conditions, "waiting": [], "dropped": {}, **known}

    async def _pongs(self, websocket, lock):
        while True:
            text = await websocket.receive_text()
            if text != "ping":
                self.asked.append(json.loads(text))
            elif self.answers_pings and not self.mute:
                await _send(websocket, lock, {"type": "pong"})


class _Modules(StaticFiles):
    """Files that a browser keeps for all tests, which have servers at one port, one after the other."""

    def file_response(self, *args, **kwargs):
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "max-age=3600, immutable"
        return response


async def _send(websocket, lock, message):
    async with lock:
        await websocket.send_json(message)


def _recorded(from_s, to_s, rate_hz):
    start, step = 1_780_000_000.0, 1 / float(rate_hz)
    first, last = int(max(0.0, from_s) / step), int(min(to_s, RECORDED_S) / step)
    times = [n * step for n in range(first, last + 1) if n * step >= FIRST_FIX_S]
    named = list(enumerate(made_up.names(2)))
    return [
        {"type": "state", "unix_s": start + t, "tags": [made_up.state_row(name, n, t, start + t) for n, name in named]}
        for t in times
    ]


def _guarded(response):
    """What the real server sends: anything from elsewhere is refused by the browser."""
    response.headers["content-security-policy"] = "default-src 'self'; img-src 'self' data: blob:"
    response.headers["cache-control"] = "no-cache"
    return response


_port = free_port()


def _usual_port():
    """The same one for all servers of this process, unless it is in use."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", _port))
        except OSError:
            return free_port()
    return _port


if __name__ == "__main__":
    with PageServer(tags=int(sys.argv[1]) if len(sys.argv) > 1 else 3) as server:
        print(server.address)  # noqa: T201 - the address is the program's output
        while True:
            time.sleep(3600)
