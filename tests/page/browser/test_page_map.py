"""A person looks at the map: its legend, overlays, floors and 3-D view; follows a tag, saves it, tries other places."""

import csv
import io
import math

import page_site as made_up
import pytest
from page_browser import PHONE
from PIL import Image

from support.value_colours import colour_of

pytestmark = pytest.mark.statistical

WORDS = """
  const found = [];
  const before = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (words, ...at) {
    found.push(words);
    before.call(this, words, ...at);
  };
  given === "picture" ? exporting.mapPicture() : map.redraw();
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  CanvasRenderingContext2D.prototype.fillText = before;
  return found;"""


def written(visit, what="map"):
    """Words that the map's layers write, or those of its picture."""
    return visit.run("map/map", f"const exporting = await import('/page/map/export.js'); {WORDS}", what)


def send_site(server, visit, **changes):
    server.send({"type": "site", "site": made_up.site_message(**changes)})
    visit.until("name => skyless.state.site.name === name", changes["name"])
    visit.frames()


def test_each_tag_has_an_entry_in_the_legend_beside_the_map_or_on_a_phone_below_it(serve, visit):
    shown = visit(serve(tags=24))
    page = shown.page
    page.click("#legend summary")
    shown.until("document.querySelectorAll('.tag-marks button').length === 24")
    shapes = "[...document.querySelectorAll('.tag-marks button svg')].map((s) => s.dataset.shape + s.style.color)"
    assert len(set(page.evaluate(shapes))) == 24
    room, legend = page.locator("#map").bounding_box(), page.locator("#legend").bounding_box()
    assert legend["x"] >= room["x"] + room["width"] - 1
    page.click(".tag-marks button:has-text('tag-007')")
    assert page.evaluate("skyless.state.selection.tag") == "tag-007"
    page.locator("#floor").wait_for(state="hidden")
    page.fill("#floor-heights", "0; 3.2 6.5")
    page.press("#floor-heights", "Enter")
    page.reload()
    shown.until("document.querySelectorAll('#floor option').length === 4")
    page.fill("#floor-heights", "ground")
    page.press("#floor-heights", "Enter")
    page.wait_for_selector(".toast.bad:has-text('no list of heights')")
    page.locator("#legend-body").wait_for()
    page.locator(".marks .frame").wait_for()  # of the master's mark
    page.click("#legend summary")
    page.set_viewport_size(PHONE)
    shown.frames()
    box = page.locator("#map").bounding_box()
    page.click("#fit")
    assert shown.at(0.0, 0.0)[1] + 30 < box["y"] + box["height"] - 48  # the room's name is clear of the scale
    page.click("#legend summary")
    room, legend = page.locator("#map").bounding_box(), page.locator("#legend").bounding_box()
    assert legend["y"] >= room["y"] + room["height"] - 1
    assert room["height"] > 150


def test_an_overlay_is_computed_coloured_and_read_or_says_why_there_is_none(hall):
    server, visit = hall
    page = visit.page
    server.waits = {"overlay"}
    page.click("#legend summary")
    page.select_option("#overlay", "sigma")
    page.wait_for_selector("#ramp-box.pending:has-text('Predicted σ: computing')")
    server.waits = set()
    page.wait_for_selector("#ramp-shown >> visible=true")
    box = page.locator("#ramp-box").inner_text()
    for words in ("least 2.0 cm", "largest 5.1 cm", "for tags at 1.2 m"):
        assert words in box
    ticks = visit.texts("#ramp-ticks span")
    assert "3 cm" in ticks
    assert len(ticks) >= 3
    visit.frames()
    assert visit.at(0.0, 0.0)[1] + 30 < page.locator("#ramp-box").bounding_box()["y"]  # clear of the lowest names
    for at, words in (((12.0, 7.0), "Predicted σ 2.0 cm"), ((0.0, 0.0), "no fix")):
        page.mouse.move(*visit.at(*at))
        assert words in page.locator("#readout").inner_text()
    value, scale, shown = visit.run("map/view map/overlay store", """
      const pixel = document.getElementById("still").getContext("2d").getImageData(view.px(5.6), view.py(4.4), 1, 1);
      return [overlay.valueAt(5.6, 4.4), store.state.overlay.data.scale, [...pixel.data.slice(0, 3)]];""")  # fmt: skip
    assert shown == pytest.approx(colour_of(value, scale["low"], scale["high"]), abs=6)
    page.select_option("#overlay", "none")
    page.locator("#ramp-box").wait_for(state="hidden")
    server.errors["overlay"] = "a position needs 4 anchors or more; this site has 2"
    page.select_option("#overlay", "hdop")
    page.wait_for_selector("#ramp-box:has-text('No overlay: a position needs 4 anchors or more')")
    server.errors.clear()
    page.click("#ramp-again")
    page.wait_for_selector("#ramp-shown >> visible=true")
    visit.forgive()


