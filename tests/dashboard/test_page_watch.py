"""What the watch of the anchors finds is shown on the map and in the list; and goes when it is gone."""

import pytest
from page_browser import until
from page_fake_survey import moved, watch


@pytest.fixture
def hall(serve, visit):
    server = serve(tags=0)
    return server, visit(server)


def drawn_words(page):
    return page.evaluate("""async () => {
      const { drawFindings } = await import("/page/map/findings.js");
      const context = document.createElement("canvas").getContext("2d");
      const words = [];
      context.fillText = (text) => words.push(text);
      drawFindings(context);
      return words;
    }""")


def test_an_anchor_that_has_moved_is_shown_and_goes(hall):
    server, visit = hall
    page = visit.page
    server.send(watch(moved(4)))
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors .findings li:has-text('Anchor 4 has moved by about 11 cm, since ')")
    page.wait_for_selector("#panel-anchors tr.bad:has-text('4 moved 11 cm')")
    assert drawn_words(page) == ["moved 11 cm"]
    server.send(watch())
    page.locator("#panel-anchors .findings").wait_for(state="hidden")
    assert drawn_words(page) == []


def test_several_findings(hall):
    server, visit = hall
    page = visit.page
    link = {**moved(1), "kind": "link", "anchors": [1, 5], "sentence": "The link 1–5 is blocked, by about 35 cm."}
    check = {**moved(6), "kind": "check", "anchors": [6, 7], "sentence": "Something has changed at anchors 6 and 7."}
    server.send(watch(moved(4), link, check))
    page.click("#tab-anchors")
    until(page, "document.querySelectorAll('#panel-anchors .findings li').length === 3")
    assert drawn_words(page) == ["moved 11 cm", "link blocked", "check"]


def test_the_findings_fit_a_phone(serve, visit):
    server = serve(tags=0)
    page = visit(server, viewport={"width": 390, "height": 844}).page
    server.send(watch(moved(4), moved(5)))
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors .findings li")
    wide = "[...document.querySelectorAll('html, body, #panels')].some((e) => e.scrollWidth > e.clientWidth + 1)"
    assert not page.evaluate(wide)
