"""Assets: names, colours, filters, the dialog that edits them, import, and two pages at once. Simulated."""

import time

import page_site as made_up
import pytest
from page_browser import until

pytestmark = pytest.mark.statistical

GROUPS = ("forklifts", "people", "crates", "robots", "tools", "carts", "cranes", "drones", "pallets", "guests")


def asset(tag, name="", group="", **more):
    return {"tag": tag, "name": name, "group": group, "icon": "", "colour": "", "owner": "", "notes": "", **more}


def many(count):
    return [
        asset(f"tag-{n + 1:03d}", f"Thing {n + 1}", GROUPS[n % len(GROUPS)], owner="Ann" if n % 50 == 0 else "")
        for n in range(count)
    ]


def wait_for_puts(server, count=1):
    end = time.monotonic() + 5
    while len(server.puts) < count:
        assert time.monotonic() < end, "nothing was sent"
        time.sleep(0.02)
    return server.puts[-1]


def wait_for(server, wanted):
    end = time.monotonic() + 5
    while not (server.asked and wanted(server.asked[-1])):
        assert time.monotonic() < end, server.asked[-1:]
        time.sleep(0.02)


def names(page):
    return page.locator("#panel-tags tbody button.name").all_inner_texts()


STYLES = """async () => {
  const { visibleTags } = await import("/page/map/tags.js");
  return visibleTags().seen.map(({ track, colour, other, fresh }) => [track.name, fresh, colour, other]);
}"""


def styles(page, count):
    """Colour of each tag as the map draws it, and whether it is faint, once all are there and fresh.

    On a busy machine positions come late, and stale tags are grey.
    """
    end = time.monotonic() + 30
    while True:
        seen = page.evaluate(STYLES)
        if len(seen) == count and all(fresh == "fresh" for _, fresh, _, _ in seen):
            return {tag: (colour, faint) for tag, _, colour, faint in seen}
        assert time.monotonic() < end, seen[:3]
        time.sleep(0.03)


@pytest.fixture
def hall(serve, visit):
    server = serve(tags=3)
    server.assets = [
        asset("forklift", "Linde 3", "forklifts", icon="F", owner="Bea", notes="fork bent"),
        asset("trolley", "Cart 1", "carts", colour="#ffffff"),
    ]
    return server, visit(server, color_scheme="light")


