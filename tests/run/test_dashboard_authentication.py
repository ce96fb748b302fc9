"""What the page's server finds wrong with codes and keys: each cause is named, one cause is not reported as another."""

import pytest
from dashboard_builders import fix, status
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.keys.fault import Fault
from skyless.run.condition.evidence import Evidence
from skyless.run.condition.monitor import authentication_reasons
from skyless.run.site_table import SiteTable
from support.site_messages import anchor_health, tag_health

DAY_S = 86400.0
UNIX_S = 1e9
TAG = tag_health("t", unix_s=UNIX_S)
TRUSTING = replace(TAG, trust="open", is_verified=True)
ANCHOR = anchor_health(unix_s=UNIX_S, master=None, term=None, mode="free")
KEYED = replace(ANCHOR, chain=2, chain_ends_unix_s=UNIX_S + 400 * DAY_S)


class Site:
    """Nodes that report once a second what a test has set."""

    def __init__(self, anchors=KEYED, tags=TRUSTING):
        self.now_s = 100.0
        self.evidence = Evidence(SiteTable(0.0, "here"))
        self.anchors = {str(n): replace(anchors, anchor=n) for n in range(1, 7)}
        self.tags = {name: replace(tags, tag=name) for name in ("t1", "t2")}
        for kind, names in (("anchor", self.anchors), ("tag", self.tags)):
            for name in names:
                self.evidence.add_status(status(kind, name), self.now_s)

    def change(self, *names, **values):
        for name in names:
            nodes = self.anchors if name in self.anchors else self.tags
            nodes[name] = replace(nodes[name], **values)
        return self

    def run(self, seconds=10):
        """Pass time; the last reasons, by kind."""
        for _ in range(seconds):
            self.now_s += 1.0
            for name, health in self.anchors.items():
                self.evidence.add_health("anchor", name, health, self.now_s, UNIX_S)
            for name, health in self.tags.items():
                self.tags[name] = replace(health, receptions=health.receptions + 400)
                self.evidence.add_health("tag", name, self.tags[name], self.now_s, UNIX_S)
                self.evidence.add_fix(fix(name, UNIX_S + self.now_s), self.now_s, UNIX_S)
        return {reason.kind: reason for reason in authentication_reasons(self.evidence, self.now_s)}


@pytest.mark.parametrize(("anchors", "tags"), [(KEYED, TRUSTING), (KEYED, TAG), (ANCHOR, TAG)])
def test_nothing_is_found_where_all_is_well_nor_at_a_site_without_keys(anchors, tags):
    assert Site(anchors, tags).run() == {}


NO_CHAIN = {"chain": None, "code_fault": "no-chain"}
ENDED = NO_CHAIN | {"chain_ends_unix_s": UNIX_S - 1.0}
SAID = "are forged, or the anchor has another seed (found by 2 tags and anchor 2)"


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        ("t1", {"clock_error_s": 0.25}, "clock warning: the clock of tag t1 is 0.25 s ahead of the site's"),
        ("t1 t2", {"clock_error_s": -30.0, "is_verified": False}, "clock bad: the clocks of tags t1 and t2 differ"),
        ("t1 t2", {"clock_error_s": -30.0, "is_verified": False}, "clock bad: from the site's by up to 30.0 s"),
        ("t2", {"is_verified": False}, "not-verified bad: nothing that tag t2 receives is verified"),
        ("3", {"code_fault": "clock-wrong"}, "codes warning: anchor 3 sends no codes: its clock differs from those of"),
        ("2 3", NO_CHAIN, "codes warning: 2 and 3 send no codes: no key chain"),
        ("3", {"code_fault": "of a later version"}, "codes warning: anchor 3 sends no codes: of a later version"),
        ("3", {"chain": None, "chain_ends_unix_s": None}, "keys warning: anchor 3 has no keys, though 5 others have"),
        ("1", {"chain_ends_unix_s": UNIX_S + 12 * DAY_S}, "chain warning: chain of anchor 1 ends in 12 days"),
        ("1", {"chain_ends_unix_s": UNIX_S + 0.5 * DAY_S}, "chain warning: chain of anchor 1 ends in 12 hours"),
        ("1 2", ENDED, "chain-ended bad: the key chain of anchors 1 and 2 has ended: they send no codes"),
        ("t1 t2 2", {"faults": {"5": "bad-code"}}, "forged warning: beacons in the name of anchor 5 have a wrong code"),
        ("t1 t2 2", {"faults": {"5": "bad-code"}}, f"forged warning: a wrong code: they {SAID}"),
        ("t1", {"faults": {"5": "of a later version"}}, "forged warning: are not accepted (of a later version)"),
        ("t1", {"faults": {"99": "no-code"}}, "forged warning: beacons in the name of anchor 99 have no code"),
    ],
)
def test_each_cause_is_named_alone_and_gone_afterwards(names, values, expected):
    site, names = Site(), names.split()
    before = site.anchors | site.tags
    (kind, level), text = expected.split(": ", 1)[0].split(), expected.split(": ", 1)[1]
    reasons = site.change(*names, **values).run()
    assert reasons.keys() == {kind}
    assert reasons[kind].level == level
    assert text in reasons[kind].text
    assert reasons[kind].advice
    assert reasons[kind].names
    for name in names:
        site.change(name, **{key: getattr(before[name], key) for key in values})
    assert site.run() == {}


