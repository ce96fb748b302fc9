"""``skyless watch``: it has the page's condition; its picture fits the terminal and shows nothing old as new."""

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, Wire, fix, status
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.console import Console

from skyless.cli.common import plain
from skyless.cli.nodes.site_view import AnchorRow, Picture, SiteView, TagRow, drawn
from skyless.run.condition.monitor import Condition, Reason
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import AlarmMessage, Asset, AssetsMessage
from support.site_messages import anchor_health, tag_health

GOOD = Condition("good", "", (), None, None)
QUIET = Picture("lab", 1, True, 1000.0, "mqtt://here:1", None, GOOD, (), (), (), {}, 0)


@pytest.fixture
def view(times):
    """Of a connected broker that has the site."""
    view = SiteView(Wire(), SITE_ID, lambda: times.now_s, lambda: times.unix_s)
    connect(view)
    view.link.deliver(topics.site_topic(SITE_ID), SITE)
    return view


def connect(view, connected=True):
    for callback in view.link.on_state:
        callback(connected)


def alarm(subject, **more):
    one = AlarmMessage(f"r/{subject}", "r", "Rule", "inside", "warning", subject, 900.0, 900.0, f"{subject} is there")
    return replace(one, **more)


def lines(picture, width=80, height=24):
    console = Console(width=width, height=height, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(drawn(picture, height))
    return [line.rstrip() for line in console.export_text().splitlines()]


def all_is_well(send, times, tags=("t1", "t2"), anchors=range(1, 7)):
    for tag in tags:
        send(topics.status_topic(SITE_ID, "tag", tag), status("tag", tag))
        send(topics.health_topic(SITE_ID, "tag", tag), tag_health(tag, unix_s=times.unix_s))
        send(topics.fix_topic(SITE_ID, tag), fix(tag, times.unix_s))
    for number in anchors:
        heard = {str(other): 0.1 for other in range(1, 7) if other != number}
        send(topics.status_topic(SITE_ID, "anchor", number), status("anchor", str(number)))
        health = anchor_health(number, unix_s=times.unix_s, mode="free", heard_age_s=heard)
        send(topics.health_topic(SITE_ID, "anchor", number), health)


def test_a_tag_without_fixes_comes_first_and_its_age_is_in_words(view, times):
    for _ in range(4):
        all_is_well(view.link.deliver, times)
        times.move(0.5)
    for _ in range(4):
        all_is_well(view.link.deliver, times, ("t1",))
        view.link.deliver(topics.health_topic(SITE_ID, "tag", "t2"), tag_health("t2", reason="no-beacons"))
        times.move(1.0)
    view.evaluate()
    stale, fresh = view.picture().tags
    assert (stale.tag, stale.state, stale.health.reason) == ("t2", "no fix", "no-beacons")
    assert stale.age_s == pytest.approx(4.5, abs=0.01)
    assert (fresh.state, fresh.fix.anchors) == ("fix", (1, 2, 3, 4))
    shown = lines(view.picture())
    (row,) = [line for line in shown if line.startswith("t2 ")]
    assert "no fix for 4 s" in row or "no fix for 5 s" in row
    assert "no-beacons" in row
    assert "tags (2)" in "".join(shown)


def test_a_tag_has_the_name_of_its_asset_at_this_site(view, times):
    all_is_well(view.link.deliver, times)
    for site, shown in ((SITE.site.name, "Forklift 2"), ("", "Forklift 2"), ("another", "t2")):
        assets = AssetsMessage((Asset("t1", group="people"), Asset("t2", "Forklift 2")), site)
        view.link.deliver(topics.assets_topic(SITE_ID), assets)
        rows = [line for line in lines(view.picture()) if line.startswith(("t1 ", shown))]
        assert len(rows) == 2
        assert [row.tag for row in view.picture().tags] == ["t1", "t2"]
    view.link.deliver(topics.assets_topic(SITE_ID), b"{}")
    assert view.picture().unused == {"assets": 1}


def test_nothing_is_fresh_without_the_broker(view, times):
    all_is_well(view.link.deliver, times)
    connect(view, False)
    view.evaluate()
    assert {row.state for row in view.picture().tags} == {"no fix"}


def test_alarms_that_nobody_has_seen_come_first_and_go_with_their_topic(view):
    old, new = alarm("a", acknowledged_unix_s=950.0, acknowledged_by="Ada"), alarm("b", severity="critical")
    for one in (old, alarm("c"), new):
        view.link.deliver(topics.alarm_topic(SITE_ID, "r", one.subject), one)
    assert [one.subject for one in view.picture().alarms] == ["b", "c", "a"]
    view.link.deliver(topics.alarm_topic(SITE_ID, "r", "b"), b"")
    view.link.deliver(topics.alarm_topic(SITE_ID, "r", "c"), b"{}")
    assert [one.subject for one in view.picture().alarms] == ["c", "a"]
    assert view.picture().unused == {"alarm": 1}
    assert "not used here alarm 1" in lines(view.picture())
    assert "alarms (2)" in lines(view.picture())


def test_reasons_that_are_not_shown_are_counted():
    reasons = tuple(Reason(f"kind{n}", "warning", f"trouble {n}", f"advice {n}") for n in range(5))
    shown = lines(replace(QUIET, condition=replace(GOOD, level="warning", text="trouble 0", reasons=reasons)))
    assert shown[1:6] == ["trouble 0", "trouble 1", "trouble 2", "and 2 more", "advice 0"]


def test_an_anchor_that_is_silent_comes_first(view, times):
    all_is_well(view.link.deliver, times)
    times.move(4.0)
    all_is_well(view.link.deliver, times, anchors=(1, 2, 4, 5, 6))
    first, *others = view.picture().anchors
    assert (first.anchor, first.state, len(first.health.heard_age_s)) == ("3", "silent", 5)
    assert {row.state for row in others} == {"anchor"}
    assert any(line.startswith("3 ") and "silent" in line and "4 s ago" in line for line in lines(view.picture()))


@pytest.mark.site
@settings(max_examples=25)
@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 20), st.integers(80, 200), st.integers(24, 60))
def test_a_picture_fits_and_says_how_many_it_leaves_out(tags, anchors, alarms, width, height):
    rows = tuple(TagRow(f"tag{n}", "fix", 0.0, fix()) for n in range(tags))
    picture = replace(
        QUIET,
        tags=rows,
        anchors=tuple(AnchorRow(str(n), "anchor", 0.5) for n in range(anchors)),
        alarms=tuple(alarm(f"t{n}") for n in range(alarms)),
    )
    shown = lines(picture, width, height)
    assert len(shown) <= height
    assert max(map(len, shown)) <= width
    left_out = sum(int(line.split()[1]) for line in shown if line.startswith("and "))
    seen = sum(line.startswith("tag") and not line.startswith("tags") for line in shown)
    seen += sum(line[:1].isdecimal() and " anchor " in line for line in shown) + sum(
        " is there" in line for line in shown
    )
    assert seen + left_out == tags + anchors + alarms
    if tags + anchors + alarms < height - 6:
        assert left_out == 0


def test_long_names_and_figures_keep_their_columns_at_80():
    far = fix(position_m=(1234.56, -987.65, 12.34), std_m=0.123, hpl_m=1.5, anchors=tuple(range(24)),
              alert="detected-not-excluded")  # fmt: skip
    row = TagRow("tag-of-the-forklift-of-goods-in", "fix", 0.0, far, tag_health("", updates_per_s=345.0))
    line = lines(replace(QUIET, tags=(row,)))[2]
    for figure in ("1234.56", "-987.65", "12.34", "12.3", "150.0", "345", "24", "0.0 s", "FAULT"):
        assert f" {figure}" in line


@pytest.mark.site
@given(st.text())
def test_nothing_from_the_network_controls_the_terminal(text):
    assert plain(text).isprintable()
    picture = replace(QUIET, site=text, tags=(TagRow(text, "fix"),), trouble=text)
    assert all(line.isprintable() for line in lines(picture))


def test_the_picture_is_json(view, times):
    all_is_well(view.link.deliver, times)
    view.evaluate()
    assert msgspec.json.decode(msgspec.json.encode(view.picture()), type=Picture) == view.picture()
