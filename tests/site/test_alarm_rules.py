"""Rules of alarms: hours against the calendar, whom a rule concerns, and what a wrong rule is answered with."""

import contextlib
from datetime import datetime, timedelta

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.site import AlarmRule
from skyless.page._alarms import read_rules
from skyless.run.mqtt.messages import AlarmRulesMessage, WrongMessageError, site_message
from skyless.sim.lab import lab_site
from skyless.site.alarm_rules import MAX_RULES, BadAlarmRulesError, check_rules, read_hours
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
MINUTE = st.integers(0, 24 * 60 - 1)
MONDAY = datetime(2026, 11, 23)


@given(st.integers(0, 6), st.integers(0, 6), MINUTE, MINUTE, st.integers(0, 6), MINUTE)
def test_hours_are_those_of_the_calendar(first, last, begin, end, weekday, minute):
    text = f"{DAYS[first]}-{DAYS[last]} {begin // 60:02}:{begin % 60:02}-{end // 60:02}:{end % 60:02}"
    if begin == end:
        with pytest.raises(ValueError, match="mon-fri"):
            read_hours(text)
        return
    days = [(first + k) % 7 for k in range((last - first) % 7 + 1)]
    at = MONDAY + timedelta(days=weekday, minutes=minute)
    within = False
    for day in days:
        for week in (-7, 0, 7):
            start = MONDAY + timedelta(days=day + week, minutes=begin)
            stop = MONDAY + timedelta(days=day + week + (end < begin), minutes=end)
            within |= start <= at < stop
    assert read_hours(text).contain(weekday, minute) == within


@pytest.mark.parametrize(
    ("text", "within", "without"),
    [
        ("", [(0, 0), (6, 1439)], []),
        (
            "mon-fri 06:00-22:00, sat 08:00-12:00",
            [(0, 360), (4, 1319), (5, 480)],
            [(0, 359), (4, 1320), (5, 720), (6, 600)],
        ),
        ("22:00-06:00", [(0, 1320), (1, 359), (0, 0)], [(0, 360), (6, 1319)]),
        ("sun 22:00-06:00", [(6, 1320), (0, 359)], [(6, 0), (0, 360)]),
        ("sat-sun", [(5, 0), (6, 1439)], [(4, 1439), (0, 0)]),
        ("Mon 00:00-24:00", [(0, 0), (0, 1439)], [(1, 0)]),
        (" fri-mon 8:00 - 9:30 ", [(4, 480), (0, 569)], [(1, 480)]),
    ],
)
def test_hours_as_people_write_them(text, within, without):
    hours = read_hours(text)
    assert all(hours.contain(*at) for at in within)
    assert not any(hours.contain(*at) for at in without)


@given(st.text("adefhimnorstuw0123456789:-, \n\u0663\u00e9", max_size=30))
def test_any_text_gives_hours_or_an_error_that_says_what_is_right(text):
    try:
        read_hours(text)
    except ValueError as error:
        assert "mon-fri 06:00-22:00" in str(error)


@pytest.mark.parametrize(
    "text",
    ["mon-", "25:00-26:00", "06:60-07:00", "mo 06:00-07:00", "06:00", "mon,,tue", "24:00-03:00", ",", "24:01-03:00"],
)
def test_wrong_hours(text):
    with pytest.raises(ValueError, match="mon-fri"):
        read_hours(text)


