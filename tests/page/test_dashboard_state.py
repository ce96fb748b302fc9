"""Messages to the page have the fields that it expects."""

import json

import pytest
from dashboard_builders import fix, status, truth
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.page.state import MAX_HEALTHS, PageRequest, Sent, SiteState
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth
from skyless.run.site_table import SiteTable
from support.site_messages import anchor_health

POSITION = ("name", "x_m", "y_m", "z_m", "vx", "vy")
ERRORS = ("cov_xx", "cov_xy", "cov_yy", "std_m", "error_m", "true_x", "true_y", "anchors_used", "chi2", "fix_unix_s")
LEVELS = ("hpl_m", "alert", "height_given", "std_z_m", "verified_age_s", "unverified")
FIELDS = POSITION + ERRORS + LEVELS + ("fresh_s", "sleep_s", "gone_s")


class State(SiteState):
    """A state whose table gets a fix of a tag at any time."""

    def __init__(self):
        super().__init__(SiteTable(0.0))
        self.given = 0

    def add_fix(self, fix, now_s, unix_s):
        self.given += 1
        self.table.add_fix(replace(fix, unix_s=fix.unix_s + 1e-6 * self.given), now_s).ended_unix_s = unix_s

    def add_health(self, name, health, now_s):
        self.table.add_health("anchor" if isinstance(health, AnchorHealth) else "ether", name, health, now_s)


def rows(state, since=0):
    return [dict(zip(FIELDS, row, strict=True)) for row in json.loads(state.state_since(since))["tags"]]


def test_a_row_has_the_fields_in_order():
    state = State()
    state.unix_s = 1000.0625
    covariance = (4e-4, 1e-4, 9.0, 1e-4, 2e-4, 9.0, 9.0, 9.0, 9.0)
    state.add_fix(
        fix(position_m=(1.25, 2.5, 0.75), velocity_mps=(0.5, -0.25, 0.1), covariance_m2=covariance), 0.0, 1000.0
    )
    message = json.loads(state.state_since(0))
    assert message["type"] == "state"
    assert message["unix_s"] == pytest.approx(1000.0625, abs=1e-3)
    position, errors = ("t1", 1.25, 2.5, 0.75, 0.5, -0.25), (4e-4, 1e-4, 2e-4, 0.01, None, None, None)
    assert message["tags"] == [[*position, *errors, 4, 2.5, 1000.0, None, None, 1, None, None, None, 2.5, 0.0, 900.0]]
    state.add_fix(fix(velocity_mps=None), 0.0, 1000.0)
    assert rows(state)[0]["vx"] is None


HEIGHT = {"covariance_m2": (4e-4, 0.0, 0.0, 0.0, 4e-4, 0.0, 0.0, 0.0, 9e-4)}
VERIFIED = {"time_s": 1000.0, "unverified": 0.1789}


@pytest.mark.parametrize(
    ("given_fields", "shown"),
    [
        *(
            ({"hpl_m": 0.123456, "alert": one}, {"hpl_m": 0.1235, "alert": one})
            for one in ("none", "unavailable", None)
        ),
        (HEIGHT | {"height_known": True}, {"height_given": 1, "std_z_m": None}),
        (HEIGHT | {"height_known": False}, {"height_given": 0, "std_z_m": 0.03}),
        (VERIFIED | {"verified_until_s": None}, {"verified_age_s": None, "unverified": None}),
        (VERIFIED | {"verified_until_s": 999.7}, {"verified_age_s": 0.3, "unverified": 0.179}),
        (VERIFIED | {"verified_until_s": 1000.0}, {"verified_age_s": 0.0, "unverified": 0.179}),
    ],
)
def test_rows_hold_levels_alerts_heights_and_how_far_a_fix_is_verified(given_fields, shown):
    state = State()
    state.add_fix(fix(**given_fields), 0.0, 1000.0)
    assert {name: rows(state)[0][name] for name in shown} == shown


@pytest.mark.parametrize(("unix_s", "shown_unix_s"), [(1000.4, 1000.4), (1000.6, 1000.0), (4600.0, 1000.0)])
def test_the_time_of_a_fix_whose_tag_has_a_wrong_clock_is_the_servers(unix_s, shown_unix_s):
    state = State()
    state.add_fix(fix(unix_s=unix_s), 0.0, 1000.0)
    state.unix_s = 1200.0  # a page that is opened much later gets the same time
    assert rows(state)[0]["fix_unix_s"] == shown_unix_s


