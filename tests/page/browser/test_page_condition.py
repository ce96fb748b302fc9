"""The page shows the condition of the site with its reasons, and is never green without fresh evidence."""

import time

import page_site as made_up
import pytest
from page_browser import until
from page_survey import moved, watch

pytestmark = pytest.mark.statistical

OFFLINE = made_up.reason("anchors", "warning", "anchor 8 of 8 is offline", "See its power.", ["anchor/8"])
SLOW = made_up.reason("slow", "bad", "this computer is too slow: the emulated air missed 41 % of the transmissions")


def pill_is(page, level):
    until(page, "level => document.getElementById('pill').className === `pill ${level}`", arg=level)


def header(page):
    """The pill's word and the sentence below the header."""
    return page.locator("#pill").inner_text(), page.locator("#condition-words").inner_text()


def test_the_pill_has_the_level_the_line_below_it_the_first_reason_and_the_browsers_tab_a_mark(hall):
    server, visit = hall
    page = visit.page
    pill_is(page, "good")
    assert header(page) == ("Live", "All is well: nothing speaks against the positions shown.")
    assert page.title() == "● Hall 7 · Skyless"
    server.condition = made_up.condition(OFFLINE)
    pill_is(page, "warning")
    assert header(page) == ("Warning", "Anchor 8 of 8 is offline.")
    assert page.locator("#condition-more").inner_text() == "What to do"
    assert page.title().startswith("▲ ")
    assert page.locator("#condition-said").inner_text() == "Warning. Anchor 8 of 8 is offline."
    server.condition = made_up.condition(SLOW, OFFLINE)
    pill_is(page, "bad")
    assert header(page)[0] == "Fault"
    assert page.locator("#condition-more").inner_text() == "and 1 more"
    assert page.title().startswith("✕ ")
    server.condition = made_up.condition(level="waiting", text="no tag is online")
    pill_is(page, "waiting")
    assert (*header(page), page.title()[0]) == ("Waiting", "No tag is online.", "○")
    assert page.locator("#condition-more").is_hidden()


def test_all_reasons_are_listed_on_a_click_by_the_pointer_and_by_keys(hall):
    server, visit = hall
    page = visit.page
    server.condition = made_up.condition(SLOW, OFFLINE)
    pill_is(page, "bad")
    panel = page.locator("#condition-list")
    assert panel.is_hidden()
    page.hover("#pill")
    panel.wait_for()
    assert panel.locator("li").count() == 2
    assert "2 things are wrong" in panel.inner_text()
    assert "See its power." in panel.inner_text()
    page.mouse.move(400, 400)
    panel.wait_for(state="hidden")
    page.click("#pill")
    page.mouse.move(400, 400)
    assert page.locator("#pill").get_attribute("aria-expanded") == "true"
    show = panel.locator("button:has-text('Show anchor 8')").element_handle()
    show.focus()
    server.condition = made_up.condition(SLOW, {**OFFLINE, "text": "anchor 8 of 9 is offline"})
    panel.locator("li:has-text('8 of 9')").wait_for()
    assert show.evaluate("button => button === document.activeElement")
    show.click()
    page.wait_for_selector("#panel-anchors tr.selected:has-text('8')")
    page.keyboard.press("Escape")
    panel.wait_for(state="hidden")
    page.click("#tab-zones")
    page.click("#pill")
    show.click()  # selected already
    page.wait_for_selector("#panel-anchors tr.selected:has-text('8')")
    page.keyboard.press("Escape")
    panel.wait_for(state="hidden")
    page.click("#condition-more")
    panel.wait_for()
    page.click("#condition-more")
    panel.wait_for(state="hidden")
    page.mouse.click(400, 400)
    page.focus("#theme")
    page.keyboard.press("Shift+Tab")
    panel.wait_for()
    page.keyboard.press("Escape")
    panel.wait_for(state="hidden")


def test_without_a_judgement_or_with_an_old_one_the_page_is_not_green(serve, visit):
    server = serve()
    server.condition = None
    page = visit(server).page
    pill_is(page, "waiting")
    server.condition = made_up.condition()
    pill_is(page, "good")
    server.condition = None  # positions still come
    pill_is(page, "waiting")
    assert header(page) == ("Waiting", "The server is silent.")
    assert page.evaluate("skyless.state.connection.phase") == "open"


