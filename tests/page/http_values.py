"""A site with all that the HTTP interface gives, and a history that needs no files."""

import asyncio
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import ClassVar
from unittest.mock import MagicMock

import msgspec
from dashboard_builders import SITE, SITE_ID, SQUARE, fix, status
from msgspec.structs import replace
from starlette.exceptions import HTTPException

from skyless.core.errors import SkylessError
from skyless.core.site import AlarmRule, GeoreferenceSite
from skyless.page.api import questions
from skyless.run.history.answers import Contact, Dwell, Heatmap, Span, Track, TrackPoint
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import AlarmMessage, Asset

HALL = GeoreferenceSite(52.5, 13.3, 34.0, 30.0)
RULE = AlarmRule("cold", "inside", zone="desk", after_s=10.0)
ALARM = AlarmMessage(
    id="cold/t1/1",
    rule="cold",
    name="Cold",
    kind="inside",
    severity="warning",
    subject="t1",
    since_unix_s=1.0,
    unix_s=2.0,
    sentence="Forklift 1 (t1) is in Desk",
    tags=("t1",),
    zone="desk",
    position_m=(2.0, 2.0, 1.0),
)
ASSETS = (Asset("t1", "Forklift 1", "forklifts", "🚜", "#c2410c"), Asset("t3", "Ada", "people"))
NAMES = [f"t{n}" for n in range(1, 8)]


class FakeHistory:
    """Answers of the right kinds; for the tag ``slow`` it takes long."""

    asked: ClassVar = []
    release = threading.Event()

    def __init__(self, folder, site):
        self.where = folder, site

    def _note(self, *question):
        FakeHistory.asked.append((*self.where, *question))

    def tags(self):
        return ("t1", "t2")

    def track(self, tag, span, most_points=2000):
        self._note("track", tag, span, most_points)
        if tag == "slow":
            FakeHistory.release.wait(20.0)
        if tag == "none":
            raise SkylessError("tag is 'none'; the history has t1")
        return Track(
            tag,
            (TrackPoint(1.0, 0.0, 0.0, 0.0, 0.1, None, None), TrackPoint(2.0, 1.0, 0.0, 0.0, 0.1, 0.5, "none")),
            2,
            1.0,
            10.0,
        )

    def heatmap(self, span, cell_m=0.25, tags=()):
        self._note("heatmap", span, cell_m, tags)
        return Heatmap(0.0, 0.0, cell_m, 2, 1, (0.0, 1.5), 1)

    def dwell(self, span, tags=(), zone=None):
        self._note("dwell", span, tags, zone)
        return (Dwell("t1", "desk", "Desk", 1, 5.0, 1.0, 6.0),)

    def contacts(self, tag, span, distance_m=2.0):
        self._note("contacts", tag, span, distance_m)
        return (Contact(tag, "t2", 1.0, 2.0, 0.7),)


def span_of(from_text, to_text, now_unix_s):
    """Numbers, and one word."""
    if from_text == "yesterday":
        return Span(1.0, now_unix_s)
    try:
        return Span(float(from_text), float(to_text) if to_text else now_unix_s)
    except ValueError:
        raise SkylessError(f"from is {from_text!r}; it should be a time") from None


def fake_history(patch):
    """Put it in the place of the real one, whose libraries need not be there."""
    FakeHistory.asked.clear()
    FakeHistory.release.clear()
    patch.setitem(sys.modules, "skyless.run.history.queries", SimpleNamespace(History=FakeHistory))
    patch.setitem(sys.modules, "skyless.run.history.answers", SimpleNamespace(span_of=span_of))
    patch.setattr(questions, "TaskProcess", FakeProcess)


class FakeProcess:
    """Takes the place of the history's process: a thread answers."""

    def __init__(self, module, fault):
        self._fault, self._pool = fault, ThreadPoolExecutor(1, "history")

    async def run(self, question):
        loop = asyncio.get_running_loop()
        try:
            return msgspec.json.encode(await loop.run_in_executor(self._pool, questions._answer, question))
        except SkylessError as error:
            raise HTTPException(self._fault, str(error)) from None


def fill(live, wire):
    """A georeferenced site with seven tags, a zone, assets and an alarm."""
    site = replace(SITE, site=replace(SITE.site, georeference=HALL))
    wire.deliver(topics.site_topic(SITE_ID), site)
    live.store_zones((SQUARE,))
    live.assets.store(ASSETS)
    for name in NAMES:
        show(live, wire, name)
    wire.deliver(topics.status_topic(SITE_ID, "tag", "t9"), status(name="t9"))
    wire.deliver(topics.status_topic(SITE_ID, "anchor", "1"), status("anchor", "1"))
    live.alarms = MagicMock(messages=(ALARM,), rules=(RULE,), file_rules=())
    live.alarms.store_rules = lambda rules, site: setattr(live.alarms, "rules", rules)
    live.acknowledged = []
    live.acknowledge = lambda *what: live.acknowledged.append(what)
    live.tick()


def show(live, wire, name, x=2.0, **more):
    """A fix of a tag."""
    wire.deliver(topics.fix_topic(SITE_ID, name), fix(name, live.wall_clock(), (x, 2.0, 1.0), **more))
