"""What the page's server says of a healthy large site, and how much processor time the page takes for a frame of it.

``.venv/bin/python benchmarks/page.py [--part server|page|all] [--seconds 8] [--quick]``

Server: its live site gets the messages of healthy tags and anchors without a broker, by a clock that stands meanwhile,
so that no load disturbs it: what it finds then, what it sends a page, and the processor time of one evaluation, and of
fixes, 20 a second of each tag.
Page: a headless Chromium shows a made-up site of that size, with the list of tags open, while tags move; the server
process sends it what the real one would. The figure is the processor time of the page's thread for each frame drawn.
Each site has its line of JSON.
"""

import argparse
import asyncio
import contextlib
import itertools
import json
import socket
import sys
import threading
import time
from pathlib import Path

import msgspec
import uvicorn
from msgspec.structs import replace
from playwright.sync_api import sync_playwright

sys.path.extend(str(Path(__file__).parents[1] / "tests" / folder) for folder in (".", "page", "page/browser", "run"))
from dashboard_builders import SITE, SITE_ID, Times, Wire, fix
from page_browser import CHROMIUM, FLAGS, until
from test_dashboard_condition import anchor_health

from skyless.page.app import Services, make_app
from skyless.page.connections import AccessRules
from skyless.page.live import LiveSite
from skyless.page.sites import LiveSites
from skyless.run.mqtt import topics
from support.site_messages import tag_health

QUICK = ((50, 8),)
SERVER = ((20, 8), (1_900, 8), (3_000, 8), (10_000, 8), (100_000, 8), (3, 1_000), (3, 3_000), (3, 10_000), (250_000, 8))
PAGE = ((200, 8), (1_000, 1_000), (100_000, 10_000))
SPACING_M = 4.0
FREE = replace(SITE.site.schedule, mode="free")
FIXES = 20_000
"""Fixes whose processor time is measured."""
MOVING = 2_000
"""Fixes a second of the page's site."""

encode = msgspec.json.encode