@pytest.mark.parametrize(
    ("fields", "key", "words"),
    [
        ({"id": "a b", "kind": "silent", "after_s": 5.0}, "id", "letters, digits"),
        ({"id": "", "kind": "silent", "after_s": 5.0}, "id", "letters, digits"),
        ({"kind": "inside"}, "zone", "id of a zone"),
        ({"kind": "inside", "zone": "a/b"}, "zone", "id of a zone"),
        ({"kind": "inside", "zone": "z", "limit": 1.0}, "limit", "left out"),
        ({"kind": "silent"}, "after_s", "from 1"),
        ({"kind": "near"}, "limit", "distance in metres"),
        ({"kind": "near", "limit": 0.0}, "limit", "distance in metres"),
        ({"kind": "crowded", "zone": "z", "limit": 1.5}, "limit", "whole number"),
        ({"kind": "battery", "limit": 20.0}, "limit", "share"),
        ({"kind": "battery", "limit": 0.2, "hysteresis": 2.0}, "hysteresis", "from 0"),
        ({"kind": "anchor-offline", "tags": ("t",)}, "tags", "left out"),
        ({"kind": "silent", "after_s": 5.0, "tags": ("group:",)}, "tags", "group:NAME"),
        ({"kind": "near", "limit": 1.0, "others": ("x y",)}, "others", "group:NAME"),
        ({"kind": "silent", "after_s": 5.0, "hours": "never"}, "hours", "mon-fri"),
        ({"kind": "silent", "after_s": 5.0, "name": "two\nlines"}, "name", "a line"),
    ],
)
def test_a_wrong_rule_names_rule_key_value_and_what_is_right(fields, key, words):
    with pytest.raises(BadAlarmRulesError) as caught:
        check_rules([AlarmRule("good", "anchor-moved"), AlarmRule(**{"id": "a"} | fields)])
    error = caught.value
    assert (error.row, error.rule, error.key) == (1, fields.get("id", "a"), key)
    assert words in str(error)


def test_identifiers_are_unique_also_among_those_of_the_file():
    rule = AlarmRule("a", "anchor-moved")
    check_rules([rule])
    for rules, others in (([rule, rule], []), ([rule], [rule])):
        with pytest.raises(BadAlarmRulesError, match="no other rule"):
            check_rules(rules, others)
    with pytest.raises(BadAlarmRulesError, match=str(MAX_RULES)):
        check_rules([AlarmRule(f"r{k}", "anchor-moved") for k in range(MAX_RULES + 1)])


@given(st.binary(max_size=60) | st.just(b'{"rules": [{"id": "x", "kind": "other"}]}'))
def test_a_message_gives_rules_or_an_error(payload):
    message = AlarmRulesMessage((AlarmRule("a", "near", limit=2.0, tags=("group:people",)),), "hall")
    assert read_rules(msgspec.json.encode(message)) == message
    with contextlib.suppress(WrongMessageError, BadAlarmRulesError):
        assert read_rules(payload).rules is not None


FILE_RULE = (
    '[[alarms]]\nid = "cold"\nkind = "inside"\nzone = "cold-store"\nafter_s = 600\nhours = "mon-fri 06:00-22:00"\n'
)


def test_rules_are_written_to_a_site_file_and_travel_beside_the_site(tmp_path):
    near = AlarmRule("near", "near", name='Fork "7" – near', limit=2.5, tags=("group:forks",), others=("t1", "t2"))
    cold = AlarmRule("cold", "inside", zone="cold", after_s=600.0, severity="critical", hours="22:00-06:00")
    site = replace(lab_site(), alarms=(near, cold))
    path = tmp_path / "s.toml"
    path.write_text(site_template(site))
    assert load_site(path).alarms == (near, cold)
    message = site_message(site, simulated=True, unix_s=1.0)
    sent = msgspec.json.decode(msgspec.json.encode(message))
    assert "alarms" not in sent["site"]  # earlier versions refuse it there
    assert [rule["id"] for rule in sent["alarms"]] == ["near", "cold"]
    assert message.whole_site == site
    assert site_message(lab_site(), simulated=True, unix_s=1.0).whole_site == lab_site()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ('kind = "insid"', r'alarms\[0\].kind is "insid"; it should be one of inside'),
        ('kind = "inside"\nzones = "x"', r"alarms\[0\].zones"),
        ('kind = "silent"', r"alarms\[0\].zone \(rule cold\)"),
    ],
)
def test_a_wrong_rule_in_a_site_file(tmp_path, wrong, words):
    head = 'name = "s"\nid = 1\nmaster = 1\n[[anchors]]\nid = 1\nx_m = 0.0\ny_m = 0.0\n'
    (tmp_path / "s.toml").write_text(head + FILE_RULE.replace('kind = "inside"', wrong))
    with pytest.raises(ConfigurationError, match=words):
        load_site(tmp_path / "s.toml")