def test_a_chain_of_all_anchors_is_named_in_few_words():
    site = Site(replace(KEYED, chain_ends_unix_s=UNIX_S + 59.6 * DAY_S))
    assert site.run()["chain"].text == "the key chain of all 6 anchors ends in 59 days"
    site.change(*"123456", chain_ends_unix_s=UNIX_S - 1.0, code_fault="no-chain")
    assert site.run()["chain-ended"].text == "the key chain of all 6 anchors has ended: they send no codes"


def test_tags_with_a_key_at_a_site_without_codes_are_the_only_ones_with_a_reason():
    site = Site(ANCHOR).change("t1", "t2", is_verified=False, faults=dict.fromkeys("123456", "no-code"))
    reasons = site.run()
    assert reasons.keys() == {"not-verified"}
    assert reasons["not-verified"].text == "nothing that tags t1 and t2 receive is verified (no code)"


@pytest.mark.parametrize("fault", Fault)
def test_every_fault_of_a_beacon_has_words_of_its_own(fault):
    text = Site().change("t1", faults={"5": str(fault)}).run()["forged"].text
    of_beacons = {"bad-code", "repeated-frame", "no-code", "revoked-chain", "late-frame", "early-frame"}
    assert ("are not accepted" in text) == (fault not in of_beacons)


def test_an_anchor_with_a_wrong_seed_is_named_and_not_those_with_which_it_finds_fault():
    site = Site().change("5", faults=dict.fromkeys("12346", "bad-code"))
    site.change("1", "2", "3", "4", "6", "t1", faults={"5": "bad-code"})
    reason = site.run()["forged"]
    assert reason.names == ("anchor/5",)
    assert "found by tag t1 and 5 anchors" in reason.text


def test_each_of_two_anchors_may_be_the_one_with_the_wrong_seed():
    reason = Site().change("1", faults={"2": "bad-code"}).change("2", faults={"1": "bad-code"}).run()["forged"]
    assert reason.names == ("anchor/2", "anchor/1")


def test_forged_beacons_are_bad_where_a_tag_does_not_verify_them():
    site = Site().change("t1", faults={"5": "bad-code"}).change("t2", trust=None)
    reason = site.run()["forged"]
    assert reason.level == "bad"
    assert "Do not rely on tag t2" in reason.advice
    assert site.change("t1", faults={"5": "late-frame"}).run()["forged"].level == "warning"


def test_a_beacon_without_code_is_forged_only_where_its_anchor_sends_codes():
    site = Site().change("3", chain=None, code_fault="no-chain").change("t1", faults={"3": "no-code"})
    assert site.run().keys() == {"codes"}
    site.change("3", chain=2, code_fault=None)
    assert site.run(3) == {}, "the tag's fault may be of before"
    assert site.run(4).keys() == {"forged"}
    site.change("3", chain=None, chain_ends_unix_s=None)
    assert site.run().keys() == {"keys"}
    site.evidence.add_status(status("anchor", "3", online=False), site.now_s)
    del site.anchors["3"]
    assert site.run(3) == {}
    assert site.run().keys() == {"forged"}


def test_what_a_wrong_clock_explains_is_not_stated_of_others():
    site = Site().change("t1", clock_error_s=9.0, is_verified=False, faults=dict.fromkeys("123456", "late-frame"))
    assert site.run().keys() == {"clock"}
    reasons = site.change("t1", clock_error_s=None).run()
    assert reasons["not-verified"].text == "nothing that tag t1 receives is verified (late frame)"
    assert reasons.keys() == {"not-verified"}
    site = Site().change("2", code_fault="clock-wrong", faults=dict.fromkeys("13456", "early-frame"))
    assert site.run().keys() == {"codes"}


def test_a_tag_that_starts_or_receives_nothing_is_not_one_without_verified_beacons():
    site = Site().change("t1", is_verified=False)
    assert site.run(4) == {}
    assert site.run(4).keys() == {"not-verified"}
    silent = site.evidence.table.all("tag")["t1"]
    silent.previous = silent.health
    assert [*authentication_reasons(site.evidence, site.now_s)] == []


HEALTHS = st.fixed_dictionaries(
    {},
    optional={
        "chain": st.none() | st.integers(),
        "chain_ends_unix_s": st.none() | st.floats(allow_nan=False, allow_infinity=False),
        "code_fault": st.none() | st.sampled_from([*map(str, Fault)]) | st.text(max_size=3),
        "faults": st.dictionaries(
            st.sampled_from("1234567") | st.text(max_size=2), st.sampled_from([*map(str, Fault)])
        ),
        "trust": st.sampled_from([None, "open", "verified"]),
        "is_verified": st.booleans(),
        "clock_error_s": st.none() | st.floats(allow_nan=False, allow_infinity=False),
    },
)


@settings(max_examples=40)
@given(st.dictionaries(st.sampled_from(["1", "2", "3", "t1", "t2"]), HEALTHS))
def test_whatever_nodes_report_there_is_at_most_one_reason_of_a_kind(changes):
    site = Site()
    for name, values in changes.items():
        fields = (site.anchors | site.tags)[name].__struct_fields__
        site.change(name, **{key: value for key, value in values.items() if key in fields})
    site.run(2)
    site.run(6)
    reasons = [*authentication_reasons(site.evidence, site.now_s)]
    assert len({reason.kind for reason in reasons}) == len(reasons)
    assert all(reason.text and reason.advice for reason in reasons)
