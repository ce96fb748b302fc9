"""A person watches a site: tags move and fall silent, connections are lost, the condition says what is wrong."""

import io
import time

import page_site as made_up
import pytest
from page_browser import PHONE, WINDOW
from page_survey import moved, watch
from PIL import Image

pytestmark = pytest.mark.statistical

OFFLINE = made_up.reason("anchors", "warning", "anchor 8 of 8 is offline", "See its power.", ["anchor/8"])
SLOW = made_up.reason("slow", "bad", "this computer is too slow: the emulated air missed 41 % of the transmissions")
PILL = "level => document.getElementById('pill').className === `pill ${level}`"


def test_a_tag_moves_is_selected_falls_silent_and_leaves(hall):
    server, visit = hall
    page = visit.page
    visit.until("skyless.frames.moving > 10 && skyless.live.all.size === 3")
    x, y = visit.position("forklift")
    true_x, true_y, *_ = made_up.truth(0, time.time() - server.started)
    assert (x - true_x) ** 2 + (y - true_y) ** 2 < 1.0  # drawn late, and given errors of up to 0.1 m
    picture = "document.getElementById('moving').toDataURL()"
    before = page.evaluate(picture)
    visit.until("([x]) => skyless.live.all.get('forklift').shown[0] !== x", [x])
    visit.until(f"before => {picture} !== before", before)
    assert page.locator("table.tags tbody tr").count() == 3
    assert page.locator("#pill").inner_text() == "Live"
    page.wait_for_selector("#summary dd:text-is('3/3')")
    shown = page.locator("#summary").inner_text().replace("\n", " ")
    assert "Anchors 7/8" in shown
    assert "1.2 ms, p99 3.4 ms" in shown
    for name, words in (("forklift", "none"), ("trolley", "faulty anchor excluded")):
        page.click(f"table.tags button:has-text('{name}')")
        page.wait_for_selector(f".detail dd:text-is('{words}')")
    assert visit.texts(".detail dd.warn") == ["faulty anchor excluded"]
    page.click("table.tags button:has-text('robot')")
    page.wait_for_selector(".detail dd.bad:text-is('fault not excluded: no protection level')")
    server.silent_tags = {"robot"}
    page.wait_for_selector("table.tags tr.late:has-text('robot')")
    page.wait_for_selector("text=No fix: too few anchors")
    server.tags = 0
    row = made_up.state_row("drone", 0, 0.0, time.time() - 1000)
    server.send({"type": "state", "unix_s": time.time(), "tags": [row]})
    gone = "table.tags tr.gone:has-text('drone')"
    page.wait_for_selector(gone, timeout=8e3)  # sooner than by the silence since its row


def test_a_site_comes_later_and_nothing_is_drawn_while_nothing_changes(serve, visit):
    server = serve(site=False, tags=0)
    shown = visit(server)
    page = shown.page
    page.locator("#waiting").wait_for()
    shown.until("/^[0-9:]+$/.test(document.getElementById('time').textContent)")  # without any tag
    server.send({"type": "site", "site": made_up.site_message()})
    page.locator("#waiting").wait_for(state="hidden")
    assert page.locator("#site-name").inner_text() == "Hall 7"
    page.wait_for_timeout(500)
    frames = page.evaluate("skyless.frames.moving")
    page.wait_for_timeout(2000)
    assert page.evaluate("skyless.frames.moving") - frames < 12  # health comes once a second


def test_a_cut_connection_is_reported_and_comes_back(hall):
    server, visit = hall
    page = visit.page
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors tr.good:has-text('2 master')")
    server.cut()
    page.wait_for_selector("#banner:has-text('Connection lost')")
    assert page.locator("#pill").inner_text() == "Disconnected"
    page.locator("#condition-line").wait_for(state="hidden")  # the banner says it
    page.wait_for_selector("#panel-anchors tr.unknown:has-text('3')")
    visit.until("document.querySelectorAll('#panel-anchors tr:is(.good, .warn, .bad)').length === 0")
    page.locator("#panel-anchors section:has(.nodes)").wait_for(state="hidden")
    page.click("#panel-anchors button:text-is('3')")
    page.wait_for_selector("#panel-anchors .detail dd:has-text('health unknown')")
    server.refuse, server.full = False, True
    page.wait_for_selector("#banner:has-text('too many pages are open')")
    server.full, server.site_name = False, "Hall 8"
    page.locator("#banner").wait_for(state="hidden")
    visit.until("skyless.state.site.name === 'Hall 8' && skyless.live.all.size === 3")
    server.mute = True
    page.wait_for_selector("#banner:has-text('no message for')")
    visit.forgive()


def test_the_condition_has_a_line_a_list_and_buttons_that_show_what_it_is_about(hall):
    server, visit = hall
    page = visit.page
    visit.until(PILL, "good")
    server.condition = made_up.condition(SLOW, OFFLINE)
    visit.until(PILL, "bad")
    assert page.title() == "✕ Hall 7 · Skyless"
    panel = page.locator("#condition-list")
    panel.wait_for(state="hidden")
    page.hover("#pill")
    panel.wait_for()
    assert panel.locator("li").count() == 2
    for words in ("2 things are wrong", "See its power.", "Hall 7, number 7", "Protection level"):
        assert words in panel.inner_text()
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
    for again in (False, True):
        if again:  # it is selected already
            page.click("#tab-zones")
            page.click("#pill")
        show.click()
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


