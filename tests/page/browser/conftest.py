"""What the tests in a browser share: one browser, servers of a made-up site, visits in which nothing may fail."""

import asyncio
import contextlib
from asyncio import events
from pathlib import Path

import pytest
from page_browser import CHROMIUM, FLAGS, Visit
from page_server import PageServer


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
        yield lambda **settings: stack.enter_context(PageServer(**settings))


@pytest.fixture
def visit(chromium):
    """Open the page; in the end, it has reported no problem and sent requests to its server only."""
    browser, loop = chromium
    visits = []

    def open_page(server, **context):
        visits.append(Visit(browser, server.address, **context))
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
