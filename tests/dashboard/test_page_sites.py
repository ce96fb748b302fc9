"""The choice of a site in the header, and what the empty map says while no site is alive or kernels are compiled."""

from urllib.parse import parse_qs, urlsplit

import pytest
from page_browser import until
from page_fake_site import condition

pytestmark = pytest.mark.statistical


def sites(shown, *known):
    return {"type": "sites", "shown": shown, "sites": known}


def test_the_empty_map_says_which_sites_are_gone(serve, visit):
    server = serve(tags=0, site=False)
    page = visit(server).page
    page.wait_for_selector("#waiting:has-text('Waiting for a site')")
    until(page, "skyless.state.connection.phase === 'open'")
    server.send(sites(None, [1, "lab", False]))
    page.wait_for_selector("#waiting:has-text('Site 1, lab, was here; none of its programs is online.')")
    assert page.locator("#sites").is_hidden()


@pytest.mark.parametrize("width", [1440, 390])
def test_another_site_is_chosen_in_the_header(serve, visit, width):
    server = serve(tags=1)
    visited = visit(server, viewport={"width": width, "height": 844})
    page, sockets, asked = visited.page, [], []
    until(page, "skyless.state.liveId !== null")
    mine = page.evaluate("skyless.state.liveId")
    server.send(sites(mine, [1, "lab", False], [mine, "Hall 7", True]))
    until(page, "skyless.state.sites.length === 2")
    assert page.locator("#sites").is_hidden(), "a site that is gone is not offered"
    server.send(sites(mine, [1, "lab", True], [mine, "Hall 7", True]))
    page.wait_for_selector("#sites")
    assert page.locator("#site-name").is_hidden()
    words = page.evaluate("[...document.querySelectorAll('#sites option')].map((o) => [o.text, o.selected])")
    assert words == [["lab (site 1)", False], [f"Hall 7 (site {mine})", True]]
    box = page.locator("#sites").bounding_box()
    assert 46 <= box["width"] < box["x"] + box["width"] <= width
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.on("websocket", lambda socket: sockets.append(socket.url))
    page.on("request", lambda request: asked.append(urlsplit(request.url)))
    page.select_option("#sites", "1")
    page.wait_for_url("**/?site=1")
    until(page, "skyless.state.connection.phase === 'open'")
    assert parse_qs(urlsplit(sockets[-1]).query) == {"site": ["1"]}
    until(page, "skyless.state.liveId !== null")
    page.evaluate("import('/page/api.js').then((api) => api.overlay('sigma', 1))")
    until(page, "true")
    (query,) = {one.query for one in asked if one.path == "/api/overlay"}
    assert parse_qs(query)["site"] == [str(mine)], "the site that is shown, whichever was asked for"


def preparation(done, total):
    return {"type": "preparation", "preparation": {"done": done, "total": total, "left_s": 25.0, "unix_s": 0.0}}


@pytest.mark.parametrize(
    "viewport", [{"width": 1440, "height": 900}, {"width": 390, "height": 844}], ids=["wide", "phone"]
)
def test_the_empty_map_shows_how_far_the_kernels_are_compiled(serve, visit, viewport):
    server = serve(tags=0, site=False)
    page = visit(server, viewport=viewport).page
    page.wait_for_selector("#waiting")
    assert page.locator("#preparation").is_hidden()
    server.condition = condition(level="waiting", text="waiting for the site's anchors")
    page.wait_for_selector("#condition-words:has-text('Waiting for the site')")
    server.send(preparation(0, 0))
    page.wait_for_selector("#preparation:has-text('Compiling the kernels')")
    page.wait_for_selector("#condition-words:has-text('Compiling')")
    assert page.locator("#waiting").is_hidden()
    server.send(preparation(37, 120))
    page.wait_for_selector("#preparation:has-text('Compiling 37 of 120 kernels')")
    assert page.locator("#preparation").inner_text().split("\n")[-1].startswith("About 25 s left.")
    assert page.evaluate("document.querySelector('#preparation progress').value") == pytest.approx(37 / 120)
    box = page.locator("#preparation progress").bounding_box()
    assert 0.0 < box["x"] < box["x"] + box["width"] < viewport["width"]
    server.send({"type": "preparation", "preparation": None})
    page.locator("#preparation").wait_for(state="hidden")
    page.wait_for_selector("#waiting")
    page.wait_for_selector("#condition-words:has-text('Waiting for the site')")