def test_a_page_that_is_behind_is_not_green(hall):
    server, visit = hall
    page = visit.page
    pill_is(page, "good")
    server.answers_pings = False
    page.evaluate("skyless.state.ping = { sentMs: performance.now() - 2300, tripMs: 0 }")
    pill_is(page, "warning")
    assert header(page)[1].startswith("This page is ")
    server.condition = made_up.condition(SLOW)
    pill_is(page, "bad")
    page.click("#pill")
    page.wait_for_selector("#condition-list li:nth-child(2):has-text('s behind.')")
    server.condition = made_up.condition()
    server.send({"type": "pong"})
    until(page, "skyless.state.ping.sentMs === null")
    assert page.evaluate("skyless.state.ping.tripMs") > 2300
    pill_is(page, "warning")  # until a later answer has come in time
    server.answers_pings = True
    pill_is(page, "good")


def test_a_lost_broker_or_connection_is_not_green(hall):
    server, visit = hall
    page = visit.page
    pill_is(page, "good")
    server.send({"type": "mqtt", "connected": False, "broker": "mqtt://hall:1883"})
    until(page, "!document.getElementById('pill').className.includes('good')")
    server.send({"type": "mqtt", "connected": True, "broker": "mqtt://hall:1883"})
    pill_is(page, "good")
    server.mute = server.refuse = True  # one that took a new connection would be live for a moment
    until(page, "!document.getElementById('pill').className.includes('good')", timeout_s=8.0)
    pill_is(page, "lost")
    assert page.locator("#pill").inner_text() == "Disconnected"
    assert page.locator("#condition-line").is_hidden()  # the banner says it
    assert page.locator("#summary").inner_text().count("–") >= 3  # no figures of before
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors tr.unknown:has-text('3')")
    # Nobody says what they are now; the panel is drawn some times a second.
    until(page, "document.querySelectorAll('#panel-anchors tr:is(.good, .warn, .bad)').length === 0")
    assert not page.locator("#panel-anchors section:has(.nodes)").is_visible()
    page.click("#panel-anchors button:text-is('3')")
    page.wait_for_selector("#panel-anchors .detail dd:has-text('health unknown')")
    server.mute = server.refuse = False
    until(page, "skyless.state.connection.phase === 'open'", timeout_s=15.0)
    visit.problems.clear()  # the browser's own lines about the refused sockets


def test_a_page_too_many_shows_why(hall):
    server, visit = hall
    server.full = True
    server.cut()
    server.refuse = False
    until(visit.page, "document.getElementById('banner').innerText.includes('too many pages are open')", timeout_s=8.0)
    server.full = False
    visit.page.locator("#banner").wait_for(state="hidden")
    visit.problems[:] = [text for text in visit.problems if "WebSocket connection" not in text]


def test_the_summary_has_figures(hall):
    server, visit = hall
    page = visit.page
    page.wait_for_selector("#summary dd:text-is('3/3')")
    shown = page.locator("#summary").inner_text().replace("\n", " ")
    assert "Anchors 7/8" in shown
    assert "Hz" in page.evaluate("import('/page/summary.js').then((m) => new Map(m.summaryFacts()).get('Rate'))")
    assert "1.2 ms, p99 3.4 ms" in shown
    page.click("#pill")
    shown = page.locator("#condition-list").inner_text()
    assert "Hall 7, number 7" in shown
    assert "Protection level" in shown
    server.condition = None
    until(page, "(skyless.state.conditionMs = -1e4, document.querySelector('#summary .latency dd').innerText === '–')")


def test_a_dead_anchor_has_no_figures(hall):
    _, visit = hall
    page = visit.page
    page.click("#tab-anchors")
    dead = page.locator("#panel-anchors tr.bad:has-text('8')")
    dead.wait_for()
    assert dead.locator("td").all_inner_texts()[2:] == ["–"] * 6
    page.click("#panel-anchors button:text-is('8')")
    page.wait_for_selector("#panel-anchors .detail dd:has-text('its figures are not known')")
    assert set(page.locator("#panel-anchors .detail output").all_inner_texts()) <= {"–"}
    page.click("#panel-anchors button:text-is('5')")
    page.wait_for_selector("#panel-anchors .detail dd:text-is('not synchronised')")
    assert "Synchronised to" not in page.locator("#panel-anchors .detail").inner_text()
    condition = """async () => {
      const { condition } = await import("/page/map/anchors.js");
      const { health } = skyless.state;
      health.conditions.delete(8); // as the server drops what is old
      return condition(8);
    }"""
    assert page.evaluate(condition) == "unknown"


