"""What the dashboard's tests share: a live site, one browser, servers of a made-up site, visits nothing may fail in."""

import asyncio
import contextlib
from asyncio import events
from pathlib import Path

import pytest
from dashboard_builders import SITE_ID, Times, Wire
from page_browser import CHROMIUM, FLAGS, Visit
from page_fake_server import FakeServer

from skyless.page.live import LiveSite


@pytest.fixture
def times():
    return Times()


@pytest.fixture
def wire():
    return Wire()


@pytest.fixture
def live(times, wire):
    """Of a broker that is not connected yet."""
    live = LiveSite("here", "mqtt://broker:1", None, lambda: times.now_s, lambda: times.unix_s)
    live.attach(wire, SITE_ID)
    return live


@pytest.fixture(scope="session")
def chromium():
    """One browser for all tests of a worker: Chromium and Playwright's event loop, which counts as running."""
    sync_api = pytest.importorskip("playwright.sync_api")
    if not Path(CHROMIUM).exists():
        pytest.skip(f"no Chromium at {CHROMIUM}: apt install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        loop = asyncio.get_running_loop()
        events._set_running_loop(None)  # between visits other tests run loops of their own
        yield browser, loop
        events._set_running_loop(loop)
        browser.close()


@pytest.fixture
def serve():
    """Start a server of a made-up site."""
    with contextlib.ExitStack() as stack:
        yield lambda **settings: stack.enter_context(FakeServer(**settings))


@pytest.fixture
def visit(chromium):
    """Open the page; in the end, it has reported no problem and sent requests to its server only."""
    browser, loop = chromium
    visits = []

    def open_page(server, **context):
        visits.append(Visit(browser, server.address, **context))
        visits[-1].host = server.address.split("/")[2]
        return visits[-1]

    events._set_running_loop(loop)
    try:
        yield open_page
        for one in visits:
            one.close()
    finally:
        events._set_running_loop(None)
    for one in visits:
        assert one.problems == []
        assert one.hosts <= {one.host}


@pytest.fixture
def hall(serve, visit):
    """A server with three tags, and a visit to it."""
    server = serve()
    return server, visit(server)
