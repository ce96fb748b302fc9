"""The map: outline, marks and names of tags, overlays, 3-D view, floors, following, and what is saved."""

import base64
import csv
import io
import itertools
import math
import time
from pathlib import Path

import numpy as np
import page_site as made_up
import pytest
from page_browser import THREE_FRAMES, until
from PIL import Image

from skyless.site.planning.colours import COLOUR_STOPS, scale_of
from value_colours import colour_of

pytestmark = pytest.mark.statistical

PROTANOPIA = np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]])
DEUTERANOPIA = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
"""Linear red, green and blue as a reader without one kind of cones sees them (Machado and others, 2009)."""


def modules(names, body, head="async (given) => "):
    """A function of the page with modules of it by their names."""
    imports = "".join(f"const {name.split('/')[-1]} = await import('/page/{name}.js'); " for name in names)
    return f"{head}{{ {imports}{body} }}"


def pixels(page, canvas):
    data = page.evaluate(f"document.getElementById('{canvas}').toDataURL().split(',')[1]")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA"))


def send_site(server, page, beside=None, **changes):
    message = made_up.site_message(time.time()) | (beside or {})
    message["site"] |= changes
    server.send({"type": "site", "site": message})
    until(page, "name => skyless.state.site.name === name", message["site"]["name"])
    page.evaluate(THREE_FRAMES)


# The room


def test_walls_that_close_are_the_room(hall):
    page = hall[1].page
    outline = page.evaluate(modules(["map/room"], "return room.roomOutline();"))
    assert (outline["kind"], outline["name"]) == ("room", "room")
    assert {tuple(corner) for corner in outline["corners"]} == {(0, 0), (24, 0), (24, 14), (0, 14)}


def test_without_walls_the_area_of_the_anchors_is_named_as_such(hall):
    server, seen = hall
    send_site(server, seen.page, name="Bare", walls=[])
    outline = seen.page.evaluate(modules(["map/room"], "return room.roomOutline();"))
    assert outline["name"] == "area of the anchors"
    assert {tuple(corner) for corner in outline["corners"]} == {(1, 1), (23, 1), (23, 13), (1, 13)}
    words = written(seen.page)
    assert "area of the anchors, 22.0 m × 12.0 m" in words
    assert {"x in m", "y in m"} <= set(words)
    assert any(word.endswith(" m") and word[0].isdigit() for word in words)  # the scale's bar


def test_the_outline_of_the_site_is_the_room_and_in_view(hall):
    server, seen = hall
    corners = [[-3, 0], [27, 0], [27, 9], [12, 14], [-3, 14]]
    send_site(server, seen.page, {"outline_m": corners}, name="Outlined", walls=[])
    outline = seen.page.evaluate(modules(["map/room"], "return room.roomOutline();"))
    assert (outline["kind"], outline["corners"]) == ("room", corners)
    assert "room, 30.0 m × 14.0 m" in written(seen.page)
    fits = "return [view.toX(-3, 0), view.view.width - view.toX(27, 0)];"
    assert min(seen.page.evaluate(modules(["map/view"], fits))) > 0


def test_the_scale_does_not_cover_the_size_of_the_room(serve, visit):
    server = serve()
    seen = visit(server, viewport={"width": 390, "height": 844})
    send_site(server, seen.page, name="Narrow", walls=[])
    script = """
      const { left, top, height } = floor.scaleBox();
      const context = document.createElement("canvas").getContext("2d");
      const found = [];
      for (let y = top - 60; y < top + height; y += 2) {
        view.pan(0, y - view.toY(1, 1)); // the lower edge of the area of the anchors
        context.fillText = (words, x, at) => found.push([x + context.measureText(words).width / 2, at - 6]);
        names.still.length = 0;
        room.nameRoom(context, []);
      }
      return [found.length, found.filter(([right, at]) => right > left && at + 11 > top && at < top + height).length];
    """
    count, covered = seen.page.evaluate(modules(["map/floor", "map/names", "map/room", "map/view"], script))
    assert (count > 20, covered) == (True, 0)