def test_events_are_listed_filtered_and_counted(hall):
    server, visit = hall
    page = visit.page
    now = time.time()
    events = [
        made_up.event(1, now - 60, "good", "anchor", "anchor/3", "anchor 3 is online"),
        made_up.event(2, now - 50, "note", "program", "recorder/demo", "recorder demo started"),
        made_up.event(3, now - 40, "bad", "anchor", "anchor/8", "anchor 8 is offline"),
        made_up.event(4, now - 30, "bad", "alert", "tag/robot", "tag robot: a fault is not excluded"),
    ]
    server.send({"type": "log", "events": events})
    page.wait_for_selector("#tab-events .unread:has-text('2')")
    page.click("#tab-events")
    rows = page.locator("#event-list li")
    until(page, "document.querySelectorAll('#event-list li').length === 4")
    assert "robot" in rows.first.inner_text()
    for row in rows.all():
        line, mark = row.bounding_box(), row.locator("span").first.bounding_box()
        assert line["y"] <= mark["y"] < line["y"] + line["height"]
    until(page, "document.querySelector('#tab-events .unread') === null")
    page.select_option("#event-filter", "severe")
    until(page, "document.querySelectorAll('#event-list li').length === 2")
    page.select_option("#event-filter", "programs")
    until(page, "document.querySelectorAll('#event-list li').length === 1")
    page.select_option("#event-filter", "all")
    server.send(
        {"type": "log", "events": [*events[2:], made_up.event(5, now, "warning", "master", "anchor/2", "anchor 2")]}
    )
    until(page, "document.querySelectorAll('#event-list li').length === 5")
    page.click("#event-list button:has-text('Anchor 8 is offline')")
    page.wait_for_selector("#panel-anchors tr.selected:has-text('8')")
    page.click("#tab-events")
    page.click("#event-list button:has-text('Anchor 8 is offline')")  # selected already
    page.wait_for_selector("#panel-anchors tr.selected:has-text('8')")


MIN_ROOM = """() => {
  const line = document.getElementById("condition-line");
  const [words, more, whole] = ["condition-words", "condition-more", "condition-line"].map((id) =>
    document.getElementById(id).getBoundingClientRect());
  return Math.min(
    line.clientHeight - line.scrollHeight, line.clientWidth - line.scrollWidth,
    words.left - whole.left, whole.right - words.right, words.top - whole.top, whole.bottom - words.bottom,
    whole.right - more.right, whole.bottom - more.bottom, 60 - whole.height,
    whole.top - document.querySelector("header").getBoundingClientRect().bottom,
    document.getElementById("map").getBoundingClientRect().top - whole.bottom,
  );
}"""
"""By how many pixels the sentence and its button are within their line, this between header and map and below 60."""


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_a_long_sentence_takes_two_lines_below_one_word_and_is_whole_in_the_title(serve, visit, size):
    server = serve()
    server.site_name = "Distribution centre north, hall 7"
    words = "; ".join(f"computer host-{n} is too slow: tag{n} dropped 12 % of its receptions" for n in range(5))
    server.condition = made_up.condition(made_up.reason("slow", "bad", words), OFFLINE)
    page = visit(server, viewport=dict(zip(("width", "height"), size, strict=True))).page
    pill_is(page, "bad")
    assert header(page) == ("Fault", f"{words[0].upper()}{words[1:]}.")
    until(page, f"({MIN_ROOM})() >= 0")
    assert page.get_attribute("#condition-words", "title") == header(page)[1]
    assert page.evaluate("document.getElementById('pill-words').getBoundingClientRect().height < 24")
    assert page.evaluate("document.querySelector('header').scrollWidth <= innerWidth")


def test_on_a_phone_the_open_tab_is_in_view(serve, visit):
    page = visit(serve(), viewport={"width": 390, "height": 844}).page
    page.focus("#tab-tags")
    page.keyboard.press("End")
    box = page.locator("#tab-recordings").bounding_box()
    assert box["x"] + box["width"] <= 391


# What the watch of the anchors finds


def drawn_words(page):
    return page.evaluate("""async () => {
      const { drawFindings } = await import("/page/map/findings.js");
      const context = document.createElement("canvas").getContext("2d");
      const words = [];
      context.fillText = (text) => words.push(text);
      drawFindings(context);
      return words;
    }""")


@pytest.fixture
def empty_hall(serve, visit):
    server = serve(tags=0)
    return server, visit(server)


def test_an_anchor_that_has_moved_is_shown_and_goes(empty_hall):
    server, visit = empty_hall
    page = visit.page
    server.send(watch(moved(4)))
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors .findings li:has-text('Anchor 4 has moved by about 11 cm, since ')")
    page.wait_for_selector("#panel-anchors tr.bad:has-text('4 moved 11 cm')")
    assert drawn_words(page) == ["moved 11 cm"]
    server.send(watch())
    page.locator("#panel-anchors .findings").wait_for(state="hidden")
    assert drawn_words(page) == []


def test_several_findings(empty_hall):
    server, visit = empty_hall
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
