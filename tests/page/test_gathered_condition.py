"""The condition of a site for a list of many sites: the page's, and what only a gather knows."""

import msgspec
import numpy as np
import pytest
from dashboard_builders import status
from msgspec.structs import replace
from test_dashboard_condition import anchor_health

from skyless.run.fix_batch import ALERTS, RECORD
from skyless.run.gather.node import SiteCondition
from skyless.run.gather.streams import TagName
from skyless.run.mqtt.messages import site_message
from skyless.run.mqtt.topics import health_topic, site_topic, status_topic
from skyless.sim.lab import lab_site
from support.site_messages import tag_health

SITE = replace(lab_site(100.0), name="hall")
ANCHORS = [str(anchor.id) for anchor in SITE.anchors]
NAMES = {1: TagName("ann", "here", 0.0), 2: TagName("bob", "here", 0.0)}


class Condition(SiteCondition):
    """That of a site, to which time and messages are given by the second."""

    def say(self, topic, message, now_s):
        self.on_message(topic, msgspec.json.encode(message), now_s)

    def second(self, now_s, *tags, alert=0, silent=(), idle=()):
        """Healths of its anchors and tags, and a batch."""
        for name in ANCHORS:
            if name not in silent:
                health = replace(anchor_health(int(name), now_s, 1), synchronised=name not in idle)
                self.say(health_topic(7, "anchor", name), health, now_s)
        records = np.zeros(len(tags), RECORD)
        records["tag"], records["flags"] = tags, alert
        self.on_batch(records, NAMES, now_s)

    def judged(self, now_s, drops=0, waiting=0):
        return self.reasons({"wrong": drops}, waiting, now_s)


@pytest.fixture
def condition():
    found = Condition(0.0)
    found.say(site_topic(7), site_message(SITE, simulated=True, unix_s=1.0), 0.0)
    return found


def test_a_site_without_fixes_is_bad_once_it_had_time_for_some(condition):
    condition.second(4.0)
    assert condition.judged(4.0) == ("good", [])
    condition.second(6.0)
    assert condition.judged(6.0) == ("bad", ["no tag is online"])
    for second in range(12, 40):
        condition.second(float(second), *((1, 2) if second < 25 else (2,)))
        assert condition.judged(second)[0] == ("degraded" if second >= 34 else "good")
        assert condition.tags_heard(second) == (1 if second >= 34 else 2)
    assert condition.judged(39.0)[1] == ["tag ann does not report any more"]
    condition.second(50.0)
    assert condition.judged(50.0) == ("bad", ["no positions, although 2 tags are online: they do not report"])


def test_a_tag_without_a_fix_says_why(condition):
    condition.say(status_topic(7, "tag", "ann"), status("tag", "ann"), 0.0)
    for second in range(8):
        condition.second(float(second), 2)
        condition.say(health_topic(7, "tag", "ann"), tag_health(tag="ann", reason="too-few-anchors"), second)
    assert condition.judged(7.0) == ("degraded", ["tag ann has no fix: too few anchors"])


def test_a_site_that_is_not_published_is_bad():
    condition = Condition(0.0)
    condition.second(1.0, 1)
    assert condition.judged(2.0) == ("bad", ["the site is not published: no anchor or emulated air is running"])


def test_alerts_anchors_and_what_only_a_gather_knows_degrade(condition):
    for second in range(12):
        condition.second(float(second), 1, silent=ANCHORS[1] if second < 10 else ())
        for name in (*ANCHORS, "99"):
            online = (second, name) not in {(6, ANCHORS[1]), (6, "99")}  # 99 is not of this site any more
            condition.say(status_topic(7, "anchor", name), status("anchor", name, online), float(second))
        condition.on_message(status_topic(7, "anchor", ANCHORS[2]), b"broken", float(second))
        if second == 6:
            assert condition.online() == {"anchor": len(ANCHORS) - 1}
            offline = f"anchor {ANCHORS[1]} of {len(ANCHORS)} is offline"
            assert condition.judged(6.0, 3) == ("degraded", [offline])
    condition.second(20.0, 1)
    assert condition.judged(20.0, 3) == ("good", [])  # they were dropped before
    waiting = ["6000 fixes wait for the stream", "2 fixes were dropped in the last minute"]
    assert condition.judged(21.0, 5, 6000) == ("degraded", waiting)
    for number, alert in enumerate(ALERTS, 1):
        condition.second(90.0 + 5.0 * number, 1, alert=number)
        assert condition.judged(90.0 + 5.0 * number, 5)[0] == {
            "none": "good",
            "unavailable": "good",
            "detected-excluded": "degraded",
        }.get(alert, "bad"), alert
