"""A person finds tags, names them, edits and imports assets: the list of tags, its filters, the dialog of assets."""

import pytest
from page_site import asset

pytestmark = pytest.mark.statistical

NAMES = "#panel-tags tbody button.name"
COUNT = f"count => document.querySelectorAll('{NAMES}').length === count"


@pytest.fixture
def hall(serve, visit):
    known = [
        asset("forklift", "Linde 3", "forklifts", icon="F", owner="Bea", notes="fork bent"),
        asset("trolley", "Cart 1", "carts", colour="#ffffff"),
    ]
    server = serve(assets=known)
    shown = visit(server, color_scheme="light")
    shown.until("skyless.live.all.size === 3 && skyless.state.assets.size === 2")
    shown.until(COUNT, 3)
    return server, shown


def test_assets_name_their_tags_and_tags_are_filtered(hall):
    server, visit = hall
    page = visit.page
    assert visit.texts(NAMES) == ["Cart 1", "F Linde 3", "robot"]
    page.get_by_label("Group", exact=True).select_option("forklifts")
    visit.until(COUNT, 1)
    faint = "return tags.visibleTags().seen.filter(({ other }) => other).map(({ track }) => track.name);"
    assert visit.run("map/tags", faint) == ["robot", "trolley"]
    page.wait_for_selector("#part:has-text('faint')")
    page.click("text=Show all")
    page.get_by_label("Find a tag").fill("bea")
    visit.until(COUNT, 1)
    assert visit.texts(NAMES) == ["F Linde 3"]
    page.click("text=Show all")
    page.locator("#panel-tags").get_by_label("Zone", exact=True).select_option("dock")
    in_dock = (
        "[...skyless.live.all.values()].filter(({ shown: [x, y] }) => x > 14 && x < 21 && y > 2.5 && y < 6).length"
    )
    visit.until(f"({COUNT})({in_dock})")
    page.click("text=Show all")
    page.click(f"{NAMES}:has-text('Linde 3')")
    page.wait_for_selector("#panel-tags .detail h2:has-text('F Linde 3')")
    details = page.locator("#panel-tags .detail").inner_text()
    for words in ("forklift", "forklifts", "Bea", "fork bent"):
        assert words in details
    page.click("#legend summary")
    page.click("#legend >> text=group carts")
    visit.until(COUNT, 1)
    server.assets = []
    server.send()
    visit.until(COUNT, 3)
    page.locator(".filter").wait_for(state="hidden")  # a filter of a group that is gone would hide tags


def test_of_five_hundred_tags_the_rows_that_are_seen_are_built_found_and_edited(serve, visit):
    known = [asset(f"tag-{n:03d}", f"Thing {n}", "spare", owner="Ann" if n % 50 == 1 else "") for n in range(1, 501)]
    server = serve(tags=500, rate_hz=2.0, assets=known)
    shown = visit(server)
    page = shown.page
    shown.until("skyless.live.all.size === 500 && skyless.state.assets.size === 500")
    rows = f"document.querySelectorAll('{NAMES}').length"
    shown.until(f"{rows} > 5")
    assert page.evaluate(rows) < 125
    assert not page.locator(f"{NAMES}:text-is('Thing 500')").count()
    page.evaluate("document.getElementById('panels').scrollTop = 1e6")
    page.locator(f"{NAMES}:text-is('Thing 500')").wait_for()
    assert page.evaluate(rows) < 125
    page.get_by_label("Find a tag").fill("ann")
    shown.until("document.querySelector('#panel-tags .count').textContent === '10 of 500 tags found'")
    assert shown.run("map/tags", "return tags.visibleTags().seen.filter(({ other }) => !other).length;") == 10
    page.fill("#panel-tags input[type=search]", "nobody")
    page.wait_for_selector("#panel-tags :text-is('No tag is found.')")
    page.click("#edit-assets")
    assert page.locator("#assets-dialog tbody tr").count() == 150
    page.get_by_label("Find in the table").fill("thing 499")
    page.get_by_label("Group of tag-499").fill("spares")
    page.keyboard.press("Tab")
    page.click("#assets-dialog button.primary")
    sent = server.body("assets")["assets"]
    assert (len(sent), sent[498]) == (500, asset("tag-499", "Thing 499", "spares"))