MIN_ROOM = """() => {
  const [header, line, words, more, map] = ["header", "#condition-line", "#condition-words", "#condition-more", "#map"]
    .map((name) => document.querySelector(name));
  const boxes = [header, line, words, more, map].map((part) => part.getBoundingClientRect());
  const [above, whole, sentence, button, below] = boxes;
  return Math.min(
    line.clientHeight - line.scrollHeight, line.clientWidth - line.scrollWidth, sentence.left - whole.left,
    whole.right - sentence.right, sentence.top - whole.top, whole.bottom - sentence.bottom, whole.right - button.right,
    whole.bottom - button.bottom, 60 - whole.height, whole.top - above.bottom, below.top - whole.bottom,
    innerWidth - header.scrollWidth, 23 - document.getElementById("pill-words").getBoundingClientRect().height,
  );
}"""
"""By how many pixels the sentence and its button are within their line, this between header and map and below 60."""


def test_a_long_sentence_takes_two_lines_below_one_word_and_is_whole_in_the_title(serve, visit):
    server = serve(site_name="Distribution centre north, hall 7")
    words = "; ".join(f"computer host-{n} is too slow: tag{n} dropped 12 % of its receptions" for n in range(5))
    server.condition = made_up.condition(made_up.reason("slow", "bad", words), OFFLINE)
    shown = visit(server)
    shown.until(PILL, "bad")
    for size in ({"width": 1440, "height": 900}, PHONE, WINDOW):
        shown.page.set_viewport_size(size)
        shown.until(f"({MIN_ROOM})() >= 0")
    assert shown.page.get_attribute("#condition-words", "title") == f"{words[0].upper()}{words[1:]}."


def test_events_are_counted_until_they_are_read_and_show_what_they_are_about(hall):
    server, visit = hall
    page = visit.page
    now = time.time()
    events = [
        made_up.event(1, now - 40, "bad", "anchor", "anchor/8", "anchor 8 is offline"),
        made_up.event(2, now - 30, "bad", "alert", "tag/robot", "tag robot: a fault is not excluded"),
    ]
    server.send({"type": "log", "events": events})
    page.wait_for_selector("#tab-events .unread:has-text('2')")
    page.click("#tab-events")
    visit.until("document.querySelectorAll('#event-list li').length === 2")
    for row in page.locator("#event-list li").all():
        line, mark = row.bounding_box(), row.locator("span").first.bounding_box()
        assert line["y"] <= mark["y"] < line["y"] + line["height"]
    visit.until("document.querySelector('#tab-events .unread') === null")
    for _ in ("selected", "selected already"):
        page.click("#tab-events")
        page.click("#event-list button:has-text('Anchor 8 is offline')")
        page.wait_for_selector("#panel-anchors tr.selected:has-text('8')")
    page.wait_for_selector("#panel-anchors .detail dd:has-text('its figures are not known')")
    assert set(visit.texts("#panel-anchors .detail output")) <= {"–"}
    page.click("#panel-anchors button:text-is('3')")
    page.wait_for_selector("#panel-anchors .detail canvas")
    server.send(watch(moved(4)))
    page.wait_for_selector("#panel-anchors .findings li:has-text('Anchor 4 has moved by about 11 cm, since ')")
    page.wait_for_selector("#panel-anchors tr.bad:has-text('4 moved 11 cm')")
    page.click("#tab-timing")
    page.wait_for_selector("#phases svg")


def test_a_site_with_random_instants_has_no_leader_and_no_superframe(serve, visit):
    page = visit(serve(mode="free", tags=0)).page
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors tr.good")
    page.click("#legend summary")
    assert "anchor on the air" in page.locator(".marks").inner_text()
    assert "master" not in page.locator(".marks").inner_text() + page.locator("#panel-anchors").inner_text()
    page.locator("#tab-timing").wait_for(state="hidden")


def test_a_floor_plan_lies_where_the_site_says(serve, visit):
    file = io.BytesIO()
    Image.new("RGB", (480, 300), (200, 30, 30)).save(file, "PNG")
    shown = visit(serve(tags=0, floor_plan=file.getvalue()))
    shown.until("import('/page/map/floor.js').then(({ floor }) => floor?.height_m === 15)")
    reddish = """
      const data = document.getElementById("still").getContext("2d").getImageData(0, 0, 2000, 2000);
      return given.map(([x, y]) => {
        const [r, g, b] = data.data.slice(4 * (Math.round(view.py(y)) * 2000 + Math.round(view.px(x))));
        return r > 100 && g < 90 && b < 90;
      });"""
    shown.frames()
    assert shown.run("map/view", reddish, [[6.37, -0.71], [23.37, 13.71], [6.37, -1.31]]) == [True, True, False]
    shown.forgive()
