"""The page shows how far tags' positions are verified, codes and keys of anchors, and phases, if there are any."""

import time

import pytest
from page_browser import until

from skyless.core.keys.fault import Fault

pytestmark = pytest.mark.statistical

DAY_S = 86400.0


@pytest.fixture
def hall(serve, visit):
    server = serve(mode="free")
    return server, visit(server).page


def facts(page, kind, name):
    """The facts of a tag or an anchor, by their names, as soon as it is shown."""
    page.click(f"#tab-{kind}s")
    page.click(f"#panel-{kind}s table button:has-text('{name}')")
    page.locator(f"#panel-{kind}s .detail h2:has-text('{name}')").wait_for()
    return f"""() => Object.fromEntries(
      [...document.querySelectorAll("#panel-{kind}s .detail .facts > div:not([hidden])")]
        .map((box) => [box.firstChild.innerText, [box.lastChild.innerText, box.lastChild.className]]))"""


def test_a_site_without_keys_looks_as_before(hall):
    _, page = hall
    shown = page.evaluate(facts(page, "tag", "forklift"))
    assert "Anchors used" in shown
    assert shown.keys().isdisjoint({"Verified", "Not accepted", "Clock"})
    shown = page.evaluate(facts(page, "anchor", "4"))
    assert "Heard" in shown
    assert shown.keys().isdisjoint({"Codes", "Key chain", "Not accepted"})
    assert "verified" not in page.locator("#panel-tags").inner_text()


def test_a_tag_says_how_far_its_position_is_verified(hall):
    server, page = hall
    server.tag_reports = {
        "forklift": {"trust": "open", "is_verified": True, "faults": {"3": "bad-code", "4": "of later"}},
        "trolley": {"trust": "verified", "is_verified": True},
        "robot": {"trust": "open", "is_verified": False, "clock_error_s": -3.25},
    }
    server.verified = {"forklift": (0.3, 0.18), "trolley": (0.0, 0.0)}
    read = facts(page, "tag", "forklift")
    until(page, f"/^up to 0.[3-9] s ago; 18.% of the last second's beacons not yet$/.test(({read})().Verified?.[0])")
    until(page, f"({read})()['Not accepted']")
    shown = page.evaluate(read)
    assert shown["Verified"][1] == ""
    assert shown["Not accepted"] == ["anchor 3: wrong code: forged, or another seed; anchor 4: of later", "bad"]
    read = facts(page, "tag", "trolley")
    until(page, f"/^up to 0.[0-9] s ago; only verified positions are given$/.test(({read})().Verified?.[0])")
    server.verified = {"trolley": (30.0, 0.5)}
    until(page, f"({read})().Verified[1] === 'warn'")
    read = facts(page, "tag", "robot")
    until(page, f"({read})().Verified?.[1] === 'bad'")
    shown = page.evaluate(read)
    assert (shown["Verified"][0], shown["Clock"]) == ("nothing is verified", ["3.3 s behind the site's", "bad"])
    assert page.locator("#panel-tags button.name:has-text('not verified')").all_inner_texts() == ["robot not verified"]
    server.tag_reports = {}
    page.locator("#panel-tags button.name:text-is('robot')").wait_for()


def test_a_tag_names_the_anchors_whose_phases_it_uses_and_whether_its_board_computes(hall):
    server, page = hall
    read = facts(page, "tag", "forklift")
    shown = page.evaluate(read)
    assert "Carrier phases" not in shown
    assert shown["Method"][0] == "joint"
    server.tag_reports = {"forklift": {"carrier_phase_anchors": [1, 2, 5], "on_board": True}}
    until(page, f"({read})()['Carrier phases']?.[0] === 'of anchors 1, 2, 5'")
    assert page.evaluate(read)["Method"][0].startswith("joint, on its board")
    server.tag_reports = {"forklift": {"carrier_phase_anchors": []}}
    until(page, f"!('Carrier phases' in ({read})())")


def test_an_anchor_shows_its_codes_its_key_chain_and_what_it_does_not_accept(hall):
    server, page = hall
    now = time.time()
    keyed = {"chain": 2, "chain_ends_unix_s": now + 400.5 * DAY_S}
    server.anchor_reports = dict.fromkeys(range(1, 8), keyed) | {
        2: keyed | {"code_fault": "clock-wrong"},
        3: keyed | {"chain_ends_unix_s": now + 20.5 * DAY_S, "faults": {"5": "bad-code"}},
        4: keyed | {"chain": None, "chain_ends_unix_s": now - DAY_S, "code_fault": "no-chain"},
    }
    expected = {
        "1": {"Codes": ["with each beacon", ""], "Key chain": ["in 400 days", ""]},
        "2": {"Codes": ["none: its clock is wrong", "warn"]},
        "3": {
            "Key chain": ["in 20 days", "warn"],
            "Not accepted": ["anchor 5: wrong code: forged, or another seed", "bad"],
        },
        "4": {"Codes": ["none: no key chain holds now", "warn"], "Key chain": ["ended on ", "bad"]},
        "8": {"Codes": ["none: it has no keys", "warn"]},
    }
    for anchor, wanted in expected.items():
        read = facts(page, "anchor", anchor)
        until(page, f"({read})().Codes")
        shown = page.evaluate(read)
        for name, (words, grade) in wanted.items():
            assert words in shown[name][0]
            assert shown[name][1] == grade
    assert "Key chain" not in page.evaluate(read)
    page.locator(
        "#panel-anchors tr.warn button:text-is('8 no codes')"
    ).wait_for()  # rows in view are drawn now and then
    assert page.locator("#panel-anchors tr.warn button").all_inner_texts() == ["2 no codes", "4 no codes", "8 no codes"]


def test_a_recording_shows_how_far_it_was_verified_and_nothing_of_the_live_site(hall):
    words = """async ([health, age_s, share]) => {
      const { verifiedWords } = await import("/page/panels/codes.js");
      return verifiedWords(health, age_s ?? NaN, share)?.words ?? null;
    }"""
    _, page = hall
    assert page.evaluate(words, [None, None, None]) is None
    assert page.evaluate(words, [None, 0.2, 0.0]) == "up to 0.2 s ago"
    assert page.evaluate(words, [None, 0.2, 0.001]) == "up to 0.2 s ago; 1\u00a0% of the last second's beacons not yet"
    assert page.evaluate(words, [{"trust": "open", "is_verified": True}, None, None]) == "not yet"


def test_every_fault_has_words(hall):
    _, page = hall
    names = page.evaluate("async () => Object.keys((await import('/page/panels/codes.js')).FAULTS)")
    assert names == [fault.value for fault in Fault]
