"""The page with many tags, with a wide site, and in a browser that does not keep up. Simulated."""

import time

import page_site as made_up
import pytest
from page_browser import until

pytestmark = pytest.mark.statistical

TAGS = 400
SHOWN = "document.querySelectorAll('#panel-tags tbody button.name').length"
BUSY = "(ms) => { const end = performance.now() + ms; while (performance.now() < end); }"


def test_a_long_list_builds_the_rows_that_are_seen_and_reaches_its_end(serve, visit):
    page = visit(serve(tags=TAGS, rate_hz=2.0)).page
    until(page, f"skyless.live.all.size === {TAGS}")
    until(page, f"{SHOWN} > 5")
    assert page.evaluate(SHOWN) < TAGS / 4
    assert not page.locator("#panel-tags button.name:text-is('tag-400')").count()
    page.evaluate("document.getElementById('panels').scrollTop = 1e6")
    page.locator("#panel-tags button.name:text-is('tag-400')").wait_for()
    assert page.evaluate(SHOWN) < TAGS / 4


@pytest.mark.parametrize("wide_m", [900.0, 12_000.0])
def test_a_wide_site_is_seen_whole(serve, visit, wide_m):
    server = serve()
    visit = visit(server)
    message = made_up.site_message(time.time())
    message["site"] |= {"walls": [], "name": "Yard"}
    for anchor in message["site"]["anchors"]:
        anchor["x_m"] *= wide_m / made_up.WIDTH_M
    server.send({"type": "site", "site": message})
    until(visit.page, "skyless.state.site?.name === 'Yard'")
    visit.page.click("#fit")
    box = visit.page.locator("#canvas").bounding_box()
    for anchor in message["site"]["anchors"]:
        x, y = visit.at(anchor["x_m"], anchor["y_m"])
        assert box["x"] < x < box["x"] + box["width"]
        assert box["y"] < y < box["y"] + box["height"]


def test_a_browser_that_does_not_keep_up_says_so_stays_connected_and_asks_for_less(serve, visit):
    page = visit(serve()).page
    limit = "import('/page/pace.js').then((pace) => pace.rowLimit())"
    most = page.evaluate(limit)
    for _ in range(2):
        page.evaluate(BUSY, 1500)
        page.wait_for_timeout(50)
    until(page, "document.getElementById('condition-line').innerText.includes('his browser is too slow')")
    assert page.evaluate("skyless.state.connection.phase") == "open"
    assert page.evaluate(limit) < most


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_table_of_tags_is_not_cut_off(serve, visit, size):
    page = visit(serve(tags=20), viewport=dict(zip(("width", "height"), size, strict=True))).page
    page.wait_for_selector("#panel-tags tr.fresh")
    assert page.evaluate("(box => box.scrollWidth <= box.clientWidth)(document.querySelector('#panel-tags .scroll-x'))")