def test_assets_name_and_colour_their_tags_and_are_filtered(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.size === 3 && skyless.state.assets.size === 2")
    until(page, "document.querySelectorAll('#panel-tags tbody button.name').length === 3")
    assert names(page) == ["Cart 1", "F Linde 3", "robot"]
    look = styles(page, 3)
    assert look["trolley"][0] != "rgb(255, 255, 255)", "white is not seen on a light map"
    assert look["forklift"][0] != look["robot"][0]
    page.get_by_label("Group", exact=True).select_option("forklifts")
    until(page, "document.querySelectorAll('#panel-tags tbody button.name').length === 1")
    assert {tag: faint for tag, (_, faint) in styles(page, 3).items()} == {
        "forklift": False, "trolley": True, "robot": True,
    }  # fmt: skip
    page.wait_for_selector("#part:has-text('faint')")
    page.click("text=Show all")
    page.get_by_label("Find a tag").fill("bea")
    until(page, "document.querySelector('#panel-tags tbody').innerText.includes('Linde 3')")
    assert names(page) == ["F Linde 3"]
    page.click("text=Show all")
    page.locator("#panel-tags").get_by_label("Zone", exact=True).select_option("dock")
    in_dock = """skyless.live.sorted.filter((track) => {
      const row = new Float64Array(21);
      track.at(skyless.shown_s(), row);
      return row[0] > 14 && row[0] < 21 && row[1] > 2.5 && row[1] < 6;
    }).length"""
    until(page, f"document.querySelectorAll('#panel-tags tbody button.name').length === {in_dock}")
    page.click("text=Show all")
    page.click("#panel-tags tbody button.name:has-text('Linde 3')")
    page.wait_for_selector("#panel-tags .detail h2:has-text('F Linde 3')")
    details = page.locator("#panel-tags .detail").inner_text()
    for words in ("forklift", "forklifts", "Bea", "fork bent"):
        assert words in details
    page.click("#legend summary")
    page.click("#legend >> text=group carts")
    until(page, "document.querySelectorAll('#panel-tags tbody button.name').length === 1")
    server.assets = []
    server.send_site_messages()
    until(page, "document.querySelectorAll('#panel-tags tbody button.name').length === 3")
    assert page.locator(".filter").is_hidden(), "a filter of a group that is gone would hide tags"


def test_five_hundred_assets_are_told_apart(serve, visit):
    server = serve(tags=500, rate_hz=2.0)
    server.assets = many(500)
    page = visit(server).page
    until(page, "skyless.live.all.size === 500 && skyless.state.assets.size === 500")
    assert len({colour for colour, _ in styles(page, 500).values()}) == len(GROUPS)
    page.get_by_label("Find a tag").fill("ann")
    until(page, "document.querySelector('#panel-tags .count').textContent === '10 of 500 tags found'")
    assert sum(not faint for _, faint in styles(page, 500).values()) == 10
    assert page.evaluate("skyless.state.find") == "ann"
    page.click("#edit-assets")
    assert page.locator("#assets-dialog tbody tr").count() == 150
    page.get_by_label("Find in the table").fill("thing 499")
    page.get_by_label("Group of tag-499").fill("spares")
    page.keyboard.press("Tab")
    page.click("#assets-dialog button.primary")
    sent = wait_for_puts(server)["assets"]
    assert len(sent) == 500
    assert sent[498] == server.assets[498] == asset("tag-499", "Thing 499", "spares")


def test_a_server_that_sends_a_part_is_asked_for_the_tags_that_are_found(serve, visit):
    server = serve(tags=0)
    server.assets = many(300)
    page = visit(server).page
    now = time.time()
    row = made_up.state_row("tag-001", 0, 1.0, now)
    server.send({"type": "state", "unix_s": now, "tags": [row], "left": [], "of": 5000, "inside": 10})
    until(page, "skyless.state.part?.of === 5000")
    page.get_by_label("Find a tag").fill("thing 29")
    wait_for(server, lambda asked: asked["find"] == "thing 29")
    assert set(server.asked[-1]["tags"]) >= {"tag-029", *(f"tag-{n}" for n in range(290, 300))}
    page.locator("#panel-tags").get_by_label("Zone", exact=True).select_option("dock")
    wait_for(server, lambda asked: asked["view"] == [14, 2.5, 21, 6])


def test_assets_are_added_changed_and_removed_with_the_keyboard(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.size === 3 && skyless.state.assets.size === 2")
    page.wait_for_selector("#edit-assets:enabled")
    page.focus("#edit-assets")
    page.keyboard.press("Enter")
    dialog = page.locator("#assets-dialog")
    dialog.get_by_role("button", name="Add", exact=True).focus()
    page.keyboard.press("Enter")
    page.keyboard.type("trolley")  # the new row has the focus
    page.keyboard.press("Tab")
    page.keyboard.type("Robot 1")
    page.keyboard.press("Tab")
    server.refusal = "asset 'trolley': the tag has two assets; it should have one"
    dialog.get_by_role("button", name="Save").press("Enter")
    page.wait_for_selector("#assets-dialog .fault:has-text('the tag has two assets')")
    visit.problems.clear()  # the browser's own line about the answer 400
    server.refusal = None
    assert [row["name"] for row in page.evaluate("skyless.state.assets.values().toArray()")] == ["Linde 3", "Cart 1"]
    dialog.locator(".new .asset-tag").fill("robot")
    page.keyboard.press("Tab")
    dialog.get_by_label("Colour of robot", exact=True).fill("red")
    page.keyboard.press("Tab")
    dialog.get_by_role("button", name="Save").click()
    assert page.evaluate("document.activeElement.validationMessage") != ""
    assert server.puts == []
    dialog.get_by_label("Colour of robot", exact=True).fill("#c2410c")
    page.keyboard.press("Tab")
    dialog.get_by_role("button", name="Remove trolley").press("Enter")
    assert dialog.locator(".foot").inner_text().startswith("Not saved yet: 1 new, 0 changed, 1 removed.")
    page.keyboard.press("Escape")
    page.wait_for_selector("#assets-dialog .fault:has-text('not saved')")
    server.refusal = "asset 'robot': group is 'long'; it should have 64 characters at most"
    dialog.get_by_role("button", name="Save").click()
    page.wait_for_selector("#assets-dialog .fault:has-text('64 characters at most')")
    server.refusal = None
    visit.problems.clear()  # the browser's own line about the answer 400
    dialog.get_by_role("button", name="Save").click()
    assert wait_for_puts(server) == {
        "assets": [server.assets[0], asset("robot", "Robot 1", colour="#c2410c")], "site": "Hall 7",
    }  # fmt: skip
    dialog.wait_for(state="detached")
    until(page, "document.querySelector('#panel-tags tbody').innerText.includes('Robot 1')")


def test_a_file_shows_what_it_changes_before_it_is_sent(hall, tmp_path):
    server, visit = hall
    page = visit.page
    until(page, "skyless.state.assets.size === 2")
    page.click("#edit-assets")
    dialog = page.locator("#assets-dialog")
    file = tmp_path / "assets.csv"
    for text, words in (
        ("name,group\r\nA,b\r\n", 'no column "tag"'),
        ("tag,size\r\na,b\r\n", 'column "size" is not known'),
        ("tag,name\na,b\na,c\n", 'Line 3: the tag "a" is listed twice'),
        ('tag,name\na,"b\n', "quotation mark is not closed"),
        ("tag,name\na,b,c\n", "Line 2 has 3 values for 2 columns"),
        ("tag,name\na,Säge\n", "not UTF-8"),
    ):
        file.write_text(text, encoding="latin-1")
        dialog.locator("input[type=file]").set_input_files(file)
        page.wait_for_selector(f"#assets-dialog .fault:has-text('{words}')")
    file.write_text(
        '\ufefftag;name;notes\r\nforklift;"Linde; 4";\r\nrobot;"R ""2""";"two\nlines"\r\n\r\n', encoding="utf-8"
    )
    dialog.locator("input[type=file]").set_input_files(file)
    page.wait_for_selector("#assets-dialog .foot:has-text('1 new, 1 changed, 0 removed')")
    assert dialog.locator("tbody .state").all_inner_texts() == ["+ new", "● changed", ""]
    assert server.puts == []
    dialog.get_by_role("button", name="Save").click()
    sent = {one["tag"]: one for one in wait_for_puts(server)["assets"]}
    assert sent["forklift"] == asset("forklift", "Linde; 4", "forklifts", icon="F", owner="Bea")
    assert sent["robot"] == asset("robot", 'R "2"', notes="two\nlines")
    assert sent["trolley"]["name"] == "Cart 1", "assets that the file has not stay"
    page.click("#edit-assets")
    with page.expect_download() as found:
        dialog.get_by_text("Export CSV").click()
    assert found.value.suggested_filename == "assets.csv"


def test_of_two_pages_that_edit_at_once_none_erases_the_others_change(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.state.assets.size === 2")
    page.click("#edit-assets")
    dialog = page.locator("#assets-dialog")
    dialog.get_by_label("Name of forklift").fill("Mine")
    page.keyboard.press("Tab")
    server.assets = [{**server.assets[0], "name": "Theirs"}, {**server.assets[1], "name": "Cart 2"}]  # not told yet
    dialog.get_by_role("button", name="Save").click()
    page.wait_for_selector("#assets-dialog .said:has-text('Another page has saved forklift, trolley meanwhile')")
    assert "Both have changed forklift: saving keeps what stands here." in dialog.inner_text()
    assert dialog.get_by_label("Name of trolley").input_value() == "Cart 2"
    assert server.puts == []
    server.assets.append(asset("robot", "Third"))
    dialog.get_by_role("button", name="Save").click()
    page.wait_for_selector("#assets-dialog .said:has-text('Another page has saved robot meanwhile')")
    dialog.get_by_role("button", name="Save").click()
    assert [one["name"] for one in wait_for_puts(server)["assets"]] == ["Mine", "Cart 2", "Third"]