def written(page):
    """Words that the still layers write."""
    return page.evaluate("""async () => {
      const { redraw } = await import("/page/map/map.js");
      const context = document.getElementById("still").getContext("2d");
      const found = [];
      context.fillText = (words) => found.push(words);
      redraw();
      await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
      delete context.fillText;
      return found;
    }""")


@pytest.mark.parametrize(
    ("walls", "corners"),
    [
        ([(0, 0, 4, 0), (4, 0, 4, 3), (4, 3, 0, 3), (0, 3, 0, 0), (2, 0, 2, 3)], {(0, 0), (4, 0), (4, 3), (0, 3)}),
        ([(0, 0, 6, 0), (6, 0, 6, 2), (6, 2, 2, 2), (2, 2, 2, 5), (2, 5, 0, 5), (0, 5, 0, 0)],
         {(0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)}),
        ([(0, 0, 4, 0), (4, 0, 4, 4), (4, 4, 0, 4), (0, 4, 0, 0), (4, 0, 8, 0), (8, 0, 8, 4), (8, 4, 4, 4)],
         {(0, 0), (4, 0), (8, 0), (8, 4), (4, 4), (0, 4)}),
        ([(0, 0, 4, 0), (4, 0, 4, 3), (4, 3, 0, 3)], None),
    ],
)  # fmt: skip
def test_the_outer_edge_of_walls(hall, walls, corners):
    given = [dict(zip(("x1_m", "y1_m", "x2_m", "y2_m"), wall, strict=True)) for wall in walls]
    found = hall[1].page.evaluate(modules(["map/room"], "return room.closedWalls(given);"), given)
    assert (found and {tuple(corner) for corner in found}) == corners


# Marks and names


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_tags_never_share_colour_and_mark(serve, visit, scheme):
    page = visit(serve(tags=0), color_scheme=scheme).page
    styles = page.evaluate(modules(["map/marks"], "return Array.from({length: 56}, (_, n) => marks.tagStyle(n, 56));"))
    assert len({(style["colour"], style["shape"]) for style in styles}) == 56
    for one, other in itertools.combinations(styles[:24], 2):
        if one["shape"] == other["shape"]:
            for eye in (np.eye(3), PROTANOPIA, DEUTERANOPIA):
                assert difference(one["colour"], other["colour"], eye) > 0.1, (one, other)


def oklab(red_green_blue, eye=None):
    """A colour of 0 to 255 in OKLab, for an eye."""
    values = np.array(red_green_blue) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    cones = np.array([[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]])
    mix = np.array([[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]])
    return mix @ np.cbrt(cones @ (linear if eye is None else eye @ linear).clip(0.0, 1.0))


def difference(one, other, eye):
    """Distance of two colours in OKLab for an eye; 0.02 is just seen."""
    one, other = (oklab([int(part) for part in text[4:-1].split(",")], eye) for text in (one, other))
    return float(np.linalg.norm(one - other))


def test_each_tag_has_an_entry_in_the_legend_beside_the_map(serve, visit):
    page = visit(serve(tags=24)).page
    page.click("#legend summary")
    until(page, "document.querySelectorAll('.tag-marks button').length === 24")
    shapes = page.evaluate(
        "[...document.querySelectorAll('.tag-marks button svg')].map((s) => [s.dataset.shape, s.style.color].join())"
    )
    assert len(set(shapes)) == 24
    room, legend = page.locator("#map").bounding_box(), page.locator("#legend").bounding_box()
    assert legend["x"] >= room["x"] + room["width"] - 1
    page.click(".tag-marks button:has-text('tag-007')")
    assert page.evaluate("skyless.state.selection.tag") == "tag-007"
    page.reload()
    until(page, "window.skyless?.state.connection.phase === 'open'")
    assert page.locator("#legend-body").is_visible()
    assert page.locator(".marks .frame").is_visible()  # of the master's mark


