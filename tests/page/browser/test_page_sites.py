"""A person chooses a site, of a broker's or of a hub's, and watches one with very many tags."""

import time
from urllib.parse import parse_qs, urlsplit

import msgspec
import numpy as np
import pytest
from page_browser import PHONE

from skyless.page import gathered
from skyless.run.fix_batch import RECORD
from skyless.sim.lab import lab_site
from support.waiting import came

pytestmark = pytest.mark.statistical


def sites(shown, *known):
    return {"type": "sites", "shown": shown, "sites": known}


@pytest.mark.parametrize("window", [{"width": 1440, "height": 844}, PHONE])
def test_another_site_is_chosen_in_the_header(serve, visit, window):
    server = serve(tags=1)
    shown = visit(server, viewport=window)
    page, sockets, asked = shown.page, [], []
    mine = page.evaluate("skyless.state.liveId")
    server.send(sites(mine, [1, "lab", False], [mine, "Hall 7", True]))
    shown.until("skyless.state.sites.length === 2")
    page.locator("#sites").wait_for(state="hidden")  # a site that is gone is not offered
    server.send(sites(mine, [1, "lab", True], [mine, "Hall 7", True]))
    page.wait_for_selector("#sites")
    page.locator("#site-name").wait_for(state="hidden")
    words = page.evaluate("[...document.querySelectorAll('#sites option')].map((o) => [o.text, o.selected])")
    assert words == [["lab (site 1)", False], [f"Hall 7 (site {mine})", True]]
    box = page.locator("#sites").bounding_box()
    assert 46 <= box["width"] < box["x"] + box["width"] <= window["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= window["width"]
    page.on("websocket", lambda socket: sockets.append(socket.url))
    page.on("request", lambda request: asked.append(urlsplit(request.url)))
    page.select_option("#sites", "1")
    page.wait_for_url("**/?site=1")
    shown.until("skyless.state.connection.phase === 'open' && skyless.state.liveId !== null")
    assert parse_qs(urlsplit(sockets[-1]).query) == {"site": ["1"]}
    shown.run("api", "return api.overlay('sigma', 1);")
    (query,) = {one.query for one in asked if one.path == "/api/overlay"}
    assert parse_qs(query)["site"] == [str(mine)], "the site that is shown, whichever was asked for"


def hub_site(number, condition, reason="", **more):
    return {"number": number, "name": f"Hall {number}", "condition": condition, "reason": reason, **more}


def test_the_sites_at_a_hub_are_listed_and_their_pages_change_nothing(hall):
    server, visit = hall
    page = visit.page
    page.locator("#draw").wait_for()
    page.locator("#all-sites").wait_for(state="hidden")
    halls = [hub_site(1, "cut", reason="not heard for 3 min"), hub_site(2, "good", tags_heard=9, versions={"0.2": 4})]
    server.hub = {"hub": "nats://a:4222", "connected": True, "sites": halls}
    page.goto(server.address)
    page.wait_for_selector("tr.cut:has-text('Not heard for 3 min.')")
    assert "●" not in page.locator("tr.cut").inner_text()
    page.fill("#find", "hall 2")
    page.wait_for_selector("tr.cut", state="detached")
    for key in ("Tab", "Tab", "Enter"):  # after the switch of colours
        page.keyboard.press(key)
    page.wait_for_url("**/?site=2")
    page.wait_for_selector("#all-sites")
    for change in ("#draw", "#tab-setup", "#add-zone"):
        page.locator(change).wait_for(state="hidden")
    page.click("#all-sites")
    page.wait_for_selector("tr.good")
    server.hub = {**server.hub, "connected": False}
    page.wait_for_selector("#banner:has-text('cannot be reached')")
    assert page.locator("tr.good").count() == 0


# Very many tags: the page asks the binary stream for its view, and draws points, or counts in cells.

LEFT_M, RIGHT_M, Y_M = 3.0, 21.0, 7.0


class Crowd:
    """The server's messages of tags at two places of the hall; those at the right were heard some seconds ago."""

    def __init__(self, count):
        self.asked, self.spoilt = [], False
        self.show(count, count // 2)

    def show(self, count, right):
        """Place ``count`` tags: the first ``right`` with even numbers at the right, the others at the left."""
        records = np.zeros(count, RECORD)
        records["tag"], records["flags"] = np.arange(count), 1
        is_right = (records["tag"] % 2 == 0) & (records["tag"] < 2 * right)
        records["position_mm"][:, :2] = (
            np.column_stack([np.where(is_right, RIGHT_M, LEFT_M), np.full(count, Y_M)]) * 1000
        )
        self.columns = gathered.Columns()
        self.columns.update(records[is_right], 1.0)
        self.columns.update(records[~is_right], 5.0)
        self.columns.names = {number: f"t{number}" for number in range(count)}

    def __call__(self, asked):
        self.asked.append(asked)
        view = msgspec.convert({key: asked[key] for key in ("view", "px", "named")}, gathered.View)
        unix_us = round(1e6 * (time.time() + 1.0))  # later than any delay that the page reckons with
        found = gathered.tags_message(self.columns, view, 5.0, unix_us)
        named = [gathered.names_message(self.columns, view.named, unix_us)] if view.named else []
        return [
            *named,
            gathered.anchors_message(lab_site(100.0).anchors, unix_us),
            found[:-1] if self.spoilt else found,
        ]


PIXEL = """
  const canvas = document.getElementById("moving");
  const context = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  return [...context.getImageData(Math.round(view.px(given[0])), Math.round(view.py(given[1])), 1, 1).data];"""


def test_very_many_tags_are_points_or_counts(serve, visit):
    crowd = Crowd(1000)
    shown = visit(serve(tags=0, live2=crowd))
    page = shown.page
    part = "document.getElementById('part').textContent"
    shown.until(f"{part} === '1\\u202f000 tags are shown as points'")

    def seen(x_m):
        shown.frames()
        return shown.run("map/view", PIXEL, [x_m, Y_M])

    fresh, old = seen(LEFT_M), seen(RIGHT_M)
    assert [fresh[3], old[3]] == [255, 255]
    assert max(fresh[:3]) - min(fresh[:3]) > 60 > max(old[:3]) - min(old[:3]), "tags that are not heard are grey"

    # The nearest point is selected; the server is asked for its name.
    page.mouse.click(*shown.at(LEFT_M, Y_M))
    shown.until("/^t[0-9]*[13579]$/.test(skyless.state.selection.tag)")

    # The map is moved: points stay where they are in the hall, and the new view is asked for.
    views = len({tuple(asked["view"]) for asked in crowd.asked})
    page.focus("#canvas")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    assert seen(LEFT_M) == fresh
    shown.until(f"{part}.includes('points')")
    came(lambda: len({tuple(asked["view"]) for asked in crowd.asked}) > views)

    # What is no message changes nothing; more tags than points are counts.
    crowd.spoilt = True
    crowd.show(6007, 0)
    page.keyboard.press("0")
    page.wait_for_timeout(300)
    assert page.evaluate("skyless.state.many.kind") == "P"
    crowd.spoilt = False
    page.keyboard.press("-")
    shown.until(f"{part} === '6\\u202f007 tags, shown as counts: zoom in to see single ones'")
    assert seen(LEFT_M)[3] > 200 > seen(RIGHT_M)[3]

    # In 3-D there is only the ordinary stream.
    page.click("#spatial")
    shown.until(f"!{part}.includes('counts') || document.getElementById('part').hidden")
