"""The choice of a site in the header, and what the empty map says while no site is alive or kernels are compiled."""

from urllib.parse import parse_qs, urlsplit

import pytest
from page_browser import until

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


def test_the_sites_at_a_hub_are_listed_and_their_pages_change_nothing(serve, visit):
    server = serve(tags=1)
    visited = visit(server)
    page = visited.page
    until(page, "skyless.state.site !== null")
    assert page.locator("#draw").is_visible()
    assert page.locator("#all-sites").is_hidden()
    halls = [hub_site(1, "cut", reason="not heard for 3 min"), hub_site(2, "good", tags_heard=9, versions={"0.2": 4})]
    server.hub = {"hub": "nats://a:4222", "connected": True, "sites": halls}
    page.goto(server.address)
    page.wait_for_selector("tr.cut:has-text('Not heard for 3 min.')")
    assert "●" not in page.locator("tr.cut").inner_text()
    page.fill("#find", "hall 2")
    page.wait_for_selector("tr.cut", state="detached")
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")  # after the switch of colours
    page.keyboard.press("Enter")
    page.wait_for_url("**/?site=2")
    page.wait_for_selector("#all-sites")
    for change in ("#draw", "#tab-setup", "#add-zone"):
        assert page.locator(change).is_hidden()
    page.click("#all-sites")
    page.wait_for_selector("tr.good")
    server.hub = {**server.hub, "connected": False}
    page.wait_for_selector("#banner:has-text('cannot be reached')")
    assert page.locator("tr.good").count() == 0


def hub_site(number, condition, reason="", **more):
    return {"number": number, "name": f"Hall {number}", "condition": condition, "reason": reason, **more}