def test_on_a_phone_the_legend_is_below_the_map(serve, visit):
    seen = visit(serve(), viewport={"width": 390, "height": 844})
    page = seen.page
    _, lowest = seen.at(0.0, 0.0)
    map_box = page.locator("#map").bounding_box()
    assert lowest + 30 < map_box["y"] + map_box["height"] - 48  # its name is clear of the bar with the scale
    page.click("#legend summary")
    room, legend = page.locator("#map").bounding_box(), page.locator("#legend").bounding_box()
    assert legend["y"] >= room["y"] + room["height"] - 1
    assert room["height"] > 150


def test_names_that_stand_still_are_moved_or_left_out(hall):
    drawn = hall[1].page.evaluate(
        modules(
            ["map/names"],
            """const context = document.createElement("canvas").getContext("2d");
            context.fillText = (words, x, y) => found.push([words, y]);
            const found = [];
            names.still.splice(0, Infinity, [90, 90, 110, 110]);
            for (const words of ["one", "two", "none"]) names.labelIfFree(context, words, 100, [100, 120, 140]);
            return found;""",
        )
    )
    assert drawn == [["one", 120], ["two", 140]]


def test_names_keep_clear_of_each_other_and_of_marks(hall):
    boxes = hall[1].page.evaluate(
        modules(
            ["map/names"],
            """const context = document.createElement("canvas").getContext("2d");
            const wanted = given.map(([x, y], n) => ({ key: `t${n}`, words: `tag-00${n}`, x, y, colour: "black" }));
            return names.drawNames(context, wanted, [[100, 100, 160, 160]]);""",
        ),
        [(200, 200), (205, 203), (210, 198), (230, 205), (300, 300), (130, 98)],
    )
    for one, other in itertools.combinations([*boxes, [100, 100, 160, 160]], 2):
        assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


# Overlays


def test_an_overlay_says_that_it_is_computed_then_shows_its_scale_and_values(hall):
    server, seen = hall
    page = seen.page
    server.overlay_waits = True
    page.click("#legend summary")
    page.select_option("#overlay", "sigma")
    page.wait_for_selector("#ramp-box.pending:has-text('Predicted σ: computing')")
    server.overlay_waits = False
    page.wait_for_selector("#ramp-shown >> visible=true")
    box = page.locator("#ramp-box").inner_text()
    assert "least 2.0 cm" in box
    assert "largest 5.1 cm" in box
    assert "for tags at 1.2 m" in box
    ticks = page.locator("#ramp-ticks span").all_inner_texts()
    assert "3 cm" in ticks
    assert len(ticks) >= 3
    page.evaluate(THREE_FRAMES)
    assert seen.at(0.0, 0.0)[1] + 30 < page.locator("#ramp-box").bounding_box()["y"]  # clear of the lowest names
    page.mouse.move(*seen.at(12.0, 7.0))
    assert "Predicted σ 2.0 cm" in page.locator("#readout").inner_text()
    page.mouse.move(*seen.at(0.0, 0.0))
    assert "no fix" in page.locator("#readout").inner_text()
    page.select_option("#overlay", "none")
    page.locator("#ramp-box").wait_for(state="hidden")


def test_an_overlay_that_fails_says_why_and_can_be_tried_again(hall):
    server, seen = hall
    page = seen.page
    server.overlay_error = "a position needs 4 anchors or more; this site has 2"
    page.evaluate("import('/page/map/overlay.js').then((m) => m.choose('hdop'))")
    page.wait_for_selector("#ramp-box:has-text('No overlay: a position needs 4 anchors or more')")
    server.overlay_error = None
    page.click("#ramp-again")
    page.wait_for_selector("#ramp-shown >> visible=true")
    assert [text for text in seen.problems if "422" not in text] == []
    seen.problems.clear()