def test_only_tags_with_a_newer_fix_are_sent_and_only_their_last():
    state = State()
    state.add_fix(fix("a"), 0.0, 1000.0)
    state.add_fix(fix("b"), 0.0, 1000.0)
    seen = state.table.fixes_serial
    state.add_fix(fix("b", position_m=(5.0, 5.0, 1.0)), 0.1, 1000.0)
    state.add_fix(fix("b", position_m=(6.0, 5.0, 1.0)), 0.2, 1000.0)
    assert [(row["name"], row["x_m"]) for row in rows(state, seen)] == [("b", 6.0)]
    assert {row["name"] for row in rows(state)} == {"a", "b"}
    assert rows(state, state.table.fixes_serial) == []


def test_readers_at_the_same_serial_share_the_bytes():
    state = State()
    state.add_fix(fix(), 0.0, 1000.0)
    assert state.state_since(0) is state.state_since(0)


def test_the_error_is_against_the_truth_moved_to_the_moment_of_the_fix():
    state = State()
    state.add_truth(truth(unix_s=999.9, position_m=(0.0, 0.0, 1.0), velocity_mps=(2.0, 1.0, 0.0)))
    state.add_truth(truth(unix_s=1000.05, position_m=(9.0, 9.0, 1.0), velocity_mps=(1.0, 0.0, 0.0)))
    state.add_truth(truth(unix_s=1000.2, position_m=(50.0, 50.0, 1.0)))
    state.add_fix(fix(unix_s=1000.0, position_m=(8.95, 9.04, 7.0)), 0.0, 1000.0)
    row = rows(state)[0]
    assert (row["true_x"], row["true_y"]) == (8.95, 9.0)
    assert row["error_m"] == pytest.approx(0.04)  # horizontal: the height was given
    state.add_fix(fix(unix_s=1000.0, position_m=(8.95, 9.04, 1.03), height_known=False), 0.0, 1000.0)
    assert rows(state)[0]["error_m"] == pytest.approx(0.05)


@pytest.mark.parametrize("late_s", [0.3, -0.3, 100.0])
def test_a_truth_of_another_time_gives_no_error(late_s):
    state = State()
    state.add_truth(truth(unix_s=1000.0 + late_s))
    state.add_fix(fix(unix_s=1000.0), 0.0, 1000.0)
    assert rows(state)[0]["error_m"] is None
    assert rows(state)[0]["true_x"] is None


def test_a_restarted_ether_is_accepted():
    state = State()
    state.add_truth(truth(unix_s=5000.0))
    state.add_truth(truth(unix_s=1000.0, position_m=(2.0, 2.0, 1.0)))
    state.add_fix(fix(unix_s=1000.0), 0.0, 1000.0)
    assert rows(state)[0]["error_m"] == 0.0


def health(state, sent=None):
    return json.loads(state.new_health(sent or Sent()))


def test_health_holds_the_newest_of_every_node():
    state = State()
    assert health(state) == {
        "type": "health",
        "whole": True,
        "anchors": [],
        "tags": [],
        "ether": None,
        "nodes": [],
        "conditions": {},
        "waiting": [],
        "dropped": {},
        "ages": {"anchors": {}, "tags": {}, "ether": {}},
    }
    state.add_health("2", anchor_health(1), 0.0)
    state.add_health("2", anchor_health(2), 1.0)
    state.add_health("air", EtherHealth(0.0, 1.0, 5, 0, {}, {}, 0, 0), 1.0)
    state.table.add_status(status(), 1.0)
    state.table.add_status(status(online=False), 1.0)
    state.now_s = 3.5
    state.table.drops["fix"] = 3
    message = health(state)
    assert [anchor["anchor"] for anchor in message["anchors"]] == [2]
    assert message["ether"]["transmissions"] == 5
    assert [(node["name"], node["online"]) for node in message["nodes"]] == [("t1", False)]
    assert message["dropped"] == {"fix": 3}
    assert message["ages"] == {"anchors": {"2": 2.5}, "tags": {}, "ether": {"air": 2.5}}