def site_of(anchors):
    first = SITE.site.anchors[0]
    side = max(round(anchors**0.5), 1)
    placed = tuple(
        replace(first, id=n + 1, x_m=SPACING_M * (n % side), y_m=SPACING_M * (n // side)) for n in range(anchors)
    )
    return replace(SITE, site=replace(SITE.site, anchors=placed, master=1, walls=(), schedule=FREE)), SPACING_M * side


class Site:
    """A live site whose tags and anchors are healthy."""

    def __init__(self, tags, anchors, clock, wall_clock):
        self.live = LiveSite("here", "mqtt://broker:1", None, clock, wall_clock)
        self.live.attach(Wire(), SITE_ID)
        self.tags, self.anchors, self.wall_clock = tags, anchors, wall_clock
        message, self.side_m = site_of(anchors)
        self.live.feed.receive(topics.site_topic(SITE_ID), encode(message))
        self.live.on_connection(connected=True)

    def move(self, first, count, moving=None):
        """Fixes of ``count`` tags, of all or of a number that are spread over the site."""
        unix_s = self.wall_clock()
        columns = max(round(self.tags**0.5), 1)
        for n in range(first, first + count):
            k = n * max(self.tags // (moving or self.tags), 1) % self.tags
            x, y = self.side_m * (k % columns + unix_s % 1) / columns, self.side_m * (k // columns) / columns
            made = fix(f"t{k}", unix_s, (x, y, 1.0), latency_s=0.0)
            self.live.feed.receive(topics.fix_topic(SITE_ID, f"t{k}"), encode(made))

    def report(self, tags, part=0, parts=1):
        """What anchors, or each of ``parts`` in turn, and some tags report of themselves."""
        unix_s = self.wall_clock()
        for n in range(1 + part, self.anchors + 1, parts):
            self.live.feed.receive(topics.health_topic(SITE_ID, "anchor", str(n)), encode(anchor_health(n, unix_s)))
        for k in range(tags):
            self.live.feed.receive(
                topics.health_topic(SITE_ID, "tag", f"t{k}"), encode(tag_health(f"t{k}", unix_s=unix_s))
            )


def server_row(tags, anchors):
    times = Times()
    site = Site(tags, anchors, lambda: times.now_s, lambda: times.unix_s)
    for second in range(8):
        site.report(0)
        if second > 5:
            site.move(0, tags)
        times.move(1.0)
        begin_s = time.process_time()
        site.live.tick()
        tick_s = time.process_time() - begin_s
    condition = site.live.condition
    page = site.live.open_page()
    sizes = {json.loads(m)["type"]: len(m) for m in asyncio.run(page.drain(site.live.state))}
    offline = sum(kind == "bad" for kind in site.live.state.conditions.values())
    payloads = []
    for k in range(max(tags, FIXES)):
        made = fix(f"t{k % tags}", times.unix_s + 0.05 * (k // tags), (k % 7, 1.0, 1.0), latency_s=0.0)
        payloads.append((topics.fix_topic(SITE_ID, made.tag), encode(made)))
    begin_s = time.process_time()
    for k, (topic, payload) in enumerate(payloads):
        site.live.feed.receive(topic, payload)
        if k % tags == tags - 1:
            times.move(0.05)
            site.live.tick()
    fixes_s = time.process_time() - begin_s
    return {
        "tags": tags, "anchors": anchors, "level": condition.level, "text": condition.text,
        "tags_with_fix": condition.tags_with_fix, "tags_known": condition.tags, "anchors_known": condition.anchors,
        "offline": offline, "tick_cpu_ms": 1e3 * tick_s,
        "fixes_per_cpu_s": len(payloads) / fixes_s,
        "state_bytes": sizes.get("state"), "health_bytes": sizes["health"],
    }  # fmt: skip


@contextlib.contextmanager
def served(tags, anchors):
    """The real application around a live site that is fed from the same loop; its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    site = Site(tags, anchors, time.monotonic, time.time)
    app = make_app(Services(LiveSites(site.live), None, None), AccessRules())
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", ws="websockets-sansio", lifespan="off"))

    async def feed():
        site.move(0, tags)
        site.report(min(tags, 2_000))
        for done in itertools.count():
            site.move(done * MOVING // 10, MOVING // 10, MOVING)
            site.report(0 if done % 10 else min(tags, 1_000), done % 10, 10)
            site.live.table.is_empty or site.live.tick()
            await asyncio.sleep(0.1)

    async def run():
        feeding = asyncio.create_task(feed())
        await server.serve()
        feeding.cancel()

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    yield f"http://127.0.0.1:{port}/"
    site.live.close()
    server.should_exit = True
    thread.join(10)


COUNT = "() => [skyless.frames.moving, skyless.frames.still, performance.now()]"


def page_row(browser, tags, anchors, seconds):
    with served(tags, anchors) as address:
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(address)
        until(page, f"window.skyless?.live.sorted.length >= {min(tags, 500)}")
        time.sleep(5.0)
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})

        def busy_s():
            metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
            return metrics["TaskDuration"]

        (frames, still, begin_ms), busy = page.evaluate(COUNT), busy_s()
        time.sleep(seconds)
        (more, still_more, end_ms), after = page.evaluate(COUNT), busy_s()
        words = page.evaluate("document.getElementById('part').innerText")
        rows = page.evaluate("document.querySelectorAll('table.tags tbody tr').length")
        page.close()
    made = max(more - frames, 1)
    return {
        "tags": tags, "anchors": anchors, "frames_per_s": made / ((end_ms - begin_ms) / 1e3),
        "still_frames_per_s": (still_more - still) / ((end_ms - begin_ms) / 1e3),
        "cpu_ms_per_frame": 1e3 * (after - busy) / made, "rows_built": rows, "words": words,
    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=("server", "page", "all"), default="all")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--quick", action="store_true", help="one small site")
    asked = parser.parse_args()
    if asked.part != "page":
        for size in QUICK if asked.quick else SERVER:
            print(json.dumps(server_row(*size)), flush=True)
    if asked.part != "server":
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            for size in QUICK if asked.quick else PAGE:
                print(json.dumps(page_row(browser, *size, asked.seconds)), flush=True)
            browser.close()


if __name__ == "__main__":
    main()