def test_the_page_colours_values_as_the_planner_does(hall):
    page = hall[1].page
    scale = scale_of(sorted(made_up_values()))
    given = [{"low": scale.low, "high": scale.high, "stops": COLOUR_STOPS}, list(np.geomspace(0.01, 0.2, 30))]
    drawn = page.evaluate(
        modules(
            ["map/overlay", "pictures"],
            "const [scale, values] = given;"
            "return values.map((value) => pictures.colourAt(overlay.fractionOf(value, scale), scale));",
        ),
        given,
    )
    for value, colour in zip(given[1], drawn, strict=True):
        assert colour == pytest.approx(colour_of(value, scale.low, scale.high), abs=1e-6)
    page.evaluate("import('/page/map/overlay.js').then((m) => m.choose('sigma'))")
    until(page, "skyless.state.overlay.data !== null")
    page.evaluate(THREE_FRAMES)
    x, y = page.evaluate(modules(["map/view"], "return [view.toX(5.6, 4.4), view.toY(5.6, 4.4)];"))
    shown = pixels(page, "still")[round(y), round(x)]
    value = page.evaluate(modules(["map/overlay"], "return overlay.valueAt(5.6, 4.4);"))
    scale = page.evaluate("skyless.state.overlay.data.scale")
    expected = colour_of(value, scale["low"], scale["high"])
    assert shown[:3] == pytest.approx(expected, abs=6)
    hall[1].problems.clear()  # a hint that pixels are read slowly


def made_up_values():
    return [value for value in made_up.overlay("sigma", 0.5)["values"] if value is not None]


# 3-D, floors, following


def test_the_3d_view_turns_zooms_and_returns(hall):
    page = hall[1].page
    flat = page.evaluate(modules(["map/view"], "return [view.toY(5, 5, 0), view.toY(5, 5, 3)];"))
    assert flat[0] == flat[1]
    page.click("#spatial")
    assert page.get_attribute("#spatial", "aria-pressed") == "true"
    assert page.is_disabled("#draw")
    where = modules(["map/view"], "return [view.toX(5, 5), view.toY(5, 5, 0), view.toY(5, 5, 3), view.view.scale];")
    before = page.evaluate(where)
    assert before[1] - before[2] > 10  # heights are seen
    page.focus("#canvas")
    page.keyboard.press("ArrowRight")
    turned = page.evaluate(where)
    assert math.hypot(turned[0] - before[0], turned[1] - before[1]) > 3
    page.keyboard.press("+")
    assert page.evaluate(where)[3] > turned[3]
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 360, box["y"] + 340, steps=4)
    page.mouse.up()
    assert page.evaluate(where)[:2] != turned[:2]
    assert {"1 · 2.8 m", "z", "x in m", "Tags: height 1.2 m given"} <= set(written(page))
    page.keyboard.press("3")
    assert page.evaluate(modules(["map/view"], "return view.toY(5, 5, 3) - view.toY(5, 5, 0);")) == 0


def test_positions_under_the_pointer_are_right_in_every_direction(hall):
    errors = hall[1].page.evaluate(
        modules(
            ["map/view"],
            """view.setSpatial(true);
            const errors = [];
            for (let n = 0; n < 40; n++) {
              view.orbit(0.3, Math.sin(n));
              const [x, y] = view.toSite(view.toX(3, 4), view.toY(3, 4, n / 10), n / 10);
              errors.push(Math.hypot(x - 3, y - 4));
            }
            return errors;""",
        )
    )
    assert max(errors) < 1e-9


def test_ellipses_are_seen_as_the_projection_of_their_points(hall):
    seen, across, up = hall[1].page.evaluate(
        modules(
            ["map/view"],
            """view.setSpatial(true);
            view.orbit(0.7, 0.2);
            const x = [1, 0].map((one, n) => (view.toX(one, n) - view.toX(0, 0)) / view.view.scale);
            const y = [1, 0].map((one, n) => (view.toY(0, 0) - view.toY(one, n)) / view.view.scale);
            return [view.seenCovariance(2, 0.5, 1), x, y];""",
        )
    )
    matrix = np.array([across, up])
    expected = matrix @ np.array([[2.0, 0.5], [0.5, 1.0]]) @ matrix.T
    assert seen == pytest.approx([expected[0, 0], expected[0, 1], expected[1, 1]])