def test_a_page_gets_the_health_that_is_new_to_it():
    state, sent = State(), Sent()
    for name in ("1", "2"):
        state.add_health(name, anchor_health(int(name)), 1.0)
        state.table.add_status(status("anchor", name), 1.0)
    state.judge(1.0, blind=False)
    first = health(state, sent)
    assert (first["whole"], len(first["anchors"]), len(first["nodes"])) == (True, 2, 2)
    assert first["conditions"] == {"1": "good", "2": "good"}
    state.add_health("2", anchor_health(2), 4.0)
    state.table.add_status(status("anchor", "1", online=False), 1.0)
    state.judge(4.0, blind=False)
    then = health(state, sent)
    assert (then["whole"], [one["anchor"] for one in then["anchors"]]) == (False, [2])
    assert ([node["name"] for node in then["nodes"]], then["conditions"]) == (["1"], {"1": "bad"})
    state.judge(4.0, blind=False)
    nothing = health(state, sent)
    assert (nothing["anchors"], nothing["nodes"], nothing["conditions"], nothing["ages"]["anchors"]) == ([], [], {}, {})


def test_silence_makes_an_anchor_offline_only_while_the_server_can_hear():
    state = State()
    state.add_health("1", anchor_health(1), 0.0)
    for now_s, blind, kind in ((3.0, False, "good"), (9.0, True, "good"), (9.5, False, "bad"), (10.0, True, "bad")):
        state.judge(now_s, blind=blind)
        assert health(state)["conditions"] == {"1": kind}


def test_of_many_anchors_a_page_gets_all_conditions_and_the_healths_that_it_names():
    state, sent = State(), Sent()
    for n in range(MAX_HEALTHS + 1):
        state.add_health(str(n), anchor_health(n, role="master" if n == 7 else "anchor"), 0.0)
    state.judge(0.0, blind=False)
    first = health(state, sent)
    assert len(first["conditions"]) == MAX_HEALTHS + 1
    assert [one["anchor"] for one in first["anchors"]] == [7]
    sent.wanted = PageRequest(anchors=("9", "no such"))
    assert [one["anchor"] for one in health(state, sent)["anchors"]] == [9]
    assert health(state, sent)["anchors"] == []
    state.add_health("9", anchor_health(9), 1.0)
    state.add_health("8", anchor_health(8), 1.0)
    assert [one["anchor"] for one in health(state, sent)["anchors"]] == [9]


@pytest.mark.site
@given(
    st.lists(
        st.tuples(
            st.lists(st.tuples(st.integers(0, 11), st.integers(0, 9)), max_size=8),
            st.none() | st.tuples(st.integers(0, 9), st.integers(0, 9)),
            st.sets(st.integers(0, 14), max_size=3),
            st.sampled_from(["", "t1", "x"]),
            st.integers(1, 12),
        ),
        max_size=12,
    )
)
def test_a_page_always_has_the_newest_fix_of_just_the_tags_that_it_was_given(steps):
    """Whatever moves, and whatever it asks for; those that it names come first, and others only from its view."""
    state, sent = State(), Sent()
    newest, shown = {}, {}
    for serial, (moves, view, named, text, rows_wanted) in enumerate(steps):
        state.now_s = float(serial)
        for tag, x in moves:
            state.add_fix(fix(f"t{tag}", position_m=(float(x), 0.0, 1.0)), state.now_s, 1000.0)
            newest[f"t{tag}"] = float(x), state.now_s
        sent.wanted = PageRequest(
            None if view is None else (min(view), -1.0, max(view), 1.0),
            text,
            tuple(f"t{n}" for n in named),
            (),
            rows_wanted,
        )
        message = json.loads(state.new_state(sent) or '{"tags": []}')
        for name in message.get("left", []):
            shown.pop(name, None)
        shown |= {row[0]: row[1] for row in message["tags"]}
        assert shown == {name: newest[name][0] for name in shown}
        if len(newest) <= rows_wanted:
            assert shown.keys() == newest.keys()
            continue
        assert len(shown) <= rows_wanted
        wished = {f"t{n}" for n in named} & newest.keys()
        assert wished <= shown.keys() or len(shown) == rows_wanted
        low, high = (0.0, 9.0) if view is None else (min(view), max(view))
        for name in shown.keys() - wished:
            assert low <= newest[name][0] <= high or (text and text in name)
        if message["tags"]:
            inside = [x for x, _ in newest.values() if low <= x <= high]
            assert (message["of"], message["inside"]) == (len(newest), len(inside))
