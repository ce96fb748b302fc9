"""While kernels are compiled the empty map says so with a count, in both themes and on a phone; then it goes."""

import pytest
from page_fake_site import condition


def preparation(done, total):
    return {"type": "preparation", "preparation": {"done": done, "total": total, "left_s": 25.0, "unix_s": 0.0}}


@pytest.mark.parametrize(
    "viewport", [{"width": 1440, "height": 900}, {"width": 390, "height": 844}], ids=["wide", "phone"]
)
def test_the_empty_map_shows_how_far_the_kernels_are_compiled(serve, visit, viewport):
    server = serve(tags=0, site=False)
    page = visit(server, viewport=viewport).page
    page.wait_for_selector("#waiting")
    assert page.locator("#preparation").is_hidden()
    server.condition = condition(level="waiting", text="waiting for the site's anchors")
    page.wait_for_selector("#condition-words:has-text('Waiting for the site')")
    server.send(preparation(0, 0))
    page.wait_for_selector("#preparation:has-text('Compiling the kernels')")
    page.wait_for_selector("#condition-words:has-text('Compiling')")
    assert page.locator("#waiting").is_hidden()
    server.send(preparation(37, 120))
    page.wait_for_selector("#preparation:has-text('Compiling 37 of 120 kernels')")
    assert page.locator("#preparation").inner_text().split("\n")[-1].startswith("About 25 s left.")
    assert page.evaluate("document.querySelector('#preparation progress').value") == pytest.approx(37 / 120)
    box = page.locator("#preparation progress").bounding_box()
    assert 0.0 < box["x"] < box["x"] + box["width"] < viewport["width"]
    server.send({"type": "preparation", "preparation": None})
    page.locator("#preparation").wait_for(state="hidden")
    page.wait_for_selector("#waiting")
    page.wait_for_selector("#condition-words:has-text('Waiting for the site')")