def test_assets_are_added_changed_and_removed_with_the_keyboard(hall):
    server, visit = hall
    page = visit.page
    page.focus("#edit-assets")
    page.keyboard.press("Enter")
    dialog = page.locator("#assets-dialog")
    save = dialog.get_by_role("button", name="Save")
    dialog.get_by_role("button", name="Add", exact=True).focus()
    page.keyboard.press("Enter")
    for words in ("trolley", "Robot 1"):  # the new row has the focus
        page.keyboard.type(words)
        page.keyboard.press("Tab")
    server.errors["assets"] = "asset 'trolley': the tag has two assets; it should have one"
    save.press("Enter")
    page.wait_for_selector("#assets-dialog .fault:has-text('the tag has two assets')")
    server.errors.clear()
    assert page.evaluate("[...skyless.state.assets.values()].map(({ name }) => name)") == ["Linde 3", "Cart 1"]
    dialog.locator(".new .asset-tag").fill("robot")
    page.keyboard.press("Tab")
    colour = dialog.get_by_label("Colour of robot", exact=True)
    colour.fill("red")
    page.keyboard.press("Tab")
    save.click()
    assert page.evaluate("document.activeElement.validationMessage") != ""
    colour.fill("#c2410c")
    page.keyboard.press("Tab")
    dialog.get_by_role("button", name="Remove trolley").press("Enter")
    assert dialog.locator(".foot").inner_text().startswith("Not saved yet: 1 new, 0 changed, 1 removed.")
    page.keyboard.press("Escape")
    page.wait_for_selector("#assets-dialog .fault:has-text('not saved')")
    assert not server.bodies["assets"]
    save.click()
    robot = asset("robot", "Robot 1", colour="#c2410c")
    assert server.body("assets") == {"assets": [server.assets[0], robot], "site": "Hall 7"}
    dialog.wait_for(state="detached")
    visit.until("document.querySelector('#panel-tags tbody').innerText.includes('Robot 1')")
    visit.forgive()


def test_a_file_is_shown_before_it_is_sent_and_another_pages_changes_are_not_erased(hall, tmp_path):
    server, visit = hall
    page = visit.page
    page.click("#edit-assets")
    dialog, file = page.locator("#assets-dialog"), tmp_path / "assets.csv"
    for content, words in (
        ("tag,size\r\na,b\r\n", ".fault:has-text('column \"size\" is not known')"),
        ("tag,name\nforklift,Mine\nrobot,R\n", ".foot:has-text('1 new, 1 changed, 0 removed')"),
    ):
        file.write_text(content, encoding="utf-8")
        dialog.locator("input[type=file]").set_input_files(file)
        page.wait_for_selector(f"#assets-dialog {words}")
    assert visit.texts("#assets-dialog tbody .state") == ["+ new", "● changed", ""]
    linde, cart = server.assets
    server.assets = [{**linde, "name": "Theirs"}, {**cart, "name": "Cart 2"}]  # of which this page has not heard yet
    dialog.get_by_role("button", name="Save").click()
    page.wait_for_selector("#assets-dialog .said:has-text('Another page has saved forklift, trolley meanwhile')")
    assert "Both have changed forklift: saving keeps what stands here." in dialog.inner_text()
    assert dialog.get_by_label("Name of trolley").input_value() == "Cart 2"
    assert not server.bodies["assets"]
    server.assets.append(asset("drone", "Third"))
    dialog.get_by_role("button", name="Save").click()
    page.wait_for_selector("#assets-dialog .said:has-text('Another page has saved drone meanwhile')")
    dialog.get_by_role("button", name="Save").click()
    sent = {one["tag"]: one["name"] for one in server.body("assets")["assets"]}
    assert sent == {"forklift": "Mine", "trolley": "Cart 2", "robot": "R", "drone": "Third"}
    page.click("#edit-assets")
    assert visit.saved("#assets-dialog >> text=Export CSV")[0] == "assets.csv"