def test_a_given_height_is_named_and_an_estimated_one_has_its_value(hall):
    words = hall[1].page.evaluate(
        modules(
            ["map/tags", "tracks"],
            """const row = new Float64Array(tracks.COLUMNS);
            row[tracks.Z] = 1.2;
            const estimated = tags.heightWords(row, true);
            row[tracks.HEIGHT_GIVEN] = 1;
            return [estimated, tags.heightWords(row, true)];""",
        )
    )
    assert words == [" · z 1.20 m", " · height 1.2 m given"]


def two_floors():
    anchors = made_up.site_message(0.0)["site"]["anchors"]
    return [one | {"floor": 0} for one in anchors[:4]] + [one | {"floor": 1, "z_m": 6.0} for one in anchors[4:]]


def test_tags_and_anchors_of_other_floors_are_dimmed(hall):
    server, seen = hall
    page = seen.page
    send_site(server, page, name="Two floors", anchors=two_floors())
    page.click("#legend summary")
    assert page.locator("#floor option").all_inner_texts() == ["all", "floor 0", "floor 1"]
    others = modules(["map/tags"], "return tags.visibleTags().seen.map((one) => one.other);")
    until(page, "skyless.live.all.get('robot')?.count > 3")
    assert set(page.evaluate(others)) == {False}
    page.select_option("#floor", "1")
    assert set(page.evaluate(others)) == {True}
    page.select_option("#floor", "0")
    assert set(page.evaluate(others)) == {False}
    dimmed = modules(
        ["map/floors"], "const other = floors.otherFloor(); return [other(2.8, 0), other(6, 1), other(3.5)];"
    )
    assert page.evaluate(dimmed) == [False, True, True]


def test_floors_of_the_site_s_file(hall):
    """Their names, zones that lie on one, and tags whose height is given: they are on the floor of their zone."""
    server, seen = hall
    page = seen.page
    floors = [{"number": 0, "low_m": 0.0, "name": "Ground"}, {"number": 1, "low_m": 3.0, "name": "Offices"}]
    send_site(server, page, name="House", anchors=two_floors(), beside={"floors": floors})
    page.click("#legend summary")
    assert page.locator("#floor option").all_inner_texts() == ["all", "Ground", "Offices"]
    page.select_option("#floor", "1")
    whole = {"name": "Everywhere", "polygon_m": [[-99, -99], [99, -99], [99, 99], [-99, 99]], "colour": None}
    server.send({"type": "zones", "zones": [{"id": "all", **whole, "floor": 1}]})
    until(page, "skyless.state.zones.length === 1")
    until(page, "skyless.live.all.get('robot')?.count > 3")
    script = """const row = new Float64Array(21);
        row[17] = 1;
        return [tags.floorByZone(row), tags.floorByZone(row.with(17, 0)), floors.chosenFloor().name];"""
    assert page.evaluate(modules(["map/tags", "map/floors"], script)) == [1, None, "Offices"]


def test_anchors_above_each_other_have_one_line_of_names(hall):
    server, seen = hall
    page = seen.page
    floor_0 = two_floors()[:4]
    floor_1 = [one | {"id": one["id"] + 4, "floor": 1, "z_m": 6.0} for one in floor_0]
    send_site(server, page, name="Two floors", anchors=floor_0 + floor_1)
    written = modules(
        ["map/anchors", "map/view"],
        """const words = [];
        const context = document.createElement("canvas").getContext("2d");
        context.fillText = (text) => words.push(text);
        anchors.drawAnchors(context);
        return words;""",
    )
    lines = {line.replace(" master", "") for line in page.evaluate(written)}
    assert lines == {f"{one['id']}, {one['id'] + 4}" for one in floor_0}
    page.evaluate("skyless.state.options.floor = 1")
    assert set(page.evaluate(written)) == {str(one["id"]) for one in floor_1}