def test_the_3d_view_turns_zooms_returns_and_shows_the_chosen_floor(hall):
    server, visit = hall
    page = visit.page
    assert {"x in m", "y in m"} <= set(written(visit))
    assert any(word.endswith(" m") and word[0].isdigit() for word in written(visit))  # the scale's bar
    page.click("#spatial")
    assert page.get_attribute("#spatial", "aria-pressed") == "true"
    assert page.is_disabled("#draw")

    def where():
        body = "return [view.toX(5, 5), view.toY(5, 5, 0), view.toY(5, 5, 3), view.view.scale];"
        return visit.run("map/view", body)

    before = where()
    page.focus("#canvas")
    page.keyboard.press("ArrowRight")
    turned = where()
    assert math.dist(turned[:2], before[:2]) > 3
    page.keyboard.press("+")
    assert where()[3] > turned[3]
    box = page.locator("#canvas").bounding_box()
    begin = (box["x"] + 300, box["y"] + 300)
    visit.drag(begin, (begin[0] + 60, begin[1] + 40))
    assert where()[:2] != turned[:2]
    assert {"1 · 2.8 m", "z", "x in m", "Tags: height 1.2 m given"} <= set(written(visit))
    page.keyboard.press("3")
    assert where()[1] == where()[2]

    send_site(server, visit, name="Two floors", anchors=made_up.two_floors())
    page.click("#legend summary")
    assert visit.texts("#floor option") == ["all", "floor 0", "floor 1"]
    page.select_option("#floor", "1")
    page.click("#legend summary")
    page.click("#spatial")
    visit.frames()
    x, y, low_y, drawn_y = visit.run("map/floor map/floors map/view store", """
      const context = document.createElement("canvas").getContext("2d");
      let drawn = null;
      context.drawImage = () => (drawn = context.getTransform().transformPoint({ x: 14.3, y: -2.8 }));
      const data = { x_m: [0, 24], y_m: [0, 14], step_m: 1 };
      const before = store.state.overlay;
      store.state.overlay = { ...before, data, picture: context.canvas };
      floor.drawOverlay(context);
      store.state.overlay = before;
      const ground_y = view.toY(14.3, 2.8, floors.groundHeight());
      return [view.toX(14.3, 2.8), ground_y, view.toY(14.3, 2.8), drawn.y];""")  # fmt: skip
    assert low_y - y > 20
    assert drawn_y == pytest.approx(y)
    server.silent_tags = set(made_up.names(3))
    page.evaluate("skyless.live.clear()")
    box = page.locator("#canvas").bounding_box()
    page.mouse.click(box["x"] + x, box["y"] + y)
    visit.until("skyless.state.selection.zone === 'dock'")


def test_a_followed_tag_stays_in_the_middle_until_escape(hall):
    _, visit = hall
    page = visit.page
    page.click("#follow")
    page.wait_for_selector(".toast:has-text('Select a tag first')")
    page.click("table.tags button:has-text('robot')")
    page.click("#follow")
    page.wait_for_selector("#following:has-text('Following robot')")
    middle = """
      const one = tags.drawn.find(({ name }) => name === "robot");
      return one ? Math.hypot(one.x - view.view.width / 2, one.y - view.view.height / 2) : 99;"""
    for _ in range(3):
        visit.frames()
        assert visit.run("map/tags map/view", middle) < 1.0
    page.focus("#canvas")
    page.keyboard.press("Escape")
    page.locator("#following").wait_for(state="hidden")
    assert page.evaluate("skyless.state.selection.tag") == "robot"


