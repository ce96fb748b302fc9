"""A server of a made-up site for the page's tests and for work on the page.

By hand: ``PYTHONPATH=tests .venv/bin/python tests/page/browser/page_server.py [tags]``, then open what it prints.
"""

import asyncio
import contextlib
import json
import mimetypes
import socket
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path

import msgspec
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
from support.waiting import came

PAGE = Path(skyless.__file__).parent / "page" / "browser"


class PageServer:
    """Serves on a free port of loopback in a thread of its own; its attributes are the switches of the tests."""

    def __init__(self, **switches):
        self.tags, self.rate_hz, self.site, self.site_name, self.mode, self.placed = (
            3,
            10.0,
            True,
            "Hall 7",
            "master",
            True,
        )
        self.zones, self.zone_events, self.log = [dict(made_up.DOCK)], [], []
        self.assets, self.rules, self.file_rules, self.alarms = [], [], [], []
        self.floor_plan = self.recorded_plan = None
        """Images."""
        self.recorded_site, self.events_note, self.history = True, False, False
        self.condition, self.survey = made_up.condition(), None
        self.hub = self.live2 = None
        """What ``/api/sites`` answers, with which the server is at a hub; and what answers pages of very many tags."""
        self.silent_tags, self.verified = set(), {}
        self.tag_reports, self.anchor_reports = {}, {}
        """Tags without fixes, and how far those of others are verified; changes to healths."""
        self.refuse, self.mute, self.full = False, False, False
        self.errors, self.waits = {}, set()
        """By the last word of the path: why requests are refused, and those that are not answered now."""
        self.asked, self.bodies = [], defaultdict(list)
        """What pages say that they show; and what they have sent, by the last word of the path."""
        vars(self).update(switches)
        self.started = time.time()
        self.sockets = {}
        self.port = _usual_port()
        self._loop = None
        self._server = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        came(lambda: self._server and self._server.started)
        return self

    def __exit__(self, *_):
        self._server.should_exit = True
        self._thread.join(5)

    @property
    def address(self):
        return f"http://127.0.0.1:{self.port}/"

    def body(self, what, count=1):
        """The last of the bodies that pages have sent, once there are ``count``."""
        return came(lambda: self.bodies[what][count - 1 :])[-1]

    def cut(self):
        """Close every live socket and take no new one until ``refuse`` is false again."""
        self.refuse = True
        for websocket in list(self.sockets):
            asyncio.run_coroutine_threadsafe(websocket.close(1012), self._loop).result(5)

    def send(self, *messages):
        """Send messages to every page; without any, those of assets, rules and alarms after a change."""
        for message in messages or self._site_messages():
            for websocket, lock in list(self.sockets.items()):
                asyncio.run_coroutine_threadsafe(_send(websocket, lock, message), self._loop).result(5)

    def _run(self):
        mimetypes.add_type("text/javascript", ".js")
        routes = [
            Route("/", self._index),
            Route("/api/{path:path}", self._api, methods=["GET", "PUT", "POST"]),
            WebSocketRoute("/live", self._live),
            WebSocketRoute("/live2", self._live2),
            Mount("/page", _Modules(directory=PAGE)),
        ]
        config = uvicorn.Config(Starlette(routes=routes), port=self.port, log_level="warning", ws="websockets-sansio")
        self._server = uvicorn.Server(config)
        self._server.install_signal_handlers = lambda: None
        asyncio.run(self._serve())

    async def _serve(self):
        self._loop = asyncio.get_running_loop()
        await self._server.serve()

    async def _index(self, request):
        """With what the real server sends: anything from elsewhere is refused by the browser."""
        lists = self.hub is not None and "site" not in request.query_params
        policy = "default-src 'self'; img-src 'self' data: blob:"
        headers = {"content-security-policy": policy, "cache-control": "no-cache"}
        return FileResponse(PAGE / ("sites.html" if lists else "index.html"), headers=headers)

    async def _api(self, request):
        path, query = request.path_params["path"].removeprefix("v1/").split("/"), dict(request.query_params)
        kind = path[-1]
        content = await request.body()
        while kind in self.waits and not await request.is_disconnected():
            await asyncio.sleep(0.02)
        if kind in self.errors:
            return JSONResponse({"error": self.errors[kind]}, status_code=422)
        if request.method != "GET":
            self.bodies[kind].append(json.loads(content) if kind != "floor_plan" else content)
        found = self._answer(path, query, self.bodies[kind][-1] if request.method != "GET" else None)
        return found if isinstance(found, Response) else JSONResponse(found)

    def _answer(self, path, query, body):
        match path:
            case ["zones" | "assets" | "alarm_rules" as what] if body:
                key = what.removeprefix("alarm_")
                setattr(self, key, body[key])
                return body
            case ["assets"]:
                return {"assets": self.assets}
            case ["alarm_rules"]:
                return {"rules": self.rules, "file_rules": self.file_rules}
            case ["alarms", rule, subject, "acknowledge"]:
                (named,) = [one for one in self.alarms if one["id"] == body["id"]]
                assert (named["rule"], named["subject"]) == (rule, subject)
                named |= {"acknowledged_unix_s": time.time(), "acknowledged_by": body["by"]}
                return body
            case ["assets.csv" | "sheet"]:
                return Response(b"a file")
            case ["sites"]:
                return self.hub
            case ["overlay"]:
                self.bodies["step_m"].append(float(query["step_m"]))
                return made_up.overlay(query["kind"], float(query["step_m"]))
            case ["floor_plan"]:
                return {} if body else Response(self.floor_plan, media_type="image/png")
            case ["survey", "facts"]:
                self.survey.use(body)
            case ["survey", "save"]:
                self.survey.save(body["serial"])
            case ["recordings", *rest]:
                return self._recording(rest, query)
            case ["history", kind]:
                self.bodies["history"].append((kind, query))
                if not self.history:
                    return JSONResponse({"error": "this server keeps no history"}, status_code=404)
                found, status = made_up.history(kind, query)
                return JSONResponse(found, status_code=status)
        return {}

    def _recording(self, path, query):
        start, end = made_up.RECORDED_UNIX_S, made_up.RECORDED_UNIX_S + made_up.RECORDED_S
        match path:
            case []:
                known = {"name": "walk.mcap", "duration_s": made_up.RECORDED_S, "bytes": 48_300_000, "complete": True}
                return [{**known, "start_unix_s": start, "site": "Hall 7", "tags": 2, "fixes": 1800}]
            case [name] if name != "walk.mcap":
                return JSONResponse({"error": "there is no such recording"}, status_code=404)
            case [name]:
                site = (
                    made_up.site_message(made_up.PLAN if self.recorded_plan else None) if self.recorded_site else None
                )
                known = {"name": name, "site": site, "start_unix_s": start, "end_unix_s": end, "tags": made_up.names(2)}
                spans = [[start + made_up.FIRST_FIX_S, start + 55.0], [start + 60.0, end]]
                return {**known, "zones": [made_up.DOCK], "fix_spans_unix_s": spans}
            case [_, "events"]:
                return {"events": made_up.recorded_events(), "complete": not self.events_note}
            case [_, "states"]:
                times = (float(query[key]) for key in ("from_s", "to_s", "rate_hz"))
                return {"states": made_up.recorded_states(*times)}
            case [_, "floor_plan"]:
                return Response(self.recorded_plan, media_type="image/png")
            case [name, "file"]:
                return Response(b"recorded", headers={"Content-Disposition": f"attachment; filename={name}"})

    async def _live(self, websocket):
        if self.refuse:
            return await websocket.close()
        await websocket.accept()
        if self.full:
            return await websocket.close(1013, "too many pages are open: 100 of this computer, 100 in all")
        lock = asyncio.Lock()
        for message in (self.hello(), {"type": "log", "events": self.log}, *self._site_messages()):
            await _send(websocket, lock, message)
        self.sockets[websocket] = lock
        periods = {self._states: 1 / self.rate_hz, self._health: 1.0, self._condition: 0.2, self._survey: 0.2}
        jobs = [asyncio.create_task(self._repeat(websocket, lock, *job)) for job in periods.items()]
        jobs.append(asyncio.create_task(self._read(websocket, lock)))
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
        for job in jobs:
            job.cancel()
        await asyncio.gather(*jobs, return_exceptions=True)
        self.sockets.pop(websocket, None)
        return None

    async def _live2(self, websocket):
        await websocket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                for message in self.live2(json.loads(await websocket.receive_text())):
                    await websocket.send_bytes(message)

    async def _repeat(self, websocket, lock, message, period_s):
        while True:
            begin = time.time()
            if not self.mute and (known := message(begin)):
                await _send(websocket, lock, known)
            await asyncio.sleep(max(0.0, begin + period_s - time.time()))

    async def _read(self, websocket, lock):
        while True:
            text = await websocket.receive_text()
            if text != "ping":
                self.asked.append(json.loads(text))
            elif not self.mute:
                await _send(websocket, lock, {"type": "pong"})

    def hello(self):
        plan = made_up.PLAN if self.floor_plan else None
        site = made_up.site_message(plan, self.mode, self.placed, name=self.site_name) if self.site else None
        known = {"type": "hello", "version": "0.1.0", "site": site, "thresholds": msgspec.to_builtins(THRESHOLDS)}
        known |= {"zones": self.zones, "events": self.zone_events, "mqtt": True, "history": self.history}
        return {**known, "hub": self.hub is not None, "live2": self.live2 is not None}

    def _site_messages(self):
        return [
            {"type": "assets", "assets": self.assets},
            {"type": "alarm_rules", "rules": self.rules, "file_rules": self.file_rules},
            {"type": "alarms", "alarms": self.alarms, "more": 0},
        ]

    def _states(self, now):
        named = [one for one in enumerate(made_up.names(self.tags)) if one[1] not in self.silent_tags]
        verified = {name: self.verified.get(name, (None, None)) for _, name in named}
        rows = [made_up.state_row(name, n, now - self.started, now, verified[name]) for n, name in named]
        return {"type": "state", "unix_s": now, "tags": rows} if rows else None

    def _health(self, now):
        """At a site with a master anchor 5 is not synchronised, and 8 is offline."""
        since, old = now - self.started, {8} if self.mode == "master" else set()
        anchors = [
            made_up.anchor_health(n, since, now - 20 * (n in old), self.mode, **self.anchor_reports.get(n, {}))
            for n in range(1, 9)
        ]
        tags = []
        for number, name in enumerate(made_up.names(self.tags)):
            reason = "too-few-anchors" if name in self.silent_tags else None
            tags.append(made_up.tag_health(name, number, since, now, reason=reason, **self.tag_reports.get(name, {})))
        conditions = {str(one["anchor"]): "good" if one["synchronised"] else "warn" for one in anchors}
        nodes = [
            {"online": True, "kind": kind, "name": name, "version": "0.1.0", "host": "hall", "pid": 1, "unix_s": 1.0}
            for kind, name in (("ether", "air"), ("dashboard", "page"), ("recorder", "demo"))
        ]
        ages = {"anchors": {name: 20.0 if int(name) in old else 0.1 for name in conditions}, "ether": {"air": 0.1}}
        ages["tags"] = dict.fromkeys(made_up.names(self.tags), 0.1)
        ether = {"unix_s": now, "simulated_s": since, "transmissions": 476, "late": 0, "stalls": 0, "overruns": 0}
        known = {"type": "health", "whole": True, "waiting": [], "dropped": {}, "anchors": anchors, "tags": tags}
        conditions |= dict.fromkeys(map(str, old), "bad")
        return {**known, "conditions": conditions, "ether": ether, "nodes": nodes, "ages": ages}

    def _condition(self, now):
        return self.condition and self.condition | {"unix_s": now}

    def _survey(self, _now):
        return self.survey and self.survey.message()


class _Modules(StaticFiles):
    """Files that a browser keeps for all tests, which have servers at one port, one after the other."""

    def file_response(self, *args, **kwargs):
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "max-age=3600, immutable"
        return response


async def _send(websocket, lock, message):
    async with lock:
        await websocket.send_json(message)


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