def test_in_3d_the_overlay_and_clicks_are_on_the_ground_of_the_chosen_floor(hall):
    server, seen = hall
    page = seen.page
    send_site(server, page, name="Two floors", anchors=two_floors())
    page.click("#legend summary")
    page.select_option("#floor", "1")
    page.click("#legend summary")
    page.click("#spatial")
    page.evaluate(THREE_FRAMES)
    x, y, low_y, drawn_y = page.evaluate(
        modules(
            ["map/floor", "map/floors", "map/view"],
            """const box = document.getElementById("canvas").getBoundingClientRect();
            const [x, y] = [view.toX(14.3, 2.8), view.toY(14.3, 2.8, floors.groundHeight())];
            const context = document.createElement("canvas").getContext("2d");
            let drawn = null;
            context.drawImage = () => (drawn = context.getTransform().transformPoint({ x: 14.3, y: -2.8 }));
            const data = { x_m: [0, 24], y_m: [0, 14], step_m: 1 };
            const before = skyless.state.overlay;
            skyless.state.overlay = { ...before, data, picture: context.canvas };
            floor.drawOverlay(context);
            skyless.state.overlay = before;
            return [box.left + x, box.top + y, box.top + view.toY(14.3, 2.8), box.top + drawn.y];""",
        )
    )
    assert low_y - y > 20
    assert drawn_y == pytest.approx(y)
    server.silent_tags = set(made_up.names(3))
    page.evaluate("skyless.live.clear()")
    page.mouse.click(x, y)
    until(page, "skyless.state.selection.zone === 'dock'")


def test_floors_can_be_given_as_heights_and_are_kept(hall):
    page = hall[1].page
    page.click("#legend summary")
    assert page.locator("#floor").is_hidden()
    page.fill("#floor-heights", "0; 3.2 6.5")
    page.press("#floor-heights", "Enter")
    until(page, "document.querySelectorAll('#floor option').length === 4")
    page.reload()
    until(page, "document.querySelectorAll('#floor option').length === 4")
    page.fill("#floor-heights", "ground")
    page.press("#floor-heights", "Enter")
    page.wait_for_selector(".toast.bad:has-text('no list of heights')")


def test_a_followed_tag_stays_in_the_middle_until_escape(hall):
    page = hall[1].page
    page.click("#follow")
    page.wait_for_selector(".toast:has-text('Select a tag first')")
    until(page, "skyless.live.all.get('robot')?.count > 3")
    page.click("table.tags button:has-text('robot')")
    page.click("#follow")
    page.wait_for_selector("#following:has-text('Following robot')")
    middle = modules(
        ["map/tags", "map/view"],
        "const one = tags.drawn.find(({ name }) => name === 'robot');"
        "return one ? Math.hypot(one.x - view.view.width / 2, one.y - view.view.height / 2) : 99;",
    )
    for _ in range(3):
        page.evaluate(THREE_FRAMES)
        assert page.evaluate(middle) < 1.0
    page.focus("#canvas")
    page.keyboard.press("Escape")
    assert page.locator("#following").is_hidden()
    assert page.evaluate("skyless.state.selection.tag") == "robot"


# What is saved