def test_the_map_is_saved_as_a_picture_with_its_legend_and_positions_as_a_table(hall):
    server, visit = hall
    page = visit.page
    visit.until("skyless.live.all.get('robot')?.count > 5")
    page.click("#legend summary")
    assert "2048" in page.locator("#save-positions").get_attribute("title")
    rows = list(csv.DictReader(visit.saved("#save-positions")[1].decode().splitlines()))
    assert {row["tag"] for row in rows} == {"forklift", "robot", "trolley"}
    mine = [row for row in rows if row["tag"] == "trolley"]
    assert [row["time"] for row in mine] == sorted(row["time"] for row in mine)
    assert {(row["alert"], float(row["z_m"])) for row in mine} == {("detected-excluded", 1.2)}
    assert abs(float(mine[0]["x_m"]) - made_up.truth(1, 0.0)[0]) < 5.0

    name, content = visit.saved("#save-picture")
    assert name.startswith("skyless-Hall-7-20")
    picture, box = Image.open(io.BytesIO(content)), page.locator("#map").bounding_box()
    assert (picture.format, picture.width) == ("PNG", round(box["width"]))
    assert picture.height > box["height"] + 60
    live = written(visit, "picture")
    assert {"Hall 7", "forklift", "robot", "trolley", "anchor synchronised"} <= set(live)
    assert any("live · simulated" in one and "20" in one for one in live)
    server.cut()
    visit.until("skyless.state.connection.phase === 'lost'")
    page.evaluate("skyless.state.connection.since -= 3600e3")
    heading = next(one for one in written(visit, "picture") if "simulated" in one)
    assert "last known state, connection lost" in heading
    assert f" {page.evaluate('new Date(Date.now() - 3600e3).getHours()'):02d}:" in heading
    visit.forgive()


def test_an_anchor_is_dragged_and_sigma_predicted_again(hall):
    """Coarse while it moves, fine where it is dropped; its height is typed; nothing goes to the site."""
    server, visit = hall
    page = visit.page
    computed = "skyless.state.overlay.pendingSince === null"
    page.click("#tab-anchors")
    page.click("#try-places")
    page.wait_for_selector("#placing:visible")
    visit.until("skyless.state.overlay.data?.kind === 'sigma'")
    at, box = visit.run("map/anchors", "return anchors.drawnAnchors[0];"), page.locator("#canvas").bounding_box()
    x, y = box["x"] + at["x"], box["y"] + at["y"]
    visit.drag((x, y), (x + 30, y - 20))
    visit.until(computed)
    (anchor,) = server.body("overlay")["anchors"]
    steps_m = server.bodies["step_m"]
    assert (anchor["id"], max(steps_m) / steps_m[0], steps_m[-1]) == (at["id"], 5.0, steps_m[0])
    page.fill("#placing-z_m", "4.25")
    page.keyboard.press("Enter")
    visit.until(computed)
    visit.until("document.querySelector('#placing-help').textContent.includes('1 anchor elsewhere')")
    assert visit.saved("#placing-sheet")[0].endswith(".pdf")
    assert server.bodies["sheet"] == [{"anchors": [anchor | {"z_m": 4.25}]}]
    lines = visit.saved("#placing-table")[1].decode().splitlines()
    assert lines[0] == "id,x_m,y_m,z_m"
    assert f"{anchor['id']},{anchor['x_m']:g},{anchor['y_m']:g},4.25" in lines
    count = len(server.bodies["overlay"])
    page.click("#placing-end")
    page.locator("#placing").wait_for(state="hidden")
    own = "id => skyless.state.site.anchors.find((one) => one.id === id).x_m"
    assert page.evaluate(own, anchor["id"]) != anchor["x_m"]
    visit.until(computed)
    assert (len(server.bodies["overlay"]), steps_m[-1]) == (count, steps_m[0]), "the site's own places again"