def test_the_map_is_saved_as_a_picture_with_its_legend(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.get('robot')?.count > 3")
    page.click("#legend summary")
    with page.expect_download() as download:
        page.click("#save-picture")
    assert download.value.suggested_filename.startswith("skyless-Hall-7-20")
    picture = Image.open(download.value.path())
    box = page.locator("#map").bounding_box()
    assert picture.format == "PNG"
    assert picture.width == round(box["width"])
    assert picture.height > box["height"] + 60
    words = """async () => {
      const { mapPicture } = await import("/page/map/export.js");
      const found = [];
      const before = CanvasRenderingContext2D.prototype.fillText;
      CanvasRenderingContext2D.prototype.fillText = function (words, ...at) {
        found.push(words);
        before.call(this, words, ...at);
      };
      mapPicture();
      CanvasRenderingContext2D.prototype.fillText = before;
      return found;
    }"""
    live = page.evaluate(words)
    assert {"Hall 7", "forklift", "robot", "trolley", "anchor synchronised"} <= set(live)
    assert any("live · simulated" in one and "20" in one for one in live)
    server.cut()
    until(page, "skyless.state.connection.phase === 'lost'")
    at = page.evaluate(
        "(skyless.state.connection.since -= 3600e3, new Date(Date.now() - 3600e3).toLocaleTimeString('en-GB'))"
    )
    heading = next(one for one in page.evaluate(words) if "simulated" in one)
    assert "last known state, connection lost" in heading
    assert f" {at[:2]}:" in heading
    server.refuse = False
    until(page, "skyless.state.connection.phase === 'open'", timeout_s=15.0)
    visit.problems.clear()  # the browser's own lines about the refused sockets


def test_positions_are_saved_as_a_table(hall):
    page = hall[1].page
    until(page, "skyless.live.all.get('robot')?.count > 5")
    page.click("#legend summary")
    assert "2048" in page.locator("#save-positions").get_attribute("title")
    with page.expect_download() as download:
        page.click("#save-positions")
    rows = list(csv.DictReader(Path(download.value.path()).read_text().splitlines()))
    assert list(rows[0]) == ["time", "tag", "x_m", "y_m", "z_m", "sigma_m", "level_m", "alert", "height_given"]
    assert {row["tag"] for row in rows} == {"forklift", "robot", "trolley"}
    mine = [row for row in rows if row["tag"] == "trolley"]
    assert [row["time"] for row in mine] == sorted(row["time"] for row in mine)
    assert mine[0]["time"].endswith("Z")
    assert {row["alert"] for row in mine} == {"detected-excluded"}
    x_m, *_ = made_up.truth(1, 0.0)
    assert abs(float(mine[0]["x_m"]) - x_m) < 5.0
    assert float(mine[0]["z_m"]) == 1.2


def test_names_with_commas_are_quoted_in_the_table(hall):
    lines = hall[1].page.evaluate(
        modules(
            ["map/export", "tracks"],
            """const track = new tracks.Track('a "b", c');
            const row = Array(tracks.COLUMNS + 1).fill(1.5);
            track.push(row);
            return module.positionsCsv([track], 10);""",
        ).replace("const export =", "const module =")
    )
    assert list(csv.reader(lines.splitlines()))[1][1] == 'a "b", c'


# Other places for anchors


def test_an_anchor_is_dragged_and_sigma_predicted_again(hall):
    """Coarse while it moves, fine where it is dropped; its height is typed; nothing goes to the site."""
    server, seen = hall
    page = seen.page
    page.click("#tab-anchors")
    page.click("#try-places")
    page.wait_for_selector("#placing:visible")
    until(page, "skyless.state.overlay.data?.kind === 'sigma'")
    at = page.evaluate(modules(["map/anchors"], "return anchors.drawnAnchors[0];"))
    box = page.locator("#canvas").bounding_box()
    x, y = box["x"] + at["x"], box["y"] + at["y"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y - 20, steps=4)
    page.mouse.up()
    until(page, "skyless.state.overlay.pendingSince === null")
    (moved,) = server.overlays[-1][1]
    fine, coarse = server.overlays[0][0], max(step for step, _ in server.overlays)
    assert (moved["id"], coarse / fine, server.overlays[-1][0]) == (at["id"], 5.0, fine)
    page.fill("#placing-z_m", "4.25")
    page.keyboard.press("Enter")
    until(page, "skyless.state.overlay.pendingSince === null")
    page.wait_for_function("() => document.querySelector('#placing-help').textContent.includes('1 anchor elsewhere')")
    with page.expect_download() as sheet:
        page.click("#placing-sheet")
    assert sheet.value.suggested_filename.endswith(".pdf")
    assert server.sheets == [[moved | {"z_m": 4.25}]]
    with page.expect_download() as table:
        page.click("#placing-table")
    lines = Path(table.value.path()).read_text().splitlines()
    assert lines[0] == "id,x_m,y_m,z_m"
    assert f"{moved['id']},{moved['x_m']:g},{moved['y_m']:g},4.25" in lines
    page.click("#placing-end")
    assert page.locator("#placing").is_hidden()
    own = "skyless.state.site.anchors.find((one) => one.id === id)"
    assert page.evaluate(f"(id) => {own}.x_m", moved["id"]) != moved["x_m"]
    until(page, "skyless.state.overlay.pendingSince === null")
    assert server.overlays[-1] == (fine, [])
